"""Motions of many windows and their derivatives, by two programs: a step in which nothing can touch, and a part of one.

Each window goes on in its own time. Its next step is tried without contact first, all windows at once; those in which
a gap may close wait until there are enough of them to go on with contact, from one impact to the next (a segment). So
impacts cost what they cost, wherever they are, and windows of any length share the programs. Derivatives by the start
of a window and by the quantities are composed from those of single steps and segments, in forward mode.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from carom.learning.unknowns.quantities import Learned
from carom.simulation.events import closing_speed, hermite, touching
from carom.simulation.impact import ImpactRule, Stepper, smooth_flow
from carom.simulation.projection import project_state
from carom.simulation.rollout import step
from carom.simulation.segments import Progress, Segments, end_of_step
from carom.system import System

FREE, NEAR = 64, 32
"""Windows that are moved together, without and with contact."""
AT_ONCE = 4
"""Contacts that are closed at once in nearly all segments: the solver has room for more only where there are more."""
PLACES = 4
"""Places on the way of a step at which gaps are looked at, before it is said that none can close."""
INDEPENDENT = 1e-8
"""Constraints whose singular values are all above this share of the largest are independent."""
MARGIN = 0.05
"""Share of what a gap can change within a step by which it must stay open at these places."""


class Hits(NamedTuple):
    """Steps in which contacts changed velocities: of which window, at which step, and what that depends on."""

    window: Int[np.ndarray, " H"]
    step: Int[np.ndarray, " H"]
    jump: Float[np.ndarray, " H"]  # m/s
    by_theta: Float[
        np.ndarray, "H P"
    ]  # m/s, of velocities after it, by each free number, or of positions over the step
    closed: Bool[np.ndarray, "H C"]  # whose gaps can have closed


class Motion(NamedTuple):
    """Starts of windows, on their constraints, positions at their times, and derivatives by the start and theta."""

    start: Float[np.ndarray, "W 2 n d"]
    x: Float[np.ndarray, "W T R"]
    by_start: Float[np.ndarray, "W T R S"]
    by_theta: Float[np.ndarray, "W T R P"]
    hits: Hits


def _with_derivatives(one: Callable, ways: Float[Array, "S m"] | None, *at: Array):
    """`one` of arrays, which has something beside, and its derivatives by all their numbers as one matrix; by the first
    array as far as it moves along `ways`, if there are some."""
    flat, unravel = ravel_pytree(at)
    every = jnp.eye(len(flat), dtype=flat.dtype)
    along = every
    if ways is not None:
        size, m = ways.shape
        along = jnp.zeros((m + len(flat) - size, len(flat)), flat.dtype).at[:m, :size].set(ways.T)
        along = along.at[m:].set(every[size:])

    def push(t):
        return jax.jvp(lambda flat: one(*unravel(flat)), (flat,), (t,), has_aux=True)

    after, slopes, beside = jax.vmap(push, out_axes=(None, 0, None))(along)
    by = jnp.concatenate([part.reshape(len(along), -1) for part in jax.tree.leaves(slopes)], axis=1).T
    if ways is not None:
        by = jnp.concatenate([by[:, : ways.shape[1]] @ ways.T, by[:, ways.shape[1] :]], axis=1)
    return after, by, beside


def _ways(system: System, z: Float[Array, "2 n d"]) -> Float[Array, "S m"]:
    """Ways that a state can move along its constraints, of unit length and orthogonal."""
    flat, unravel = ravel_pytree(z)
    held = _ties(system, unravel)(flat)
    return jnp.linalg.qr(held.T, mode="complete")[0][:, len(held) :]


def _ties(system: System, unravel: Callable) -> Callable[[Array], Array]:
    """Derivatives of the constraints of a state, and of their rates, by it."""

    def missed(flat):
        z = unravel(flat)
        return jnp.concatenate(jax.jvp(system.constraints, (z[0],), (z[1],)))

    return jax.jacfwd(missed)


@eqx.filter_jit
def _constrained(learned: Learned, theta, z: Float[Array, "2 n d"]):
    """Singular values of what holds a state, relative to the largest, and whether theta has a part in that."""
    flat, unravel = ravel_pytree(z)
    values = jnp.linalg.svd(_ties(learned.assemble(theta), unravel)(flat), compute_uv=False)
    moved = jax.jacfwd(lambda theta: learned.assemble(theta).constraints(z[0]))(theta)
    return values / values[0], jnp.any(moved != 0)


@eqx.filter_jit
def _free_steps(learned: Learned, theta, z: Float[Array, "B 2 n d"], dt: Float[Array, " B"], rule, thin: bool):
    system = learned.assemble(theta)

    def alone(dt, z, theta):
        system = learned.assemble(theta)
        out = step(system, z[0], z[1], _stepper(learned, dt, rule, contact=False))
        return jnp.stack([out.x, out.v]), None

    def one(z, dt):
        after, slopes, _ = _with_derivatives(functools.partial(alone, dt), _ways(system, z) if thin else None, z, theta)
        if not system.contacts:
            return after, slopes, jnp.zeros(0, bool)
        start, end = (z[0], z[1]), (after[0], after[1])
        fastest, travel = closing_speed(system, start, end) * dt, system.travel()
        shares = jnp.linspace(0, 1, PLACES + 1)
        gaps = jax.vmap(lambda s: system.gaps(hermite(start, end, dt, s * dt)[0]))(shares)
        close = jnp.min(gaps, axis=0) <= MARGIN * fastest + touching(system, z[0])
        far = (fastest > travel) & (travel > 0) & (gaps[0] <= 2 * fastest)
        return after, slopes, close | far

    return jax.vmap(one)(z, dt)


def _segments(
    learned: Learned, theta, start: Float[Array, "B 2 n d"], dt: Float[Array, " B"], now: Progress, count, rule, thin
):
    """The next segments of steps: how far they are then, and the derivatives of that, (x, v, left), by the state, what
    is left and theta. By the rule of steps a step is one segment."""
    system = learned.assemble(theta)

    def segment(start, dt, now: Progress, count, z, left, theta):
        system, stepper = learned.assemble(theta), _stepper(learned, dt, rule)
        if rule == "step":
            out = step(system, z[0], z[1], stepper)
            return (jnp.stack([out.x, out.v]), 0 * left), now._replace(left=0 * left, overflow=out.overflow)
        inverse_mass = system.inverse_mass_matrix()
        forward = Segments(system, inverse_mass, stepper, smooth_flow(system, stepper, inverse_mass))
        end = forward(now._replace(x=z[0], v=z[1], left=left), count)
        out = end_of_step(system, Progress.begin(system, start[0], start[1], dt), end)
        x, v = (jnp.where(end.left > 0, *pair) for pair in ((end.x, out.x), (end.v, out.v)))
        return (jnp.stack([x, v]), end.left), end

    def one(start, dt, now: Progress, count):
        own = functools.partial(segment, start, dt, now, count)
        z = jnp.stack([now.x, now.v])
        after, slopes, end = _with_derivatives(own, _ways(system, z) if thin else None, z, now.left, theta)
        return end._replace(x=after[0][0], v=after[0][1]), slopes

    return jax.vmap(one)(start, dt, now, count)


QUICK = {"xla_cpu_use_fusion_emitters": False}
"""What XLA compiles a large program with in two thirds of the time, to code that takes a little longer."""


@functools.cache
def _compiled_segments() -> Callable:
    """`_segments`, compiled quickly by versions of XLA that can be told to."""
    try:
        jax.jit(lambda x: x, compiler_options=QUICK)(0.0)
    except jax.errors.JaxRuntimeError:
        return eqx.filter_jit(_segments)
    return eqx.filter_jit(_segments, compiler_options=QUICK)  # pyright: ignore[reportCallIssue] - not in its stub


@eqx.filter_jit
def _starts(learned: Learned, theta, z: Float[Array, "W 2 n d"]):
    """Starts brought onto the constraints, and the derivatives of that from there.

    Elsewhere steps off the constraints, which nothing tells, would seem to be told.
    """

    def onto(z, theta):
        system = learned.assemble(theta)
        return jnp.stack(project_state(system.constraints, z[0], z[1], system.inverse_mass_matrix(), steps=3)), None

    return jax.vmap(lambda z: _with_derivatives(onto, None, onto(z, theta)[0], theta)[:2])(z)


def _stepper(learned: Learned, dt: Float[Array, ""], rule: ImpactRule, contact: bool = True) -> Stepper:
    return Stepper(dt=dt, impact=rule, project=bool(learned.skeleton.links), contact=contact)


def _composed(own: Float[np.ndarray, "R s A"], before: Float[np.ndarray, "R S Q"]) -> Float[np.ndarray, "R s Q"]:
    """Derivatives of what has its `own` by a state and by theta, and whose state has those `before`.

    The last columns of both are those by theta.
    """
    size = before.shape[1]
    after = own[:, :, :size] @ before
    after[:, :, before.shape[2] - (own.shape[2] - size) :] += own[:, :, size:]
    return after


def _padded(rows: np.ndarray, size: int) -> np.ndarray:
    return rows[np.arange(size).clip(max=len(rows) - 1)]


class _Within:
    """Windows within a step, and the derivatives of how far they are by where they began it and by theta."""

    def __init__(self, learned: Learned, z: Float[np.ndarray, "W 2 n d"], P: int):
        system = learned.skeleton
        count, size, n = len(z), z[0].size, system.n_points
        self.all, self.few = learned, learned.with_max_active(min(AT_ONCE, system.max_active))
        self.state, self.left = np.zeros_like(z), np.zeros(count)
        self.acted, self.push = np.zeros((count, system.n_candidates), bool), np.zeros((count, n))
        self.segments = np.zeros(count, int)
        self.slopes = np.zeros((count, size + 1, size + P))

    def begin(self, rows: Int[np.ndarray, " R"], state: Float[np.ndarray, "W 2 n d"], dt: Float[np.ndarray, " R"]):
        """Begin a step of `dt` (s)."""
        self.state[rows], self.left[rows] = state[rows], dt
        self.acted[rows], self.push[rows], self.segments[rows], self.slopes[rows] = False, 0, 0, 0
        size = self.slopes.shape[1] - 1
        self.slopes[rows[:, None], np.arange(size), np.arange(size)] = 1

    def move_on(self, theta, rows, state, dt, rule: ImpactRule, thin: bool) -> Int[np.ndarray, " D"]:
        """Go on by a segment; which windows are at the end of their step."""
        end, own = self._segment(self.few, theta, rows, state, dt, rule, thin)
        over = np.flatnonzero(end.overflow > 0)
        if len(over) and self.all.skeleton.max_active > AT_ONCE:
            again = self._segment(self.all, theta, rows[over], state, dt[over], rule, thin)
            for part, full in zip(jax.tree.leaves((end, own)), jax.tree.leaves(again), strict=True):
                part[over] = full
        self.state[rows], self.left[rows] = np.stack([end.x, end.v], 1), end.left
        self.acted[rows], self.push[rows] = end.acted, end.push
        self.segments[rows] += 1
        self.slopes[rows] = _composed(own, self.slopes[rows])
        return rows[~(end.left > 0)]

    def _segment(self, learned: Learned, theta, rows, state, dt, rule: ImpactRule, thin: bool):
        padded = _padded(rows, NEAR)
        x, v, left, acted, push, count, start = (
            jnp.asarray(part[padded])
            for part in (self.state[:, 0], self.state[:, 1], self.left, self.acted, self.push, self.segments, state)
        )
        none = jnp.zeros(len(padded))
        now = Progress(x, v, left, acted, none > 0, none.astype(int), none, push)
        out = _compiled_segments()(learned, theta, start, jnp.asarray(_padded(dt, NEAR)), now, count, rule, thin)
        return jax.tree.map(lambda a: np.array(a)[: len(rows)], out)


class Flow:
    """How windows move: the quantities learned, and the rule of impacts."""

    def __init__(self, learned: Learned, rule: ImpactRule):
        self.learned = learned
        self.rule: ImpactRule = rule
        self.thin: bool | None = None

    @np.errstate(all="ignore")
    def compile(self, theta: Float[np.ndarray, " P"], x: Float[np.ndarray, "n d"], dt: float) -> None:
        """Compile what moves windows, by a step of `dt` (s) of a system at rest at `x` (m).

        Beside other work, in a thread: most of it does not hold up Python.
        """
        there, rule = jnp.asarray(theta), self.rule
        z = np.stack([x, np.zeros_like(x)])[None]
        thin = self._is_thin(there, z)
        state = jnp.asarray(np.repeat(z, FREE, axis=0))
        if self.learned.skeleton.links:
            state = _starts(self.learned, there, state)[0]
        _free_steps(self.learned, there, state, jnp.full(FREE, dt), rule, thin)
        if self.learned.skeleton.contacts:
            within, rows = _Within(self.learned, np.asarray(state[:NEAR]), len(theta)), np.arange(NEAR)
            within.begin(rows, np.asarray(state[:NEAR]), np.full(NEAR, dt))
            within.move_on(there, rows, np.asarray(state[:NEAR]), np.full(NEAR, dt), rule, thin)

    def _is_thin(self, theta: Array, z: Float[np.ndarray, "W 2 n d"]) -> bool:
        """Whether states may be moved along their constraints alone: these are independent, and the same for all theta.

        Else derivatives are by all numbers of a state.
        """
        if self.thin is None:
            self.thin = False
            if self.learned.skeleton.links:
                values, moved = _constrained(self.learned, theta, jnp.asarray(z[0]))
                self.thin = bool(values.min() > INDEPENDENT) and not bool(moved)
        return self.thin

    @np.errstate(over="ignore", invalid="ignore")  # motion that goes wrong is seen by who asks for it
    def __call__(
        self,
        theta: Float[np.ndarray, " P"],
        z: Float[np.ndarray, "W 2 n d"],
        steps: Float[np.ndarray, "W L"],
    ) -> Motion:
        """Positions (W, L + 1, n d) at the times that `steps` (s) lead to; NaN steps are none, behind the others."""
        count, most = steps.shape
        size, P = z[0].size, len(theta)
        there = jnp.asarray(theta)
        thin = self._is_thin(there, z)
        state = np.array(z, float)
        slopes = np.zeros((count, size, size + P))
        slopes[:, :, :size] = np.eye(size)
        if self.learned.skeleton.links:
            for rows in _batches(np.arange(count), FREE):
                out = _starts(self.learned, there, jnp.asarray(state[_padded(rows, FREE)]))
                state[rows], slopes[rows] = (np.asarray(a)[: len(rows)] for a in out)
        half, start = size // 2, state.copy()
        x = np.zeros((count, most + 1, half))
        by = np.zeros((count, most + 1, half, size + P))
        x[:, 0], by[:, 0] = state[:, 0].reshape(count, half), slopes[:, :half]
        length = np.isfinite(steps).sum(axis=1)
        at = np.zeros(count, int)
        waiting = np.zeros(count, bool)
        closed = np.zeros((count, self.learned.skeleton.n_candidates), bool)
        alone = np.zeros((count, half))
        hits: list[tuple] = []
        within = _Within(self.learned, z, P)

        def commit(rows, new, by_start_and_theta):
            state[rows], slopes[rows] = new, by_start_and_theta
            at[rows] += 1
            x[rows, at[rows]], by[rows, at[rows]] = state[rows, 0].reshape(-1, half), slopes[rows, :half]

        while True:
            going = np.flatnonzero((at < length) & ~waiting)
            for rows in _batches(going, FREE):
                padded = _padded(rows, FREE)
                out = _free_steps(
                    self.learned,
                    there,
                    jnp.asarray(state[padded]),
                    jnp.asarray(steps[padded, at[padded]]),
                    self.rule,
                    thin,
                )
                new, own, near = (np.asarray(a)[: len(rows)] for a in out)
                touch = near.any(axis=1)
                waiting[rows[touch]], closed[rows[touch]] = True, near[touch]
                alone[rows[touch]] = new[touch, 1].reshape(-1, half)
                within.begin(rows[touch], state, steps[rows[touch], at[rows[touch]]])
                commit(rows[~touch], new[~touch], _composed(own[~touch], slopes[rows[~touch]]))
            queue = np.flatnonzero(waiting)
            if not len(queue) and not len(going):
                break
            if len(queue) < NEAR and np.any((at < length) & ~waiting):
                continue
            for rows in _batches(queue, NEAR):
                done = within.move_on(there, rows, state, steps[rows, at[rows]], self.rule, thin)
                rows, new, own = done, within.state[done], within.slopes[done][:, :-1]
                jump = np.linalg.norm(new[:, 1].reshape(-1, half) - alone[rows], axis=1)
                hit = jump > 1e-9 * np.linalg.norm(alone[rows], axis=1)
                if hit.any():
                    strength = _strength(own[hit][:, :, size:], steps[rows, at[rows]][hit])
                    hits.append((rows[hit], at[rows][hit], jump[hit], strength, closed[rows][hit]))
                commit(rows, new, _composed(own, slopes[rows]))
                waiting[rows] = False
        joined = [np.concatenate(parts) for parts in zip(*hits, strict=True)] if hits else None
        found = Hits(*joined) if joined else _none(P, closed.shape[1])
        return Motion(start, x, by[..., :size], by[..., size:], found)


def _none(P: int, C: int) -> Hits:
    zero = np.zeros(0, int)
    return Hits(zero, zero, np.zeros(0), np.zeros((0, P)), np.zeros((0, C), bool))


def _batches(rows: np.ndarray, size: int):
    for first in range(0, len(rows), size):
        yield rows[first : first + size]


def _strength(by_theta: Float[np.ndarray, "H S P"], dt: Float[np.ndarray, " H"]) -> Float[np.ndarray, "H P"]:
    half = by_theta.shape[1] // 2
    places, speeds = (np.linalg.norm(part, axis=1) for part in (by_theta[:, :half], by_theta[:, half:]))
    return np.maximum(places / dt[:, None], speeds)
