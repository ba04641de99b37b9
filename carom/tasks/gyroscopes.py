"""A gyroscope on a ball joint beside a wall (paper, appendix H): `gyro` and `gyro-e`."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.contact.candidates import RimPlane
from carom.mechanics.bodies import RigidBody, embed_pose, embed_velocity
from carom.mechanics.constraints import Joint
from carom.mechanics.potentials import Gravity
from carom.system import System
from carom.tasks.base import Task, sample_free
from carom.tasks.pendulums import GRAVITY

RIM_POINTS = tuple(k * 6.28 / 20 for k in range(20))
"""Angles (rad) of the rim points of the paper's experiments: not quite a full turn."""


def turn(axis: int, angle: Float[Array, "*b"]) -> Float[Array, "*b 3 3"]:
    """Rotation matrices about a coordinate axis."""
    c, s, one, zero = jnp.cos(angle), jnp.sin(angle), jnp.ones_like(angle), jnp.zeros_like(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rows = [[zero] * 3 for _ in range(3)]
    rows[axis][axis], rows[i][i], rows[j][j], rows[i][j], rows[j][i] = one, c, c, -s, s
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def euler_motion(
    angles: Float[Array, "*b 3"], rates: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3"]]:
    """Rotation (body to world) and angular velocity (rad/s, world frame) of ZXZ Euler angles and their rates."""
    first, second, third = (turn(axis, angles[..., k]) for k, axis in enumerate((2, 0, 2)))
    tilted = first @ second
    axes = jnp.stack([jnp.broadcast_to(first[..., 2], tilted[..., 2].shape), first[..., 0], tilted[..., 2]], axis=-1)
    return tilted @ third, jnp.squeeze(axes @ rates[..., None], axis=-1)


class Gyroscope(Task):
    """A wheel on an axle whose end turns about the origin; its rim can touch the wall y = -0.33. Gravity along -z."""

    name: str
    contact_friction: float
    contact_restitution: float
    mass: float = 0.1
    arm: float = 0.5
    moments_per_mass: tuple[float, float, float] = (0.24, 0.24, 0.04)
    rim: float = 0.3
    wall: float = -0.33
    rim_points: tuple[float, ...] | None = RIM_POINTS
    dt: float = 0.02
    steps: int = 100

    def system(self):
        moments = self.mass * np.array(self.moments_per_mass)
        return System(
            bodies=[RigidBody(self.mass, moments, self.rim)],
            # The joint is at (0, 0, -arm) in the body frame.
            constraints=[Joint(0, (1 + self.arm, 0.0, 0.0, -self.arm), (0.0, 0.0, 0.0))],
            contacts=[RimPlane([0], (0.0, self.wall, 0.0), (0.0, 1.0, 0.0), angles=self.rim_points)],
            potential=Gravity((0.0, 0.0, -GRAVITY)),
            friction=self.contact_friction,
            restitution=self.contact_restitution,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        dtype = system.friction.dtype

        def draw(key, size):
            keys = jax.random.split(key, 3)
            angles, rates = jax.random.uniform(keys[0], (2, size, 3), dtype, minval=-1.5, maxval=1.5)
            sign = jax.random.rademacher(keys[1], (size,), dtype)
            spin = 1.5 * (7 + jax.random.normal(keys[2], (size,), dtype)) * sign
            rates = jnp.stack([3 * rates[:, 0], 0.2 * rates[:, 1], spin], axis=1)
            rotation, omega = euler_motion(angles, rates)
            center = self.arm * rotation[..., 2]
            return embed_pose(center, rotation), embed_velocity(rotation, jnp.cross(omega, center), omega)

        return sample_free(system, key, n, draw)


GYRO = Gyroscope(name="gyro", contact_friction=0.1, contact_restitution=0.8)
GYRO_E = Gyroscope(name="gyro-e", contact_friction=0.0, contact_restitution=1.0)
