"""The trainer: one for every system and model. `learn` fits the unknowns of a skeleton to a dataset."""

import dataclasses
import itertools
import time
import warnings
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.checks import require
from carom.contact.impulses import CMr, ContactModel
from carom.errors import CaromError
from carom.learning.baselines import BASELINES, new_baseline, physical_quantities, with_baseline
from carom.learning.config import FORMULATIONS, LearnConfig
from carom.learning.dataset import Chunks, Dataset, closed_contacts, contact_flags
from carom.learning.models import NeuralPotential, Unknowns, mass_ratios
from carom.learning.optimizer import Rates, fresh_optimizer, learning_rate_schedule, make_optimizer
from carom.learning.progress import LoopProgress, training_text
from carom.learning.refine import Fit, can_be_refined, polish
from carom.learning.run import RunFolder
from carom.simulation.files import Recording
from carom.simulation.impact import Stepper
from carom.simulation.rollout import step
from carom.system import StepModel, System


@dataclasses.dataclass(frozen=True)
class LearnReport:
    """What a training came to. `mass_ratio` is to the first body."""

    friction: list[float]
    restitution: list[float]
    mass_ratio: list[float]
    train_loss: float | None
    """None where no epoch was needed: the refinement before the first was enough."""
    val_loss: float
    epochs: int
    seconds: float
    stopped_early: bool
    skipped_steps: int
    overflowed_contacts: int
    refined: bool
    """Whether what was kept is what a refinement ended with (see `LearnConfig.refine`)."""
    epsilon: float | None = None
    """Of the contact model CMr."""


class TrainState(eqx.Module):
    """Everything a training needs to go on from."""

    unknowns: Unknowns
    optimizer: Any
    best: Unknowns
    best_loss: Float[Array, ""]
    best_epoch: Int[Array, ""]
    epoch: Int[Array, ""]
    skipped: Int[Array, ""]
    overflow: Int[Array, ""]
    settled: Bool[Array, ""]  # masses and contact properties: they have been refined


def initial_unknowns(skeleton: System, config: LearnConfig, recording: Recording | None = None) -> Unknowns:
    """Starting values: equal masses, the configured friction and restitution, a random network scaled to `recording`.

    An epsilon that is learned starts from the skeleton's, whose contact model must be CMr.
    A potential of the skeleton that is itself a `NeuralPotential` is taken as the starting point.
    """
    floats = skeleton.friction.dtype
    count = skeleton.n_properties
    baseline = initial_baseline(skeleton, config)
    has = physical_quantities(skeleton if baseline is None else with_baseline(skeleton, baseline))

    def chosen(name, value):
        return value if name in config.learn and ("mass" if name == "potential" else name) in has else None

    key = jax.random.key(config.seed)
    potential = NeuralPotential.of(skeleton, recording, key=key, width=config.width, depth=config.depth)
    if isinstance(skeleton.potential, NeuralPotential):
        potential = skeleton.potential.extended(potential)
    return Unknowns(
        log_mass_ratio=chosen("mass", jnp.zeros(len(skeleton.bodies) - 1, floats)),
        friction=chosen("friction", jnp.full(count, config.initial_friction, floats)),
        restitution=chosen("restitution", jnp.full(count, config.initial_restitution, floats)),
        potential=chosen("potential", potential),
        log_epsilon=_initial_log_epsilon(skeleton) if config.epsilon == "learn" else None,
        contact_model=baseline if isinstance(baseline, ContactModel) else None,
        step_model=baseline if isinstance(baseline, StepModel) else None,
    )


def _initial_log_epsilon(skeleton: System) -> Float[Array, ""]:
    model = skeleton.contact_model
    if not isinstance(model, CMr) or float(model.epsilon) == 0:
        raise CaromError('epsilon "learn" starts from the skeleton\'s: its contact model must be CMr, epsilon above 0.')
    return jnp.log(model.epsilon)


def initial_baseline(skeleton: System, config: LearnConfig) -> ContactModel | StepModel | None:
    """The untrained network of a baseline; None for the others."""
    if config.model not in BASELINES:
        return None
    sizes = {"width": config.width, "depth": config.depth} if config.model == "mlp-cd-clnn" else {}
    return new_baseline(config.model, skeleton, jax.random.fold_in(jax.random.key(config.seed), 1), **sizes)


REFINE_AFTER = 0.4
"""Share of the epochs after which the unknowns are refined, potential included; again at the end.

If that is not enough, the network goes on learning with better masses, which it cannot tell from its own errors.
"""
EXACT = 0.01
"""A refinement ends that came to this share of what is enough."""
LOSS_WIDTH_DECAY = 1e-4
"""How narrow the quadratic part of the loss is at the end of a training, over its width at the start."""


