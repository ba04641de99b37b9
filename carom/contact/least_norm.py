r"""Of all impulses that contacts may have with given modes the one of least norm. Arrays only.

Where contacts are redundant (`A` is singular) many impulses `y` within the friction cones do the same; where contacts
slide, some may meet Coulomb's law that leave other velocities. With `u = Q y + q` the modes of a solution (which
contacts are open, stick, and slide where to) say what the others may be: a convex set `Y`, a product over the contacts,
and a plane,

    open        y_n = lower,                                    u_n > 0
    closed      y_n >= lower,                                   u_n = 0
    sticking    |y_t| <= mu y_n,                                u_t = 0
    sliding     y_t = -mu y_n u_t / |u_t|                       (of a convex program: u_n = mu |u_t|)

The one of least norm in both, the projection of zero, is unique. With `Q` and `y` scaled by each contact's mobility the
norm is an energy, which knows neither frame nor unit; and nothing hangs on how a solution was found. (But in 3D, where
velocities change: the way of sliding turns with them.)
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from carom.contact.cone_algebra import dot, pick

# --- The method -------------------------------------------------------------------------------------------------
#
# With E the rows of the plane, E Q = U S V^T and b = -S^-1 U^T E q, the plane is V^T y = b, and the projection is
# P(V a), where a maximises the concave dual, of which this is the negative, with its gradient:
#
#     phi(a) = |z|^2 / 2 - |z - P(z)|^2 / 2 - b a,   z = V a;      phi' = V^T P(z) - b
#
# P, the projection onto Y, is piecewise smooth, so that Newton's steps end in the minimum after a few, each the one
# after which phi is least of some lengths and diagonals: phi is flat where all impulses along a way are at an edge, and
# nearly so where contacts are jammed, with impulses far larger than what is asked for.

_SINGULAR = 1e-9
"""Singular values below this share of the largest one are zero."""
_REGULAR = 1e-6
"""Matrices whose pivots are all above this share of their diagonals have none."""
STILL = 1e-7
"""Velocities below this share of the largest that there is, or that an impulse makes, are zero."""
_SLOW = 0.01
"""Where the impulse is at the edge of its cone, velocities above this share of those are sliding."""
_ROUNDING = 1e-13
"""Curvatures below this share of the largest are rounding."""
_STEPS = 80
_PATIENCE = 12
"""Steps without one that is better by a tenth after which a search ends: modes that nothing can have, or rounding."""
_LENGTHS = (1.0, 10.0, 0.3, 0.1, 0.03, 0.01, 0.001)
_RIDGES = ((0.0, 1e-13), (1e-5, 1e-10), (1e-2, 1e-10))
"""Diagonals of a step's matrix: a share of what is missed, and at least. Steps of each are tried."""
_FOUND = 1e-13


class Allowed(NamedTuple):
    """`Y` above."""

    mu: Float[Array, "K B"]
    lower: Float[Array, "K B"]
    closed: Bool[Array, "K B"]
    slides: Bool[Array, "K B"]
    way: Float[Array, "K t B"]  # unit vector against the sliding


class _Look(NamedTuple):
    """What is known at `a`."""

    a: Float[Array, "n B"]
    P: Float[Array, "K d B"]  # of V a, and its derivative
    D: Float[Array, "K d d B"]
    slope: Float[Array, "n B"]  # phi'
    missed: Float[Array, " B"]  # by it, where that matters


class _Search(NamedTuple):
    """Where the search is, the best that it has seen, and when that was."""

    at: _Look
    best: _Look
    since: Int[Array, " B"]
    step: Int[Array, ""]


