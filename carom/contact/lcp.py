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
from jaxtyping import Array, Bool, Float, Int

from carom.contact.linalg import Cholesky
from carom.errors import CaromError

# --- The method -------------------------------------------------------------------------------------------------
#
# Lemke's method finds a complementary basis; its matrix is copositive, so that in exact arithmetic it ends in a
# solution wherever no self-stress (an impulse inside the pyramids with A f = 0) has to do work against `rebound`.
# Elsewhere there is mostly none, and where there is one another start may find it. If none does, the impulse is that
# of A with a larger diagonal: that problem always has a solution, and the residual tells that it is another's.
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
    friction: Float[Array, "K B"]
    present: Bool[Array, "K B"]


def _directions(d: int, facets: int) -> np.ndarray:
    """The pyramid's unit directions, (m, d - 1)."""
    if d == 2:
        return np.array([[1.0], [-1.0]])
    angle = 2 * np.pi * np.arange(facets) / facets
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _after(problem: _Problem, f: Float[Array, "K d B"]) -> Float[Array, "K d B"]:
    """Velocity after the impact, less rebound and target."""
    return jnp.sum(problem.A * f.reshape(1, -1, f.shape[-1]), axis=1).reshape(f.shape) + problem.v


def _along(directions: np.ndarray, x: Float[Array, "K t B"]) -> Float[Array, "K m B"]:
    return jnp.einsum("mt,ktb->kmb", jnp.asarray(directions, x.dtype), x)


# --- Lemke's method ---------------------------------------------------------------------------------------------
#
# The tableau expresses the basic variables by the others: basic = T nonbasic + value. Cycling is excluded by a
# symbolic perturbation of the constants, values + epsilon ties for an infinitesimal epsilon, with ties drawn at
# random: the tableau carries both columns, and the second decides where the first does not. `start` is that random
# column and the one of the artificial variable z_0, both positive.


class _Lemke(NamedTuple):
    T: Float[Array, "N N+3 B"]  # columns: nonbasic variables, value, tie
    rows: Int[Array, "N B"]  # basic variables: w as 0..N-1, z as N..2N-1, z_0 as 2N
    columns: Int[Array, "N+1 B"]  # nonbasic variables
    entering: Int[Array, " B"]
    done: Bool[Array, " B"]
    iteration: Int[Array, ""]


def _pivot(T: Array, column: Array, row: Array, col: Array) -> Array:
    """The tableau after basic `row` and nonbasic `column` (one-hot, (N, B) and (N + 1, B)) have changed places."""
    column = jnp.concatenate([column, jnp.zeros_like(column[:2])])
    across = jnp.sum(jnp.where(row[:, None], T, 0), axis=0)
    pivot = jnp.sum(jnp.where(row, col, 0), axis=0)
    across = jnp.where(column, 1, -across) / jnp.where(pivot == 0, 1, pivot)
    return jnp.where(row[:, None] | column[None], 0, T) + jnp.where(row, 1, col)[:, None] * across[None]


def _first(choice: Bool[Array, "N B"], key: Float[Array, "N B"]) -> Bool[Array, "N B"]:
    """One-hot of the least key among the chosen."""
    best = jnp.argmin(jnp.where(choice, key, jnp.inf), axis=0)
    return (jnp.arange(key.shape[0])[:, None] == best) & choice


def _lemke_start(M: Array, q: Array, start: Array) -> _Lemke:
    size, batch = q.shape
    ties, cover = (jnp.broadcast_to(x[:, None], q.shape) for x in start)
    T = jnp.concatenate([M, jnp.stack([cover, q, ties], axis=1)], axis=1)
    rows = jnp.broadcast_to(jnp.arange(size)[:, None], (size, batch))
    columns = jnp.broadcast_to(jnp.arange(size, 2 * size + 1)[:, None], (size + 1, batch))
    ratio = q / cover
    row = _first(ratio == jnp.min(ratio, axis=0), ties / cover)
    leaving = jnp.argmax(row, axis=0)
    done = jnp.min(q, axis=0) >= 0
    row = row & ~done
    column = (columns == 2 * size) & ~done
    T = jnp.where(done, T, _pivot(T, column, row, T[:, size]))
    rows = jnp.where(row, 2 * size, rows)
    columns = jnp.where(column, leaving, columns)
    return _Lemke(T, rows, columns, leaving + size, done, jnp.asarray(0))


