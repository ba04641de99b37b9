"""Optimal control through contacts: what is chosen, what is wanted, and the optimiser that brings them together.

A problem is a `Control` object: how a motion follows from what is chosen (an initial state, forces over time, a
parameter of the system), what it costs, and by how much it misses. Derivatives run through the simulator; with
`impact="event"` they are right through impacts too (docs/gradients.md).
"""

import abc
import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from carom.checks import as_floats, require
from carom.learning.progress import LoopProgress
from carom.learning.run import RunFolder
from carom.mechanics.dynamics import Formulation
from carom.simulation.impact import COMPENSATION_STEPS, IMPACT_RULES, ImpactRule
from carom.simulation.rollout import Trajectory, check_trajectory, simulate
from carom.simulation.start_checks import check_initial_state
from carom.system import System

Choice = dict[str, Array]
"""What is chosen, by name."""
Play = Callable[[Choice], Trajectory]
OptimizerName = Literal["adam", "lbfgs"]
CHECKPOINT_EVERY = 20
"""Iterations between checkpoints."""


class Setup(NamedTuple):
    """What a choice means: the system that moves, its initial state, and forces over time (N)."""

    system: System
    x0: Float[Array, "n d"]
    v0: Float[Array, "n d"]
    force: Float[Array, "steps n d"] | None = None


class Control(eqx.Module):
    """A problem of optimal control. A new one is a class with these members."""

    name: eqx.AbstractVar[str]
    task: eqx.AbstractVar[str]  # the named system that it is about
    dt: eqx.AbstractVar[float]  # s
    steps: eqx.AbstractVar[int]
    optimizer: eqx.AbstractVar[OptimizerName]
    learning_rate: eqx.AbstractVar[float]  # of Adam, in the units of the choice
    unit: eqx.AbstractVar[str]  # of `miss`

    @abc.abstractmethod
    def start(self) -> Choice:
        """The choice to begin with, in SI units."""

    @abc.abstractmethod
    def setup(self, system: System, choice: Choice) -> Setup:
        """What `system`, the true or a learned one, does with a choice."""

    @abc.abstractmethod
    def loss(self, choice: Choice, motion: Trajectory) -> Float[Array, ""]:
        """What is made as small as can be."""

    @abc.abstractmethod
    def miss(self, motion: Trajectory) -> Float[Array, ""]:
        """By how much the motion misses what is wanted, in `unit`."""

    @abc.abstractmethod
    def scout(self, key: PRNGKeyArray, play: "Play") -> Choice | None:
        """Another choice to begin with, after a descent that has ended without success; None if there is none.

        **Arguments:** `key`, to draw from; `play`, from choices (batch first) to their motions.
        """

    @abc.abstractmethod
    def target(self) -> Float[np.ndarray, " d"] | None:
        """The place (m) that is aimed at, to draw; None where there is none."""


@dataclasses.dataclass(frozen=True)
class ControlConfig:
    """How to optimise. What is None is the problem's own."""

    iterations: int = 200
    """Most steps of the optimiser."""
    optimizer: OptimizerName | None = None
    """Adam, or L-BFGS with a line search; by default what suits the problem."""
    learning_rate: float | None = None
    """Of Adam, in the units of the choice; it falls to a hundredth along half a cosine."""
    impact: ImpactRule = "event"
    """How contacts act; with "step", derivatives through the time of impact are wrong."""
    max_events: int = 2
    """Most times at which a step is cut."""
    enough: float = 1e-6
    """Stop when the loss, mostly the square of the miss, is no more than the square of this."""
    patience: int = 10
    """A descent ends when the loss has not become smaller for so many iterations. Where another sequence of contacts
    may lead farther, the next one then begins elsewhere."""
    seed: int = 0
    """Of where that is."""

    def check(self) -> None:
        """Raise `CaromError` for values that make no sense."""
        for name in ("iterations", "max_events", "patience"):
            value = getattr(self, name)
            require(value >= 1, f"{name} must be at least 1; it was {value}.")
        names = get_args(OptimizerName)
        require(
            self.optimizer is None or self.optimizer in names,
            f"optimizer must be one of {list(names)}; it was {self.optimizer!r}.",
        )
        require(
            self.learning_rate is None or 0 < self.learning_rate < math.inf,
            f"learning_rate must be a positive number; it was {self.learning_rate}.",
        )
        require(self.impact in IMPACT_RULES, f"impact must be one of {sorted(IMPACT_RULES)}; it was {self.impact!r}.")
        require(self.enough >= 0, f"enough must not be negative; it was {self.enough}.")


