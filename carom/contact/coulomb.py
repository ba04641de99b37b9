r"""Coulomb's law, exactly: the nonlinear complementarity problem of contacts with friction. Arrays only.

The problem, for each of a batch of `B` independent sets of `K` contacts in `d` = 2 or 3 dimensions, with `u = A f + v`
the velocities after the impact (normal first), for every contact:

    f_n >= lower,   u_n >= 0,   (f_n - lower) u_n = 0                       Signorini's condition (`lower` = 0)
    |f_t| <= mu f_n,   and where u_t is not zero   f_t = -mu f_n u_t / |u_t|     Coulomb's

It is the cone problem of `cones.py` with De Saxce's correction `u + mu |u_t| e_n` in place of `u` (G. De Saxce, Z.-Q.
Feng 1998; V. Acary, F. Cadoux, C. Lemarechal, J. Malick 2011), and no convex program. See `solve_coulomb_problem`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from carom.contact.batching import as_one_batch, by_size, contacts_used, solve_chosen
from carom.contact.cone_algebra import matvec, pick
from carom.contact.cones import apply, solve_cones
from carom.contact.coulomb_law import (
    DELTA,
    Judged,
    Modes,
    Problem,
    jacobian,
    judge,
    modes_at,
    scale,
    sensitivity_of,
    softened,
    sound,
)
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
BLOCK = {6: 128, 24: 64}
"""Problems solved together, by the most rows that one has (more rows: 32)."""


class CoulombSolution(NamedTuple):
    """Impulses `f` (N s), and by how much they miss the law, relative to each problem's own scale.

    The residual is infinite where the data were not finite, which makes the impulse NaN.
    """

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]


# --- Sweeps and steps -------------------------------------------------------------------------------------------


def _sweep(problem: Problem, y: Float[Array, "K d B"], sweeps) -> Float[Array, "K d B"]:
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


def _newton(problem: Problem, y: Float[Array, "K d B"], steps: int) -> Float[Array, "K d B"]:
    """Newton steps from `y`, each as long as makes `|H|` least of some lengths; the best impulse on the way."""

    class _Path(NamedTuple):
        y: Array
        modes: Modes
        best: Array
        least: Array
        step: Array

    def look(y: Array) -> tuple[Array, Array, Modes]:
        modes = modes_at(problem, y, matvec(problem.Q, y) + problem.q)
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
        best = jnp.asarray(jnp.where(better, y, path.best))
        return _Path(y, modes, best, jnp.minimum(value, path.least), path.step + 1)

    start = _Path(y, Modes.nothing(problem), y, jnp.full_like(y[0, 0], jnp.inf), jnp.asarray(0))
    return jax.lax.while_loop(keep_going, body, start).best


def _step(problem: Problem, modes: Modes, wanted: Bool[Array, ""]) -> Float[Array, "K d B"]:
    """The Newton step from where `modes` are, if it is `wanted`, or none."""

    def solve() -> Array:
        flat = jnp.moveaxis(-modes.H.reshape(-1, modes.H.shape[-1]), -1, 0)[..., None]
        change = jnp.linalg.solve(jacobian(problem, modes), flat)[..., 0]
        change = jnp.moveaxis(change, 0, -1).reshape(modes.H.shape)
        return jnp.where(jnp.isfinite(change), change, 0)

    return jax.lax.cond(wanted, solve, lambda: jnp.zeros_like(modes.H))


_POLISHING = 2


def _polish(problem: Problem, soft: Problem, y: Float[Array, "K d B"], steps: Bool[Array, ""]) -> Judged:
    """`y` less what the diagonal has changed of the velocities, if that meets the law better, and if `steps`.

    Then, of all impulses with the modes there, that of least norm, where it obeys the law.
    """

    def improve(count, best: Judged) -> Judged:
        last = count == _POLISHING + 1

        def least() -> Array:
            u = matvec(problem.Q, best.y) + problem.q
            return least_norm(problem.Q, problem.q, u, best.y, problem.mu, problem.lower)

        def moved() -> Array:
            return best.y + _step(soft, best.modes, steps & (count > 0))

        new = judge(problem, jax.lax.cond(last, least, moved))
        better = jnp.where(last, new.residual <= _SOLVED, new.residual < best.residual)
        return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best)

    unknown = Judged(y, Modes.nothing(problem), jnp.full_like(y[0, 0], jnp.inf))
    return jax.lax.fori_loop(0, _POLISHING + 2, improve, unknown)


class _Search(NamedTuple):
    swept: Float[Array, "K d B"]
    y: Float[Array, "K d B"]
    residual: Float[Array, " B"]
    round: Int[Array, ""]


def _search(problem: Problem, start: Float[Array, "K d B"], rounds: Int[Array, ""]) -> _Search:
    """Rounds of sweeps and Newton steps from `start`, until every problem is solved."""
    soft = softened(problem)

    def keep_going(search: _Search):
        return (search.round < rounds) & jnp.any(search.residual > _SOLVED)

    def smaller(state):
        y, delta = state
        return _newton(softened(problem, delta), y, _STEPS), delta / 10

    def body(search: _Search) -> _Search:
        # Round -1 looks at the start.
        begun, again = search.round >= 0, search.round > 0
        swept = _sweep(soft, search.swept, jnp.where(again, _SWEEPS * 2**search.round, 0))
        # Every other round comes down from a large diagonal, with which there is one solution.
        first = jnp.where(begun, jnp.where(again & (search.round % 2 == 0), 0.1, DELTA), 0).astype(swept.dtype)
        y, _ = jax.lax.while_loop(lambda state: state[1] > 0.5 * DELTA, smaller, (swept, first))
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


def _solve_block(A, v, friction, lower, reference, start, rounds) -> CoulombSolution:
    """Solve one block of problems from `start` (N s), batch first in and out."""
    finite, (A, v, friction, lower, start) = sound(A, v, friction, lower, start)
    problem, size, unit = scale(A, v, friction, lower, reference)
    whole = size[:, None] * unit
    start = jnp.moveaxis(start, 0, -1) / jnp.where(whole > 0, whole, jnp.inf)
    found = _search(problem, start, jnp.max(rounds, initial=0))
    nan = jnp.asarray(jnp.where(finite, 0, jnp.nan), v.dtype)
    return CoulombSolution(jnp.moveaxis(found.y * whole + nan, -1, 0), jnp.where(finite, found.residual, jnp.inf))


def _solve_batch(A, v, friction, lower, reference) -> CoulombSolution:
    """Solve a batch block by block: problems without a contact cost nothing, those with few only their own room.

    What the first round does not solve is put together in blocks of its own.
    """
    batch, k, d = v.shape
    used = contacts_used(A, k)
    start = solve_cones(A, v, friction, lower, reference)
    out = CoulombSolution(
        impulse=jnp.zeros((batch, k, d), v.dtype), residual=jnp.where(used > 0, jnp.inf, jnp.zeros(batch, v.dtype))
    )

    def one_pass(count, out: CoulombSolution) -> CoulombSolution:
        rounds = jnp.full(batch, jnp.where(count == 0, 1, _ROUNDS))
        for size, chosen in by_size(used, k):
            m = size * d
            arrays = (A[:, :m, :m], v[:, :size], friction[:, :size], lower[:, :size], reference[:, :size])
            missing = chosen & ~(out.residual <= _SOLVED)
            block = next((size for most, size in BLOCK.items() if m <= most), 32)
            out = solve_chosen(_solve_block, (*arrays, start[:, :size], rounds), missing, block, out)
        return out

    return jax.lax.fori_loop(0, 2, one_pass, out)


_batched = as_one_batch(_solve_batch, "solver of Coulomb's law")
_sensitivity = as_one_batch(sensitivity_of, "solver of Coulomb's law")


@jax.custom_jvp
def _impulse(A, v, friction, lower, reference) -> CoulombSolution:
    return _batched(A, v, friction, lower, reference)


# The derivative. H(y; A, v, mu, lower) = 0 at the solution, with the modes that are there, gives
#
#     (dH/dy + dH/du A) df = -( dH/du (dA f + dv) + dH/dmu dmu + dH/dlower dlower )
#
# The matrix is that of the last Newton step, in scaled impulses. Everything on the right is linear in the tangents, so
# that both modes, vmap and jit follow from this rule.
@_impulse.defjvp
def _impulse_jvp(primals, tangents):
    dA, dv, dfriction, dlower, _ = tangents  # `reference` only sets a scale
    solution = _batched(*primals)
    f = solution.impulse
    out = _sensitivity(*primals, f)
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
