"""Potential energies: the interface, which learned potentials implement too, and the given ones."""

import abc
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, not_negative, require, require_values, whole_numbers


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


class Sum(Potential):
    """Several potentials at once: `V = sum_k V_k`."""

    parts: tuple[Potential, ...]

    def __init__(self, *parts: Potential):
        self.parts = parts

    def __call__(self, x, mass_matrix):
        return sum((part(x, mass_matrix) for part in self.parts), jnp.zeros((), x.dtype))

    def dimension(self):
        return next((d for part in self.parts if (d := part.dimension()) is not None), None)


class Springs(Potential):
    """Springs along a row of points: `V = sum k (l - l_0)^2` (paper, appendix H; no factor of one half).

    **Arguments:** `points`, indices in order; `stiffness` k (J/m^2); `rest_length` l_0 (m); `anchor` (d,), a fixed
    point (m) that the first point hangs from by a spring of its own, or `None`.
    """

    points: tuple[int, ...] = eqx.field(static=True)
    stiffness: Float[Array, ""]
    rest_length: Float[Array, ""]
    anchor: Float[Array, " d"] | None

    def __init__(self, points: Sequence[int], stiffness, rest_length, anchor=None):
        self.points = whole_numbers("Springs points", points)
        self.stiffness, self.rest_length = as_floats(stiffness), as_floats(rest_length)
        self.anchor = None if anchor is None else as_floats(anchor)
        require(
            len(self.points) + (anchor is not None) >= 2,
            f"points must name at least two ends of springs, the anchor included; they were {self.points}.",
        )
        require_values("stiffness", stiffness, not_negative, "zero or a positive number of J/m^2")
        require_values("rest_length", rest_length, not_negative, "zero or a positive number of metres")

    def __call__(self, x, mass_matrix):
        row = x[jnp.array(self.points)]
        if self.anchor is not None:
            row = jnp.concatenate([self.anchor.astype(x.dtype)[None], row])
        length = jnp.linalg.norm(row[1:] - row[:-1], axis=1)
        return self.stiffness.astype(x.dtype) * jnp.sum((length - self.rest_length.astype(x.dtype)) ** 2)

    def dimension(self):
        return None if self.anchor is None else self.anchor.shape[0]


class Gravity(Potential):
    """Uniform gravity: `V = - sum_bodies m g . x_center`, with `acceleration` g (d,) in m/s^2."""

    acceleration: Float[Array, " d"]

    def __init__(self, acceleration):
        self.acceleration = as_floats(acceleration)
        require(
            self.acceleration.ndim == 1 and self.acceleration.shape[0] in (2, 3),
            f"acceleration must be a vector of 2 or 3 numbers in m/s^2; its shape was {self.acceleration.shape}.",
        )
        require_values("acceleration", acceleration, np.isfinite, "finite numbers in m/s^2")

    def __call__(self, x, mass_matrix):
        # A row of the mass matrix sums to its body's mass at the centre of mass and to zero at the axis points.
        return -jnp.sum(mass_matrix, axis=0) @ (x @ self.acceleration)

    def dimension(self):
        return self.acceleration.shape[0]
