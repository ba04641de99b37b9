"""A cube that is tossed onto a table: `cube`, with the properties published for the recorded one."""

import jax
import jax.numpy as jnp
import numpy as np

from carom.contact.boxes import CornerPlane
from carom.mechanics.bodies import RigidBody, embed_pose, embed_velocity
from carom.mechanics.potentials import Gravity
from carom.system import System
from carom.tasks.base import Task, sample_free


class Cube(Task):
    """A homogeneous cube above the table z = 0, with friction and restitution as published for the acrylic cube of

    S. Pfrommer, M. Halm, M. Posa, *ContactNets: Learning Discontinuous Contact Dynamics with Smooth, Implicit
    Representations* (CoRL 2020). Lengths are those of its recordings, which are 2.1 % short: half a width is 51.2 mm
    for 52.4, and gravity 9.61 m/s^2 for 9.81.

    `sample` tosses it from 0.1 to 0.3 m with about 1 m/s sideways and about 6 rad/s about each axis.
    """

    name: str
    mass: float = 0.37
    inertia: float = 8.1e-4 * (0.0512 / 0.0524) ** 2  # kg m^2, about any axis
    half_width: float = 0.0512
    contact_friction: float = 0.18
    contact_restitution: float = 0.125
    gravity: float = 9.61
    dt: float = 1 / 148
    steps: int = 100

    def system(self):
        return System(
            bodies=[RigidBody(self.mass, np.full(3, self.inertia / 2))],
            contacts=[CornerPlane([0], self.half_width, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))],
            potential=Gravity((0.0, 0.0, -self.gravity)),
            friction=self.contact_friction,
            restitution=self.contact_restitution,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        dtype = system.friction.dtype

        def draw(key, size):
            place, turn, speed, spin = jax.random.split(key, 4)
            height = jax.random.uniform(place, (size, 1), dtype, minval=0.1, maxval=0.3)
            center = jnp.concatenate([jnp.zeros((size, 2), dtype), height], axis=1)
            rotation = jax.random.orthogonal(turn, 3, (size,), dtype)
            # A reflection is a rotation with one axis turned round.
            rotation = rotation.at[..., 0].multiply(jnp.linalg.det(rotation)[:, None])
            velocity = jax.random.normal(speed, (size, 3), dtype)
            omega = 6 * jax.random.normal(spin, (size, 3), dtype)
            return embed_pose(center, rotation), embed_velocity(rotation, velocity, omega)

        return sample_free(system, key, n, draw)


CUBE = Cube(name="cube")
