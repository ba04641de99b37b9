"""Potential energies: the interface, which learned potentials implement too, and the given ones."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from carom.checks import as_floats, require


class Potential(eqx.Module):
    """A potential energy (J) as a function of the points and of their mass matrix."""

    @abc.abstractmethod
    def __call__(self, x: Float[Array, "n d"], mass_matrix: Float[Array, "n n"]) -> Float[Array, ""]:
        """`V(x)`, in joules."""

    def dimension(self) -> int | None:
        """The dimension of space that this potential asks for, if it asks for one."""
        return None


class NoPotential(Potential):
    """No forces."""

    def __call__(self, x, mass_matrix):
        return jnp.zeros((), x.dtype)


class Gravity(Potential):
    """Uniform gravity: `V = - sum_bodies m g . x_center`, with `acceleration` g (d,) in m/s^2."""

    acceleration: Float[Array, " d"]

    def __init__(self, acceleration):
        self.acceleration = as_floats(acceleration)
        require(
            self.acceleration.ndim == 1 and self.acceleration.shape[0] in (2, 3),
            f"acceleration must be a vector of 2 or 3 numbers in m/s^2; its shape was {self.acceleration.shape}.",
        )

    def __call__(self, x, mass_matrix):
        # A row of the mass matrix sums to its body's mass at the centre of mass and to zero at the axis points.
        return -jnp.sum(mass_matrix, axis=0) @ (x @ self.acceleration)

    def dimension(self):
        return self.acceleration.shape[0]
