"""Limits of joints and dry friction in them, as contacts: neither has a place, both have rows of the Jacobian.

A limit is a contact whose gap is what is left of a coordinate's range, in rad or m. Dry friction is a contact that is
always closed and whose normal force is known: what holds, and what slips, is found together with all other contacts.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from carom.checks import as_floats, not_negative, require, require_values
from carom.contact.candidates import Candidates, Contact, property_indices
from carom.mechanics.joints import Joints


class JointReading(Contact):
    """Lengths that hang on the coordinates of joints, as `gears q`: a base for limits and dry friction.

    **Arguments:** `joints`, objects as they stand in the system's constraints; `gears` (c, q) over the coordinates of
    these, one after the other; `names` (c,).
    """

    joints: tuple[Joints, ...]
    gears: Float[Array, "c q"]
    labels: tuple[str, ...] = eqx.field(static=True)
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, joints: Joints | Sequence[Joints], gears, property: int | Sequence[int], names):
        self.joints = (joints,) if isinstance(joints, Joints) else tuple(joints)
        self.gears = as_floats(gears)
        count, kind = sum(joint.count for joint in self.joints), type(self).__name__
        require(
            self.gears.ndim == 2 and self.gears.shape[1] == count,
            f"{kind} gears must have a column for each of {count} coordinates of its joints; their shape was "
            f"{self.gears.shape}.",
        )
        self.property_index = property_indices(kind, property, self.gears.shape[0])
        own = [name for joint in self.joints for name in joint.coordinate_names()]
        said = ["+".join(own[k] for k in np.flatnonzero(row)) for row in np.asarray(self.gears)]
        self.labels = tuple(said if names is None else names)

    def _points(self) -> np.ndarray:
        return np.array(list(dict.fromkeys(p for joint in self.joints for p in joint.points())))

    def _read(self, x: Float[Array, "n d"]) -> Float[Array, " q"]:
        return jnp.concatenate([joint.coordinates(x) for joint in self.joints])

    def _rates(self, x: Float[Array, "n d"], points: np.ndarray) -> Float[Array, "c p d"]:
        """How fast each length changes with the velocity of each of these points."""

        def rates(own):
            v = jnp.zeros_like(x).at[points].set(own)
            return self.gears @ jnp.concatenate([joint.rates(x, v) for joint in self.joints])

        return jax.jacrev(rates)(jnp.zeros((len(points), x.shape[1]), x.dtype))

    def _candidates(self, gap: Float[Array, " c"], rows: Float[Array, "c p d"], row: int, points) -> Candidates:
        d, count = rows.shape[2], len(self.property_index)
        full = jnp.zeros((count, d, *rows.shape[1:]), rows.dtype).at[:, row].set(rows)
        return Candidates(gap, np.broadcast_to(points, (count, len(points))), full)

    def reach(self, radii):
        return jnp.full(len(self.property_index), jnp.inf, radii.dtype)

    def travel(self, radii):
        return jnp.full(len(self.property_index), 0.5, radii.dtype)  # rad

    def bodies_of(self):
        return ((),) * len(self.property_index)

    def names(self):
        return self.labels

    def dimension(self):
        return self.joints[0].dim


class JointLimit(JointReading):
    """Limits of joints, without friction: `side (gears q - bound) - margin` is the gap, of each of `c` limits.

    **Arguments:** `joints`, one or several, as they stand in the system's constraints; `gears` (c, q) over their
    coordinates, of one joint a unit row; `bounds` (c,) (rad, m); `sides` (c,): 1 for a lower bound, -1 for an upper
    one; `margin` (c,), how far before the bound it holds; `property`, index into the system's restitution. `ball`:
    where the three coordinates of a ball joint begin, whose angle is limited in place of `gears q`.
    """

    bounds: Float[Array, " c"]
    sides: tuple[int, ...] = eqx.field(static=True)
    margin: Float[Array, " c"]
    ball: int | None = eqx.field(static=True)

    def __init__(
        self,
        joints,
        gears,
        bounds,
        sides,
        margin: ArrayLike | Sequence[float] = 0.0,
        property=0,
        names=None,
        ball: int | None = None,
    ):
        super().__init__(joints, gears, property, names)
        if names is None:
            what = ("lower" if side > 0 else "upper" for side in sides)
            self.labels = tuple(f"{name} {side} limit" for name, side in zip(self.labels, what, strict=False))
        count = len(self.property_index)
        self.bounds, self.sides = as_floats(bounds), tuple(int(side) for side in sides)
        self.margin, self.ball = as_floats(np.broadcast_to(np.asarray(margin, float), (count,))), ball
        require(
            self.bounds.shape == (count,) and len(self.sides) == count and set(self.sides) <= {-1, 1},
            f"JointLimit bounds and sides (1 or -1) must be {count}; they were {np.asarray(self.bounds)} and "
            f"{self.sides}.",
        )

    def candidates(self, x, radii, table):
        points, sides = self._points(), jnp.array(self.sides, x.dtype)
        length = self.gears @ self._read(x)
        rows = self._rates(x, points)
        if self.ball is not None:
            own = slice(self.ball, self.ball + 3)
            vector = self._read(x)[own]
            square = jnp.sum(vector**2)
            length = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)[None]
            way = vector / jnp.where(length > 0, length, 1)
            rows = self._replaced(jnp.zeros((1, self.gears.shape[1]), x.dtype).at[0, own].set(way))._rates(x, points)
        return self._candidates(sides * (length - self.bounds) - self.margin, sides[:, None, None] * rows, 0, points)

    def _replaced(self, gears: Float[Array, "c q"]) -> "JointLimit":
        return eqx.tree_at(lambda limit: limit.gears, self, gears)


class DryFriction(JointReading):
    """Dry friction of joints: a torque of at most `loss` against their motion, which holds what is pushed by less.

    **Arguments:** `joints`, one or several, as they stand in the system's constraints; `gears` (c, q) over their
    coordinates; `loss` (c,) (N m, N). Needs the contact model `"coulomb"`.
    """

    loss: Float[Array, " c"]

    def __init__(self, joints, gears, loss, property=0, names=None):
        super().__init__(joints, gears, property, names)
        self.loss = as_floats(loss)
        count = len(self.property_index)
        require(self.loss.shape == (count,), f"DryFriction loss must be {count} numbers; it was {self.loss.shape}.")
        require_values("DryFriction loss", loss, not_negative, "zero or positive numbers of N m, or N")

    def candidates(self, x, radii, table):
        points = self._points()
        gap = jnp.zeros(len(self.property_index), x.dtype)
        return self._candidates(gap, self._rates(x, points), 1, points)
