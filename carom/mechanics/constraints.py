"""Holonomic constraints: functions `Phi(x) = 0` of the points, differentiated automatically."""

import abc

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from carom.checks import as_floats, require, require_values


class Constraint(eqx.Module):
    """Equations between points; indices are those of the points in `x` (n, d)."""

    @abc.abstractmethod
    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, " e"]:
        """`Phi(x)`: zero where the constraint holds (m^2)."""

    @abc.abstractmethod
    def points(self) -> tuple[int, ...]:
        """The points it refers to."""


class Distance(Constraint):
    """A massless rod: points `i` and `j` keep the distance `length` (m). `|x_i - x_j|^2 - length^2 = 0`."""

    i: int = eqx.field(static=True)
    j: int = eqx.field(static=True)
    length: Float[Array, ""]

    def __init__(self, i: int, j: int, length):
        require(i != j, f"Distance joins two different points; both were {i}.")
        self.i, self.j, self.length = i, j, as_floats(length)
        require_values("length", length, self.length > 0, "a positive number of metres")

    def __call__(self, x):
        return (jnp.sum((x[self.i] - x[self.j]) ** 2) - self.length**2)[None]

    def points(self):
        return self.i, self.j


class Tether(Constraint):
    """A massless rod from a fixed `anchor` (d,) to point `i`, of `length` (m). `|x_i - anchor|^2 - length^2 = 0`."""

    i: int = eqx.field(static=True)
    anchor: Float[Array, " d"]
    length: Float[Array, ""]

    def __init__(self, i: int, anchor, length):
        self.i, self.anchor, self.length = i, as_floats(anchor), as_floats(length)
        require_values("length", length, self.length > 0, "a positive number of metres (for 0 use Joint)")

    def __call__(self, x):
        return (jnp.sum((x[self.i] - self.anchor) ** 2) - self.length**2)[None]

    def points(self):
        return (self.i,)


class Joint(Constraint):
    """A ball joint: the material point `sum_k weights_k x_(first + k)` of a body stays at `anchor` (d,).

    `weights` (p,) sum to 1 and are, for a rigid body, `(1 - sum(c), c_1, ..., c_d)` with `c` the joint's place in the
    body frame (m).
    """

    first: int = eqx.field(static=True)
    weights: Float[Array, " p"]
    anchor: Float[Array, " d"]

    def __init__(self, first: int, weights, anchor):
        self.first, self.weights, self.anchor = first, as_floats(weights), as_floats(anchor)
        require_values("weights", weights, jnp.abs(jnp.sum(self.weights) - 1) < 1e-6, "numbers that sum to 1")

    def __call__(self, x):
        points = x[self.first : self.first + self.weights.shape[0]]
        return self.weights @ points - self.anchor

    def points(self):
        return tuple(range(self.first, self.first + self.weights.shape[0]))


class Rigid(Constraint):
    """Keeps the points `first ... first + d` a rigid frame: unit axes at right angles. 3 equations in 2D, 6 in 3D."""

    first: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    def __call__(self, x):
        axes = x[self.first + 1 : self.first + 1 + self.dim] - x[self.first]
        rows, columns = jnp.triu_indices(self.dim)
        return (axes @ axes.T - jnp.eye(self.dim, dtype=x.dtype))[rows, columns]

    def points(self):
        return tuple(range(self.first, self.first + self.dim + 1))
