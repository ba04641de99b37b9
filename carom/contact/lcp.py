r"""Friction-pyramid problems with Newton's restitution: a complementarity solver and its derivative. Arrays only.

The problem, for each of a batch of independent sets of `K` contacts in `d` = 2 or 3 dimensions, with `f` and the
velocity after the impact `v^+ = A f + v` stacked by contact and the normal component first (a is perpendicular to b:
a b = 0):

    0 <= f_n     perpendicular to   v_n^+ - rebound >= 0
    0 <= beta    perpendicular to   D^T (v_t^+ - target) + lambda 1 >= 0,    f_t = D beta
    0 <= lambda  perpendicular to   mu f_n - 1^T beta >= 0

The columns of `D` are unit vectors, equally spaced in the tangent plane. See `solve_lcp_impulse`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.contact.batching import as_one_batch, by_size, contacts_used, solve_chosen
from carom.contact.cone_algebra import matvec
from carom.contact.lemke import lemke
from carom.contact.linalg import Cholesky
from carom.errors import CaromError

# --- The method -------------------------------------------------------------------------------------------------
#
# Lemke's method (`lemke.py`) finds a solution; its matrix is copositive, so that in exact arithmetic it ends in one
# wherever no self-stress (an impulse inside the pyramids with A f = 0) has to do work against `rebound`.
# Elsewhere there is mostly none, and where there is one another start may find it. If none does, the impulse is that
# of A with a larger diagonal: that problem always has a solution, and the residual tells that it is another's.
#
# With friction the problem may have several solutions, and Newton's restitution lets some of them gain energy. Where
# the first one does, the other starts are tried too, and the solution of least energy among those found is taken.
#
# From the impulse found follows each contact's mode: open, sticking, sliding against one direction (a vertex of the
# pyramid's section), or sliding along an edge of it, between two directions whose velocities tie. With E the projector
# onto the components whose velocity after the impact is given, and f = S y for those that are free,
#
#     E (A f + v) = 0,   f = S y,   S = E + mu c e_n^T
#
# where c is the vertex, the middle of the edge, or 0. These few equations refine the impulse, and differentiated they
# are the derivative. Modes, and not Lemke's basis, because a basis is arbitrary where the problem is degenerate, as
# it is in the plainest cases: a ball that hits a wall head on has f_t = 0 for all that the basis knows, yet it sticks.


class _Settings(NamedTuple):
    """Tolerances, relative to the problem's scale."""

    solved: float  # residual at which a problem counts as solved
    mode: float  # velocities that count as zero when modes are told apart
    pivot: float  # smallest pivot
    tie: float  # values that count as zero in the ratio test
    ridge: float  # singular values of the mode equations below this count as zero
    starts: int = 3  # of Lemke's method
    diagonal: float = 1e-2  # what A gets where all failed, relative to A_nn

    @classmethod
    def for_dtype(cls, dtype) -> "_Settings":
        if dtype == jnp.float64:
            return cls(solved=1e-9, mode=1e-9, pivot=1e-9, tie=1e-12, ridge=1e-6)
        return cls(solved=1e-4, mode=1e-4, pivot=1e-4, tie=1e-6, ridge=1e-2)


class _Problem(NamedTuple):
    """A batch of scaled problems, batch last."""

    A: Float[Array, "n n B"]
    v: Float[Array, "K d B"]  # velocity before, less rebound and target
    before: Float[Array, "K d B"]  # velocity before
    friction: Float[Array, "K B"]
    present: Bool[Array, "K B"]


def pyramid_directions(d: int, facets: int) -> np.ndarray:
    """The pyramid's unit directions (m, d - 1); in 2D the two sides of the cone, whatever `facets`."""
    if d == 2:
        return np.array([[1.0], [-1.0]])
    angle = 2 * np.pi * np.arange(facets) / facets
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _after(problem: _Problem, f: Float[Array, "K d B"]) -> Float[Array, "K d B"]:
    """Velocity after the impact, less rebound and target."""
    return matvec(problem.A, f) + problem.v


def _energy(problem: _Problem, f: Float[Array, "K d B"]) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """What the impulses add to the energy, and how much they exchange."""
    added = jnp.sum(f * (problem.before + matvec(problem.A, f) / 2), axis=(0, 1))
    return added, jnp.sum(jnp.abs(f * problem.before), axis=(0, 1))


