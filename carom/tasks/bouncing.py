"""Bouncing point masses in the unit box (paper, appendix H): `bp5-e` and `bp5`."""

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from carom.contact.candidates import Contact, DiskDisk, DiskPlane
from carom.mechanics.bodies import PointMass
from carom.system import System
from carom.tasks.base import Task, sample_free

BOX_WALLS = (((0.0, 0.0), (1.0, 0.0)), ((1.0, 0.0), (-1.0, 0.0)), ((0.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (0.0, -1.0)))
"""Point and inward normal of the walls of the unit box: left, right, floor, ceiling."""


def box_contacts(n: int, *, individual: bool) -> list[Contact]:
    """All pairs of `n` bodies, and each body with each wall; one shared property, or individual ones."""
    pairs = list(combinations(range(n), 2))
    contacts: list[Contact] = [DiskDisk(pairs, property=range(len(pairs)) if individual else 0)] if pairs else []
    for k, (point, normal) in enumerate(BOX_WALLS):
        first = len(pairs) + k * n
        contacts.append(DiskPlane(range(n), point, normal, property=range(first, first + n) if individual else 0))
    return contacts


class BouncingPoints(Task):
    """Five point masses in a box, without gravity."""

    name: str
    masses: tuple[float, ...]
    radii: tuple[float, ...]
    contact_friction: tuple[float, ...]
    contact_restitution: tuple[float, ...]
    dt: float = 0.01
    steps: int = 100

    def system(self):
        return System(
            bodies=[PointMass(m, r) for m, r in zip(self.masses, self.radii, strict=True)],
            contacts=box_contacts(len(self.masses), individual=len(self.contact_friction) > 1),
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
            key_x, key_v = jax.random.split(key)
            share = jax.random.uniform(key_x, (size, count, 2), radii.dtype)
            return radii + share * (1 - 2 * radii), jax.random.normal(key_v, (size, count, 2), radii.dtype)

        return sample_free(system, key, n, draw)


BP5_E = BouncingPoints(
    name="bp5-e", masses=(0.1,) * 5, radii=(0.1,) * 5, contact_friction=(0.0,), contact_restitution=(1.0,)
)
BP5 = BouncingPoints(
    name="bp5",
    masses=(0.05, 0.1, 0.3, 0.4, 0.5),
    radii=(0.05, 0.1, 0.13, 0.15, 0.18),
    contact_friction=(0.5, 0.4, 0.6, 0.8, 0.9, 1.1, 0.7, 0.1, 0.0, 0.3) + (0.1,) * 20,
    contact_restitution=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0) + (0.8,) * 20,
)
