r"""Friction-cone problems: a batched solver and its derivative. Arrays only.

The problem, for each of a batch of `B` independent sets of `K` contacts in `d` = 2 or 3 dimensions (paper, eqs. 5
and 7, appendix C):

    minimise  1/2 f^T A f + f^T v    subject to   |f_t,i| <= mu_i f_n,i,   f_n,i >= lower_i

with `f = (f_n, f_t)` stacked by contact and the normal component first. See `solve_cone_problem`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.contact.active_set import ActiveSet, finish, newton_steps, sweep
from carom.contact.batching import as_one_batch, by_size, contacts_used, solve_chosen
from carom.contact.cone_algebra import (
    ConeSettings,
    Factored,
    Iterate,
    NewtonMatrix,
    Problem,
    Scales,
    Scaling,
    add_normal,
    apply,
    matvec,
    residual_of,
    scale,
)
from carom.contact.interior_point import interior_point
from carom.contact.least_norm import least_norm, may_be_redundant, polished
from carom.contact.selection import selected

# --- The method -------------------------------------------------------------------------------------------------
#
# Variables. With f_t = mu g_t the friction cone becomes the standard second-order cone |g_t| <= f_n for every mu,
# also mu = 0, where the tangent leaves the objective. So y = (f_n, g_t), f = S y, S = diag(1, mu, mu), Q = S A S,
# q = S v. Each contact is scaled by 1 / sqrt(A_nn) (mass ratios then do not matter) and the whole problem by its
# largest datum. The cone slack is s = y, the bound's slack u = y_n - lower; their multipliers are z and w.
#
#     Q y + q = z + e_n w,    s o z = 0,    u w = 0,    s, z in the cone,  u, w >= 0
#
# Where A is singular the impulse is not unique. A diagonal delta A_nn, added to each contact's own block, selects the
# solution of least norm as delta -> 0: sum_i A_nn,i |f_i|^2, an energy, which knows neither the frame nor the units of
# the contacts (bends in N m s beside stretches in N s), and in which contacts far apart do not meet.
#
# Two ways lead to the solution: Newton steps onto an active set that Gauss-Seidel shows (`active_set.py`), and where
# that fails the central path (`interior_point.py`), whose end is such a step too. The matrix is the same.
#
# Steps are Mehrotra's predictor-corrector with Nesterov-Todd scaling W (W z = W^-1 s): (Q + W^-2 + D) dy = rhs. The
# eigenvectors of W^-2 are known: p = (1, u)/sqrt 2, m = (1, -u)/sqrt 2 and, in 3D, the tangent across u. In that frame
# W^-2 is diagonal, with entries that near the solution differ by 1e15; formed in the original frame it would
# lose the small ones to rounding, in this frame it does not.


class _Internal(NamedTuple):
    """Solutions, batch first."""

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    iterations: Any  # int (B,); its tangent is of JAX's type for no tangent at all


class _Sensitivity(NamedTuple):
    """What the derivative needs, batch first: `(Q + W^-2 + D)^-1` is `frame L^-T L^-1 frame^T`."""

    regular: Float[Array, "B K d"]  # (f_n, g_t) of the regularised problem, in physical units
    moved: Float[Array, "B K d"]  # the same less the centre of its proximal term
    triangle: Float[Array, "B n n"]  # L
    frame: Float[Array, "B K d d"]
    bound: Float[Array, "B K"]  # D
    diagonal: Float[Array, "B K"]  # delta A_nn
    sticks: Bool[Array, "B K"]  # contacts inside of their cone, so that z = 0

    @classmethod
    def nothing(cls, batch: int, k: int, d: int, dtype) -> "_Sensitivity":
        """That of problems without contacts."""
        zeros = jnp.zeros((batch, k, d), dtype)
        triangle = jnp.broadcast_to(jnp.eye(k * d, dtype=dtype), (batch, k * d, k * d))
        frame, sticks = jnp.zeros((batch, k, d, d), dtype), jnp.zeros((batch, k), bool)
        return cls(zeros, zeros, triangle, frame, zeros[..., 0], zeros[..., 0], sticks)

    def solve(self, rhs: Float[Array, "B K d"]) -> Float[Array, "B K d"]:
        """`(Q + W^-2 + D)^-1 rhs`; linear in `rhs`, in both modes."""
        x = jnp.einsum("bkij,bki->bkj", self.frame, rhs).reshape(*self.triangle.shape[:2], 1)
        for transpose in (False, True):
            x = jax.lax.linalg.triangular_solve(self.triangle, x, left_side=True, lower=True, transpose_a=transpose)
        return jnp.einsum("bkij,bkj->bki", self.frame, x.reshape(rhs.shape))


class _Solved(NamedTuple):
    it: Iterate  # the best of the regularised problem
    regular: Float[Array, "K d B"]  # the solution of the regularised problem
    center: Float[Array, "K d B"]  # of its proximal term
    y: Float[Array, "K d B"]  # the solution, without the diagonal
    residual: Float[Array, " B"]
    iterations: Int[Array, ""]
    rounds: Int[Array, ""]


def _solve_block(A, v, friction, lower, reference, settings: ConeSettings, sensitivity: bool, short: bool):
    """Solve one block of problems: batch first in and out, batch last inside.

    The short way solves most problems, and gives the others an infinite residual.
    """
    batch, k, d = v.shape
    finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2))
    finite = finite & jnp.isfinite(friction).all(1) & (lower < jnp.inf).all(1)
    A_last = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    v_last, reference = jnp.moveaxis(v, 0, -1), jnp.moveaxis(reference, 0, -1)
    problem, scales = scale(A_last, v_last, friction.T, lower.T, reference, settings.diagonal)
    if short:
        out, matrix = _short_way(problem, scales, settings)
    else:
        out = _proximal_point(problem, scales, settings)
        if settings.least_norm and settings.smoothing == 0 and v.dtype == jnp.float64:
            choice = _of_least_norm(problem, scales, settings, out.y, out.residual)
            out = out._replace(
                y=choice.y,
                residual=choice.residual,
                # It solves the regularised problem around z.
                regular=jnp.where(choice.chosen, choice.y, out.regular),
                center=jnp.where(choice.chosen, choice.z, out.center),
            )
        matrix = _last_matrix(problem, scales, settings, out) if sensitivity else None
    nan = jnp.where(finite, 0, jnp.nan).astype(v.dtype)
    solution = _Internal(
        impulse=jnp.moveaxis(scales.S * scales.unit * out.y + nan, -1, 0),
        residual=jnp.where(finite, out.residual, jnp.inf),
        iterations=jnp.broadcast_to(out.iterations, (batch,)),
    )
    if not sensitivity or matrix is None:
        return solution, None
    size = scales.size[:, None]
    return solution, _Sensitivity(
        regular=jnp.moveaxis(size * scales.unit * out.regular, -1, 0),
        moved=jnp.moveaxis(size * scales.unit * (out.regular - out.center), -1, 0),
        triangle=matrix.triangle(),
        frame=jnp.moveaxis(size[:, None] * matrix.frame, -1, 0),
        bound=(matrix.curvature / jnp.where(scales.size > 0, scales.size, jnp.inf) ** 2).T,
        diagonal=scales.diagonal.T,
        sticks=matrix.sticks.T,
    )


# --- The short way: no central path -----------------------------------------------------------------------------
#
# What comes out is judged by the optimality conditions of the problem given. The impulse must be the one of least norm,
# too: it is where no contact is so near to changing sides that the diagonal could decide it, or where the conditions
# of the regularised problem hold well below the diagonal.

_CLEAR = 1e3  # times the diagonal


def _short_way(problem: Problem, scales: Scales, settings: ConeSettings) -> tuple[_Solved, Factored]:
    last = newton_steps(problem, sweep(problem, scales.mu, scales.size > 0), scales.regularization, scales.apex)
    of_regular, of_solution = jax.vmap(residual_of, in_axes=(None, 0, 0))(
        problem,
        jnp.stack([last.regular, last.y]),
        jnp.stack([jnp.zeros_like(scales.regularization), scales.regularization]),
    )
    unique = (last.margin > _CLEAR * settings.diagonal) | (of_regular < settings.diagonal / _CLEAR)
    residual = jnp.asarray(jnp.where(unique & (of_solution <= _wanted(settings)), of_solution, jnp.inf))
    zero = jnp.asarray(0)
    return _Solved(_start(problem), last.regular, jnp.zeros_like(last.y), last.y, residual, zero, zero), last.matrix


def _wanted(settings: ConeSettings) -> float:
    """The residual at which a problem is solved well enough."""
    return 0.01 * settings.tolerance


# --- The long way: the problem as it was given, along the central path -------------------------------------------
#
# The diagonal is that of a proximal term delta/2 |f - f_0|^2. With f_0 = 0 it selects the solution of least norm; one
# Newton step without the diagonal then removes most of its effect on the impulse.
#
# Round 0 goes only so far along the central path that the active set can be seen; the step onto it mostly is the end.
# What is not solved then goes on along the path in round 1. Where that is not enough (data in single precision, whose
# delta is large, with singular A or large impulses), the problem is solved again around the solution found: the
# proximal-point method (Rockafellar, 1976), which mostly needs two or three rounds.
_COARSE = 1e-6
_ROUNDS = 12


def _start(problem: Problem) -> Iterate:
    one = jnp.ones_like(problem.lower)
    identity = jnp.zeros_like(problem.q).at[:, 0].set(1)
    y = add_normal(identity, jnp.maximum(problem.lower, 0))
    return Iterate(y, y[:, 0] - problem.lower, identity, one)


def _last_matrix(problem: Problem, scales: Scales, settings: ConeSettings, found: _Solved) -> Factored:
    """That of a step from the solution: what the derivative is made of."""
    if settings.smoothing > 0:
        scaling, bound = Scaling.of(found.it.y, found.it.z), found.it.w / found.it.u
    else:
        proximal = problem._replace(q=problem.q - scales.regularization * found.center)
        active = ActiveSet.at(proximal, found.regular, scales.apex)
        scaling, bound = active.scaling, active.curvature
    return NewtonMatrix(problem.Q, scaling, bound, unrolled=False).factored()


def _proximal_point(problem: Problem, scales: Scales, settings: ConeSettings) -> _Solved:
    batch = problem.q.shape[-1]
    smooth = settings.smoothing > 0
    wanted = jnp.asarray(_wanted(settings), problem.q.dtype)
    start = _start(problem)

    def keep_going(best: _Solved):
        return jnp.any(best.residual > wanted) & (best.rounds < (1 if smooth else _ROUNDS))

    def body(best: _Solved):
        again = best.rounds > 1
        center = jnp.where(again, best.y, 0)
        proximal = problem._replace(q=problem.q - scales.regularization * center)
        first = jax.tree.map(lambda a, b: jnp.where(again, a, b), start, best.it)
        coarse = (best.rounds == 0) & (not smooth)
        target = jnp.where(coarse, jnp.maximum(_COARSE, settings.target), settings.target)
        loop = interior_point(proximal, first, best.residual <= wanted, target, settings)
        if smooth:
            new = _Solved(loop.best, loop.best.y, center, loop.best.y, loop.merit, best.iterations, best.rounds)
        else:
            finished = finish(problem, proximal, scales.regularization, loop, center, wanted)
            new = _Solved(loop.best, finished[0], center, *finished[1:], best.iterations, best.rounds)
        # A problem that is solved well enough stays as it is; so does one that this round made worse.
        take = (best.residual > wanted) & ((new.residual < best.residual) | (best.rounds == 0))

        def choose(a: Array, b: Array) -> Array:
            return jnp.where(take, a, b) if a.ndim else a

        chosen = jax.tree.map(choose, new, best)
        return chosen._replace(iterations=best.iterations + loop.iteration, rounds=best.rounds + 1)

    nothing = jnp.zeros_like(start.y)
    zero = jnp.asarray(0)
    first = _Solved(start, nothing, nothing, nothing, jnp.full(batch, jnp.inf, problem.q.dtype), zero, zero)
    return jax.lax.while_loop(keep_going, body, first)


_POLISHES = 3


class _Choice(NamedTuple):
    """Of many impulses that give the same velocities one: `z`, which it is the projection of, where it is `chosen`."""

    y: Float[Array, "K d B"]
    z: Float[Array, "K d B"]
    residual: Float[Array, " B"]
    chosen: Bool[Array, " B"]


def _of_least_norm(problem: Problem, scales: Scales, settings: ConeSettings, y: Array, residual: Array) -> _Choice:
    """The solution without a diagonal, of least norm to rounding: the diagonal selects it to rounding over delta."""
    k, d, batch = problem.q.shape
    # From S of the program, with its friction, to a scale for normal and tangents alike.
    ways = jnp.concatenate([jnp.ones_like(scales.mu)[:, None], jnp.repeat(scales.mu[:, None], d - 1, axis=1)], axis=1)
    over = jnp.where(ways > 0, 1 / jnp.where(ways > 0, ways, 1), 0)
    rows = over.reshape(k * d, batch)
    eye = jnp.eye(k * d, dtype=over.dtype)[..., None]
    plain = problem.Q - scales.regularization.reshape(k * d, 1, batch) * eye
    Q, q = rows[:, None] * plain * rows, over * problem.q
    bound = jnp.maximum(problem.lower, 0)

    def polish(_, best: tuple[Array, Array]) -> tuple[Array, Array]:
        y, residual = best
        better = over * polished(Q, q, over * matvec(plain, y) + q, ways * y, scales.mu, bound)
        missed = residual_of(problem, better, scales.regularization)
        return jnp.where(missed < residual, better, y), jnp.where(missed < residual, missed, residual)

    y, residual = jax.lax.fori_loop(0, _POLISHES, polish, (y, residual))
    u = over * matvec(plain, y) + q
    least = least_norm(Q, q, u, ways * y, scales.mu, bound, lifts=True)
    found = over * least.y
    new = residual_of(problem, found, scales.regularization)
    takes = new <= jnp.maximum(_wanted(settings), residual)
    return _Choice(
        jnp.where(takes, found, y),
        jnp.where(least.held, over * least.z, found),
        jnp.where(takes, new, residual),
        least.found & takes,
    )


def _choose_block(A, v, friction, lower, reference, impulse, residual, settings: ConeSettings) -> tuple[Array, Array]:
    """Impulses of least norm, and their residuals, of solutions that the short way has found, batch first."""
    batch, k, d = v.shape
    A, v, reference, impulse = (jnp.moveaxis(x, 0, -1) for x in (A.reshape(batch, k, d, k, d), v, reference, impulse))
    problem, scales = scale(A, v, friction.T, lower.T, reference, settings.diagonal)
    size = scales.S * scales.unit
    y = jnp.where(size > 0, impulse / jnp.where(size > 0, size, 1), 0)
    choice = _of_least_norm(problem, scales, settings, y, residual)
    return jnp.moveaxis(size * choice.y, -1, 0), choice.residual


# --- Batches ----------------------------------------------------------------------------------------------------

BLOCK = {6: 128, 24: 64}
"""Problems solved together the short way, by the most rows that a problem has (more rows: 32).