def _along(directions: np.ndarray, x: Float[Array, "K t B"]) -> Float[Array, "K m B"]:
    return jnp.einsum("mt,ktb->kmb", jnp.asarray(directions, x.dtype), x)


def _complementarity_form(
    problem: _Problem, directions: np.ndarray
) -> tuple[Float[Array, "N N B"], Float[Array, "N B"]]:
    """`M` and `q` for `z` = (f_n, beta, lambda) of each contact."""
    k, d, batch = problem.v.shape
    m = directions.shape[0]
    D = jnp.asarray(directions, problem.v.dtype)
    # U takes (f_n, beta) to (f_n, f_t).
    U = jnp.zeros((d, m + 2), D.dtype).at[0, 0].set(1).at[1:, 1 : m + 1].set(D.T)
    A = problem.A.reshape(k, d, k, d, batch)
    M = jnp.einsum("iajcb,ax,cy->ixjyb", A, U, U)
    own = jnp.zeros((k, m + 2, m + 2, batch), D.dtype)
    own = own.at[:, 1 : m + 1, m + 1].set(1).at[:, m + 1, 1 : m + 1].set(-1)
    own = own.at[:, m + 1, 0].set(problem.friction)
    index = jnp.arange(k)
    M = M.at[index, :, index].add(own)
    q = jnp.einsum("kdb,dx->kxb", problem.v, U)
    # What is absent, padding or friction, is not in the problem: w = 1, z = 0.
    rubs = problem.present & (problem.friction > 0)
    keep = jnp.concatenate([problem.present[:, None], jnp.repeat(rubs[:, None], m + 1, axis=1)], axis=1)
    M = jnp.where(keep[:, :, None, None] & keep[None, None], M, 0)
    q = jnp.where(keep, q, 1)
    size = k * (m + 2)
    return M.reshape(size, size, batch), q.reshape(size, batch)


# --- Modes ------------------------------------------------------------------------------------------------------


class _Modes(NamedTuple):
    E: Float[Array, "K d d B"]  # projector onto the components whose velocity after the impact is given
    c: Float[Array, "K t B"]  # f_t = mu c f_n + what E leaves free
    weight: Float[Array, "K B"]  # small where a contact carries nothing yet, see `_ModeEquations`


def _modes(problem: _Problem, f, directions: np.ndarray, settings: _Settings) -> _Modes:
    """The contacts' modes at impulse `f`. Of two modes that meet there it is the one that moves less."""
    t = f.shape[1] - 1
    after = _after(problem, f)
    speed = jnp.maximum(jnp.max(jnp.abs(problem.v), axis=(0, 1)), 1)
    closed = problem.present & (after[:, 0] <= settings.mode)
    along = _along(directions, after[:, 1:])
    tied = along - jnp.min(along, axis=1, keepdims=True) <= settings.mode * speed
    count = jnp.sum(tied, axis=1, dtype=f.dtype)
    c = jnp.einsum("mt,kmb->ktb", jnp.asarray(directions, f.dtype), tied.astype(f.dtype)) / count[:, None]
    # At mu = 0 friction is none, of a growing mu it opposes sliding: no component of the tangent is free.
    rubs = problem.friction > 0
    sticks = rubs & (count > (1 if t == 1 else 2))
    c = jnp.where(closed[:, None] & ~sticks[:, None], c, 0)
    P = jnp.where(sticks[:, None, None], jnp.eye(t, dtype=f.dtype)[None, :, :, None], 0)
    if t == 2:
        on_edge = rubs & (count == 2)
        edge = jnp.stack([-c[:, 1], c[:, 0]], axis=1)
        edge = edge / jnp.sqrt(jnp.where(on_edge & closed, jnp.sum(c**2, axis=1), 1))[:, None]
        P = P + jnp.where(on_edge[:, None, None], edge[:, :, None] * edge[:, None], 0)
    E = jnp.zeros((f.shape[0], t + 1, t + 1, f.shape[-1]), f.dtype).at[:, 0, 0].set(1).at[:, 1:, 1:].set(P)
    E = jnp.where(closed[:, None, None], E, 0)
    weight = jnp.where(f[:, 0] > settings.mode * jnp.maximum(jnp.max(jnp.abs(f[:, 0]), axis=0), 1), 1, 1e-3)
    return _Modes(E, c, weight.astype(f.dtype))


