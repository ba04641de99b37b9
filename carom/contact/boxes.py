"""Contacts between the corners of boxes and a plane."""

from collections.abc import Iterable, Sequence
from itertools import product

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from carom.checks import as_floats, at_once_if_known, positive, require, require_values, whole_numbers
from carom.contact.candidates import Candidates, Contact, plane, property_indices
from carom.contact.geometry import sphere_plane


class CornerPlane(Contact):
    """Contacts between the corners of boxes (rectangles in 2D) and a fixed plane: a tossed cube and a table.

    A box's edges are along its body's axes. Corners may be rounded: they are then spheres that touch the faces from
    within, so the box is as wide as without.

    **Arguments:**

    - `bodies`, which: rigid bodies.
    - `half_widths` (d,), or one number for a cube (m): half of the edges' lengths.
    - `point` (d,), on the plane (m); `normal` (d,), out of the solid side, of any length.
    - `corner_radius` (m), at most the least half width; 0: sharp corners.
    - `center` (d,), of the box, from its body's centre of mass along the body's axes (m); zero for a homogeneous box.
    - `property`, index into the system's `friction` and `restitution`: one for all, or one for each body.

    Widths, radius and centre are arrays of the system: derivatives by them are right, so that they can be learned.

    **Raises:** `CaromError` for lengths that are not positive, or a radius larger than a half width.
    """

    bodies: tuple[int, ...] = eqx.field(static=True)
    half_widths: Float[Array, " d"]
    corner_radius: Float[Array, ""]
    center: Float[Array, " d"]
    point: Float[Array, " d"]
    normal: Float[Array, " d"]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        bodies: Iterable[int],
        half_widths,
        point,
        normal,
        corner_radius: ArrayLike = 0.0,
        property: int | Sequence[int] = 0,
        center=None,
    ):
        self.bodies = whole_numbers("CornerPlane bodies", bodies, once=True)
        self.point, self.normal = plane("CornerPlane", point, normal)
        dim = self.normal.shape[0]
        half_widths, self.corner_radius = as_floats(half_widths), as_floats(corner_radius)
        require(
            half_widths.shape in ((), (dim,)),
            f"CornerPlane half_widths must be one length or {dim}; their shape was {half_widths.shape}.",
        )
        with at_once_if_known(half_widths):
            self.half_widths = jnp.broadcast_to(half_widths, (dim,))
        require(
            self.corner_radius.shape == (),
            f"CornerPlane corner_radius must be one length; its shape was {self.corner_radius.shape}.",
        )
        require_values("half_widths", half_widths, positive, "positive lengths in m")
        wanted = "from zero to the least half width (m)"
        require_values("corner_radius", corner_radius, lambda r, h: (r >= 0) & (r <= h.min()), wanted, half_widths)
        self.center = as_floats(np.zeros(dim) if center is None else center)
        require(
            self.center.shape == (dim,),
            f"CornerPlane center must be {dim} coordinates; its shape was {self.center.shape}.",
        )
        if center is not None:
            require_values("center", center, np.isfinite, "finite coordinates in m")
        each = property_indices("CornerPlane", property, len(self.bodies))
        self.property_index = tuple(p for p in each for _ in range(2**dim))

    def _corners(self) -> np.ndarray:
        """Signs of the coordinates of the corners of all boxes (c, d)."""
        signs = np.array(list(product((-1.0, 1.0), repeat=self.half_widths.shape[0])))
        return np.tile(signs, (len(self.bodies), 1))

    def _body(self) -> np.ndarray:
        return np.repeat(np.array(self.bodies, int), 2 ** self.half_widths.shape[0])

    def candidates(self, x, radii, table):
        body = self._body()
        stencil = table.stencil(body)
        require(
            stencil.shape[1] == x.shape[1] + 1,
            f"CornerPlane is for rigid bodies; the bodies {sorted(set(self.bodies))} cannot turn.",
        )
        local = self.center + self._corners().astype(x.dtype) * (self.half_widths - self.corner_radius)
        center = x[stencil[:, 0]]
        corner = center + jnp.einsum("ca,cad->cd", local, x[stencil[:, 1:]] - center[:, None])
        radius = jnp.broadcast_to(self.corner_radius, body.shape)
        touch = sphere_plane(corner, radius, self.point, self.normal)
        # The corner's own coordinates, and from there to the touching point in the frame of the body's axes.
        out = table.weights(x, body, -self.corner_radius * jnp.broadcast_to(self.normal, corner.shape))
        weights = out + jnp.concatenate([-jnp.sum(local, axis=1, keepdims=True), local], axis=1)
        return Candidates(touch.gap, stencil, weights[:, None, :, None] * touch.frame[:, :, None, :])

    def reach(self, radii):
        return jnp.full(len(self._body()), 2 * jnp.min(self.half_widths), radii.dtype)

    def travel(self, radii):
        # Corners turn about the centre: half a radian.
        return jnp.full(len(self._body()), 0.5 * jnp.linalg.norm(self.half_widths + jnp.abs(self.center)), radii.dtype)

    def bodies_of(self):
        return tuple((int(b),) for b in self._body())

    def names(self):
        corners = ("".join("+" if s > 0 else "-" for s in signs) for signs in self._corners())
        return tuple(f"{b}-corner {name}" for b, name in zip(self._body(), corners, strict=True))

    def dimension(self):
        return self.normal.shape[0]