class Physics(NamedTuple):
    """How a system is simulated, beside what the problem says; a learned one as it was learned."""

    formulation: Formulation = "lagrangian"
    compensation_steps: float | None = COMPENSATION_STEPS


AS_GIVEN = Physics()


@dataclasses.dataclass(frozen=True)
class ControlReport:
    """The best choice that was found, and how: losses and misses of each iteration, first of the start."""

    choice: Choice
    loss: float
    miss: float
    losses: list[float]
    misses: list[float]
    before: Trajectory
    after: Trajectory
    seconds: float


def perform(
    control: Control,
    system: System,
    choice: Choice,
    config: ControlConfig | None = None,
    physics: Physics = AS_GIVEN,
    *,
    throw: bool = True,
) -> Trajectory:
    """The motion of `system` with a choice.

    **Raises:** `CaromError` as `simulate` does, unless `throw` is false.
    """
    config = ControlConfig() if config is None else config
    setup = control.setup(system, choice)
    return simulate(
        setup.system,
        setup.x0,
        setup.v0,
        dt=control.dt,
        steps=control.steps,
        impact=config.impact,
        max_events=config.max_events,
        force=setup.force,
        formulation=physics.formulation,
        compensation_steps=physics.compensation_steps,
        throw=throw,
    )


class _State(NamedTuple):
    """What an iteration hands on: all that a run that was stopped needs to go on."""

    iteration: Int[Array, ""]
    choice: Choice
    optimizer: Any
    best: Choice
    best_loss: Float[Array, ""]
    lowest: Float[Array, ""]  # loss of this descent
    since: Int[Array, ""]  # iterations since it was lowered


class _Evaluation(NamedTuple):
    loss: Float[Array, ""]
    miss: Float[Array, ""]
    motion: Trajectory
    gradient: Choice

    def is_finite(self) -> bool:
        return all(bool(jnp.isfinite(part).all()) for part in jax.tree.leaves((self.loss, self.gradient)))


# The only program that is compiled: line search and optimiser call it, and are too small to be worth one.
@eqx.filter_jit
def _evaluate(control: Control, system: System, choice: Choice, config: ControlConfig, physics: Physics):
    def objective(choice):
        motion = perform(control, system, choice, config, physics, throw=False)
        return control.loss(choice, motion), (control.miss(motion), motion)

    (loss, (miss, motion)), gradient = jax.value_and_grad(objective, has_aux=True)(choice)
    return _Evaluation(loss, miss, motion, gradient)


MOST_HALVINGS = 10
"""Of a step of L-BFGS that does not make the loss smaller."""
_SUFFICIENT = 1e-4
"""Share of the decrease that the slope promises which a step of L-BFGS must bring (Armijo)."""


def _make_optimizer(control: Control, config: ControlConfig) -> tuple[optax.GradientTransformation, int]:
    """The optimiser, and how often its steps may be halved."""
    if (config.optimizer or control.optimizer) == "lbfgs":
        return optax.chain(optax.scale_by_lbfgs(), optax.scale(-1.0)), MOST_HALVINGS
    rate = config.learning_rate or control.learning_rate
    return optax.adam(optax.cosine_decay_schedule(rate, config.iterations, alpha=0.01)), 0