class _ModeEquations:
    """`(E A S + 1 - E) y = E r`, solved in the least-squares sense of least norm.

    Iterated Tikhonov regularisation: singular values well above `ridge` are inverted to rounding, those well below it
    count as zero (redundant contacts), and the result is finite whatever the matrix. The norm is weighted, so that of
    redundant contacts those change that already carry something, unless they do not suffice.
    """

    def __init__(self, problem: _Problem, modes: _Modes, ridge: float):
        k, d, batch = problem.v.shape
        n = k * d
        E, c, weight = modes
        A = problem.A.reshape(k, d, k, d, batch)
        # Tangents may be far lighter than normals: each contact's get a unit of their own.
        index = jnp.arange(k)
        light = jnp.max(jnp.stack([A[index, i, index, i] for i in range(d)]), axis=0)
        unit = jax.lax.rsqrt(jnp.maximum(light, 1))
        slope = (problem.friction * E[:, 0, 0])[:, None] * c
        S = weight[:, None, None] * E.at[:, 1:, 1:].multiply(unit[:, None, None]).at[:, 1:, 0].set(slope)
        R = E.at[:, 1:, 1:].multiply(unit[:, None, None])
        G = jnp.einsum("iaxb,ixjyb,jyzb->iajzb", R, A, S)
        G = G.at[index, :, index].add(jnp.eye(d, dtype=E.dtype)[None, :, :, None] - E)
        G = G.reshape(n, n, batch)
        self.S, self.R, self.G = S, R, G
        gram = jnp.einsum("kib,kjb->ijb", G, G)
        largest = jnp.maximum(jnp.max(jnp.sum(G**2, axis=0), axis=0), 1)
        self.factor = Cholesky(gram + ridge**2 * largest * jnp.eye(n, dtype=G.dtype)[..., None])

    def solve(self, r: Float[Array, "n m B"]) -> Float[Array, "n m B"]:
        """The change of the impulse that changes the given velocities by `r`."""
        k, d, _, batch = self.R.shape
        m = r.shape[1]
        r = jnp.einsum("iaxb,ixmb->iamb", self.R, r.reshape(k, d, m, batch)).reshape(-1, m, batch)

        def improve(_, y):
            rest = r - jnp.einsum("ijb,jmb->imb", self.G, y)
            return y + self.factor.solve(jnp.einsum("jib,jmb->imb", self.G, rest))

        y = jax.lax.fori_loop(0, 4, improve, jnp.zeros_like(r))
        return jnp.einsum("iaxb,ixmb->iamb", self.S, y.reshape(k, d, m, batch)).reshape(-1, m, batch)


def _residual(problem: _Problem, f, directions: np.ndarray) -> Float[Array, " B"]:
    """Largest violation of the conditions by the impulse alone, relative to the problem's scale.

    The multipliers follow from it: `lambda = max(-D^T v_t)` and the least `1^T beta` is the pyramid's gauge of f_t.
    Velocities are relative to 1, impulses to the largest if that is larger, products to both.
    """
    after = _after(problem, f)
    slip = jnp.max(-_along(directions, after[:, 1:]), axis=1)
    normals, reach = directions, 1.0
    if directions.shape[0] > 2:
        normals = directions + np.roll(directions, 1, axis=0)
        reach = 2 * np.cos(np.pi / directions.shape[0]) ** 2
    gauge = jnp.max(_along(normals / reach, f[:, 1:]), axis=1)
    limit = problem.friction * f[:, 0]
    largest = jnp.maximum(jnp.max(jnp.abs(f), axis=(0, 1)), 1)
    dissipation = jnp.sum(f[:, 1:] * after[:, 1:], axis=1) + slip * limit
    parts = [-after[:, 0], -f[:, 0] / largest, (gauge - limit) / largest]
    parts += [jnp.abs(f[:, 0] * after[:, 0]) / largest, jnp.abs(dissipation) / largest]
    violation = jnp.max(jnp.stack(parts), axis=0)
    # Where friction is none, so is the scale of the tangential velocity.
    violation = jnp.max(jnp.where(problem.present, violation, 0), axis=0)
    return jnp.where(jnp.isfinite(violation), violation, jnp.inf)


