"""Disks that can rotate, and balls on a table: `bd5`, `throw` and `billiards`."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from carom.contact.candidates import DiskDisk
from carom.mechanics.bodies import PointMass, RigidBody, embed_pose, embed_velocity
from carom.mechanics.potentials import Gravity
from carom.system import System
from carom.tasks.base import Task, sample_free
from carom.tasks.bouncing import BP5, box_contacts
from carom.tasks.gyroscopes import turn
from carom.tasks.pendulums import GRAVITY


def uniform_disk(mass: float, radius: float) -> RigidBody:
    """A disk of even thickness: second moments `m r^2 / 4` about each axis plane."""
    return RigidBody(mass, (mass * radius**2 / 4,) * 2, radius)


class BouncingDisks(Task):
    """Disks in the unit box; they rotate."""

    name: str
    masses: tuple[float, ...]
    radii: tuple[float, ...]
    contact_friction: tuple[float, ...]
    contact_restitution: tuple[float, ...]
    gravity: float = 0.0
    dt: float = 0.01
    steps: int = 100

    def system(self):
        return System(
            bodies=[uniform_disk(m, r) for m, r in zip(self.masses, self.radii, strict=True)],
            contacts=box_contacts(len(self.masses), individual=len(self.contact_friction) > 1),
            potential=Gravity((0.0, -self.gravity)) if self.gravity else None,
            friction=np.array(self.contact_friction),
            restitution=np.array(self.contact_restitution),
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        count = len(self.masses)
        radii = jnp.asarray(self.radii, system.friction.dtype)[:, None]

        def draw(key, size):
            place, angle, speed = jax.random.split(key, 3)
            center = radii + jax.random.uniform(place, (size, count, 2), radii.dtype) * (1 - 2 * radii)
            turned = turn(2, jax.random.uniform(angle, (size, count), radii.dtype, maxval=2 * jnp.pi))[..., :2, :2]
            motion = 0.5 * jax.random.normal(speed, (size, count, 3), radii.dtype)
            x, v = embed_pose(center, turned), embed_velocity(turned, motion[..., :2], motion[..., 2:])
            return x.reshape(size, -1, 2), v.reshape(size, -1, 2)

        return sample_free(system, key, n, draw)


class Billiards(Task):
    """A cue ball that runs into a triangle of ten balls on a table without cushions. Balls do not rotate.

    `sample` puts the cue ball at (0.1, 0.5) m, up to 0.02 m to either side, with a velocity of (0.3, 0) m/s and a
    normal deviation of 0.02 m/s.
    """

    name: str
    contact_restitution: float = 0.8
    mass: float = 1.0
    radius: float = 0.03
    rows: int = 4
    dt: float = 0.003
    steps: int = 1024

    def system(self):
        n = 1 + self.rows * (self.rows + 1) // 2
        return System(
            bodies=[PointMass(self.mass, self.radius)] * n,
            contacts=[DiskDisk(combinations(range(n), 2))],
            friction=0.0,
            restitution=self.contact_restitution,
            dim=2,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def triangle(self) -> np.ndarray:
        """Centres of the balls that are hit: ball j <= i of row i at `(.5 + 2 r i, .5 + 2 r j - .7 r i)`."""
        r = self.radius
        return np.array(
            [(0.5 + 2 * r * i, 0.5 + 2 * r * j - 0.7 * r * i) for i in range(self.rows) for j in range(i + 1)]
        )

    def sample(self, system, key, n):
        place, speed = jax.random.split(key)
        rack = jnp.asarray(self.triangle(), system.friction.dtype)
        aside = jax.random.uniform(place, (n,), rack.dtype, minval=-0.02, maxval=0.02)
        cue = jnp.stack([jnp.full(n, 0.1, rack.dtype), 0.5 + aside], axis=1)[:, None]
        x = jnp.concatenate([cue, jnp.broadcast_to(rack, (n, *rack.shape))], axis=1)
        deviation = 0.02 * jax.random.normal(speed, (n, 2), rack.dtype)
        return x, jnp.zeros_like(x).at[:, 0].set(deviation + jnp.array([0.3, 0.0], rack.dtype))


BD5 = BouncingDisks(
    name="bd5",
    masses=BP5.masses,
    radii=BP5.radii,
    contact_friction=(0.3, 0.5, 0.1, 0.4, 1.4, 0.9, 0.8, 0.0, 0.2, 0.6) + (0.1,) * 20,
    contact_restitution=(0.2, 0.4, 0.1, 0.9, 0.8, 0.3, 1.0, 0.9, 0.7, 0.0) + (0.8,) * 20,
)
THROW = BouncingDisks(
    name="throw",
    masses=(0.1,),
    radii=(0.1,),
    contact_friction=(0.2,),
    contact_restitution=(0.8,),
    gravity=GRAVITY,
)
BILLIARDS = Billiards(name="billiards")
