"""Bodies as sets of points: point masses and rigid bodies in the extended-body representation (paper, appendix H)."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from carom.checks import as_floats, not_negative, positive, require, require_values


class Body(eqx.Module):
    """A body that moves as one. Lengths in m, masses in kg."""

    mass: eqx.AbstractVar[Float[Array, ""]]
    radius: eqx.AbstractVar[Float[Array, ""]]

    @abc.abstractmethod
    def n_points(self, dim: int) -> int:
        """How many points stand for this body in `dim` dimensions."""

    @abc.abstractmethod
    def mass_matrix(self, dim: int) -> Float[Array, "p p"]:
        """Mass matrix (kg) of the body's points: `T = 1/2 sum_ab M_ab v_a . v_b`."""

    @abc.abstractmethod
    def inverse_mass_matrix(self, dim: int) -> Float[Array, "p p"]:
        """Inverse of `mass_matrix` (1/kg), in closed form."""


def _check_shapes(mass, radius) -> None:
    require(mass.shape == (), f"mass must be one number of kilograms; its shape was {mass.shape}.")
    require(radius.shape == (), f"radius must be one number of metres; its shape was {radius.shape}.")


class PointMass(Body):
    """A mass at one point, with a radius that matters for contact alone: it does not rotate.

    **Arguments:** `mass` (kg, > 0); `radius` (m, >= 0).
    """

    mass: Float[Array, ""]
    radius: Float[Array, ""]

    def __init__(self, mass, radius=0.0):
        self.mass, self.radius = as_floats(mass), as_floats(radius)
        _check_shapes(self.mass, self.radius)
        require_values("mass", mass, positive, "a positive number of kilograms")
        require_values("radius", radius, not_negative, "zero or a positive number of metres")

    def n_points(self, dim: int) -> int:
        return 1

    def mass_matrix(self, dim: int):
        return self.mass[None, None]

    def inverse_mass_matrix(self, dim: int):
        return 1 / self.mass[None, None]


class RigidBody(Body):
    """A rigid body as `d + 1` points: its centre of mass and the ends of the unit principal axes from there.

    **Arguments:** `mass` (kg, > 0); `moments` (d,), second moments of the mass distribution about the principal axis
    planes, `mu_i = integral x_i^2 dm` (kg m^2, > 0), so that `I_xx = mu_y + mu_z` in 3D and `I = mu_x + mu_y` in 2D (a
    uniform disk of radius r: `m r^2 / 4` each); `radius` (m, >= 0) of a round body, for contact.

    The kinetic energy is `m/2 |v_0|^2 + sum_i mu_i/2 |v_i - v_0|^2`.
    """

    mass: Float[Array, ""]
    moments: Float[Array, " d"]
    radius: Float[Array, ""]

    def __init__(self, mass, moments, radius=0.0):
        self.mass, self.moments, self.radius = as_floats(mass), as_floats(moments), as_floats(radius)
        _check_shapes(self.mass, self.radius)
        require(
            self.moments.shape in ((2,), (3,)),
            f"moments must be 2 or 3 second moments, one an axis; their shape was {self.moments.shape}.",
        )
        require_values("mass", mass, positive, "a positive number of kilograms")
        require_values("moments", moments, positive, "positive second moments in kg m^2, one an axis")
        require_values("radius", radius, not_negative, "zero or a positive number of metres")

    def n_points(self, dim: int) -> int:
        return dim + 1

    def mass_matrix(self, dim: int):
        center = (self.mass + jnp.sum(self.moments))[None, None]
        return jnp.block([[center, -self.moments[None]], [-self.moments[:, None], jnp.diag(self.moments)]])

    def inverse_mass_matrix(self, dim: int):
        # v_i = v_0 + w_i with independent v_0 (mass m) and w_i (mass mu_i).
        axes = jnp.concatenate([jnp.zeros(1, self.moments.dtype), 1 / self.moments])
        return 1 / self.mass + jnp.diag(axes)


class BodyTable(eqx.Module):
    """Which points belong to which body: static indices for vectorised geometry.

    `center` (bodies,) is each body's first point, `axes` (bodies, d) its axis points (for a point mass, its centre).
    """

    dim: int = eqx.field(static=True)
    center: tuple[int, ...] = eqx.field(static=True)
    axes: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    n_points: int = eqx.field(static=True)

    @classmethod
    def of(cls, bodies: Sequence[Body], dim: int) -> "BodyTable":
        center, axes, n = [], [], 0
        for body in bodies:
            count = body.n_points(dim)
            center.append(n)
            axes.append(tuple(range(n + 1, n + count)) if count > 1 else (n,) * dim)
            n += count
        return cls(dim, tuple(center), tuple(axes), n)

    def stencil(self, body: Int[np.ndarray, " c"]) -> Int[np.ndarray, "c p"]:
        """The points that a material point of each body depends on: its centre, then the ends of its axes.

        One point (p = 1) where none of the bodies can turn; a point mass among rigid bodies repeats its centre.
        """
        center, axes = np.array(self.center)[body], np.array(self.axes)[body]
        if (axes == center[:, None]).all():
            return center[:, None]
        return np.concatenate([center[:, None], axes], axis=1)

    def weights(
        self, x: Float[Array, "n d"], body: Int[np.ndarray, " c"], offset: Float[Array, "c d"]
    ) -> Float[Array, "c p"]:
        """Barycentric weights of material points over their `stencil`: `sum_p w_p x_p` is where they are.

        The same sum of velocities is how fast they are. `offset` (c, d) leads from the centre of body `body[k]` to the
        point (m, world frame). A rigid body's weights are the point's coordinates in the frame of its axes; a point
        mass carries its offset along.
        """
        points = self.stencil(body)
        if points.shape[1] == 1:
            return jnp.ones(points.shape, x.dtype)
        turns = points[:, 1] != points[:, 0]
        axes = jnp.where(turns[:, None, None], x[points[:, 1:]] - x[points[:, :1]], jnp.eye(self.dim, dtype=x.dtype))
        local = jnp.where(turns[:, None], _coordinates(axes, offset), 0)  # (c, d)
        return jnp.concatenate([1 - jnp.sum(local, axis=1, keepdims=True), local], axis=1)


