"""Holonomic constraints: functions `Phi(x) = 0` of the points, differentiated automatically."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, at_once_if_known, positive, require, require_values, whole


class Constraint(eqx.Module):
    """Equations between points; indices are those of the points in `x` (n, d)."""

    @abc.abstractmethod
    def __call__(self, x: Float[Array, "n d"]) -> Float[Array, " e"]:
        """`Phi(x)`: zero where the constraint holds (m^2)."""

    @abc.abstractmethod
    def points(self) -> tuple[int, ...]:
        """The points it refers to."""

    def size(self, length: Float[Array, ""]) -> Float[Array, "*e"]:
        """How large `Phi` is beside what it holds, of all equations or of each: of a rod, the square of its length.

        `length` (m): size of the bodies, for what has none of its own. Here for a `Phi` in m^2.
        """
        return length**2


class Distance(Constraint):
    """A massless rod: points `i` and `j` keep the distance `length` (m). `|x_i - x_j|^2 - length^2 = 0`."""

    i: int = eqx.field(static=True)
    j: int = eqx.field(static=True)
    length: Float[Array, ""]

    def __init__(self, i: int, j: int, length):
        self.i, self.j, self.length = whole("Distance i", i), whole("Distance j", j), as_floats(length)
        require(i != j, f"Distance joins two different points; both were {i}.")
        require_values("length", length, positive, "a positive number of metres")

    def __call__(self, x):
        return (jnp.sum((x[self.i] - x[self.j]) ** 2) - self.length**2)[None]

    def size(self, length):
        return self.length**2

    def points(self):
        return self.i, self.j


class Tether(Constraint):
    """A massless rod from a fixed `anchor` (d,) to point `i`, of `length` (m). `|x_i - anchor|^2 - length^2 = 0`."""

    i: int = eqx.field(static=True)
    anchor: Float[Array, " d"]
    length: Float[Array, ""]

    def __init__(self, i: int, anchor, length):
        self.i, self.anchor, self.length = whole("Tether i", i), as_floats(anchor), as_floats(length)
        require_values("Tether anchor", anchor, np.isfinite, "finite coordinates in m")
        require_values("length", length, positive, "a positive number of metres (for 0 use Joint)")

    def __call__(self, x):
        return (jnp.sum((x[self.i] - self.anchor) ** 2) - self.length**2)[None]

    def size(self, length):
        return self.length**2

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
        self.first, self.weights, self.anchor = whole("Joint first", first), as_floats(weights), as_floats(anchor)
        require_values("Joint anchor", anchor, np.isfinite, "finite coordinates in m")
        require_values("weights", weights, _sums_to_one, "numbers that sum to 1")

    def __call__(self, x):
        points = x[self.first : self.first + self.weights.shape[0]]
        return self.weights @ points - self.anchor

    def size(self, length):
        return jnp.maximum(length, _arm(self.weights))

    def points(self):
        return tuple(range(self.first, self.first + self.weights.shape[0]))


class Pivot(Constraint):
    """A ball joint between two bodies: a material point of one is always where a material point of the other is.

    `sum_k weights_i_k x_(i + k) - sum_k weights_j_k x_(j + k) = 0`, in m. `i` and `j` are the bodies' first points;
    `weights_i`, `weights_j` (p,) sum to 1 and are, for a rigid body, `place_weights` of the joint's place in its frame.
    """

    i: int = eqx.field(static=True)
    j: int = eqx.field(static=True)
    weights_i: Float[Array, " p"]
    weights_j: Float[Array, " q"]

    def __init__(self, i: int, weights_i, j: int, weights_j):
        require(i != j, f"Pivot joins two different bodies; the first point of both was {i}.")
        self.i, self.j = whole("Pivot i", i), whole("Pivot j", j)
        self.weights_i, self.weights_j = as_floats(weights_i), as_floats(weights_j)
        for name, weights in (("weights_i", self.weights_i), ("weights_j", self.weights_j)):
            require_values(name, weights, _sums_to_one, "numbers that sum to 1")

    def __call__(self, x):
        return _material(x, self.i, self.weights_i) - _material(x, self.j, self.weights_j)

    def size(self, length):
        return jnp.maximum(length, jnp.maximum(_arm(self.weights_i), _arm(self.weights_j)))

    def points(self):
        return (*_range(self.i, self.weights_i), *_range(self.j, self.weights_j))


class Angles(Constraint):
    """Directions fixed in a rigid body keep their angles with directions fixed in another, or in space.

    `u_k . w_k - cosines_k = 0` with `u_k = sum_a directions_ka (x_(i + a) - x_i)`, and `w_k` alike from `others` and
    the body whose first point is `j`, or `others_k` itself where `j` is `None`.

    **Arguments:** `i`, `j`, first points of the bodies; `directions`, `others` (e, d), unit vectors in the frames of
    their axes; `cosines` (e,) of the angles between them, or one for all.

    A hinge keeps its axis at right angles to two directions of the other body; a universal joint keeps the angle of its
    two axes; a slide keeps `e_1, e_2, e_3` at right angles to `e_2, e_3, e_1`. No equation may follow from the others:
    keep directions at right angles that are so, not equal ones that are equal.
    """

    i: int = eqx.field(static=True)
    j: int | None = eqx.field(static=True)
    directions: Float[Array, "e d"]
    others: Float[Array, "e d"]
    cosines: Float[Array, " e"]

    def __init__(self, i: int, directions, others, cosines=0.0, j: int | None = None):
        require(i != j, f"Angles are between two different bodies; the first point of both was {i}.")
        self.i, self.j = whole("Angles i", i), None if j is None else whole("Angles j", j)
        self.directions, self.others = as_floats(directions), as_floats(others)
        shape = self.directions.shape
        require(
            len(shape) == 2 and shape == self.others.shape,
            f"Angles directions and others must be as many vectors (e, d); their shapes were {shape} and "
            f"{self.others.shape}.",
        )
        for name, value in (("directions", directions), ("others", others)):
            require_values(f"Angles {name}", value, np.isfinite, "finite numbers")
        cosines = as_floats(cosines)
        require(
            cosines.shape in ((), shape[:1]),
            f"Angles cosines must be one number or {shape[0]}; their shape was {cosines.shape}.",
        )
        with at_once_if_known(cosines):
            self.cosines = jnp.broadcast_to(cosines, shape[:1])
        require_values("cosines", cosines, lambda c: np.abs(c) < 1, "between -1 and 1, without these")

    def __call__(self, x):
        turned = self.directions @ _axes(x, self.i, self.directions.shape[1])
        others = self.others if self.j is None else self.others @ _axes(x, self.j, self.others.shape[1])
        return jnp.sum(turned * others, axis=1) - self.cosines

    def size(self, length):
        return jnp.ones_like(length)

    def points(self):
        d = self.directions.shape[1]
        return tuple(p for first in (self.i, self.j) if first is not None for p in range(first, first + d + 1))


class Track(Constraint):
    """A material point of a body stays on a line or plane that is fixed in another rigid body, or in space.

    `n_k . (p - a) = 0`, in m, with `p = sum_k weights_k x_(i + k)`; `n_k = normals_k` and `a = anchor` in space where
    `j` is `None`, else in the frame of the body whose first point is `j`: `a = x_j + sum_b anchor_b (x_(j + b) - x_j)`.

    **Arguments:** `i`, `j`, first points of the bodies; `weights` (p,), which sum to 1, see `place_weights`; `normals`
    (e, d), independent unit vectors at right angles to the line (in 3D two) or the plane (one); `anchor` (d,), a point
    of it (m).
    """

    i: int = eqx.field(static=True)
    j: int | None = eqx.field(static=True)
    weights: Float[Array, " p"]
    normals: Float[Array, "e d"]
    anchor: Float[Array, " d"]

    def __init__(self, i: int, weights, normals, anchor, j: int | None = None):
        require(i != j, f"Track joins two different bodies; the first point of both was {i}.")
        self.i, self.j = whole("Track i", i), None if j is None else whole("Track j", j)
        self.weights, self.normals, self.anchor = as_floats(weights), as_floats(normals), as_floats(anchor)
        for name, value in (("normals", normals), ("anchor", anchor)):
            require_values(f"Track {name}", value, np.isfinite, "finite numbers")
        require_values("weights", weights, _sums_to_one, "numbers that sum to 1")
        require(
            self.normals.ndim == 2 and self.normals.shape[1:] == self.anchor.shape,
            f"Track normals must be vectors (e, d) and anchor a point (d,); their shapes were {self.normals.shape} and "
            f"{self.anchor.shape}.",
        )

    def __call__(self, x):
        place = _material(x, self.i, self.weights)
        if self.j is None:
            return self.normals @ (place - self.anchor)
        axes = _axes(x, self.j, self.anchor.shape[0])
        return self.normals @ axes @ (place - x[self.j] - self.anchor @ axes)

    def size(self, length):
        return jnp.maximum(length, _arm(self.weights))

    def points(self):
        frame = () if self.j is None else range(self.j, self.j + self.anchor.shape[0] + 1)
        return (*_range(self.i, self.weights), *frame)


def place_weights(place) -> Float[Array, " p"]:
    """Weights over a rigid body's points of the material point at `place` (d,) in the frame of its axes (m)."""
    place = as_floats(place)
    with at_once_if_known(place):
        return jnp.concatenate([1 - jnp.sum(place, keepdims=True), place])


