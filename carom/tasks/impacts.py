"""One or two balls and an impact or two, for gradients and control: `bounce-once`, `ground-wall`, `two-balls`.

The systems of Zhong, Han and Brikis, *Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients
w.r.t. Position, Velocity and Control?* (2022).
"""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from carom.contact.candidates import DiskDisk, DiskPlane
from carom.mechanics.bodies import PointMass
from carom.mechanics.potentials import Gravity
from carom.system import System
from carom.tasks.base import Task, sample_free


class Impacts(Task):
    """Balls of one mass and radius that start from one state, among planes (point and normal each).

    `sample` moves each coordinate of the start by up to 0.02 m, and velocities by a normal deviation of 0.02 m/s.
    """

    name: str
    start: tuple[tuple[float, float], ...]
    velocity: tuple[tuple[float, float], ...]
    radius: float
    dt: float
    steps: int = 480
    planes: tuple[tuple[tuple[float, float], tuple[float, float]], ...] = ()
    contact_restitution: float = 1.0
    gravity: float = 0.0
    mass: float = 1.0

    def system(self):
        balls = range(len(self.start))
        pairs = list(combinations(balls, 2))
        return System(
            bodies=[PointMass(self.mass, self.radius) for _ in balls],
            contacts=[*([DiskDisk(pairs)] if pairs else []), *(DiskPlane(balls, *plane) for plane in self.planes)],
            potential=Gravity((0.0, -self.gravity)) if self.gravity else None,
            friction=0.0,
            restitution=self.contact_restitution,
            dim=2,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        start, velocity = (jnp.asarray(np.array(part), system.friction.dtype) for part in (self.start, self.velocity))

        def draw(key, size):
            place, speed = jax.random.split(key)
            shape = (size, *start.shape)
            x = start + jax.random.uniform(place, shape, start.dtype, minval=-0.02, maxval=0.02)
            return x, velocity + 0.02 * jax.random.normal(speed, shape, start.dtype)

        return sample_free(system, key, n, draw)


_FLOOR = ((0.0, 0.0), (0.0, 1.0))
BOUNCE_ONCE = Impacts(
    name="bounce-once", start=((-1.0, 1.0),), velocity=((2.0, -2.0),), radius=0.1, dt=1 / 480, planes=(_FLOOR,)
)
GROUND_WALL = Impacts(
    name="ground-wall",
    start=((-0.5, 1.0),),
    velocity=((5.0, -5.0),),
    radius=0.1,
    dt=0.6 / 480,
    planes=(_FLOOR, ((1.75, 0.0), (-1.0, 0.0))),
    contact_restitution=0.92,
    gravity=9.8,
)
TWO_BALLS = Impacts(
    name="two-balls",
    start=((-2.0, -2.0), (-1.0, -1.0)),
    velocity=((0.0, 0.0), (0.0, 0.0)),
    radius=0.2,
    dt=1 / 480,
)