def _coordinates(axes: Float[Array, "c d d"], offset: Float[Array, "c d"]) -> Float[Array, "c d"]:
    """The `a` with `sum_i a_i axes_i = offset`, by Cramer's rule: exact also where axes have drifted from unit ones."""
    if axes.shape[-1] == 2:
        (ax, ay), (bx, by) = (axes[:, i].T for i in range(2))
        numerators = jnp.stack([offset[:, 0] * by - offset[:, 1] * bx, ax * offset[:, 1] - ay * offset[:, 0]], axis=1)
        return numerators / (ax * by - ay * bx)[:, None]
    normals = jnp.stack([jnp.cross(axes[:, (i + 1) % 3], axes[:, (i + 2) % 3]) for i in range(3)], axis=1)
    volume = jnp.sum(axes[:, 0] * normals[:, 0], axis=1)
    return jnp.sum(normals * offset[:, None], axis=2) / volume[:, None]


def embed_pose(position: Float[Array, "*b d"], rotation: Float[Array, "*b d d"]) -> Float[Array, "*b p d"]:
    """Points `(d + 1, d)` of a rigid body at `position` (m) with `rotation` (body to world; columns are the axes)."""
    return jnp.concatenate([position[..., None, :], position[..., None, :] + jnp.swapaxes(rotation, -1, -2)], axis=-2)


def embed_velocity(
    rotation: Float[Array, "*b d d"], velocity: Float[Array, "*b d"], omega_world: Float[Array, "*b w"]
) -> Float[Array, "*b p d"]:
    """Point velocities (m/s) of a rigid body: `v_i = v_0 + omega x axis_i`.

    `omega_world` (rad/s) has one component in 2D and three, in the world frame, in 3D.
    """
    axes = jnp.swapaxes(rotation, -1, -2)
    if rotation.shape[-1] == 2:
        spin = omega_world[..., None] * jnp.stack([-axes[..., 1], axes[..., 0]], axis=-1)
    else:
        spin = jnp.cross(jnp.broadcast_to(omega_world[..., None, :], axes.shape), axes)
    return jnp.concatenate([velocity[..., None, :], velocity[..., None, :] + spin], axis=-2)


def recover_pose(points: Float[Array, "*b p d"]) -> tuple[Float[Array, "*b d"], Float[Array, "*b d d"]]:
    """Position (m) and rotation (body to world) from a rigid body's points: the nearest rotation to its axes."""
    axes = jnp.swapaxes(points[..., 1:, :] - points[..., :1, :], -1, -2)
    u, _, vh = jnp.linalg.svd(axes)
    sign = jnp.linalg.det(u @ vh)
    u = u.at[..., :, -1].multiply(sign[..., None])
    return points[..., 0, :], u @ vh


def recover_velocity(
    points: Float[Array, "*b p d"], velocities: Float[Array, "*b p d"]
) -> tuple[Float[Array, "*b d"], Float[Array, "*b w"]]:
    """Velocity of the centre (m/s) and angular velocity (rad/s, world frame) from point velocities."""
    axes = points[..., 1:, :] - points[..., :1, :]
    spin = velocities[..., 1:, :] - velocities[..., :1, :]
    if axes.shape[-1] == 2:
        omega = jnp.sum(axes[..., 0] * spin[..., 1] - axes[..., 1] * spin[..., 0], axis=-1, keepdims=True) / 2
    else:
        omega = jnp.sum(jnp.cross(axes, spin), axis=-2) / 2
    return velocities[..., 0, :], omega


def total_mass_matrix(bodies: Sequence[Body], dim: int) -> Float[Array, "n n"]:
    """Mass matrix (kg) of all points of all bodies."""
    return jax.scipy.linalg.block_diag(*(body.mass_matrix(dim) for body in bodies))


def total_inverse_mass_matrix(bodies: Sequence[Body], dim: int) -> Float[Array, "n n"]:
    """Inverse of `total_mass_matrix` (1/kg)."""
    return jax.scipy.linalg.block_diag(*(body.inverse_mass_matrix(dim) for body in bodies))
