"""Contacts of balls that are fixed anywhere in rigid bodies: with a plane, and with each other.

The ends of a capsule are two balls, the corners of a box eight of radius 0.
"""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from carom.checks import (
    as_floats,
    at_once_if_known,
    not_negative,
    positive,
    require,
    require_values,
    whole,
    whole_numbers,
)
from carom.contact.candidates import Candidates, Contact, plane, property_indices
from carom.contact.geometry import sphere_plane, sphere_sphere


def _places(
    x: Float[Array, "n d"], stencil: Int[np.ndarray, "c p"], centers: Float[Array, "c d"]
) -> tuple[Float[Array, "c d"], Float[Array, "c p"]]:
    """Where the material points at `centers` in the frames of their bodies are, and their weights less the centre's.

    `p = x_0 + sum_a c_a (x_a - x_0)`. Coordinates are those of the body, so that a point is the same material point
    where the axes have drifted.
    """
    origin = x[stencil[:, 0]]
    places = origin + jnp.einsum("ca,cad->cd", centers, x[stencil[:, 1:]] - origin[:, None])
    return places, jnp.concatenate([-jnp.sum(centers, axis=1, keepdims=True), centers], axis=1)


def _need_rigid(name: str, stencil: Int[np.ndarray, "c p"], dim: int, bodies: Iterable[int]) -> None:
    require(
        stencil.shape[1] == dim + 1 and bool((stencil[:, 1] != stencil[:, 0]).all()),
        f"{name} is for rigid bodies; of the bodies {sorted(set(bodies))} some cannot turn. Use DiskPlane or DiskDisk "
        "for point masses.",
    )


class BallPlane(Contact):
    """Contacts between balls (disks in 2D) fixed in rigid bodies and a fixed plane.

    With `c_k` the ball's centre in the frame of its body, `p = x_0 + sum_a c_ka (x_a - x_0)` is its place, the gap is
    `N . (p - point) - r_k`, and the material point that touches is `p - r_k N`.

    **Arguments:**

    - `bodies`, which body each ball is fixed in; a body may have many.
    - `centers` (c, d), of the balls, from the centre of mass along the body's axes (m).
    - `radii` (c,), or one for all (m); 0: a sharp corner.
    - `point` (d,), on the plane (m); `normal` (d,), out of the solid side, of any length.
    - `property`, index into the system's `friction` and `restitution`: one for all, or one for each ball.

    Centres and radii are arrays of the system: derivatives by them are right, so that they can be learned.

    **Raises:** `CaromError` for shapes that do not fit, or negative radii.
    """

    bodies: tuple[int, ...] = eqx.field(static=True)
    centers: Float[Array, "c d"]
    radii: Float[Array, " c"]
    point: Float[Array, " d"]
    normal: Float[Array, " d"]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, bodies: Iterable[int], centers, radii, point, normal, property: int | Sequence[int] = 0):
        self.bodies = whole_numbers("BallPlane bodies", bodies)
        self.point, self.normal = plane("BallPlane", point, normal)
        count, dim = len(self.bodies), self.normal.shape[0]
        self.centers, radii = as_floats(centers), as_floats(radii)
        if count == 0:
            self.centers, radii = self.centers.reshape(0, dim), radii.reshape(-1)
        require(
            self.centers.shape == (count, dim),
            f"BallPlane centers must be {count} places of {dim} coordinates; their shape was {self.centers.shape}.",
        )
        require(
            radii.shape in ((), (count,)), f"BallPlane radii must be one or {count}; their shape was {radii.shape}."
        )
        with at_once_if_known(radii):
            self.radii = jnp.broadcast_to(radii, (count,))
        require_values("radii", radii, not_negative, "zero or positive lengths in m")
        require_values("centers", centers, np.isfinite, "finite coordinates in m")
        self.property_index = property_indices("BallPlane", property, count)

    def candidates(self, x, radii, table):
        body = np.array(self.bodies)
        stencil = table.stencil(body)
        _need_rigid("BallPlane", stencil, x.shape[1], self.bodies)
        place, inner = _places(x, stencil, self.centers)
        touch = sphere_plane(place, self.radii, self.point, self.normal)
        weights = inner + table.weights(x, body, -self.radii[:, None] * self.normal)
        return Candidates(touch.gap, stencil, weights[:, None, :, None] * touch.frame[:, :, None, :])

    def _arm(self):
        return jnp.linalg.norm(self.centers, axis=1)

    def reach(self, radii):
        # Deeper, the body's centre may be behind the plane.
        return (self._arm() + self.radii).astype(radii.dtype)

    def travel(self, radii):
        # A ball at the centre moves on a straight line; others turn about it: half a radian.
        arm = self._arm().astype(radii.dtype)
        return jnp.asarray(jnp.where(arm > 0, 0.5 * arm, jnp.inf))

    def bodies_of(self):
        return tuple((b,) for b in self.bodies)

    def names(self):
        return tuple(f"{b}-wall (ball {k})" for k, b in enumerate(self.bodies))

    def dimension(self):
        return self.normal.shape[0]