def _lemke_step(state: _Lemke, settings: _Settings) -> _Lemke:
    T, rows, columns, entering, done, iteration = state
    size = rows.shape[0]
    column = columns == entering
    col = jnp.sum(jnp.where(column[None], T[:, : size + 1], 0), axis=1)
    falling = col < -settings.pivot
    slope = jnp.where(falling, -col, 1)
    ratio = jnp.min(jnp.where(falling, jnp.maximum(T[:, -2], 0) / slope, jnp.inf), axis=0)
    # No basic variable falls: a ray, the problem has (for this method) no solution.
    ray = ~jnp.any(falling, axis=0)
    tied = falling & (T[:, -2] - jnp.where(ray, 0, ratio) * slope <= settings.tie)
    is_artificial = rows == 2 * size
    key = jnp.where(is_artificial, -jnp.inf, T[:, -1] / slope)  # z_0 leaves whenever it can
    move = ~done & ~ray
    row = _first(tied, key) & move
    leaving = jnp.sum(jnp.where(row, rows, 0), axis=0)
    T = jnp.where(move, _pivot(T, column & move, row, col), T)
    rows = jnp.where(row, entering, rows)
    columns = jnp.where(column & move, leaving, columns)
    done = done | ray | (leaving == 2 * size)
    return _Lemke(T, rows, columns, (leaving + size) % (2 * size), done, iteration + 1)


def _lemke(M: Float[Array, "N N B"], q: Float[Array, "N B"], start: Float[Array, "2 N"], settings: _Settings):
    """The `z` with `0 <= z`, `0 <= M z + q`, `z^T (M z + q) = 0`, or where there was none, where the search ended."""
    size = q.shape[0]

    def keep_going(state):
        return jnp.any(~state.done) & (state.iteration < 10 * size)

    end = jax.lax.while_loop(keep_going, lambda state: _lemke_step(state, settings), _lemke_start(M, q, start))
    is_z = end.rows[None] == jnp.arange(size, 2 * size)[:, None, None]
    return jnp.maximum(jnp.sum(jnp.where(is_z, end.T[None, :, -2], 0), axis=1), 0)


def _complementarity_form(problem: _Problem, directions: np.ndarray):
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


def _scale(A: Array, v: Array, friction: Array):
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
    return _Problem(A.reshape(k * d, k * d, batch), v / unit, friction, present), size, unit


class _Found(NamedTuple):
    f: Float[Array, "K d B"]
    residual: Float[Array, " B"]  # of the problem that was solved
    modes: _Modes
    diagonal: Float[Array, " B"]  # what that problem's A had more


def _find(problem: _Problem, directions: np.ndarray, settings: _Settings) -> _Found:
    """Lemke's method from several starts, in the end with a diagonal, until all problems are solved."""
    k, _, batch = problem.v.shape
    dtype = problem.v.dtype
    starts = np.random.default_rng(0).uniform(1, 2, (settings.starts + 1, 2, k * (len(directions) + 2)))
    starts[0, 1] = 1
    starts = jnp.asarray(starts, dtype)

    def keep_going(state):
        count, found = state
        return (count <= settings.starts) & jnp.any(found.residual > settings.solved)

    def search(state):
        count, found = state
        diagonal = jnp.where(count == settings.starts, jnp.asarray(settings.diagonal, dtype), 0)
        trial = _soften(problem, jnp.broadcast_to(diagonal, batch))
        z = _lemke(*_complementarity_form(trial, directions), starts[count], settings).reshape(k, -1, batch)
        f_t = jnp.einsum("mt,kmb->ktb", jnp.asarray(directions, dtype), z[:, 1:-1])
        new = found._replace(f=jnp.concatenate([z[:, :1], f_t], axis=1), diagonal=jnp.full(batch, diagonal))
        new = jax.lax.fori_loop(0, 2, lambda _, new: _refine(trial, new, directions, settings), new)
        failed = found.residual > settings.solved
        return count + 1, jax.tree.map(lambda a, b: jnp.where(failed, a, b), new, found)

    zero = jnp.zeros_like(problem.v)
    modes = _modes(problem, zero, directions, settings)
    start = _Found(zero, jnp.full(batch, jnp.inf, dtype), modes, jnp.zeros(batch, dtype))
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


def _solve_block(A: Array, v: Array, friction: Array, directions: np.ndarray, sensitivity: bool):
    """Solve one block of problems: batch first in and out, batch last inside."""
    batch, k, d = v.shape
    n = k * d
    settings = _Settings.for_dtype(v.dtype)
    finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2)) & jnp.isfinite(friction).all(1)
    A = jnp.where(finite[:, None, None], A, 0)
    v = jnp.where(finite[:, None, None], v, 0)
    friction = jnp.where(finite[:, None], friction, 0)
    A = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    problem, size, unit = _scale(A, jnp.moveaxis(v, 0, -1), friction.T)
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

SMALL = 2
"""Contacts up to which a problem of a larger batch is solved in a small form of its own."""

