r"""The derivative of which impulse it is, of many that meet the law: of the one of least norm. Arrays only.

With the notation of `least_norm.py`, where `y = P(z)`, `z = (E Q)^T w` and the range of V is that of `(E Q)^T`,

    dy = D dz + dP,   dz = V dc + dQ w,   E (Q dy + dQ y + dq) = E du,

in which `dP` is what friction, the bound and the way of sliding change of the projection. `du` is zero, but for what
lifts in a convex program: velocities are unique there, and a solver's own derivative gives them. Elsewhere the way of
sliding follows the impulse that is chosen.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from carom.contact.batching import as_one_batch, of_each, solve_chosen
from carom.contact.cone_algebra import apply, matvec
from carom.contact.least_norm import STILL, block_diagonal, least_norm, may_be_redundant, project

_BLOCK = 32
_SAME = 1e-6
"""Impulses that differ by less than this share of the scale are the same."""
_FLAT = 1e-12
"""Curvatures in the plane below this are none: impulses at an edge, which do not follow."""


class Selection(NamedTuple):
    """What an impulse's derivative is made of; batch first, impulses as `f / size`.

    Of the solver's derivative, of the velocities' changes without it, and of those of the projection.
    """

    told: Float[Array, "B n n"]
    met: Float[Array, "B n n"]
    rest: Float[Array, "B n n"]
    by_pull: Float[Array, "B K d d"]  # D
    by_friction: Float[Array, "B K d"]
    by_bound: Float[Array, "B K d"]
    by_slip: Float[Array, "B K d t"]  # of the velocity along the contact
    pull: Float[Array, "B K d"]  # z
    w: Float[Array, "B K d"]

    @classmethod
    def unique(cls, batch: int, k: int, d: int, dtype) -> "Selection":
        """That of problems without redundant contacts."""
        told = jnp.broadcast_to(jnp.eye(k * d, dtype=dtype), (batch, k * d, k * d))
        zeros, square = jnp.zeros((batch, k, d), dtype), jnp.zeros((batch, k, d, d), dtype)
        none = jnp.zeros_like(told)
        return cls(told, none, none, square, zeros, zeros, square[..., 1:], zeros, zeros)


def _size(A: Float[Array, "B n n"], d: int) -> tuple[Float[Array, "B K 1"], Float[Array, "B K 1"]]:
    """`1 / sqrt(A_nn)` of each contact and its inverse; of padding both are zero."""
    own = jnp.diagonal(A, axis1=1, axis2=2)[:, ::d, None]
    root = jnp.sqrt(jnp.asarray(jnp.where(own > 0, own, 1)))
    return jnp.where(own > 0, 1 / root, 0), jnp.where(own > 0, root, 0)


def _select(A, v, friction, lower, impulse, *, lifts: bool) -> Selection:
    """Of one block of problems, batch first in and out."""
    batch, k, d = v.shape
    size, root = _size(A, d)
    row = jnp.broadcast_to(size, v.shape).reshape(batch, k * d)
    y = jnp.moveaxis(root * impulse, 0, -1)
    Q = jnp.moveaxis(row[:, :, None] * A * row[:, None], 0, -1)
    q = jnp.moveaxis(size * v, 0, -1)
    unit = jnp.maximum(jnp.max(jnp.abs(q), axis=(0, 1)), jnp.max(jnp.abs(y), axis=(0, 1)))
    unit = jnp.where(unit > 0, unit, 1)
    bound = jnp.asarray(jnp.where(lower > 0, lower * root[..., 0], 0)).T
    u = matvec(Q, y) + q
    least = least_norm(Q, q / unit, u / unit, y / unit, friction.T, bound / unit, lifts=lifts)
    allowed, way = least.allowed, least.allowed.way
    D = project(allowed, least.z)[1]

    def by(friction, lower, way):
        def place(friction, lower, way):
            return project(allowed._replace(mu=friction, lower=lower, way=way), least.z)[0]

        return jax.jvp(place, (allowed.mu, allowed.lower, allowed.way), (friction, lower, way))[1]

    one, none = jnp.ones_like(allowed.mu), jnp.zeros_like(allowed.mu)
    slip = jnp.sqrt(jnp.sum(u[:, 1:] ** 2, axis=1))
    # Slower, the way is that of friction, and how it turns is not known.
    fast = allowed.slides & (slip > STILL * unit)
    turns = jnp.where(fast, -1 / jnp.where(fast, slip, 1), 0)
    across = jnp.eye(d - 1, dtype=v.dtype)[None, :, :, None] - way[:, :, None] * way[:, None]
    by_slip = jnp.stack([by(none, none, turns[:, None] * across[:, :, t]) for t in range(d - 1)], axis=2)
    V, whole, eye = least.V, block_diagonal(D), jnp.eye(k * d, dtype=v.dtype)
    inside = jnp.einsum("bij,bik,bkl->bjl", V, whole, V)
    plane = whole @ V @ jnp.linalg.solve(inside + _FLAT * eye, jnp.swapaxes(V, 1, 2))
    told, met, rest = (plane, 0 * plane, eye - plane) if lifts else (0 * plane, plane @ least.inverse, eye - plane)
    if d == 3 and not lifts:
        # The way of sliding follows the impulse.
        ways = jnp.concatenate([jnp.zeros_like(D[:, :, :1]), unit * by_slip], axis=2)
        turned = jnp.linalg.inv(eye - rest @ block_diagonal(ways) @ jnp.moveaxis(Q, -1, 0))
        met, rest = turned @ met, turned @ rest
    found = Selection(
        told,
        met,
        rest,
        *(jnp.moveaxis(part, -1, 0) for part in (D, unit * by(one, none, 0 * way), by(none, one, 0 * way))),
        *(jnp.moveaxis(unit * part, -1, 0) for part in (by_slip, least.z, least.w)),
    )

    # Where the law has been met by another impulse, its derivative is the solver's.
    is_least = least.found & (jnp.max(jnp.abs(unit * least.y - y), axis=(0, 1)) <= _SAME * unit)

    def choose(a: Array, b: Array) -> Array:
        return jnp.where(of_each(is_least, a), a, b)

    return jax.tree.map(choose, found, Selection.unique(batch, k, d, v.dtype))


def _selection_of(A, v, friction, lower, impulse, *, lifts: bool) -> Selection:
    batch, k, d = v.shape
    sound = jnp.isfinite(impulse).all((1, 2)) & jnp.isfinite(v).all((1, 2))
    chosen = may_be_redundant(A, k) & sound
    out = Selection.unique(batch, k, d, v.dtype)
    return solve_chosen(functools.partial(_select, lifts=lifts), (A, v, friction, lower, impulse), chosen, _BLOCK, out)


@functools.cache
def _batched(lifts: bool):
    return as_one_batch(functools.partial(_selection_of, lifts=lifts), "choice of an impulse")


def selected(
    data: tuple[Array, Array, Array, Array],
    impulse: Float[Array, "B K d"],
    change: Float[Array, "B K d"],
    tangents: tuple[Array, Array, Array, Array],
    *,
    lifts: bool,
) -> Float[Array, "B K d"]:
    """The derivative of impulses of least norm, from a `change` (N s) that is right but for what no velocity tells.

    `data`: A (B, n, n), v (B, K, d), friction (B, K) and lower bounds (B, K), with their `tangents`; `lifts`, see
    `least_norm`. Linear in the change and the tangents, in both modes.
    """
    A, v, _, lower = data
    dA, dv, dfriction, dlower = tangents
    if v.shape[1] == 1:
        return change
    d = v.shape[2]
    out = _batched(lifts)(*data, impulse)
    size, root = _size(A, d)

    # Scales follow A, too.
    wider = -size * size / 2 * jnp.diagonal(dA, axis1=1, axis2=2)[:, ::d, None]
    y, bound = root * impulse, jnp.where(lower > 0, lower, 0)
    own = root * change - y * wider
    speeds = size * (apply(dA, impulse) + dv + wider * (apply(A, impulse) + v) + apply(A, size * wider * y))
    slip = speeds + (size * apply(A, size * own) if lifts else 0)
    pull = size * apply(dA, size * out.w) + wider * out.pull + size * apply(A, size * wider * out.w)
    follows = jnp.einsum("bkij,bkj->bki", out.by_pull, pull) + jnp.einsum("bkij,bkj->bki", out.by_slip, slip[..., 1:])
    follows = follows + out.by_friction * dfriction[..., None]
    follows = follows + out.by_bound * (root * dlower[..., None] - root * bound[..., None] * wider)
    return size * (apply(out.told, own) - apply(out.met, speeds) + apply(out.rest, follows) + y * wider)