class BallBall(Contact):
    """Contacts between two balls (disks in 2D) that are each fixed in a rigid body; the second may be fixed in space.

    With `p_a`, `p_b` the places of their centres, the gap is `|p_a - p_b| - r_a - r_b`, the normal
    `N = (p_a - p_b) / |p_a - p_b|`, and the material points that touch are `p_a - r_a N` and `p_b + r_b N`.

    **Arguments:**

    - `pairs`, the two bodies of each contact; `None` for the second: its ball is fixed in space.
    - `centers` (c, 2, d), of the balls, from the centres of mass along the bodies' axes, or in space (m).
    - `radii` (c, 2) (m), positive.
    - `property`, index into the system's `friction` and `restitution`: one for all, or one for each pair.
    - `margin` (m), one for all or (c,): how far apart they are kept, beside their radii.

    **Raises:** `CaromError` for shapes that do not fit, a body with itself, or radii that are not positive.
    """

    pairs: tuple[tuple[int, int | None], ...] = eqx.field(static=True)
    centers: Float[Array, "c 2 d"]
    radii: Float[Array, "c 2"]
    margin: Float[Array, "..."]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        pairs: Iterable[tuple[int, int | None]],
        centers,
        radii,
        property: int | Sequence[int] = 0,
        margin: ArrayLike = 0.0,
    ):
        self.pairs = tuple(
            (whole("BallBall pairs", a), None if b is None else whole("BallBall pairs", b)) for a, b in pairs
        )
        for a, b in self.pairs:
            require(a != b, f"BallBall pairs two different bodies; a pair was ({a}, {b}).")
        self.centers, self.radii = as_floats(centers), as_floats(radii)
        count = len(self.pairs)
        require(
            self.centers.shape in ((count, 2, 2), (count, 2, 3)),
            f"BallBall centers must be {count} pairs of places; their shape was {self.centers.shape}.",
        )
        require(
            self.radii.shape == (count, 2),
            f"BallBall radii must be {count} pairs; their shape was {self.radii.shape}.",
        )
        require_values("radii", radii, positive, "positive lengths in m")
        self.margin = as_floats(margin)
        require(
            self.margin.shape in ((), (count,)),
            f"BallBall margin must be one length or {count}; its shape was {self.margin.shape}.",
        )
        require_values("margin", margin, not_negative, "zero or positive lengths in m")
        require_values("centers", centers, np.isfinite, "finite coordinates in m")
        self.property_index = property_indices("BallBall", property, count)

    def candidates(self, x, radii, table):
        first = np.array([a for a, _ in self.pairs])
        fixed = np.array([b is None for _, b in self.pairs])
        # A ball in space stands as one of the first body, with weights of zero.
        second = np.array([a if b is None else b for a, b in self.pairs])
        stencils = table.stencil(first), table.stencil(second)
        for stencil in stencils:
            _need_rigid("BallBall", stencil, x.shape[1], (b for pair in self.bodies_of() for b in pair))
        place_a, inner_a = _places(x, stencils[0], self.centers[:, 0])
        place_b, inner_b = _places(x, stencils[1], self.centers[:, 1])
        place_b = jnp.where(fixed[:, None], self.centers[:, 1], place_b)
        touch = sphere_sphere(place_a, place_b, self.radii[:, 0], self.radii[:, 1])
        normal = touch.frame[:, 0]
        weights_a = inner_a + table.weights(x, first, -self.radii[:, :1] * normal)
        weights_b = inner_b + table.weights(x, second, self.radii[:, 1:] * normal)
        weights = jnp.concatenate([weights_a, jnp.where(fixed[:, None], 0, -weights_b)], axis=1)
        return Candidates(
            touch.gap - self.margin,
            np.concatenate(stencils, axis=1),
            weights[:, None, :, None] * touch.frame[:, :, None, :],
        )

    def reach(self, radii):
        return jnp.sum(self.radii, axis=1).astype(radii.dtype)

    def travel(self, radii):
        return self.reach(radii) / 2

    def bodies_of(self):
        return tuple((a,) if b is None else (a, b) for a, b in self.pairs)

    def names(self):
        return tuple(f"{a}-{'fixed ball' if b is None else b} (pair {k})" for k, (a, b) in enumerate(self.pairs))

    def dimension(self):
        return self.centers.shape[2]