# --- From physical to scaled problems and back -----------------------------------------------------------------


class LCPSolution(NamedTuple):
    """Impulses, and the largest violation of the conditions by each problem's, relative to its scale.

    The residual is infinite where the data were not finite, which makes the impulse NaN. It is large where there is no
    solution, or none was found: where contacts squeeze a body and each asks for another velocity after the impact.
    """

    impulse: Float[Array, "*b K d"]
    residual: Float[Array, "*b"]


class _Sensitivity(NamedTuple):
    """What the derivative needs, batch first, in physical units."""

    response: Float[Array, "B n n"]  # df = -response dw where w changes while f_n c does not
    c: Float[Array, "B K t"]  # df_t / dmu = c f_n before the others respond


def _scale(A: Array, v: Array, before: Array, friction: Array):
    """Batch last: A (K, d, K, d, B), v (K, d, B), friction (K, B). Also 1 / sqrt(A_nn) and the largest datum."""
    k, d, batch = v.shape
    index = jnp.arange(k)
    normal = A[index, 0, index, 0]
    present = normal > 0
    size = jnp.where(present, jax.lax.rsqrt(jnp.where(present, normal, 1)), 0)
    A = A * size[:, None, None, None] * size[None, None, :, None]
    v = v * size[:, None]
    felt = jnp.concatenate([v[:, :1], v[:, 1:] * jnp.minimum(friction, 1)[:, None]], axis=1)
    unit = jnp.maximum(jnp.max(jnp.abs(felt), axis=(0, 1)), jnp.finfo(v.dtype).tiny ** 0.5)
    before = before * size[:, None] / unit
    return _Problem(A.reshape(k * d, k * d, batch), v / unit, before, friction, present), size, unit


class _Found(NamedTuple):
    f: Float[Array, "K d B"]
    residual: Float[Array, " B"]  # of the problem that was solved
    energy: Float[Array, " B"]  # added by the impulses
    gains: Bool[Array, " B"]
    modes: _Modes
    diagonal: Float[Array, " B"]  # what that problem's A had more


def _find(problem: _Problem, directions: np.ndarray, settings: _Settings) -> _Found:
    """Lemke's method from several starts, in the end with a diagonal, until all problems are solved without a gain."""
    k, _, batch = problem.v.shape
    dtype = problem.v.dtype
    starts = np.random.default_rng(0).uniform(1, 2, (settings.starts + 1, 2, k * (len(directions) + 2)))
    starts[0, 1] = 1
    starts = jnp.asarray(starts, dtype)

    def keep_going(state):
        count, found = state
        again = (found.residual > settings.solved) | (found.gains & (count < settings.starts))
        return (count <= settings.starts) & jnp.any(again)

    def search(state):
        count, found = state
        diagonal = jnp.where(count == settings.starts, jnp.asarray(settings.diagonal, dtype), 0)
        trial = _soften(problem, jnp.broadcast_to(diagonal, batch))
        M, q = _complementarity_form(trial, directions)
        ties, cover = starts[count]
        z = lemke(M, q, cover=cover, ties=ties, pivot=settings.pivot, tie=settings.tie).reshape(k, -1, batch)
        f_t = jnp.einsum("mt,kmb->ktb", jnp.asarray(directions, dtype), z[:, 1:-1])
        new = found._replace(f=jnp.concatenate([z[:, :1], f_t], axis=1), diagonal=jnp.full(batch, diagonal))
        new = jax.lax.fori_loop(0, 2, lambda _, new: _refine(trial, new, directions, settings), new)
        energy, exchanged = _energy(problem, new.f)
        new = new._replace(energy=energy, gains=energy > settings.solved * exchanged)
        failed = found.residual > settings.solved
        less = found.gains & (new.residual <= settings.solved) & (energy < found.energy) & (count < settings.starts)
        return count + 1, jax.tree.map(lambda a, b: jnp.where(failed | less, a, b), new, found)

    zero = jnp.zeros_like(problem.v)
    modes = _modes(problem, zero, directions, settings)
    none = jnp.zeros(batch, dtype)
    start = _Found(zero, none + jnp.inf, none, none > 0, modes, none)
    return jax.lax.while_loop(keep_going, search, (0, start))[1]


