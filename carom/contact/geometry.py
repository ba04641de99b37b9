"""Pure geometry of touching pairs: gap, where they touch, and the contact frame. Arrays only, vectorised over pairs.

A frame is (d, d): its first row is the normal, from the second body to the first, then the tangents.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


class Touch(NamedTuple):
    """`gap` (c,) in m, negative where bodies overlap; `frame` (c, d, d)."""

    gap: Float[Array, " c"]
    frame: Float[Array, "c d d"]


def contact_frame(normal: Float[Array, "c d"]) -> Float[Array, "c d d"]:
    """Complete unit normals to right-handed orthonormal frames (normal, tangents)."""
    if normal.shape[1] == 2:
        tangent = jnp.stack([-normal[:, 1], normal[:, 0]], axis=-1)
        return jnp.stack([normal, tangent], axis=1)
    # The coordinate axis that is most nearly at right angles to the normal never degenerates.
    axis = jnp.argmin(jnp.abs(normal), axis=1)
    reference = jnp.eye(3, dtype=normal.dtype)[axis]
    first = jnp.cross(normal, reference)
    first = first / jnp.linalg.norm(first, axis=1, keepdims=True)
    return jnp.stack([normal, first, jnp.cross(normal, first)], axis=1)


def sphere_sphere(
    center_a: Float[Array, "c d"],
    center_b: Float[Array, "c d"],
    radius_a: Float[Array, " c"],
    radius_b: Float[Array, " c"],
) -> Touch:
    """Two disks (2D) or spheres (3D). Where the centres coincide, the normal is the first axis."""
    difference = center_a - center_b
    square = jnp.sum(difference**2, axis=1)
    apart = square > 0
    default = jnp.zeros_like(difference).at[:, 0].set(1)
    difference = jnp.where(apart[:, None], difference, default)
    length = jnp.sqrt(jnp.where(apart, square, 1))
    distance = jnp.where(apart, length, 0)
    return Touch(distance - radius_a - radius_b, contact_frame(difference / length[:, None]))


def sphere_plane(
    center: Float[Array, "c d"], radius: Float[Array, " c"], point: Float[Array, " d"], normal: Float[Array, " d"]
) -> Touch:
    """A disk (2D) or sphere (3D) and the half-space behind a plane through `point` with unit `normal`."""
    gap = (center - point) @ normal - radius
    return Touch(gap, contact_frame(jnp.broadcast_to(normal, center.shape)))


def deepest_direction(axes: Float[Array, "c 2 3"], normal: Float[Array, " 3"]) -> Float[Array, "c 2"]:
    """The direction in the plane of two axes, by its coordinates, that leads deepest against a plane's `normal`.

    `-(N.a_1, N.a_2) / |(N.a_1, N.a_2)|`. Where the planes are parallel all directions are equally deep, and none is
    taken: zero.
    """
    height = axes @ normal
    square = jnp.sum(height**2, axis=1, keepdims=True)
    tilted = square > jnp.finfo(height.dtype).eps ** 2
    return jnp.where(tilted, -height / jnp.sqrt(jnp.where(tilted, square, 1)), 0)


def wrap_angle(angle: Float[Array, "*c"]) -> Float[Array, "*c"]:
    """The same angle in (-pi, pi] (rad)."""
    return angle - 2 * jnp.pi * jnp.ceil((angle - jnp.pi) / (2 * jnp.pi))


def bend_gap(chain: Float[Array, "3 2"], limit: Float[Array, ""]) -> Float[Array, ""]:
    """How much more (rad) the two segments between three points may bend: `limit - |difference of their angles|`.

    The angle of a segment is that from the downward vertical, `atan2(x, -y)`.
    """
    segment = chain[1:] - chain[:-1]
    angle = jnp.arctan2(segment[:, 0], -segment[:, 1])
    return limit - jnp.abs(wrap_angle(angle[1] - angle[0]))


def stretch_gap(ends: Float[Array, "2 d"], shortest: Float[Array, ""], longest: Float[Array, ""]) -> Float[Array, ""]:
    """How much (m) a segment is away from the nearer of its length limits."""
    length = jnp.linalg.norm(ends[1] - ends[0])
    return jnp.minimum(length - shortest, longest - length)
