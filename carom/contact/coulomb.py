r"""Coulomb's law, exactly: the nonlinear complementarity problem of contacts with friction. Arrays only.

The problem, for each of a batch of `B` independent sets of `K` contacts in `d` = 2 or 3 dimensions, with `u = A f + v`
the velocities after the impact (normal first), for every contact:

    f_n >= lower,   u_n >= 0,   (f_n - lower) u_n = 0                       Signorini's condition (`lower` = 0)
    |f_t| <= mu f_n,   and where u_t is not zero   f_t = -mu f_n u_t / |u_t|     Coulomb's

It is the cone problem of `cones.py` with De Saxce's correction `u + mu |u_t| e_n` in place of `u` (G. De Saxce, Z.-Q.
Feng 1998; V. Acary, F. Cadoux, C. Lemarechal, J. Malick 2011), and no convex program. See `solve_coulomb_problem`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from carom.contact.batching import as_one_batch, by_size, contacts_used, solve_chosen
from carom.contact.cone_algebra import dot, matvec, pick
from carom.contact.cones import apply, solve_cones
from carom.contact.least_norm import least_norm

# --- The method -------------------------------------------------------------------------------------------------
#
# Each contact is scaled by 1 / sqrt(A_nn), the whole problem by its largest velocity. With projections in place of
# inequalities (P. Alart, A. Curnier, A mixed formulation for frictional contact problems, 1991) the law is H(y) = 0,
#
#     H_n = y_n - max(lower, y_n - u_n)
#     H_t = y_t - proj(y_t - rho u_t, disc of radius mu max(lower, y_n - u_n)),    rho = 1 / (a bound of |A_tt|)
#
# semi-smooth. The law may have several solutions: what friction can hold may also slip. The start is the solution of
# the convex program (`cones.py`), whose velocities have the least energy: where something can be held it is held there,
# and then that is the solution. Newton steps onto the modes that are seen there (open or held by the bound, sticking,
# sliding) end in it elsewhere. Where they do not, sweeps of projected Gauss-Seidel follow, and steps with a diagonal
# that is made smaller by and by.
#
# Where A is singular the impulse is not unique. A diagonal `delta A_nn` on each contact's own block keeps the steps
# finite; a last step takes its effect on the velocities away. Of the impulses with the modes that are found the one of
# least norm is taken (`least_norm.py`): a diagonal alone selects it only to rounding over `delta`.

_DELTA = 1e-9
_SOLVED = 1e-10
"""Residual at which a problem counts as solved; that of a problem in single precision is larger by the ratio of eps."""
_CONVERGED = 1e-12
"""Newton steps go on until no |H| is larger."""
_SWEEPS = 24
_STEPS = 10
_ROUNDS = 8
"""Rounds of sweeps and steps, each with twice the sweeps of the last; most problems take the first, without any."""
_LENGTHS = (1.0, 0.5, 0.2, 0.05)
"""Shares of a Newton step that are tried."""
_NEAR_APEX = 1e-5
"""An impulse nearer to zero than this is at it, for the derivative by a bound of zero."""
BLOCK = {6: 128, 24: 64}
"""Problems solved together, by the most rows that one has (more rows: 32)."""


class CoulombSolution(NamedTuple):
    """Impulses `f` (N s), and by how much they miss the law, relative to each problem's own scale.

    The residual is infinite where the data were not finite, which makes the impulse NaN.
    """

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]


class _Problem(NamedTuple):
    """A batch of scaled problems, batch last."""

    Q: Float[Array, "n n B"]
    q: Float[Array, "K d B"]
    mu: Float[Array, "K B"]
    lower: Float[Array, "K B"]
    rho: Float[Array, "K B"]
    present: Bool[Array, "K B"]


class _Modes(NamedTuple):
    """How the law looks near an impulse: which rows say what. `H` and its derivative, both by `u` and `y`."""

    H: Float[Array, "K d B"]
    closes: Bool[Array, "K B"]  # u_n = 0, and not f_n = lower
    sticks: Bool[Array, "K B"]
    along: Float[Array, "K t B"]  # direction of y_t - rho u_t
    share: Float[Array, "K B"]  # radius / |y_t - rho u_t| of those that slide
    radius: Float[Array, "K B"]  # of the disc, per unit of mu

    @classmethod
    def nothing(cls, problem: _Problem) -> "_Modes":
        """Where nothing is known yet."""
        zeros, no = jnp.zeros_like(problem.q), jnp.zeros(problem.mu.shape, bool)
        return cls(zeros, no, no, zeros[:, 1:], zeros[:, 0], zeros[:, 0])


def _modes(problem: _Problem, y: Float[Array, "K d B"], u: Float[Array, "K d B"], apex: Array | bool = False) -> _Modes:
    """Modes at `y` with the velocities `u`; contacts in `apex` are held by their bound where `y` is next to zero."""
    trial = y[:, 0] - u[:, 0]
    closes = (trial > problem.lower) & ~(apex & (y[:, 0] < _NEAR_APEX))
    pressed = jnp.where(closes, trial, problem.lower)
    radius = problem.mu * pressed
    push = y[:, 1:] - problem.rho[:, None] * u[:, 1:]
    length = jnp.sqrt(dot(push, push))
    sticks = (length <= radius) & (radius > 0)
    safe = jnp.where(length > 0, length, 1)
    along = push / safe[:, None]
    share = jnp.where(sticks, 1.0, radius / safe)
    normal = jnp.where(closes, u[:, 0], y[:, 0] - problem.lower)
    tangent = jnp.where(sticks[:, None], problem.rho[:, None] * u[:, 1:], y[:, 1:] - radius[:, None] * along)
    H = jnp.concatenate([normal[:, None], tangent], axis=1)
    return _Modes(jnp.asarray(H), closes, sticks, along, jnp.asarray(share), pressed)


def _by_velocity(problem: _Problem, modes: _Modes, du: Float[Array, "K d m B"]) -> Float[Array, "K d m B"]:
    """`dH/du du`."""
    along, share = modes.along[:, :, None], modes.share[:, None, None]
    slides = ~modes.sticks
    normal = jnp.where(modes.closes[:, None], du[:, 0], 0)
    tangent = problem.rho[:, None, None] * du[:, 1:]
    across = tangent - along * jnp.sum(along * tangent, axis=1, keepdims=True)
    narrower = jnp.where(modes.closes, problem.mu, 0)[:, None, None] * along * du[:, :1]
    sliding = share * across + narrower
    tangent = jnp.where(slides[:, None, None], sliding, tangent)
    return jnp.concatenate([normal[:, None], tangent], axis=1)


def _by_impulse(problem: _Problem, modes: _Modes) -> Float[Array, "K d d B"]:
    """`dH/dy` of each contact at given velocities."""
    k, t, batch = modes.along.shape
    along, share = modes.along, modes.share
    eye = jnp.eye(t, dtype=along.dtype)[None, :, :, None]
    across = eye - along[:, :, None] * along[:, None]
    tangent = jnp.where(modes.sticks[:, None, None], 0, eye - share[:, None, None] * across)
    narrower = jnp.where(modes.sticks | ~modes.closes, 0, problem.mu)[:, None] * along
    first = jnp.where(modes.closes, 0, 1).astype(along.dtype)
    top = jnp.concatenate([first[:, None, None], jnp.zeros((k, 1, t, batch), along.dtype)], axis=2)
    return jnp.concatenate([top, jnp.concatenate([-narrower[:, :, None], tangent], axis=2)], axis=1)


def _jacobian(problem: _Problem, modes: _Modes) -> Float[Array, "B n n"]:
    """`dH/dy + dH/du Q`."""
    k, d, batch = problem.q.shape
    whole = _by_velocity(problem, modes, problem.Q.reshape(k, d, k * d, batch)).reshape(k, d, k, d, batch)
    index = jnp.arange(k)
    whole = whole.at[index, :, index].add(_by_impulse(problem, modes))
    return jnp.moveaxis(whole.reshape(k * d, k * d, batch), -1, 0)


def _softened(problem: _Problem, delta=_DELTA) -> _Problem:
    n = problem.Q.shape[0]
    return problem._replace(Q=problem.Q + delta * jnp.eye(n, dtype=problem.Q.dtype)[..., None])


class _Judged(NamedTuple):
    """An impulse and how it meets the law."""

    y: Float[Array, "K d B"]
    modes: _Modes
    residual: Float[Array, " B"]


def _judge(problem: _Problem, y: Float[Array, "K d B"]) -> _Judged:
    """Largest |H|: impulses relative to the largest, velocities to the largest term of `Q y + q`.

    Unlike `H` of the modes no mode can hide it: an impulse outside of its cone counts.
    """
    u = matvec(problem.Q, y) + problem.q
    modes = _modes(problem, y, u)
    impulse = jnp.maximum(jnp.max(jnp.abs(y), axis=(0, 1)), 1)
    velocity = jnp.maximum(jnp.max(matvec(jnp.abs(problem.Q), jnp.abs(y)), axis=(0, 1)), 1)
    by_velocity = jnp.concatenate([modes.closes[:, None], jnp.broadcast_to(modes.sticks[:, None], y[:, 1:].shape)], 1)
    parts = jnp.abs(modes.H) / jnp.where(by_velocity, velocity, impulse)
    # What keeps to its bound or its cone by H alone may still be pushed through it.
    approach = jnp.where(problem.present, jnp.maximum(-u[:, 0], 0), 0) / velocity
    outside = jnp.sqrt(dot(y[:, 1:], y[:, 1:])) - problem.mu * jnp.maximum(y[:, 0], 0)
    beyond = jnp.maximum(jnp.maximum(outside, problem.lower - y[:, 0]), 0) / impulse
    worst = jnp.max(jnp.concatenate([parts, approach[:, None], beyond[:, None]], axis=1), axis=(0, 1))
    return _Judged(y, modes, jnp.where(jnp.isfinite(worst), worst, jnp.inf))


# --- Sweeps and steps -------------------------------------------------------------------------------------------


def _sweep(problem: _Problem, y: Float[Array, "K d B"], sweeps) -> Float[Array, "K d B"]:
    """Projected Gauss-Seidel: each contact in turn meets the law as far as one step along its own block does."""
    k, d, batch = problem.q.shape
    rows = problem.Q.reshape(k, d, k * d, batch)

    def contact(i, y: Array) -> Array:
        u = jnp.sum(rows[i] * y.reshape(1, k * d, batch), axis=1) + problem.q[i]
        before = y[i]
        normal = jnp.maximum(before[0] - u[0], problem.lower[i])
        # The tangents see what the normal impulse has changed.
        tangent = u[1:] + rows[i, 1:].reshape(d - 1, k, d, batch)[:, i, 0] * (normal - before[0])
        moved = before[1:] - problem.rho[i] * tangent
        length = jnp.sqrt(jnp.sum(moved**2, axis=0))
        radius = problem.mu[i] * normal
        moved = moved * jnp.where(length > radius, radius / jnp.where(length > 0, length, 1), 1)
        return y.at[i].set(jnp.concatenate([normal[None], moved]))

    def body(_, y: Array) -> Array:
        return jax.lax.fori_loop(0, k, contact, y)

    return jax.lax.fori_loop(0, sweeps, body, y)


def _newton(problem: _Problem, y: Float[Array, "K d B"], steps: int) -> Float[Array, "K d B"]:
    """Newton steps from `y`, each as long as makes `|H|` least of some lengths; the best impulse on the way."""

    class _Path(NamedTuple):
        y: Array
        modes: _Modes
        best: Array
        least: Array
        step: Array

    def look(y: Array) -> tuple[Array, Array, _Modes]:
        modes = _modes(problem, y, matvec(problem.Q, y) + problem.q)
        return jnp.max(jnp.abs(modes.H), axis=(0, 1)), y, modes

    def keep_going(path: _Path):
        return (path.step <= steps) & jnp.any(path.least > _CONVERGED)

    def body(path: _Path) -> _Path:
        # The first time there is no step, only a look at the start.
        change = _step(problem, path.modes, path.step > 0)
        merits, *looks = jax.vmap(lambda length: look(path.y + length * change))(jnp.array(_LENGTHS, path.y.dtype))
        merits = jnp.where(jnp.isnan(merits), jnp.inf, merits)
        value, (y, modes) = jnp.min(merits, axis=0), pick(looks, jnp.argmin(merits, axis=0))
        better = value < path.least
        return _Path(y, modes, jnp.where(better, y, path.best), jnp.where(better, value, path.least), path.step + 1)

    start = _Path(y, _Modes.nothing(problem), y, jnp.full_like(y[0, 0], jnp.inf), jnp.asarray(0))
    return jax.lax.while_loop(keep_going, body, start).best


def _step(problem: _Problem, modes: _Modes, wanted: Bool[Array, ""]) -> Float[Array, "K d B"]:
    """The Newton step from where `modes` are, if it is `wanted`, or none."""

    def solve() -> Array:
        flat = jnp.moveaxis(-modes.H.reshape(-1, modes.H.shape[-1]), -1, 0)[..., None]
        change = jnp.linalg.solve(_jacobian(problem, modes), flat)[..., 0]
        change = jnp.moveaxis(change, 0, -1).reshape(modes.H.shape)
        return jnp.where(jnp.isfinite(change), change, 0)

    return jax.lax.cond(wanted, solve, lambda: jnp.zeros_like(modes.H))


_POLISHING = 2


def _polish(problem: _Problem, soft: _Problem, y: Float[Array, "K d B"], steps: Bool[Array, ""]) -> _Judged:
    """`y` less what the diagonal has changed of the velocities, if that meets the law better, and if `steps`.

    Then, of all impulses with the modes there, that of least norm, where it obeys the law.
    """

    def improve(count, best: _Judged) -> _Judged:
        last = count == _POLISHING + 1

        def least() -> Array:
            u = matvec(problem.Q, best.y) + problem.q
            return least_norm(problem.Q, problem.q, u, best.y, problem.mu, problem.lower)

        def moved() -> Array:
            return best.y + _step(soft, best.modes, steps & (count > 0))

        new = _judge(problem, jax.lax.cond(last, least, moved))
        better = jnp.where(last, new.residual <= _SOLVED, new.residual < best.residual)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    unknown = _Judged(y, _Modes.nothing(problem), jnp.full_like(y[0, 0], jnp.inf))
    return jax.lax.fori_loop(0, _POLISHING + 2, improve, unknown)


def _scale(A: Array, v: Array, friction: Array, lower: Array, reference: Array):
    """Batch first to a scaled problem, batch last; also what turns its impulses into physical ones, and velocities."""
    batch, k, d = v.shape
    A = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    index = jnp.arange(k)
    normal = A[index, 0, index, 0]
    present = normal > 0
    size = jnp.where(present, jax.lax.rsqrt(jnp.where(present, normal, 1)), 0)
    Q = size[:, None, None, None] * A * size[None, None, :, None]
    v, reference = jnp.moveaxis(v, 0, -1), jnp.moveaxis(reference, 0, -1)
    q = size[:, None] * v
    # Padding becomes: u_n = y_n + 1, with the solution 0.
    Q = Q.at[index, 0, index, 0].add(jnp.where(present, 0, 1))
    lower = jnp.where(present & (lower.T > 0), lower.T / jnp.where(present, size, 1), 0)
    largest = jnp.maximum(jnp.max(jnp.abs(q), axis=(0, 1)), jnp.max(lower, axis=0))
    largest = jnp.maximum(largest, jnp.max(jnp.abs(size[:, None] * reference), axis=(0, 1)))
    unit = jnp.maximum(largest, jnp.finfo(v.dtype).tiny ** 0.5)
    q = jnp.where(present[:, None], q / unit, jnp.zeros_like(q).at[:, 0].set(1))
    own = jnp.abs(Q[index, 1:, index, 1:])
    stiff = jnp.max(jnp.sum(own, axis=2), axis=1)
    rho = jnp.where(stiff > 0, 1 / jnp.where(stiff > 0, stiff, 1), 1)
    return _Problem(Q.reshape(k * d, k * d, batch), q, friction.T, lower / unit, rho, present), size, unit


class _Sensitivity(NamedTuple):
    """What the derivative needs, batch first and in physical units: `df = -inverse (by_u (dA f + dv) + ...)`."""

    matrix: Float[Array, "B n n"]  # dH/dy, which is solved with
    by_velocity: Float[Array, "B K d d"]  # dH/du of each contact
    by_friction: Float[Array, "B K d"]  # dH/dmu
    by_bound: Float[Array, "B K d"]  # dH/dlower
    size: Float[Array, "B K"]

    @classmethod
    def nothing(cls, batch: int, k: int, d: int, dtype) -> "_Sensitivity":
        """That of problems without contacts."""
        eye = jnp.broadcast_to(jnp.eye(k * d, dtype=dtype), (batch, k * d, k * d))
        zeros = jnp.zeros((batch, k, d), dtype)
        return cls(eye, jnp.zeros((batch, k, d, d), dtype), zeros, zeros, zeros[..., 0])


def _sensitivity(problem: _Problem, y: Array, bounded: Array, size: Array, unit: Array) -> _Sensitivity:
    k, d, batch = y.shape
    soft = _softened(problem)
    u = matvec(soft.Q, y) + problem.q
    # A bound of zero holds wherever the impulse is next to zero: the derivative is the one-sided one for a growing
    # bound, whichever side rounding has put the velocity on.
    modes = _modes(soft, y, u, bounded & (problem.lower == 0))
    eye = jnp.broadcast_to(jnp.eye(d, dtype=y.dtype)[None, :, :, None], (k, d, d, batch))
    by_velocity = _by_velocity(soft, modes, eye)
    slides = ~modes.sticks
    by_friction = jnp.where(slides[:, None], -modes.radius[:, None] * modes.along, 0)
    by_friction = jnp.concatenate([jnp.zeros_like(by_friction[:, :1]), by_friction], axis=1)
    held = jnp.where(modes.closes, 0, 1).astype(y.dtype)
    by_bound = jnp.where((slides & ~modes.closes)[:, None], -problem.mu[:, None] * modes.along, 0)
    by_bound = jnp.concatenate([-held[:, None], by_bound], axis=1)
    return _Sensitivity(
        matrix=_jacobian(soft, modes),
        by_velocity=jnp.moveaxis(by_velocity * size[:, None, None], -1, 0),
        by_friction=jnp.moveaxis(by_friction * unit, -1, 0),
        by_bound=jnp.moveaxis(by_bound / jnp.where(size > 0, size, 1)[:, None], -1, 0),
        size=size.T,
    )


class _Search(NamedTuple):
    swept: Float[Array, "K d B"]
    y: Float[Array, "K d B"]
    residual: Float[Array, " B"]
    round: Int[Array, ""]


def _search(problem: _Problem, start: Float[Array, "K d B"], rounds: Int[Array, ""]) -> _Search:
    """Rounds of sweeps and Newton steps from `start`, until every problem is solved."""
    soft = _softened(problem)

    def keep_going(search: _Search):
        return (search.round < rounds) & jnp.any(search.residual > _SOLVED)

    def smaller(state):
        y, delta = state
        return _newton(_softened(problem, delta), y, _STEPS), delta / 10

    def body(search: _Search) -> _Search:
        # Round -1 looks at the start.
        begun, again = search.round >= 0, search.round > 0
        swept = _sweep(soft, search.swept, jnp.where(again, _SWEEPS * 2**search.round, 0))
        # Every other round comes down from a large diagonal, with which there is one solution.
        first = jnp.where(begun, jnp.where(again & (search.round % 2 == 0), 0.1, _DELTA), 0).astype(swept.dtype)
        y, _ = jax.lax.while_loop(lambda state: state[1] > 0.5 * _DELTA, smaller, (swept, first))
        new = _polish(problem, soft, y, begun)
        better = ((new.residual < search.residual) & (search.residual > _SOLVED)) | ~begun
        y = jnp.where(better, new.y, search.y)
        # What is just between two modes (a contact that sticks with all the friction it has, one that only touches) is
        # seen as held, whatever rounding says.
        held = y.at[:, 0].multiply(1 + 1e-4).at[:, 0].add(1e-6)
        swept = jnp.where(begun, swept, held)
        return _Search(swept, y, jnp.where(better, new.residual, search.residual), search.round + 1)

    unknown = jnp.full_like(start[0, 0], jnp.inf)
    return jax.lax.while_loop(keep_going, body, _Search(start, start, unknown, jnp.asarray(-1)))


def _solve_block(A, v, friction, lower, reference, start, rounds, *, sensitivity: bool):
    """Solve one block of problems from `start` (N s), batch first in and out."""
    finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2)) & jnp.isfinite(friction).all(1)
    finite = finite & (lower < jnp.inf).all(1)

    def sound(x: Array) -> Array:
        return jnp.asarray(jnp.where(finite.reshape(-1, *(1,) * (x.ndim - 1)), x, 0))

    problem, size, unit = _scale(sound(A), sound(v), sound(friction), sound(lower), reference)
    scale = size[:, None] * unit
    start = jnp.moveaxis(sound(start), 0, -1) / jnp.where(scale > 0, scale, jnp.inf)
    found = _search(problem, start, jnp.max(rounds, initial=0))
    nan = jnp.asarray(jnp.where(finite, 0, jnp.nan), v.dtype)
    solution = CoulombSolution(jnp.moveaxis(found.y * scale + nan, -1, 0), jnp.where(finite, found.residual, jnp.inf))
    return solution, _sensitivity(problem, found.y, (lower >= 0).T, size, unit) if sensitivity else None


def _solve_batch(A, v, friction, lower, reference, *, sensitivity: bool):
    """Solve a batch block by block: problems without a contact cost nothing, those with few only their own room.

    What the first round does not solve is put together in blocks of its own.
    """
    batch, k, d = v.shape
    used = contacts_used(A, k)
    start = solve_cones(A, v, friction, lower, reference)
    solution = CoulombSolution(
        impulse=jnp.zeros((batch, k, d), v.dtype), residual=jnp.where(used > 0, jnp.inf, jnp.zeros(batch, v.dtype))
    )
    out = (solution, _Sensitivity.nothing(batch, k, d, v.dtype) if sensitivity else None)

    def one_pass(count, out):
        rounds = jnp.full(batch, jnp.where(count == 0, 1, _ROUNDS))
        for size, chosen in by_size(used, k):
            m = size * d
            arrays = (A[:, :m, :m], v[:, :size], friction[:, :size], lower[:, :size], reference[:, :size])
            missing = chosen & ~(out[0].residual <= _SOLVED)
            block = next((size for most, size in BLOCK.items() if m <= most), 32)
            solve = functools.partial(_solve_block, sensitivity=sensitivity)
            out = solve_chosen(solve, (*arrays, start[:, :size], rounds), missing, block, out)
        return out

    return jax.lax.fori_loop(0, 2, one_pass, out)


@functools.cache
def _batched(sensitivity: bool):
    """`_solve_batch`, whose batching under vmap is one larger batch."""
    return as_one_batch(functools.partial(_solve_batch, sensitivity=sensitivity), "solver of Coulomb's law")


@jax.custom_jvp
def _impulse(A, v, friction, lower, reference) -> CoulombSolution:
    return _batched(False)(A, v, friction, lower, reference)[0]


# The derivative. H(y; A, v, mu, lower) = 0 at the solution, with the modes that are there, gives
#
#     (dH/dy + dH/du A) df = -( dH/du (dA f + dv) + dH/dmu dmu + dH/dlower dlower )
#
# The matrix is that of the last Newton step, in scaled impulses. Everything on the right is linear in the tangents, so
# that both modes, vmap and jit follow from this rule.
@_impulse.defjvp
def _impulse_jvp(primals, tangents):
    dA, dv, dfriction, dlower, _ = tangents  # `reference` only sets a scale
    solution, out = _batched(True)(*primals)
    f = solution.impulse
    change = apply(dA, f) + dv
    rhs = jnp.einsum("bkij,bkj->bki", out.by_velocity, change)
    rhs = rhs + out.by_friction * dfriction[..., None] + out.by_bound * dlower[..., None]
    batch, k, d = f.shape
    y = jnp.linalg.solve(out.matrix, -rhs.reshape(batch, k * d, 1)).reshape(f.shape)
    return solution, CoulombSolution(y * out.size[..., None], jnp.zeros_like(solution.residual))


def solve_coulomb_problem(
    A: Float[Array, "B n n"],
    v: Float[Array, "B K d"],
    friction: Float[Array, "B K"],
    lower: Float[Array, "B K"] | None = None,
    *,
    reference: Float[Array, "B K d"] | None = None,
) -> CoulombSolution:
    """Impulses that obey Coulomb's law and Signorini's condition, for a batch of problems.

    **Arguments:** `A` (B, K d, K d), symmetric positive semi-definite, velocity per impulse (1 / kg); `v` (B, K, d),
    velocities of the contact points, normal first (m/s); `friction` (B, K), mu >= 0; `lower` (B, K), least normal
    impulses (N s), >= 0, or `None` for zero; `reference` (B, K, d), velocities (m/s) that `v` is what remains of, if
    so: what is small beside them is rounding. An entry of `lower` that is `-inf` is no bound, as `None` is for all.

    A contact whose normal entry of `A` is zero is padding and gets no impulse. Where the impulse is not unique it is
    the one of least norm, each contact weighted by its own mobility. Differentiable once, in both modes.

    **Source:** Alart and Curnier 1991; Acary and Brogliato, *Numerical Methods for Nonsmooth Dynamical Systems*, 2008.
    """
    dtype = v.dtype
    widest = jnp.zeros((), float).dtype
    work = widest if widest.itemsize > dtype.itemsize else dtype
    lower = jnp.full_like(friction, -jnp.inf) if lower is None else lower
    reference = jnp.zeros_like(v) if reference is None else jax.lax.stop_gradient(reference)
    out = _impulse(*(x.astype(work) for x in (A, v, friction, lower, reference)))
    return CoulombSolution(out.impulse.astype(dtype), out.residual.astype(dtype))
