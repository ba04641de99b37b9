"""Chained pendulums above a ground (paper, appendix H): `cp3` and `cp3-e`."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.contact.candidates import DiskPlane
from carom.mechanics.bodies import PointMass
from carom.mechanics.constraints import Distance, Tether
from carom.mechanics.potentials import Gravity
from carom.system import System
from carom.tasks.base import Task, sample_free

GRAVITY = 9.81


def chain_state(
    angles: Float[Array, "*b n"], rates: Float[Array, "*b n"], lengths: Float[Array, " n"]
) -> tuple[Float[Array, "*b n 2"], Float[Array, "*b n 2"]]:
    """Points and velocities of a chain hung from the origin.

    `angles` (rad) and `rates` (rad/s) are those of each link from the downward vertical.
    """
    links = lengths[..., None] * jnp.stack([jnp.sin(angles), -jnp.cos(angles)], axis=-1)
    spins = (lengths * rates)[..., None] * jnp.stack([jnp.cos(angles), jnp.sin(angles)], axis=-1)
    return jnp.cumsum(links, axis=-2), jnp.cumsum(spins, axis=-2)


def chain_angles(
    x: Float[np.ndarray, "*b n 2"], v: Float[np.ndarray, "*b n 2"]
) -> tuple[Float[np.ndarray, "*b n"], Float[np.ndarray, "*b n"], Float[np.ndarray, "*b n"]]:
    """Angles (rad), rates (rad/s) and lengths (m) of the links: the inverse of `chain_state`."""
    links, spins = (np.diff(part, axis=-2, prepend=0.0) for part in (x, v))
    lengths = np.linalg.norm(links, axis=-1)
    rates = (links[..., 0] * spins[..., 1] - links[..., 1] * spins[..., 0]) / lengths**2
    return np.arctan2(links[..., 0], -links[..., 1]), rates, lengths


class ChainedPendulum(Task):
    """Point masses on massless rods, hung from the origin; the ground is at y = -1."""

    name: str
    masses: tuple[float, ...]
    radii: tuple[float, ...]
    contact_friction: float
    contact_restitution: float
    lengths: tuple[float, ...] = (0.35, 0.4, 0.35)
    dt: float = 0.01
    steps: int = 100

    def system(self):
        n = len(self.masses)
        rods = [Distance(k - 1, k, self.lengths[k]) for k in range(1, n)]
        return System(
            bodies=[PointMass(m, r) for m, r in zip(self.masses, self.radii, strict=True)],
            constraints=[Tether(0, (0.0, 0.0), self.lengths[0]), *rods],
            contacts=[DiskPlane(range(n), point=(0.0, -1.0), normal=(0.0, 1.0))],
            potential=Gravity((0.0, -GRAVITY)),
            friction=self.contact_friction,
            restitution=self.contact_restitution,
            contact_model="cm",
            compensation="paper",
            name=self.name,
        )

    def sample(self, system, key, n):
        lengths = jnp.asarray(self.lengths, system.friction.dtype)

        def draw(key, size):
            key_angle, key_rate = jax.random.split(key)
            shape = (size, len(self.lengths))
            angles = jax.random.uniform(key_angle, shape, lengths.dtype, maxval=jnp.pi)
            return chain_state(angles, jax.random.normal(key_rate, shape, lengths.dtype), lengths)

        return sample_free(system, key, n, draw)

    def add_noise(self, x, v, sd, rng):
        """Errors on angles (rad) and rates (rad/s), so that links keep their lengths."""
        angles, rates, _ = chain_angles(x, v)
        angles, rates = (part + sd * rng.normal(size=part.shape) for part in (angles, rates))
        out = chain_state(jnp.asarray(angles), jnp.asarray(rates), jnp.asarray(self.lengths, angles.dtype))
        return np.asarray(out[0]), np.asarray(out[1])


CP3 = ChainedPendulum(
    name="cp3", masses=(0.1, 0.2, 0.15), radii=(0.05, 0.15, 0.1), contact_friction=0.5, contact_restitution=0.0
)
CP3_E = ChainedPendulum(
    name="cp3-e", masses=(0.2, 0.13, 0.15), radii=(0.15, 0.08, 0.1), contact_friction=0.0, contact_restitution=1.0
)