TABLEAU = 2**17
"""Entries of the tableaus of the problems that are solved together, so that they stay in cache."""


def _solve_batch(A, v, friction, facets: int, sensitivity: bool):
    """Solve a batch block by block. Problems without a contact cost nothing and give zeros."""
    batch, k, d = v.shape
    index = jnp.arange(k)
    diagonal = A.reshape(batch, k, d, k, d)[:, index, 0, index, 0]
    present = ~(diagonal <= 0)  # NaN counts as present, so that it is reported
    used = jnp.max(jnp.where(present, index + 1, 0), axis=1)
    extra = None
    if sensitivity:
        extra = _Sensitivity(jnp.zeros((batch, k * d, k * d), v.dtype), jnp.zeros((batch, k, d - 1), v.dtype))
    out = (LCPSolution(jnp.zeros_like(v), jnp.zeros(batch, v.dtype)), extra)
    at_least = 0
    for size in (SMALL, k) if k > 2 * SMALL else (k,):
        chosen = (used > at_least) & (used <= size)
        out = _solve_chosen(A, v, friction, facets, sensitivity, out, chosen, size)
        at_least = size
    return out


def _solve_chosen(A, v, friction, facets: int, sensitivity: bool, out, chosen, size: int):
    """Solve the `chosen` problems, of which only the first `size` contacts are used, and put them into `out`."""
    batch, _, d = v.shape
    n = size * d
    directions = _directions(d, facets)
    rows = size * (len(directions) + 2)
    block = min(max(TABLEAU // rows**2, 8), 128, batch)
    order = jnp.nonzero(chosen, size=-(-batch // block) * block, fill_value=batch)[0]

    def body(i, out):
        lanes = jax.lax.dynamic_slice(order, (i * block,), (block,))

        def take(whole):
            return whole.at[lanes].get(mode="fill", fill_value=0)

        data = take(A[:, :n, :n]), take(v[:, :size]), take(friction[:, :size])
        solved = _solve_block(*data, directions, sensitivity)

        def put(whole, part):
            return whole.at[(lanes, *(slice(0, s) for s in part.shape[1:]))].set(part, mode="drop")

        return jax.tree.map(put, out, solved)

    blocks = (jnp.sum(chosen) + block - 1) // block
    return jax.lax.fori_loop(0, blocks, body, out)


@functools.cache
def _batched(facets: int, sensitivity: bool):
    """`_solve_batch` for this pyramid, whose batching under vmap is one larger batch."""

    @jax.custom_batching.custom_vmap
    def solve(A, v, friction):
        return _solve_batch(A, v, friction, facets, sensitivity)

    @solve.def_vmap
    def _(size, batched, *arrays):
        flat = []
        for x, is_batched in zip(arrays, batched, strict=True):
            x = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            flat.append(x.reshape(-1, *x.shape[2:]))
        out = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), solve(*flat))
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def undifferentiated(*arrays):
        return solve(*arrays)

    @undifferentiated.defjvp
    def _(primals, tangents):
        raise NotImplementedError(
            "carom's complementarity solver has first derivatives only: its derivative cannot be differentiated again. "
            "Use a Gauss-Newton approximation, or differences of gradients, in place of second derivatives."
        )

    return undifferentiated


@functools.partial(jax.custom_jvp, nondiff_argnums=(3,))
def _impulse(A, v, friction, facets: int) -> LCPSolution:
    return _batched(facets, False)(A, v, friction)[0]


# The derivative. With f = S y, S = E + mu c e_n^T and constant E and c (the modes are locally constant away from
# kinks), E (A f + v) = 0 differentiates to
#
#     E A S dy = -E (dA f + dv + A u),    df = u + S dy,    u = dmu c f_n
#
# The right-hand side is linear in the tangents and its matrix is an output of the solve, from which both modes, vmap
# and jit follow.
@_impulse.defjvp
def _impulse_jvp(facets, primals, tangents):
    A, v, friction = primals
    dA, dv, dfriction = tangents
    solution, out = _batched(facets, True)(A, v, friction)
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
    even and at least 4. In 2D the pyramid is the cone.

    **Returns:** impulses (..., K, d) in N s and each problem's residual. A contact whose normal entry of `A` is zero is
    padding and gets no impulse. Where impulses are not unique they are some solution. Batch axes and `jax.vmap` both
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
    velocity = velocity - jnp.concatenate([rebound[..., None], wanted], axis=-1)
    out = _impulse(A.reshape(-1, k * d, k * d), velocity.reshape(-1, k, d), friction.reshape(-1, k), facets)
    return LCPSolution(out.impulse.reshape(v.shape).astype(v.dtype), out.residual.reshape(batch).astype(v.dtype))