Enough to fill vector units; few enough for their matrices to stay in cache, and for the slowest not to hold up many.
"""

LONG_BLOCK = {6: 64}
"""The same for the long way (more rows: 16), which few problems take and the slowest of a block holds up more."""


def _block_size(rows: int, short: bool) -> int:
    sizes, rest = (BLOCK, 32) if short else (LONG_BLOCK, 16)
    return next((size for most, size in sizes.items() if rows <= most), rest)


def _solve_batch(A, v, friction, lower, reference, settings: ConeSettings, sensitivity: bool):
    """Solve a batch block by block. Problems without a contact cost nothing and give zeros.

    In a batch with room for many contacts most problems have one or two: these, where they come first in their
    problem, are solved without the room that they do not use. The long way, where it is that of few, is compiled once.
    """
    batch, k, d = v.shape
    used = contacts_used(A, k)
    solution = _Internal(
        impulse=jnp.zeros((batch, k, d), v.dtype),
        residual=jnp.where(used > 0, jnp.inf, jnp.zeros(batch, v.dtype)),
        iterations=jnp.zeros(batch, int),
    )
    out = (solution, _Sensitivity.nothing(batch, k, d, v.dtype) if sensitivity else None)
    # Rounding leaves too little of single precision to tell a solution of the short way from others.
    has_short_way = settings.smoothing == 0 and v.dtype == jnp.float64
    forms = [(has_short_way, *form) for form in by_size(used, k)]
    if has_short_way:
        forms.append((False, k, used > 0))
    long = jnp.zeros(batch, bool)
    for short, size, chosen in forms:
        m = size * d
        arrays = (A[:, :m, :m], v[:, :size], friction[:, :size], lower[:, :size], reference[:, :size])
        missing = chosen & ~(out[0].residual <= _wanted(settings))
        long = missing & (not short)
        solve = functools.partial(_solve_block, settings=settings, sensitivity=sensitivity, short=short)
        out = solve_chosen(solve, arrays, missing, _block_size(m, short), out)
    if has_short_way and settings.least_norm and k > 1:
        # Of what the short way has found the diagonal has selected the impulse, to rounding over delta.
        none = jnp.zeros(batch, bool)
        chosen = jax.lax.cond(jnp.any(used > 1), lambda: may_be_redundant(A, k) & (used > 1) & ~long, lambda: none)
        solution, choose = out[0], functools.partial(_choose_block, settings=settings)
        arrays = (A, v, friction, lower, reference, solution.impulse, solution.residual)
        impulse, residual = solve_chosen(
            choose, arrays, chosen, _block_size(k * d, False), (solution.impulse, solution.residual)
        )
        out = (solution._replace(impulse=impulse, residual=residual), out[1])
    return out


@functools.cache
def _batched(settings: ConeSettings, sensitivity: bool):
    """`_solve_batch` for these settings, whose batching under vmap is one larger batch."""
    solve = functools.partial(_solve_batch, settings=settings, sensitivity=sensitivity)
    return as_one_batch(solve, "cone solver")


def solve_cones(A, v, friction, lower, reference) -> Float[Array, "B K d"]:
    """Impulses of `solve_cone_problem` for what has its own derivative, in the precision of the data.

    Where many impulses give the same velocities it is one near that of least norm: who asks selects for himself.
    """
    return _batched(ConeSettings.for_dtype(v.dtype)._replace(least_norm=False), False)(
        A, v, friction, lower, reference
    )[0].impulse


def _friction_scale(x, friction):
    """`S x`: the tangential components times mu."""
    return jnp.concatenate([x[..., :1], x[..., 1:] * friction[..., None]], axis=-1)


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def _impulse(A, v, friction, lower, reference, settings: ConeSettings) -> _Internal:
    return _batched(settings, False)(A, v, friction, lower, reference)[0]


# The derivative. At the solution (or at the point of the central path where `smoothing` ends) the conditions
#
#     S (A f + delta (f - f_0) + v) = z + w e_n,   f = S y,   y = (f_n, g_t)
#
# with z and w eliminated by their linearised complementarity (dz = -W^-2 dy, dw = -D (dy_n - dlower)) give
#
#     (Q + W^-2 + D e_n e_n^T) dy
#         = -( dS (A f + delta (f - f_0) + v) + S (dA f + dv + (A + delta) dS y) ) + D e_n dlower
#
# with f_0 the centre of the proximal term, zero in the first round
# (optimality conditions as in Amos and Kolter, OptNet, 2017, eq. 6, for the cones used here). Everything on the right
# is linear in the tangents and the matrix is the solver's own, so that both modes, vmap and jit follow from this rule.
@_impulse.defjvp
def _impulse_jvp(settings, primals, tangents):
    A, v, friction, *_ = primals
    dA, dv, dfriction, dlower, _ = tangents  # `reference` only sets a scale
    solution, out = _batched(settings, True)(*primals)
    f = _friction_scale(out.regular, friction)
    after = apply(A, f) + out.diagonal[..., None] * _friction_scale(out.moved, friction) + v
    # What is left of z where a contact sticks is an error, which a singular A would multiply by 1 / delta.
    after = jnp.asarray(jnp.where((out.sticks & (friction > 0))[..., None], 0, after))
    # Where mu = 0 the tangent g is not determined by the problem, and z is the apex of its cone. For a growing mu,
    # friction opposes sliding, g = -f_n after_t / |after_t|, and z leaves the apex along its boundary: z_n = |z_t|,
    # with z_t = mu after_t.
    tangent = after[..., 1:]
    norm = jnp.sqrt(jnp.sum(tangent**2, axis=-1, keepdims=True))
    frictionless = friction[..., None] == 0
    sliding = -out.regular[..., :1] * tangent / jnp.where(norm > 0, norm, 1)
    g = jnp.where(frictionless, sliding, out.regular[..., 1:])
    boundary = jnp.where(frictionless, norm * dfriction[..., None], 0)
    dSy = jnp.concatenate([jnp.zeros_like(g[..., :1]), dfriction[..., None] * g], axis=-1)
    dS_after = jnp.concatenate([jnp.zeros_like(g[..., :1]), dfriction[..., None] * tangent], axis=-1)
    force = apply(dA, f) + dv + apply(A, dSy) + out.diagonal[..., None] * dSy
    rhs = -(dS_after + _friction_scale(force, friction))
    rhs = jnp.concatenate([rhs[..., :1] + (out.bound * dlower)[..., None] + boundary, rhs[..., 1:]], axis=-1)
    df = dSy + _friction_scale(out.solve(rhs), friction)
    if settings.smoothing == 0 and f.dtype == jnp.float64:
        df = selected(primals[:-1], solution.impulse, df, tangents[:-1], lifts=True)
    no_tangent = np.zeros(solution.iterations.shape, jax.dtypes.float0)
    return solution, _Internal(df, jnp.zeros_like(solution.residual), no_tangent)


class ConeSolution(NamedTuple):
    """Solutions of a batch of problems.

    `residual` is the largest violation of the optimality conditions, relative to the problem's scale (infinite where
    the data were not finite, which makes the impulse NaN); `iterations` is that of the block a problem was solved in.
    """

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    iterations: Int[Array, " B"]


def solve_cone_problem(
    A: Float[Array, "B n n"],
    v: Float[Array, "B K d"],
    friction: Float[Array, "B K"],
    lower: Float[Array, "B K"] | None = None,
    *,
    reference: Float[Array, "B K d"] | None = None,
    smoothing: float = 0.0,
) -> ConeSolution:
    """Minimise `1/2 f^T A f + f^T v` over friction cones, for a batch of problems.

    **Arguments:** `A` (B, K d, K d), symmetric positive semi-definite, velocity per impulse (1 / kg); `v` (B, K, d),
    velocities of the contact points, normal first (m/s); `friction` (B, K), Coulomb's mu >= 0; `lower` (B, K),
    least normal impulses (N s), >= 0, or `None` for zero; `reference` (B, K, d), velocities (m/s) that `v` is what
    remains of, if so: what is small beside them is rounding; `smoothing`, final value of the complementarity products
    relative to the problem's scale. An entry of `lower` that is `-inf` is no bound, as `None` is for all.

    A contact whose normal entry of `A` is zero is padding and gets no impulse. Where the impulse is not unique it is
    the one of least norm, each contact weighted by its own mobility `A_nn`, but for degenerate problems that only the
    proximal rounds solve: of these it is one near it.
    The iterations run in double precision where that is enabled, whatever the dtype of the data. Differentiable once,
    in forward and reverse mode.

    **Source:** paper, eqs. 5 and 7, appendix C; method: Vandenberghe, *The CVXOPT linear and quadratic cone program
    solvers*, 2010.
    """
    dtype = v.dtype
    widest = jnp.zeros((), float).dtype
    work = widest if widest.itemsize > dtype.itemsize else dtype
    settings = ConeSettings.for_dtype(dtype, smoothing, work=work)
    lower = jnp.full_like(friction, -jnp.inf) if lower is None else lower
    reference = jnp.zeros_like(v) if reference is None else jax.lax.stop_gradient(reference)
    out = _impulse(*(x.astype(work) for x in (A, v, friction, lower, reference)), settings)
    return ConeSolution(out.impulse.astype(dtype), out.residual.astype(dtype), out.iterations)
