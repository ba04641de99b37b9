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
from carom.contact.cone_algebra import apply, dot, matvec, pick
from carom.contact.cones import solve_cones
from carom.contact.coulomb_law import (
    DELTA,
    Judged,
    Modes,
    Problem,
    Scaled,
    jacobian,
    judge,
    modes_at,
    sensitivity_of,
    softened,
)
from carom.contact.least_norm import are_redundant, least_norm
from carom.contact.selection import selected

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
# least norm is taken (`least_norm.py`): a diagonal alone selects it only to rounding over `delta`. What nearly is a
# solution may have one in that, too. So neither rounding nor the frame says which of several solutions is found.

_SOLVED = 1e-10
"""Residual at which a problem counts as solved."""
_CONVERGED = 1e-12
"""Newton steps go on until no |H| is larger."""
_SWEEPS = (0, 0, 48, 96, 192)
"""Sweeps of the rounds (those that follow: as many as the last): most problems take the first two, without any."""
_STEPS = 10
_ROUNDS = 8
_LENGTHS = (1.0, 0.5, 0.2, 0.05)
"""Shares of a Newton step that are tried."""
LEAST_NORM_STEPS = (8, 80)
"""Steps toward the impulse of least norm: most problems need no more than the first."""
_LOOKS = 3
"""Looks for it, where one ends at an edge of what has its modes."""
_NEAR = 1e-7
"""Residual up to which that impulse may be the solution that Newton's steps miss.

Where contacts are redundant these have rounding over `DELTA` along what moves nothing, which takes contacts at the edge
of sticking over it.
"""
BLOCK = {6: 64}
"""Problems solved together, by the most rows that one has (more rows: 16): the slowest of them holds up the others."""


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
    """`y`, or, if `steps`, less what the diagonal has changed of the velocities, where that meets the law better."""

    def improve(count, best: Judged) -> Judged:
        new = judge(problem, best.y + _step(soft, best.modes, count > 0))
        return jax.tree.map(lambda a, b: jnp.where(new.residual < best.residual, a, b), new, best)

    unknown = Judged(y, Modes.nothing(problem), jnp.full_like(y[0, 0], jnp.inf))
    return jax.lax.fori_loop(0, jnp.where(steps, _POLISHING + 1, 1), improve, unknown)


# --- Rounds -----------------------------------------------------------------------------------------------------


class _Round(NamedTuple):
    """Where the search for impulses is, batch first: where sweeps go on from, and the best so far (N s).

    `redundant`: whether others have its modes.
    """

    swept: Float[Array, "B K d"]
    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    redundant: Bool[Array, " B"]


def _one_round(A, v, friction, lower, reference, swept, impulse, residual, _, count) -> _Round:
    """Sweeps and Newton steps for one block of problems, batch first in and out; round 0 looks at the start.

    Odd rounds from 3 on come down from a large diagonal, with which there is one solution; the others take Newton steps
    at once.
    """
    count = jnp.max(count, initial=0)
    scaled = Scaled.of(A, v, friction, lower, reference)
    problem, start = scaled.problem, scaled.inside(impulse)
    soft = softened(problem)
    # What is just between two modes (a contact that sticks with all the friction it has, one that only touches) is seen
    # as held, whatever rounding says.
    held = start.at[:, 0].multiply(1 + 1e-4).at[:, 0].add(1e-6)
    swept = _sweep(
        soft,
        jnp.where(count <= 1, held, scaled.inside(swept)),
        jnp.asarray(_SWEEPS)[jnp.minimum(count, len(_SWEEPS) - 1)],
    )

    def smaller(state):
        y, delta = state
        return _newton(softened(problem, delta), y, _STEPS), delta / 10

    first = jnp.where((count > 1) & (count % 2 == 1), 0.1, DELTA)
    first = jnp.where(count > 0, first, 0).astype(swept.dtype)
    y, _ = jax.lax.while_loop(lambda state: state[1] > 0.5 * DELTA, smaller, (swept, first))
    new = _polish(problem, soft, jnp.where(count > 0, y, start), count > 0)
    better = (new.residual < residual) | (count == 0)
    y, worst = (jnp.asarray(jnp.where(better, a, b)) for a, b in ((new.y, start), (new.residual, residual)))
    worst = jnp.asarray(jnp.where(scaled.finite, worst, jnp.inf))
    redundant = are_redundant(problem.Q, matvec(problem.Q, y) + problem.q, y, problem.mu, problem.lower)
    return _Round(scaled.outside(swept), scaled.outside(y), worst, redundant)


class _Choice(NamedTuple):
    """Impulses (N s), how far they miss the law, and which of them no further look makes less; batch first."""

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    least: Bool[Array, " B"]