def optimize(
    control: Control,
    system: System,
    config: ControlConfig | None = None,
    *,
    physics: Physics = AS_GIVEN,
    start: Choice | None = None,
    run: RunFolder | None = None,
    progress: bool = True,
) -> ControlReport:
    """Find the choice with the least loss, by gradients through the simulator.

    **Arguments:**

    - `control`, the problem; `system`, the true or a learned one.
    - `config`, how to optimise; `physics`, how a learned system is to be simulated.
    - `start`, the choice to begin with, if not the problem's own.
    - `run`, a folder for checkpoints, one every `CHECKPOINT_EVERY` iterations: a run that was stopped goes on from the
      last.
    - `progress`: show it.

    **Raises:** `CaromError` for bad settings, a start that cannot be simulated, and a loss or gradient that is not
    finite.
    """
    config = ControlConfig() if config is None else config
    config.check()
    begun, first = time.monotonic(), control.start() if start is None else start
    setup = control.setup(system, first)
    check_initial_state(
        setup.system,
        as_floats(setup.x0),
        as_floats(setup.v0),
        dt=control.dt,
        compensation_steps=physics.compensation_steps,
    )
    optimizer, halvings = _make_optimizer(control, config)
    key = jax.random.key(config.seed)
    rows: list[dict[str, float]] = []

    def evaluate(choice: Choice) -> _Evaluation:
        return _evaluate(control, system, choice, config, physics)

    @jax.jit
    @jax.vmap
    def play(choice: Choice) -> Trajectory:
        return perform(control, system, choice, config, physics, throw=False)

    with (
        jax.numpy_dtype_promotion("standard"),  # optax mixes its counters with floats
        LoopProgress("iteration", config.iterations, shown=progress) as shown,
    ):
        begin = evaluate(first)
        check_trajectory(setup.system, begin.motion)
        infinite = jnp.asarray(jnp.inf, begin.loss.dtype)
        state = _State(
            jnp.asarray(0), first, optimizer.init(first), first, infinite, lowest=infinite, since=jnp.asarray(0)
        )
        now = begin
        if run is not None and (restored := run.restore_checkpoint(state)) is not None:
            state = restored
            run.rewind_metrics(int(state.iteration) - 1)
            rows = run.metrics()
            now = evaluate(state.choice)
        while True:
            k, loss = int(state.iteration), float(now.loss)
            require(
                now.is_finite(),
                f"the loss or its gradient is not finite in iteration {k} (loss {loss}). Use a smaller learning_rate, "
                "or another start.",
            )
            if run is not None and k > 0 and k % CHECKPOINT_EVERY == 0:
                run.save_checkpoint(k, state)
            rows.append({"epoch": k, "loss": loss, "miss": float(now.miss)})
            if run is not None:
                run.log(rows[-1])
            shown.update(k, f"loss {loss:.3e}  miss {float(now.miss):.2e} {control.unit}")
            state = _looked_at(state, now)
            enough = float(state.best_loss) <= config.enough**2
            if k == config.iterations or enough:
                break
            if int(state.since) >= config.patience:
                shown.say("the loss no longer falls ...")
                choice = control.scout(jax.random.fold_in(key, k), play)
                if choice is None:
                    break
                state = _restarted(state, choice, optimizer)
                now = evaluate(choice)
            else:
                state, now = _iterate(state, now, optimizer, halvings, evaluate, config.patience)
        best = evaluate(state.best)
    check_trajectory(setup.system, best.motion)
    return ControlReport(
        choice=state.best,
        loss=float(best.loss),
        miss=float(best.miss),
        losses=[row["loss"] for row in rows],
        misses=[row["miss"] for row in rows],
        before=begin.motion,
        after=best.motion,
        seconds=time.monotonic() - begun,
    )


_LOWER = 1e-6
"""By what share a loss must be lowered to count."""


def _looked_at(state: _State, now: _Evaluation) -> _State:
    """Keep the choice if it is the best, and count since when the loss has not been lowered."""
    if now.loss < state.best_loss:
        state = state._replace(best=state.choice, best_loss=now.loss)
    if now.loss < (1 - _LOWER) * state.lowest:
        return state._replace(lowest=now.loss, since=jnp.asarray(0))
    return state._replace(since=state.since + 1)


def _iterate(
    state: _State, now: _Evaluation, optimizer: optax.GradientTransformation, halvings: int, evaluate, patience: int
) -> tuple[_State, _Evaluation]:
    """One step of the optimiser, halved until the loss becomes smaller, if it may be; if it does not, none."""
    updates: Any
    updates, memory = optimizer.update(now.gradient, state.optimizer, state.choice)
    if halvings and _slope(updates, now) >= 0:  # what L-BFGS remembers is of another sequence of contacts
        updates, memory = optimizer.update(now.gradient, optimizer.init(state.choice), state.choice)
    following = state._replace(iteration=state.iteration + 1, optimizer=memory)
    for k in range(halvings + 1):
        choice = {name: value + 0.5**k * updates[name] for name, value in state.choice.items()}
        new = evaluate(choice)
        if not halvings or float(new.loss) <= float(now.loss) + _SUFFICIENT * 0.5**k * _slope(updates, now):
            return following._replace(choice=choice), new
    return following._replace(since=jnp.asarray(patience)), now


def _restarted(state: _State, choice: Choice, optimizer: optax.GradientTransformation) -> _State:
    """A new descent from `choice`."""
    return state._replace(
        iteration=state.iteration + 1,
        choice=choice,
        optimizer=optimizer.init(choice),
        lowest=jnp.full_like(state.lowest, jnp.inf),
        since=jnp.asarray(0),
    )


def _slope(updates: Choice, now: _Evaluation) -> float:
    """How the loss changes along a step, to first order."""
    return sum(float(jnp.vdot(updates[name], now.gradient[name])) for name in updates)
