"""Ropes hung from the origin, elastic between limits of stretch and bend (paper, appendix H): `rope` to `rope-200`."""

import jax
import jax.numpy as jnp

from carom.contact.limits import BendLimit, StretchLimit
from carom.mechanics.bodies import PointMass
from carom.mechanics.potentials import Gravity, Springs, Sum
from carom.system import System
from carom.tasks.base import Task, sample_free
from carom.tasks.pendulums import GRAVITY, chain_state

ORIGIN = (0.0, 0.0)


class Rope(Task):
    """Point masses joined by springs; each segment's length and each bend are limited, inelastically."""

    name: str
    points: int
    mass: float = 0.1
    rest_length: float = 0.05
    stiffness: float = 50.0
    shortest: float = 0.8
    longest: float = 1.2
    bend: float = 0.3
    contact_friction: float = 0.0
    contact_restitution: float = 0.0
    dt: float = 0.005
    steps: int = 20

    def system(self):
        row, rest = range(self.points), self.rest_length
        return System(
            bodies=[PointMass(self.mass)] * self.points,
            contacts=[
                BendLimit(row, self.bend, anchor=ORIGIN),
                StretchLimit(row, self.shortest * rest, self.longest * rest, anchor=ORIGIN),
            ],
            potential=Sum(Gravity((0.0, -GRAVITY)), Springs(row, self.stiffness, rest, anchor=ORIGIN)),
            friction=self.contact_friction,
            restitution=self.contact_restitution,
            max_active=2 * self.points - 1,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        dtype = system.friction.dtype
        lengths = jnp.full(self.points, self.rest_length, dtype)

        def draw(key, size):
            first, bends, rates = jax.random.split(key, 3)
            start = jax.random.uniform(first, (size, 1), dtype, maxval=jnp.pi)
            # Strictly within the limit, so that rounding closes no contact.
            bend = jax.random.uniform(bends, (size, self.points - 1), dtype, minval=-self.bend, maxval=self.bend)
            angles = jnp.cumsum(jnp.concatenate([start, bend * (1 - 1e-9)], axis=1), axis=1)
            return chain_state(angles, jax.random.normal(rates, (size, self.points), dtype), lengths)

        return sample_free(system, key, n, draw)


ROPE = Rope(name="rope", points=10)
ROPE_50 = Rope(name="rope-50", points=50)
ROPE_100 = Rope(name="rope-100", points=100)
ROPE_200 = Rope(name="rope-200", points=200)