def smooth_error(error: Float[Array, "*shape"], width: Float[Array, ""]) -> Float[Array, ""]:
    """Mean of `sqrt(error^2 + width^2) - width`: the mean absolute error but for a quadratic part of `width`.

    Masses and restitutions meet in valleys of the absolute error with sharp floors, along which no single quantity can
    move: the smooth floor of a wide loss lets them travel together; narrowing it then gives the exact fit of the
    absolute error (Charbonnier et al., 1994; graduated as in Blake and Zisserman, *Visual Reconstruction*, 1987).
    """
    return jnp.mean(jnp.sqrt(error**2 + width**2) - width)


def chunk_errors(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, x: Float[Array, "B L n d"], v: Float[Array, "B L n d"]
) -> tuple[Float[Array, "B M n d"], Float[Array, "B M n d"], Int[Array, ""]]:
    """Errors of positions (m) and velocities (m/s) predicted from each chunk's first state, for the others.

    Also how many closed contacts found no place in the solver.
    """
    system = unknowns.assemble(skeleton)

    def predict(x0, v0):
        def body(state, _):
            out = step(system, state[0], state[1], stepper)
            return (out.x, out.v), out

        return jax.lax.scan(body, (x0, v0), length=x.shape[1] - 1)[1]

    out = jax.vmap(predict)(x[:, 0], v[:, 0])
    return out.x - x[:, 1:], out.v - v[:, 1:], jnp.sum(out.overflow)


def chunk_loss(unknowns: Unknowns, skeleton: System, stepper: Stepper, x, v, width):
    """What is minimised, with (mean absolute error of positions plus that of velocities, overflow) beside it.

    `width` (m/s) is that of the quadratic part for velocities; for positions it is `width dt`.
    """
    error_x, error_v, overflow = chunk_errors(unknowns, skeleton, stepper, x, v)
    loss = smooth_error(error_x, width * stepper.dt) + smooth_error(error_v, width)
    return loss, (jnp.mean(jnp.abs(error_x)) + jnp.mean(jnp.abs(error_v)), overflow)


def gather_chunks(x, v, trajectory, start, length: int):
    """Chunks `(B, length, n, d)` of the recorded states."""
    times = start[:, None] + np.arange(length, dtype=np.int32)
    return x[trajectory[:, None], times], v[trajectory[:, None], times]


@eqx.filter_jit
def train_step(data, unknowns, opt_state, rates: Rates, stepper, length, width):
    """One step of the optimiser. A step whose gradient is not finite is left out and counted."""
    skeleton, x, v, trajectory, start = data
    chunk = gather_chunks(x, v, trajectory, start, length)
    gradient = eqx.filter_value_and_grad(chunk_loss, has_aux=True)
    (loss, (error, overflow)), grads = gradient(unknowns, skeleton, stepper, *chunk, width)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its counters with floats
        updates, new_state = make_optimizer(rates).update(grads, opt_state, eqx.filter(unknowns, eqx.is_inexact_array))
    new = eqx.apply_updates(unknowns, updates).project()
    finite = jnp.isfinite(loss)
    for leaf in jax.tree.leaves(grads):
        finite = finite & jnp.isfinite(leaf).all()

    def choose(a, b):
        return jnp.where(finite, a, b) if eqx.is_array(a) else a

    unknowns = jax.tree.map(choose, new, unknowns)
    opt_state = jax.tree.map(choose, new_state, opt_state)
    return unknowns, opt_state, error, overflow, ~finite