def _of_least_norm(A, v, friction, lower, reference, impulse, residual, _, steps) -> _Choice:
    """Of all impulses with the modes of a solution that of least norm, where it obeys the law; batch first."""
    scaled = Scaled.of(A, v, friction, lower, reference)
    problem, y = scaled.problem, scaled.inside(impulse)
    u, most = matvec(problem.Q, y) + problem.q, jnp.max(steps, initial=0)
    least = least_norm(problem.Q, problem.q, u, y, problem.mu, problem.lower, steps=most)
    # As far toward it as contacts that rub go on to slide, and the open ones to be open, where velocities change on the
    # way. With what then holds there may be another.
    allowed, change = least.allowed, least.y - y
    faster = matvec(problem.Q, change)
    rates = [faster[:, 0], -dot(allowed.way, faster[:, 1:])]
    rubs = allowed.slides & (problem.mu > 0) & (allowed.closed | (problem.lower > 0))
    room = [
        jnp.where(allowed.closed, jnp.inf, u[:, 0]),
        jnp.where(rubs, -dot(allowed.way, u[:, 1:]), jnp.inf),
    ]
    shares = [
        jnp.where(rate < 0, left / jnp.where(rate < 0, -rate, 1), jnp.inf)
        for rate, left in zip(rates, room, strict=True)
    ]
    share = jnp.clip(jnp.min(jnp.concatenate(shares), axis=0), 0, 1)
    new = y + share * change
    judged = judge(problem, new).residual
    takes = scaled.finite & least.found & (judged <= _SOLVED)
    residual = jnp.asarray(jnp.where(takes, judged, residual))
    # What most of the steps did not find, or what was not taken then, would be so again.
    ends = jnp.where(takes, share == 1, most >= max(LEAST_NORM_STEPS))
    return _Choice(scaled.outside(jnp.where(takes, new, y)), residual, ends | ~least.singular)


class _Search(NamedTuple):
    """Where a batch is after some `rounds`: impulses, and how often that of least norm was looked for."""

    round: _Round
    least: Bool[Array, " B"]  # the impulse is that of least norm, or none of less is found
    looks: Int[Array, " B"]
    rounds: Int[Array, ""]


def _solve_batch(A, v, friction, lower, reference) -> CoulombSolution:
    """Solve a batch in rounds, each of what is not solved yet, block by block.

    Problems without a contact cost nothing, those with few only their own room.
    """
    batch, k, d = v.shape
    used = contacts_used(A, k)
    start = solve_cones(A, v, friction, lower, reference)
    start = jnp.where(jnp.isfinite(start), start, 0)

    def in_blocks(solve, found, chosen, *more):
        for size, its in by_size(used, k):
            m = size * d
            arrays = (A[:, :m, :m], *(x[:, :size] for x in (v, friction, lower, reference)))
            arrays += tuple(x[:, :size] if x.ndim > 1 else x for x in (*found, *more))
            block = next((size for most, size in BLOCK.items() if m <= most), 16)
            found = solve_chosen(solve, arrays, chosen & its, block, found)
        return found

    near = _NEAR if jnp.finfo(v.dtype).eps < _SOLVED else _SOLVED  # else all are near, by rounding

    def missing(search: _Search):
        return ~(search.round.residual <= _SOLVED) & (search.rounds <= _ROUNDS)

    def to_choose(search: _Search):
        """What a look for the impulse of least norm may help: also what redundant contacts keep from being solved."""
        is_near = search.round.residual <= jnp.where(search.rounds <= _ROUNDS + 1, near, _SOLVED)
        return is_near & ~search.least & (search.looks < _LOOKS) & (used > 0)

    def body(search: _Search) -> _Search:
        again, before = missing(search), search.round.residual
        found = in_blocks(_one_round, search.round, again, jnp.full(batch, search.rounds))
        better = (found.residual < 0.5 * before) | (found.residual <= _SOLVED)
        looks = jnp.where(again & better, 0, search.looks)
        least = jnp.asarray(jnp.where(again, ~found.redundant, search.least))
        search = _Search(found, least, looks, search.rounds + 1)
        wanted = to_choose(search)
        steps = jnp.asarray(LEAST_NORM_STEPS)[jnp.where((found.residual <= _SOLVED) & (looks == 0), 0, 1)]
        choice = in_blocks(_of_least_norm, _Choice(found.impulse, found.residual, search.least), wanted, steps)
        found = found._replace(impulse=choice.impulse, residual=choice.residual)
        return search._replace(round=found, least=choice.least, looks=jnp.where(wanted, looks + 1, looks))

    def keep_going(search: _Search):
        return jnp.any(missing(search) | to_choose(search))

    unknown, none = jnp.where(used > 0, jnp.inf, jnp.zeros(batch, v.dtype)), jnp.zeros(batch, int)
    begin = _Search(_Round(start, start, unknown, none > 0), none > 0, none, jnp.asarray(0))
    found = jax.lax.while_loop(keep_going, body, begin).round
    return CoulombSolution(jnp.where((used > 0)[:, None, None], found.impulse, 0), found.residual)


_batched = as_one_batch(_solve_batch, "solver of Coulomb's law")
_sensitivity = as_one_batch(sensitivity_of, "solver of Coulomb's law")


@jax.custom_jvp
def _impulse(A, v, friction, lower, reference) -> CoulombSolution:
    return _batched(A, v, friction, lower, reference)


# The derivative. H(y; A, v, mu, lower) = 0 at the solution, with the modes that are there, gives
#
#     (dH/dy + dH/du A) df = -( dH/du (dA f + dv) + dH/dmu dmu + dH/dlower dlower )
#
# The matrix is that of the last Newton step, in scaled impulses. Where contacts are redundant it gives the velocities;
# which of the impulses it is, `selection.py` says. Everything on the right is linear in the tangents, so
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
    df = jnp.linalg.solve(out.matrix, -rhs.reshape(batch, k * d, 1)).reshape(f.shape) * out.size[..., None]
    df = selected(primals[:-1], f, df, tangents[:-1], lifts=False)
    return solution, CoulombSolution(df, jnp.zeros_like(solution.residual))


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