def may_be_redundant(A: Float[Array, "B n n"], contacts: int) -> Bool[Array, " B"]:
    """Whether some of several contacts (`A` of their scales, padding zeros) may be."""
    own = jnp.diagonal(A, axis1=1, axis2=2)[:, :: A.shape[1] // contacts]
    return (jnp.sum(own > 0, axis=1) > 1) & _is_singular(A)


def _is_singular(A: Float[Array, "B n n"]) -> Bool[Array, " B"]:
    """By the least pivot, diagonals of 1; rows of zeros are none."""
    own = jnp.diagonal(A, axis1=1, axis2=2)
    size = jnp.where(own > 0, jax.lax.rsqrt(jnp.asarray(jnp.where(own > 0, own, 1))), 0)
    padding = jnp.where(own > 0, 0, 1)[:, None] * jnp.eye(A.shape[1], dtype=A.dtype)
    pivots = jnp.diagonal(jnp.linalg.cholesky(size[:, :, None] * A * size[:, None] + padding), axis1=1, axis2=2)
    return ~(jnp.min(pivots, axis=1) ** 2 > _REGULAR)


def are_redundant(
    Q: Float[Array, "n n B"],
    u: Float[Array, "K d B"],
    y: Float[Array, "K d B"],
    mu: Float[Array, "K B"],
    lower: Float[Array, "K B"],
) -> Bool[Array, " B"]:
    """Whether several impulses have the modes of the solution `y`, where contacts leave as Coulomb's law says.

    They move along `G`: on a contact that slides the tangents go with the normal. Then either the velocities are the
    same, or they are not: sliding may have a continuum of solutions.
    """
    allowed, rows = _held(u, y, mu, lower, lifts=False)
    k, d, batch = y.shape
    moves = Q.reshape(k * d, k, d, batch)
    along = jnp.where(allowed.slides, mu, 0)[:, None] * allowed.way
    moves = moves.at[:, :, 0].add(jnp.sum(moves[:, :, 1:] * along, axis=2)).reshape(k * d, k * d, batch)
    own = jnp.diagonal(Q).T.reshape(k * d, batch)
    rows = rows.reshape(k * d, batch) & (own > 0)
    size = jnp.where(rows, jax.lax.rsqrt(jnp.asarray(jnp.where(rows, own, 1))), 0)
    none = jnp.where(rows, 0, 1)[:, None] * jnp.eye(k * d, dtype=y.dtype)[..., None]
    acting = jnp.moveaxis(size[:, None] * moves * size + none, -1, 0)
    pivots = jnp.diagonal(jax.lax.linalg.lu(acting)[0], axis1=1, axis2=2)
    return ~(jnp.min(jnp.abs(pivots), axis=1) > _REGULAR)


def _held(u: Array, y: Array, mu: Array, lower: Array, *, lifts: bool) -> tuple[Allowed, Bool[Array, "K d B"]]:
    """`Y`, and the rows of the plane, with the modes of the solution `y`."""
    speed = jnp.sqrt(dot(u[:, 1:], u[:, 1:]))
    still = STILL * jnp.maximum(jnp.max(jnp.abs(y), axis=(0, 1)), 1)
    slides = speed > still
    if lifts:
        # Programs are solved better than that: a contact slides if it is nearer to the edge of its cone than to rest.
        slides = slides | (speed > jnp.maximum(mu * y[:, 0] - jnp.sqrt(dot(y[:, 1:], y[:, 1:])), _SLOW * still))
    closed = u[:, 0] - (mu * speed if lifts else 0) <= still
    way = -u[:, 1:] / jnp.where(slides, speed, 1)[:, None]
    if lifts:
        # Where it slides slowly, its friction tells the way better than its velocity.
        push = jnp.sqrt(dot(y[:, 1:], y[:, 1:]))
        way = jnp.where((push > speed)[:, None], y[:, 1:] / jnp.where(push > speed, push, 1)[:, None], way)
    # What is pushed harder than it needs has friction, too.
    tangents = ((closed | (lower > 0)) & (mu > 0) & (lifts | ~slides))[:, None]
    rows = jnp.concatenate([closed[:, None], jnp.broadcast_to(tangents, y[:, 1:].shape)], axis=1)
    return Allowed(mu, lower, closed, slides, way), rows


def _parts(allowed: Allowed, t: Float[Array, "K t B"]) -> tuple[Float[Array, "K t B"], Float[Array, "K t B"]]:
    """Of tangents what is across the way of sliding, all of it where a contact sticks; and `mu` along that way."""
    way = jnp.where(allowed.slides[:, None], allowed.way, 0)
    return t - way * dot(way, t)[:, None], allowed.mu[:, None] * way


def _of_program(
    allowed: Allowed, Q: Float[Array, "n n B"], q: Float[Array, "K d B"]
) -> tuple[Float[Array, "n n B"], Float[Array, "K d B"]]:
    """The rows of the plane, and what they are to be, of a convex program: a contact that slides lifts by it.

    `u_n + mu u_t way = 0` and no velocity across: for these no velocity need be known.
    """
    k, d, batch = q.shape

    def turned(x: Float[Array, "K d B"]) -> Float[Array, "K d B"]:
        across, along = _parts(allowed, x[:, 1:])
        return jnp.concatenate([x[:, :1] + dot(along, x[:, 1:])[:, None], across], axis=1)

    rows = jax.vmap(turned, in_axes=2, out_axes=2)(Q.reshape(k, d, k * d, batch))
    return rows.reshape(k * d, k * d, batch), -turned(q)


class Least(NamedTuple):
    """The impulse `y` of least norm, where one is `found`, and what its derivative needs."""

    y: Float[Array, "K d B"]
    z: Float[Array, "K d B"]  # y = P(z),
    w: Float[Array, "K d B"]  # z = Q w, but for rows that are not in E
    V: Float[Array, "B n n"]
    inverse: Float[Array, "B n n"]  # V S^-1 U^T, with columns that are no row of E zero
    held: Bool[Array, "K d B"]  # rows of E
    allowed: Allowed
    singular: Bool[Array, " B"]  # contacts are redundant
    found: Bool[Array, " B"]


def project(allowed: Allowed, z: Float[Array, "K d B"]) -> tuple[Float[Array, "K d B"], Float[Array, "K d d B"]]:
    """`P(z)` and its derivative."""
    mu, lower, closed, slides, way = allowed
    normal, tangent = z[:, 0], z[:, 1:]
    length = jnp.sqrt(dot(tangent, tangent))
    safe = jnp.where(length > 0, length, 1)
    toward = jnp.where(slides[:, None], way, tangent / safe[:, None])
    reach = jnp.where(slides, dot(way, tangent), length)
    inside = ~slides & (length <= mu * normal)
    on_cone = (normal + mu * reach) / (1 + mu**2)
    height = jnp.where(inside, normal, on_cone)
    rises = closed & (height > lower)
    height = jnp.where(rises, height, lower)
    # At the bound there is a disc to be in.
    free = ~slides & jnp.where(rises, inside, length <= mu * height)
    y_t = jnp.where(free[:, None], tangent, mu[:, None] * height[:, None] * toward)
    y = jnp.concatenate([height[:, None], y_t], axis=1)
    slope = jnp.where(rises, jnp.where(inside, 1, 1 / (1 + mu**2)), 0)
    by_normal = slope
    by_tangent = jnp.where(inside, 0, slope * mu)[:, None] * toward  # of the height
    eye = jnp.eye(tangent.shape[1], dtype=z.dtype)[None, :, :, None]
    across = eye - toward[:, :, None] * toward[:, None]
    turning = jnp.where(slides, 0, mu * height / safe)[:, None, None] * across
    moves = (mu[:, None] * toward)[:, :, None] * by_tangent[:, None] + turning
    moves = jnp.where(free[:, None, None], eye, moves)
    lifts = jnp.where(free[:, None], 0, (mu * by_normal)[:, None] * toward)
    top = jnp.concatenate([by_normal[:, None, None], by_tangent[:, None]], axis=2)
    return y, jnp.concatenate([top, jnp.concatenate([lifts[:, :, None], moves], axis=2)], axis=1)


def polished(
    Q: Float[Array, "n n B"],
    q: Float[Array, "K d B"],
    u: Float[Array, "K d B"],
    y: Float[Array, "K d B"],
    mu: Float[Array, "K B"],
    lower: Float[Array, "K B"],
) -> Float[Array, "K d B"]:
    """A nearly solved convex program by the equations of its modes: `G^T (Q G a + q) = 0` for impulses `G a`.

    A column of G is what a contact's impulse can change: all of it where it sticks, `(1, mu way)` where it slides.
    Where contacts are jammed, small residuals leave velocities that are not small: their equations, without a diagonal,
    tell them to rounding. The part of the impulse that no equation tells stays as it is.
    """
    k, d, batch = y.shape
    speed, push = (jnp.sqrt(dot(part[:, 1:], part[:, 1:])) for part in (u, y))
    # Of what is at an edge and what leaves it the smaller is zero.
    slides = speed > mu * y[:, 0] - push
    closed = y[:, 0] - lower >= u[:, 0] - mu * jnp.where(slides, speed, 0)
    sticks = jnp.broadcast_to((~slides & (mu > 0) & (closed | (lower > 0)))[:, None], y[:, 1:].shape)
    normal = jnp.where(closed, y[:, 0], lower)
    along = jnp.where(slides, mu / jnp.where(push > 0, push, 1), 0)[:, None] * y[:, 1:]
    y = jnp.concatenate([normal[:, None], jnp.where(sticks, y[:, 1:], along * normal[:, None])], axis=1)
    blocks = jnp.zeros((k, d, d, batch), y.dtype)
    blocks = blocks.at[:, 0, 0].set(jnp.where(closed, 1, 0))
    blocks = blocks.at[:, 1:, 0].set(jnp.where(closed[:, None], along, 0))
    blocks = blocks.at[:, jnp.arange(1, d), jnp.arange(1, d)].set(jnp.where(sticks, 1, 0))
    G, matrix = block_diagonal(blocks), jnp.moveaxis(Q, -1, 0)
    values, vectors = jnp.linalg.eigh(jnp.swapaxes(G, 1, 2) @ matrix @ G)
    over = jnp.where(values > _ROUNDING * values[:, -1:], 1 / jnp.asarray(jnp.where(values > 0, values, 1)), 0)
    ways = G @ vectors
    f, known = (jnp.moveaxis(part, -1, 0).reshape(batch, k * d) for part in (y, q))
    for _ in range(2):
        missed = jnp.einsum("bij,bi->bj", ways, jnp.einsum("bij,bj->bi", matrix, f) + known)
        f = f - jnp.einsum("bij,bj->bi", ways, over * missed)
    return jnp.moveaxis(f.reshape(batch, k, d), 0, -1)


def block_diagonal(blocks: Float[Array, "K d d B"]) -> Float[Array, "B n n"]:
    """One matrix of those of the contacts."""
    k, d, _, batch = blocks.shape
    whole = jnp.zeros((k, d, k, d, batch), blocks.dtype).at[jnp.arange(k), :, jnp.arange(k)].set(blocks)
    return jnp.moveaxis(whole.reshape(k * d, k * d, batch), -1, 0)


def least_norm(
    Q: Float[Array, "n n B"],
    q: Float[Array, "K d B"],
    u: Float[Array, "K d B"],
    y: Float[Array, "K d B"],
    mu: Float[Array, "K B"],
    lower: Float[Array, "K B"],
    *,
    lifts: bool = False,
    steps: int | Int[Array, ""] = _STEPS,
) -> Least:
    """The impulse of least norm with the modes of the solution `y`, after which velocities are `u`.

    All scaled such that the largest velocity is about 1. Where no contacts are redundant, or none is found, it is `y`.
    `lifts`: of the convex programs, where a contact that slides leaves with `u_n = mu |u_t|`; these velocities, which
    are unique, are kept. Of those that `steps` are too few for none is found.
    """
    k, d, batch = y.shape
    allowed, held = _held(u, y, mu, lower, lifts=lifts)

    def first(x: Array) -> Array:
        return jnp.moveaxis(x.reshape(k * d, batch), -1, 0)

    rows = first(held)
    matrix, wanted = _of_program(allowed, Q, q) if lifts else (Q, -q)
    wanted = first(wanted)
    left, values, right = jnp.linalg.svd(jnp.where(rows[..., None], jnp.moveaxis(matrix, -1, 0), 0))
    counts = values > _SINGULAR * values[:, :1]
    V = jnp.where(counts[:, None], jnp.swapaxes(right, 1, 2), 0)
    b = (jnp.einsum("bij,bi->bj", left, jnp.where(rows, wanted, 0)) / jnp.where(counts, values, jnp.inf)).T
    if lifts:
        acting = rows[:, :, None] & rows[:, None]
        singular = _is_singular(jnp.where(acting, jnp.moveaxis(Q, -1, 0), 0))
    else:
        singular = are_redundant(Q, u, y, mu, lower)
    size = jnp.maximum(jnp.max(jnp.abs(b), axis=0), 1)

    lengths, ridges = jnp.array(_LENGTHS, y.dtype), jnp.array(_RIDGES, y.dtype).T
    eye = jnp.eye(k * d, dtype=y.dtype)

    def look(a: Array) -> tuple[Array, _Look]:
        z = jnp.einsum("bij,jb->ib", V, a).reshape(k, d, batch)
        P, D = project(allowed, z)
        value = jnp.sum(z**2 - (z - P) ** 2, axis=(0, 1)) / 2 - jnp.sum(b * a, axis=0)
        slope = jnp.einsum("bij,ib->jb", V, P.reshape(k * d, batch)) - b
        missed = jnp.where(singular, jnp.max(jnp.abs(slope), axis=0) / size, 0)
        return value, _Look(a, P, D, slope, missed)

    def newton(at: _Look) -> Array:
        whole = block_diagonal(at.D)
        curvature = jnp.einsum("bij,bik,bkl->bjl", V, whole, V)

        def step(share: Array, least: Array) -> Array:
            ridge = jnp.clip(share * at.missed, least, 0.01)[:, None]
            matrix = curvature + jnp.where(counts, ridge, 1)[..., None] * eye
            return -jnp.linalg.solve(matrix, at.slope.T[..., None])[..., 0].T

        return jax.vmap(step)(*ridges)

    def keep_going(search: _Search):
        going = (search.best.missed > _FOUND) & (search.step - search.since <= _PATIENCE)
        return (search.step <= steps) & jnp.any(going)

    def body(search: _Search) -> _Search:
        at, best, step = search.at, search.best, search.step
        # The first time there is no step, only a look at the start. All is computed for each length, and so written
        # once: to compile it costs more than to run it.
        change = jax.lax.cond(step > 0, newton, lambda at: jnp.zeros((len(_RIDGES), *at.a.shape), y.dtype), at)
        trials = at.a + jnp.concatenate([length * change for length in lengths])
        values, looks = jax.vmap(look)(trials)
        values = jnp.where(at.missed < 1e-6, looks.missed, values)  # near the end phi differs by rounding alone
        new = pick(looks, jnp.argmin(jnp.where(jnp.isnan(values), jnp.inf, values), axis=0))
        since = jnp.where(new.missed < 0.9 * best.missed, step, search.since)
        better = new.missed < best.missed
        return _Search(new, jax.tree.map(lambda a, b: jnp.where(better, a, b), new, best), since, step + 1)

    unknown = jnp.where(singular, jnp.inf, 0).astype(y.dtype)
    start = _Look(b, y, jnp.zeros((k, d, d, batch), y.dtype), b, unknown)
    none = jnp.asarray(0)
    end = jax.lax.while_loop(keep_going, body, _Search(start, start, jnp.zeros(batch, none.dtype), none)).best
    found = singular & (end.missed < 1e-9)
    over = jnp.where(counts, 1 / jnp.where(counts, values, 1), 0)
    inverse = jnp.where(rows[:, None], jnp.einsum("bij,bj,bkj->bik", V, over, left), 0)
    z = jnp.einsum("bij,jb->ib", V, end.a).reshape(k, d, batch)
    w = jnp.einsum("bij,jb->ib", left, end.a * over.T).reshape(k, d, batch)
    if lifts:
        across, along = _parts(allowed, w[:, 1:])
        w = jnp.concatenate([w[:, :1], across + along * w[:, :1]], axis=1)
    return Least(jnp.where(found, end.P, y), z, w, V, inverse, held, allowed, singular, found)