def _soften(problem: _Problem, diagonal: Float[Array, " B"]) -> _Problem:
    eye = jnp.eye(problem.A.shape[0], dtype=diagonal.dtype)
    return problem._replace(A=problem.A + diagonal * eye[..., None])


def _refine(problem: _Problem, found: _Found, directions: np.ndarray, settings: _Settings) -> _Found:
    """The impulse that meets the equations of its modes, if that has the smaller residual."""
    f = found.f
    modes = _modes(problem, f, directions, settings)
    slope = problem.friction[:, None] * modes.c
    normal = (modes.E[:, 0, 0] * f[:, 0])[:, None]
    free = jnp.einsum("kabn,kbn->kan", modes.E[:, 1:, 1:], f[:, 1:])
    moved = jnp.concatenate([normal, free + slope * normal], axis=1)
    rest = _after(problem, moved)
    change = _ModeEquations(problem, modes, settings.ridge).solve(-rest.reshape(-1, 1, f.shape[-1]))
    moved = moved + change.reshape(f.shape)
    old, new = _residual(problem, f, directions), _residual(problem, moved, directions)
    better = new <= old
    return found._replace(f=jnp.where(better, moved, f), residual=jnp.where(better, new, old), modes=modes)


def _solve_block(A: Array, v: Array, before: Array, friction: Array, *, directions: np.ndarray, sensitivity: bool):
    """Solve one block of problems: batch first in and out, batch last inside."""
    batch, k, d = v.shape
    n = k * d
    settings = _Settings.for_dtype(v.dtype)
    finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2)) & jnp.isfinite(friction).all(1)
    finite = finite & jnp.isfinite(before).all((1, 2))
    A = jnp.where(finite[:, None, None], A, 0)
    v, before = (jnp.moveaxis(jnp.where(finite[:, None, None], x, 0), 0, -1) for x in (v, before))
    friction = jnp.where(finite[:, None], friction, 0)
    A = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    problem, size, unit = _scale(A, v, before, friction.T)
    found = _find(problem, directions, settings)
    residual = _residual(problem, found.f, directions)
    nan = jnp.where(finite, 0, jnp.nan).astype(v.dtype)
    impulse = found.f * size[:, None] * unit + nan
    solution = LCPSolution(jnp.moveaxis(impulse, -1, 0), jnp.where(finite, residual, jnp.inf))
    if not sensitivity:
        return solution, None
    eye = jnp.broadcast_to(jnp.eye(n, dtype=v.dtype)[..., None], (n, n, batch))
    response = _ModeEquations(_soften(problem, found.diagonal), found.modes, settings.ridge).solve(eye)
    size = jnp.repeat(size, d, axis=0)
    response = response * size[:, None] * size[None]
    return solution, _Sensitivity(jnp.moveaxis(response, -1, 0), jnp.moveaxis(found.modes.c, -1, 0))


# --- Batches ----------------------------------------------------------------------------------------------------

TABLEAU = 2**17
"""Entries of the tableaus of the problems that are solved together, so that they stay in cache."""