@eqx.filter_jit
def validate(unknowns, skeleton, x, v, stepper):
    """Mean absolute error of positions plus that of velocities, for chunks that are not trained on.

    And the same for the better nine tenths of the chunks.
    """
    error_x, error_v, _ = chunk_errors(unknowns, skeleton, stepper, x, v)
    chunk = jnp.mean(jnp.abs(error_x) + jnp.abs(error_v), axis=(1, 2, 3))
    return jnp.mean(chunk), jnp.mean(jnp.sort(chunk)[: max(1, chunk.size * 9 // 10)])


def fresh_state(skeleton: System, config: LearnConfig, recording: Recording | None = None) -> TrainState:
    """The state before the first epoch; a network is scaled to `recording`."""
    unknowns = initial_unknowns(skeleton, config, recording)
    zero = jnp.asarray(0)
    infinity = jnp.asarray(jnp.inf)
    optimizer = fresh_optimizer(unknowns, config)
    return TrainState(unknowns, optimizer, unknowns, infinity, zero, zero, zero, zero, jnp.asarray(False))


def check_dataset(skeleton: System, dataset: Dataset, config: LearnConfig) -> int:
    """Raise `CaromError` where data and skeleton do not fit; return the largest number of contacts closed at once."""
    shape = (skeleton.n_points, skeleton.dim)
    require(
        dataset.train.x.shape[2:] == shape,
        f"the data have {dataset.train.x.shape[2]} points in {dataset.train.x.shape[3]}D, the system has {shape[0]} in "
        f"{shape[1]}D. Is this a file of another task?",
    )
    require(
        int(dataset.train.length.max()) >= config.states,
        f"chunk_length is {config.states} states, but the longest training trajectory has "
        f"{int(dataset.train.length.max())}. Use longer trajectories or a shorter chunk.",
    )
    most = 0
    for name, part in (("train", dataset.train), ("val", dataset.val)):
        valid = part.valid
        drift = np.abs(np.asarray(skeleton.constraints(jnp.asarray(part.x[valid]))))
        limit = 5e-2
        require(
            drift.size == 0 or drift.max() <= limit,
            f"the {name} data do not fit the system's rods and joints: a constraint is off by "
            f"{drift.max() if drift.size else 0:.2g} m^2. Check units, order of the points and lengths.",
        )
        most = max(most, int(np.where(valid, closed_contacts(part.x, skeleton), 0).max()))
        check_not_inside(name, part, skeleton, valid)
    return most


def check_not_inside(name: str, part: Recording, skeleton: System, valid: np.ndarray) -> None:
    """Raise `CaromError` for recorded states with a body in a wall, or bodies through each other."""
    if not skeleton.contacts:
        return
    gaps = np.asarray(skeleton.gaps(jnp.asarray(part.x[valid])))
    through = gaps < -np.asarray(skeleton.reach()) - 1e-9
    if through.any():
        row, candidate = np.argwhere(through)[0]
        trajectory, sample = np.argwhere(valid)[row]
        bodies = [b for contact in skeleton.contacts for b in contact.bodies_of()][candidate]
        what = (
            f"body {bodies[0]} in a wall" if len(bodies) == 1 else f"bodies {bodies[0]} and {bodies[1]} in each other"
        )
        require(
            False,
            f"the {name} data have {what} (trajectory {trajectory}, sample {sample}, {-gaps[row, candidate]:.3g} m "
            f"deep, {int(through.any(axis=1).sum())} samples in all). Check units, radii and walls.",
        )


def learn(
    skeleton: System,
    dataset: Dataset,
    config: LearnConfig | None = None,
    *,
    run: RunFolder | None = None,
    progress: bool = True,
) -> tuple[System, LearnReport]:
    """Learn the unknowns of `skeleton` from `dataset`: a System like it, with a neural potential and learned numbers.

    **Arguments:**

    - `skeleton`: bodies, constraints and contacts with their geometry. Its masses (but that of the first body, the
      unit of all), potential, friction and restitution are not used where `config.learn` names them.
    - `dataset`: training and validation recordings.
    - `config`: how; see `LearnConfig`.
    - `run`: a folder to keep metrics and checkpoints in. If it holds a checkpoint, the training goes on from there.
    - `progress`: show it.

    **Returns:** the learned system (of the best validation loss), and a report. Unless `config.refine` is off, steps of
    Gauss and Newton refine it on the way and at the end (see `carom.learning.refine`), if that validates better. Its
    potential has no network if the data need none.

    **Raises:** `CaromError` if data, skeleton and configuration do not fit, or the loss stays not finite.
    """
    config = LearnConfig() if config is None else config
    config.check()
    skeleton = config.prepare(skeleton)
    if config.refine and skeleton.friction.dtype == jnp.float32:
        warnings.warn(
            "the system is in single precision, in which nothing is refined. For double precision, call "
            'jax.config.update("jax_enable_x64", True) before it is made; refine=False silences this.',
            stacklevel=2,
        )
    most = check_dataset(skeleton, dataset, config)
    # Room for as many contacts as the data ever close at once, and two more for predictions that stray.
    trained = skeleton.with_max_active(most + 2) if skeleton.contacts else skeleton
    train, val = dataset.train, dataset.val
    chunks = Chunks.of(contact_flags(train, skeleton), train.length, config.states)
    smooth, impact = chunks.count()
    require(smooth + impact > 0, "the training data have no chunk that starts without contact: nothing to learn from.")
    steps = config.steps_per_epoch
    state = fresh_state(skeleton, config, train)
    restored = run.restore_checkpoint(state) if run is not None else None
    if run is not None and restored is not None:
        state = restored
        run.rewind_metrics(int(state.epoch))
    elif run is not None and run.metrics():  # killed before its first checkpoint
        run.rewind_metrics(-1)
    stepper = Stepper(
        dt=jnp.asarray(train.dt),
        formulation=FORMULATIONS[config.model],
        project=config.project,
        compensation_steps=config.compensation_steps,
        consistent=True,
    )
    x, v = jnp.asarray(train.x), jnp.asarray(train.v)
    speed = float(np.sqrt(np.mean(train.v[train.valid] ** 2)))

    def width(epoch: int) -> Float[Array, ""]:
        done = (epoch - 1) / config.epochs
        return jnp.asarray(config.loss_width * speed * LOSS_WIDTH_DECAY**done, train.x.dtype)

    rate = learning_rate_schedule(config, config.epochs * steps)
    held_out = _validation_chunks(val, skeleton, config)
    last = run.metrics()[-1] if run is not None and restored is not None else {"seconds": 0.0}
    started = time.monotonic() - last["seconds"]
    loss = jnp.asarray(last.get("loss", np.nan))
    stopped = False
    refines = config.refine and can_be_refined(state.unknowns, trained)
    refine_at = round(REFINE_AFTER * config.epochs)
    enough = config.enough * speed

    def judge(unknowns: Unknowns) -> Fit:
        return Fit(*map(float, validate(unknowns, trained, *held_out, stepper)))

    def log(epoch: int, unknowns: Unknowns, **numbers: Any) -> dict[str, Any]:
        metrics = {
            "epoch": epoch,
            "step": epoch * steps,
            "seconds": round(time.monotonic() - started, 3),
            **numbers,
            **quantities(unknowns.assemble(skeleton)),
            "skipped_steps": int(state.skipped),
            "overflowed_contacts": int(state.overflow),
        }
        if run is not None:
            run.log(metrics)
        return metrics

    def just_refined(state: TrainState) -> bool:
        return bool(state.settled) and int(state.best_epoch) in (0, refine_at)

    def refined(unknowns: Unknowns, fit: Fit, *, whole: bool) -> tuple[Unknowns, Fit] | None:
        """Unknowns that validate better than these, and how well: of the simplest potential that is enough.

        `whole`: try the whole potential too. If not, this is the first time: each step is logged.
        """
        shown.say("refining ...")
        best, full, count = None, unknowns.potential, itertools.count(1)

        def extended(new: Unknowns) -> Unknowns:
            if full is None or new.potential is None:
                return new
            return dataclasses.replace(new, potential=new.potential.extended(full))

        def judge_step(new: Unknowns) -> Fit:
            found = judge(extended(new))
            if not whole:
                log(0, new, refinement=next(count), val_loss=found.mean)
            return found

        for potential in ([] if full is None else full.simpler()) + ([full] if whole or full is None else []):
            start = dataclasses.replace(unknowns, potential=potential)
            new, found = polish(start, trained, stepper, train, judge_step, EXACT * enough)
            if found.mean < fit.mean:
                best, fit = (extended(new), found), found
            if found.typical <= enough:
                break
        return best

    def settle(state: TrainState, better: tuple[Unknowns, Fit]) -> TrainState:
        """Go on from what was refined."""
        optimizer = fresh_optimizer(better[0], config)
        return dataclasses.replace(state, unknowns=better[0], optimizer=optimizer, settled=jnp.asarray(True))

    with LoopProgress("epoch", config.epochs, int(state.epoch), shown=progress) as shown:
        if refines and restored is None:
            fit = judge(state.unknowns)
            log(0, state.unknowns, refinement=0, val_loss=fit.mean)
            better = refined(state.unknowns, fit, whole=False)
            if better is not None:
                state = _keep_best(settle(state, better), better[1].mean, 0)
                if run is not None:
                    run.save_checkpoint(0, state)
        fit = judge(state.best)
        for epoch in range(int(state.epoch) + 1, config.epochs + 1):
            if just_refined(state) and fit.typical <= enough:
                stopped = True
                break
            state, loss = _epoch(state, epoch, trained, x, v, chunks, rate, stepper, width(epoch), config)
            now = judge(state.unknowns)
            if refines and epoch == refine_at:
                better = refined(state.unknowns, now, whole=True)
                if better is not None:
                    now, state = better[1], settle(state, better)
            if now.mean < float(state.best_loss):
                fit = now
            state = _keep_best(state, now.mean, epoch)
            learning_rate = float(np.asarray(rate(epoch * steps)))
            metrics = log(epoch, state.unknowns, loss=float(loss), val_loss=now.mean, learning_rate=learning_rate)
            if run is not None and (epoch % config.checkpoint_every == 0 or epoch in (refine_at, config.epochs)):
                run.save_checkpoint(epoch, state)
            shown.update(epoch, training_text(metrics))
            require(
                bool(jnp.isfinite(loss)) or epoch < 3 or not np.isinf(float(state.best_loss)),
                f"the training loss is not finite ({int(state.skipped)} steps left out). Check the data, or lower "
                "learning_rate.",
            )
            if epoch - int(state.best_epoch) >= config.patience:
                stopped = True
                break
        best = state.best
        again = not (just_refined(state) and int(state.epoch) == int(state.best_epoch))
        better = refined(best, fit, whole=True) if refines and again else None
        best, fit = (best, fit) if better is None else better
    if best.potential is not None:
        best = dataclasses.replace(best, potential=best.potential.pruned())
    system = best.assemble(skeleton)
    report = LearnReport(
        **quantities(system),
        train_loss=float(loss) if int(state.epoch) else None,
        val_loss=fit.mean,
        epochs=int(state.epoch),
        seconds=time.monotonic() - started,
        stopped_early=stopped,
        skipped_steps=int(state.skipped),
        overflowed_contacts=int(state.overflow),
        refined=just_refined(state) or better is not None,
    )
    return system, report


def _validation_chunks(val: Recording, skeleton: System, config: LearnConfig):
    """A fixed draw of one batch of chunks, evenly from the validation trajectories."""
    rng = np.random.default_rng((config.seed, 1))
    chunks = Chunks.of(contact_flags(val, skeleton), val.length, config.states)
    require(sum(chunks.count()) > 0, "the validation data have no chunk that starts without contact.")
    trajectory, start = chunks.draw(rng, config.batch_size, config.contact_share)
    return gather_chunks(jnp.asarray(val.x), jnp.asarray(val.v), trajectory, start, config.states)


def _epoch(state: TrainState, epoch: int, skeleton, x, v, chunks, rate, stepper, width, config):
    """Learn from `chunks_per_epoch` new chunks. Their choice depends on seed and epoch alone, so that it can resume."""
    rng = np.random.default_rng((config.seed, 0, epoch))
    unknowns, opt_state = state.unknowns, state.optimizer
    losses, overflow, skipped = [], state.overflow, state.skipped
    drawn = chunks.draw(rng, config.chunks_per_epoch, config.contact_share)
    done = (epoch - 1) * config.steps_per_epoch
    for count, first in enumerate(range(0, config.chunks_per_epoch, config.batch_size)):
        trajectory, start = (part[first : first + config.batch_size] for part in drawn)
        data = (skeleton, x, v, jnp.asarray(trajectory), jnp.asarray(start))
        unknowns, opt_state, loss, over, bad = train_step(
            data,
            unknowns,
            opt_state,
            Rates.of(config, rate(done + count), state.settled),
            stepper,
            config.states,
            width,
        )
        losses.append(loss)
        overflow, skipped = overflow + over, skipped + bad.astype(skipped.dtype)
    state = dataclasses.replace(
        state, unknowns=unknowns, optimizer=opt_state, epoch=jnp.asarray(epoch), overflow=overflow, skipped=skipped
    )
    return state, jnp.mean(jnp.stack(losses))


def _keep_best(state: TrainState, val_loss, epoch: int) -> TrainState:
    if not float(val_loss) < float(state.best_loss):
        return state
    return dataclasses.replace(
        state, best=state.unknowns, best_loss=jnp.asarray(val_loss), best_epoch=jnp.asarray(epoch)
    )


def quantities(system: System) -> dict[str, Any]:
    """The physical quantities of a system, for metrics and reports; epsilon too, of a contact model that has one.

    Empty lists for those a network replaces.
    """
    has = physical_quantities(system)
    out = {
        "friction": np.asarray(system.friction).tolist() if "friction" in has else [],
        "restitution": np.asarray(system.restitution).tolist() if "restitution" in has else [],
        "mass_ratio": mass_ratios(system).tolist() if "mass" in has else [],
    }
    if isinstance(system.contact_model, CMr):
        out["epsilon"] = float(system.contact_model.epsilon)
    return out
