"""A quantity: one number of a System that can be learned. Where it stands, its bounds, and the free number behind it.

Everything about a quantity that can differ between systems of one structure (bounds, scales, what it is measured from)
is an array, and everything else is hashable: one compiled program serves them all.
"""

import abc
import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from carom.mechanics.bodies import RigidBody
from carom.system import System

Path = tuple[str | int, ...]
"""Attributes and indices that lead from a System to one of its arrays."""
AXES = "xyz"


@dataclasses.dataclass(frozen=True)
class Slot:
    """One entry of an array. `balanced`: the array's first entry is 1 less the others, as weights of places are."""

    path: Path
    index: tuple[int, ...] = ()
    balanced: bool = False

    def read(self, system: System) -> Float[Array, ""]:
        """The entry."""
        return leaf(system, self.path)[self.index]

    def write(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another entry."""
        old = leaf(system, self.path)
        new = old.at[self.index].set(value.astype(old.dtype))
        if self.balanced:
            new = new.at[0].set(1 - jnp.sum(new[1:]))
        return with_leaf(system, self.path, new)


def leaf(system: System, path: Path) -> Any:
    """What stands at `path`."""
    found: Any = system
    for part in path:
        found = found[part] if isinstance(part, int) else getattr(found, part)
    return found


def with_leaf(system: System, path: Path, value: Array) -> System:
    """The system with another array at `path`."""
    return eqx.tree_at(lambda s: leaf(s, path), system, value)


# --- places: what of a system is one number ------------------------------------------------------------------------


class Place(eqx.Module):
    """How a number is read from a system, and written into it."""

    @abc.abstractmethod
    def read(self, system: System) -> Float[Array, ""]:
        """The number."""

    @abc.abstractmethod
    def write(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another number."""


class Entry(Place):
    """An entry of an array, and those that are the same thing: the radius of a ball that touches two planes."""

    slots: tuple[Slot, ...] = eqx.field(static=True)

    def read(self, system):
        return self.slots[0].read(system)

    def write(self, system, value):
        for slot in self.slots:
            system = slot.write(system, value)
        return system


Measure = Literal["mean", "norm", "inertia"]


class Size(Place):
    """How large an array is that keeps its proportions, and those arrays that are the same thing.

    `measure`: the mean of its entries; its norm; or the mean moment of inertia of a body with these second moments,
    which in 3D is two thirds of their sum and in 2D their sum.
    """

    paths: tuple[Path, ...] = eqx.field(static=True)
    measure: Measure = eqx.field(static=True)

    def read(self, system):
        return self._size(leaf(system, self.paths[0]))

    def write(self, system, value):
        for path in self.paths:
            old = leaf(system, path)
            system = with_leaf(system, path, old * value.astype(old.dtype) / self._size(old))
        return system

    def _size(self, array: Float[Array, " d"]) -> Float[Array, ""]:
        if self.measure == "norm":
            return jnp.linalg.norm(array)
        total = jnp.sum(array)
        return total / array.shape[0] if self.measure == "mean" else total * (2 / 3 if array.shape[0] == 3 else 1)


class MassRatio(Place):
    """The mass of a body over that of the first. A rigid body keeps its shape: its moments go with its mass."""

    body: int = eqx.field(static=True)

    def read(self, system):
        return system.bodies[self.body].mass / system.bodies[0].mass

    def write(self, system, value):
        return _with_mass(system, self.body, value * system.bodies[0].mass)


class FirstMass(Place):
    """The mass of the first body (kg); all others, and all moments, keep their ratio to it."""

    def read(self, system):
        return system.bodies[0].mass

    def write(self, system, value):
        ratio = value / system.bodies[0].mass
        for k, body in enumerate(system.bodies):
            system = _with_mass(system, k, body.mass * ratio)
        return system


def _with_mass(system: System, k: int, mass: Float[Array, ""]) -> System:
    body = system.bodies[k]
    mass = mass.astype(body.mass.dtype)
    if isinstance(body, RigidBody):
        scaled = body.moments * (mass / body.mass).astype(body.moments.dtype)
        system = with_leaf(system, ("bodies", k, "moments"), scaled)
    return with_leaf(system, ("bodies", k, "mass"), mass)


class PlaneHeight(Place):
    """How far a plane is from the origin along the normal that it was told with (m); it is moved along that one.

    `planes`: the contact families whose plane it is.
    """

    planes: tuple[int, ...] = eqx.field(static=True)
    normal: Float[Array, " d"]

    def read(self, system):
        point = system.contacts[self.planes[0]].point  # pyright: ignore[reportAttributeAccessIssue]
        return point @ self.normal.astype(point.dtype)

    def write(self, system, value):
        for k in self.planes:
            old = leaf(system, ("contacts", k, "point"))
            normal = self.normal.astype(old.dtype)
            system = with_leaf(
                system, ("contacts", k, "point"), old + (value.astype(old.dtype) - old @ normal) * normal
            )
        return system


class Tilt(Place):
    """How much a plane is tilted, about its `point`: the tangent of the angle between its normal and the told one.

    Measured in the plane of the told `normal` and of `tangent`, a unit vector at right angles to it.
    """

    planes: tuple[int, ...] = eqx.field(static=True)
    normal: Float[Array, " d"]
    tangent: Float[Array, " d"]

    def read(self, system):
        normal = system.contacts[self.planes[0]].normal  # pyright: ignore[reportAttributeAccessIssue]
        return (normal @ self.tangent.astype(normal.dtype)) / (normal @ self.normal.astype(normal.dtype))

    def write(self, system, value):
        point = leaf(system, ("contacts", self.planes[0], "point"))
        for k in self.planes:
            old = leaf(system, ("contacts", k, "normal"))
            told, tangent = self.normal.astype(old.dtype), self.tangent.astype(old.dtype)
            new = old + (value.astype(old.dtype) * (old @ told) - old @ tangent) * tangent
            system = with_leaf(system, ("contacts", k, "normal"), new / jnp.linalg.norm(new))
            # One plane turns about one point, whichever of its points each family was told with.
            system = with_leaf(system, ("contacts", k, "point"), point)
        return system


class Shift(Place):
    """Where a body's centre of mass is beside its shape, along one of its axes (m): all of the shape moves against it.

    `slots`: the coordinates of the parts of the shape; `told`, what they were; `origin`: the coordinate of the first
    part where the centre of mass is at zero.
    """

    slots: tuple[Slot, ...] = eqx.field(static=True)
    told: Float[Array, " parts"]
    origin: Float[Array, ""]

    def read(self, system):
        first = self.slots[0].read(system)
        return self.origin.astype(first.dtype) - first

    def write(self, system, value):
        first = self.origin.astype(value.dtype) - value
        for slot, told in zip(self.slots, self.told - self.told[0], strict=True):
            system = slot.write(system, first + told.astype(value.dtype))
        return system


# --- quantities ----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Label:
    """What a quantity is called: `kind:which`, as in `radius:1`. `of`, in words, what it belongs to; its unit.

    `log`: its free number is its logarithm. `part_of`: the name of the quantity, if any, that holds it too, so that
    not both can be learned.
    """

    kind: str
    which: str = ""
    of: str = ""
    unit: str = ""
    log: bool = False
    part_of: str = ""

    @property
    def name(self) -> str:
        """`kind:which`."""
        return f"{self.kind}:{self.which}" if self.which else self.kind


class Quantity(eqx.Module):
    """A number of a System that can be learned: read by `value`, written by `put`.

    Behind it is a free number, which estimators change: the value itself, or its logarithm where it is positive and its
    size is what counts. A free number beyond a bound stands for the bound. `lower` and `upper` are bounds of the value,
    `scale` is a change of the free number that matters.
    """

    label: Label = eqx.field(static=True)
    place: Place
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    scale: Float[Array, ""]

    @property
    def name(self) -> str:
        """What it is chosen by."""
        return self.label.name

    @property
    def of(self) -> str:
        """What it belongs to, in words."""
        return self.label.of

    @property
    def unit(self) -> str:
        """Unit of the value; empty where it has none."""
        return self.label.unit

    @property
    def size(self) -> int:
        """How many free numbers it has: vectors are a quantity for each component."""
        return 1

    def value(self, system: System) -> Float[Array, ""]:
        """The value in a system."""
        return self.place.read(system)

    def put(self, system: System, value: Float[Array, ""]) -> System:
        """The system with another value: of the same structure and precision, and differentiable."""
        return self.place.write(system, value)

    def to_free(self, value: Float[Array, ""]) -> Float[Array, ""]:
        """The free number behind a value."""
        return jnp.log(value) if self.label.log else value

    def from_free(self, free: Float[Array, ""]) -> Float[Array, ""]:
        """The value that a free number stands for; at a bound, the derivative is that from within."""
        lower, upper = (bound.astype(free.dtype) for bound in (self.lower, self.upper))
        inside = jnp.exp(free) if self.label.log else free
        below, above = free < self.to_free(lower), free > self.to_free(upper)
        return jnp.where(below, lower, jnp.where(above, upper, inside))