def _solve_batch(A, v, before, friction, *, facets: int, sensitivity: bool):
    """Solve a batch block by block. Problems without a contact cost nothing and give zeros."""
    batch, k, d = v.shape
    n = k * d
    directions = pyramid_directions(d, facets)
    extra = _Sensitivity(jnp.zeros((batch, n, n), v.dtype), jnp.zeros((batch, k, d - 1), v.dtype))
    out = (LCPSolution(jnp.zeros_like(v), jnp.zeros(batch, v.dtype)), extra if sensitivity else None)
    for size, chosen in by_size(contacts_used(A, k), k):
        arrays = A[:, : size * d, : size * d], v[:, :size], before[:, :size], friction[:, :size]
        block = min(max(TABLEAU // (size * (len(directions) + 2)) ** 2, 8), 128)
        solve = functools.partial(_solve_block, directions=directions, sensitivity=sensitivity)
        out = solve_chosen(solve, arrays, chosen, block, out)
    return out


@functools.cache
def _solver(facets: int, sensitivity: bool):
    solve = functools.partial(_solve_batch, facets=facets, sensitivity=sensitivity)
    return as_one_batch(solve, "complementarity solver")


@functools.partial(jax.custom_jvp, nondiff_argnums=(4,))
def _impulse(A, v, before, friction, facets: int) -> LCPSolution:
    return _solver(facets, False)(A, v, before, friction)[0]


# The derivative. With f = S y, S = E + mu c e_n^T and constant E and c (the modes are locally constant away from
# kinks), E (A f + v) = 0 differentiates to
#
#     E A S dy = -E (dA f + dv + A u),    df = u + S dy,    u = dmu c f_n
#
# The right-hand side is linear in the tangents and its matrix is an output of the solve, from which both modes, vmap
# and jit follow.
@_impulse.defjvp
def _impulse_jvp(facets, primals, tangents):
    A, v, before, friction = primals
    dA, dv, _, dfriction = tangents  # `before` only chooses among solutions
    solution, out = _solver(facets, True)(A, v, before, friction)
    f = solution.impulse
    u = dfriction[..., None] * out.c * f[..., :1]
    u = jnp.concatenate([jnp.zeros_like(u[..., :1]), u], axis=-1).reshape(*f.shape[:1], -1)
    change = jnp.einsum("bij,bj->bi", dA, f.reshape(u.shape)) + dv.reshape(u.shape) + jnp.einsum("bij,bj->bi", A, u)
    df = u - jnp.einsum("bij,bj->bi", out.response, change)
    return solution, LCPSolution(df.reshape(f.shape), jnp.zeros_like(solution.residual))


def solve_lcp_impulse(
    A: Float[Array, "*b n n"],
    v: Float[Array, "*b K d"],
    friction: Float[Array, "*b K"],
    rebound: Float[Array, "*b K"],
    v_tangent_target: Float[Array, "*b K t"] | None = None,
    *,
    facets: int = 4,
) -> LCPSolution:
    """Impulses of simultaneous impacts with a friction pyramid and Newton's restitution.

    **Arguments:** `A` (..., K d, K d), Delassus matrix (1/kg), symmetric positive semi-definite, contacts stacked with
    the normal first; `v` (..., K, d), velocities before (m/s); `friction` (..., K), mu >= 0; `rebound` (..., K), least
    normal velocities after (m/s): by Newton's hypothesis `-e min(v_n, 0)`; `v_tangent_target` (..., K, d - 1),
    tangential velocities that friction strives for (m/s), or `None` for zero; `facets`, edges of the pyramid in 3D,
    even and at least 4. In 2D the pyramid is the cone; in 3D it holds less friction than the cone between its edges,
    by up to `cos(pi / facets)`, and depends on the directions of the tangents.

    **Returns:** impulses (..., K, d) in N s and each problem's residual. A contact whose normal entry of `A` is zero is
    padding and gets no impulse. Where impulses are not unique they are some solution; where the first one found adds
    energy, the one that adds least among those found from three starts. Batch axes and `jax.vmap` both
    become one batch. The search runs in double precision where that is enabled. Differentiable once, in forward and
    reverse mode; the derivative is finite also where contacts are redundant, at kinks it is a one-sided one, and at
    mu = 0 that for a growing mu.

    **Raises:** `CaromError` if `facets` is odd or less than 4.

    **Source:** paper, appendix J; Stewart and Trinkle, *An implicit time-stepping scheme for rigid body dynamics with
    inelastic collisions and Coulomb friction*, 1996; Anitescu and Potra, 1997, for Lemke's method on it.
    """
    if facets < 4 or facets % 2:
        raise CaromError(f"facets must be even and at least 4; it was {facets}.")
    *batch, k, d = v.shape
    widest = jnp.zeros((), float).dtype
    work = widest if widest.itemsize > v.dtype.itemsize else v.dtype
    A, velocity, friction, rebound = (x.astype(work) for x in (A, v, friction, rebound))
    # Friction and restitution only ever see the velocity less what is wanted.
    wanted = jnp.zeros((*batch, k, d - 1), work) if v_tangent_target is None else v_tangent_target.astype(work)
    less = velocity - jnp.concatenate([rebound[..., None], wanted], axis=-1)
    less, before = (x.reshape(-1, k, d) for x in (less, velocity))
    out = _impulse(A.reshape(-1, k * d, k * d), less, before, friction.reshape(-1, k), facets)
    return LCPSolution(out.impulse.reshape(v.shape).astype(v.dtype), out.residual.reshape(batch).astype(v.dtype))