def _sums_to_one(weights: np.ndarray) -> bool:
    return bool(abs(np.sum(weights) - 1) < 1e-6)


def _arm(weights: Float[Array, " p"]) -> Float[Array, ""]:
    """How far a material point is from its body's centre of mass (m)."""
    return jnp.linalg.norm(weights[1:])


def _range(first: int, weights: Float[Array, " p"]) -> range:
    return range(first, first + weights.shape[0])


def _material(x: Float[Array, "n d"], first: int, weights: Float[Array, " p"]) -> Float[Array, " d"]:
    return weights @ x[first : first + weights.shape[0]]


def _axes(x: Float[Array, "n d"], first: int, dim: int) -> Float[Array, "d d"]:
    """The axes of a rigid body, one a row."""
    return x[first + 1 : first + 1 + dim] - x[first]


class Rigid(Constraint):
    """Keeps the points `first ... first + d` a rigid frame: unit axes at right angles. 3 equations in 2D, 6 in 3D."""

    first: int = eqx.field(static=True)
    dim: int = eqx.field(static=True)

    def __call__(self, x):
        axes = x[self.first + 1 : self.first + 1 + self.dim] - x[self.first]
        rows, columns = jnp.triu_indices(self.dim)
        return (axes @ axes.T - jnp.eye(self.dim, dtype=x.dtype))[rows, columns]

    def size(self, length):
        return jnp.ones_like(length)

    def points(self):
        return tuple(range(self.first, self.first + self.dim + 1))
