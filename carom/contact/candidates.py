"""Contact types: from the points of a system to gaps and the contact Jacobian, and the choice of the active ones.

A new contact type is one new class here: `Contact` with its gaps and Jacobian rows.
"""

import abc
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.checks import as_floats, require
from carom.contact.geometry import Touch, sphere_plane, sphere_sphere
from carom.mechanics.bodies import BodyTable


class Candidates(NamedTuple):
    """All contacts that could be: `gap` (C,) in m; Jacobian rows (normal, tangents) to point velocities."""

    gap: Float[Array, " C"]
    jacobian: Float[Array, "C d n d"]


class Contact(eqx.Module):
    """A family of possible contacts. Static: which bodies, which contact property."""

    property_index: eqx.AbstractVar[tuple[int, ...]]

    @abc.abstractmethod
    def candidates(self, x: Float[Array, "n d"], radii: Float[Array, " bodies"], table: BodyTable) -> Candidates:
        """Gaps and Jacobian of this family's candidates, in a fixed order."""

    @abc.abstractmethod
    def reach(self, radii: Float[Array, " bodies"]) -> Float[Array, " c"]:
        """Depth (m) beyond which a candidate is not in contact but through: an impossible state."""

    @abc.abstractmethod
    def bodies_of(self) -> tuple[tuple[int, ...], ...]:
        """The bodies of each candidate."""


def _property_indices(name: str, value: int | Sequence[int], count: int) -> tuple[int, ...]:
    if isinstance(value, int):
        return (value,) * count
    indices = tuple(int(p) for p in value)
    require(
        len(indices) == count,
        f"{name} property must be one index or one for each of the {count} contacts; it had {len(indices)}.",
    )
    return indices


def _jacobian(weights: Float[Array, "c n"], frame: Float[Array, "c d d"]) -> Float[Array, "c d n d"]:
    """Rows that map point velocities to the relative velocity in the contact frame."""
    return weights[:, None, :, None] * frame[:, :, None, :]


class DiskDisk(Contact):
    """Contacts between round bodies (disks in 2D, spheres in 3D), with their radii.

    **Arguments:** `pairs`, the two bodies of each contact; `property`, index into the system's `friction` and
    `restitution`: one for all, or one for each pair.
    """

    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, pairs: Iterable[tuple[int, int]], property: int | Sequence[int] = 0):
        self.pairs = tuple((int(a), int(b)) for a, b in pairs)
        for a, b in self.pairs:
            require(a != b, f"DiskDisk pairs two different bodies; a pair was ({a}, {b}).")
        self.property_index = _property_indices("DiskDisk", property, len(self.pairs))

    def candidates(self, x, radii, table):
        a, b = np.array(self.pairs).T
        centers = np.array(table.center)
        touch = sphere_sphere(x[centers[a]], x[centers[b]], radii[a], radii[b])
        normal = touch.frame[:, 0]
        weights = table.weights(x, a, -radii[a][:, None] * normal)
        weights = weights - table.weights(x, b, radii[b][:, None] * normal)
        return Candidates(touch.gap, _jacobian(weights, touch.frame))

    def reach(self, radii):
        a, b = np.array(self.pairs).T
        return radii[a] + radii[b]

    def bodies_of(self):
        return self.pairs


class DiskPlane(Contact):
    """Contacts between round bodies and a fixed plane (in 2D, a line).

    **Arguments:** `bodies`, which; `point` (d,), on the plane (m); `normal` (d,), out of the solid side, of any length;
    `property`, index into the system's `friction` and `restitution`: one for all, or one for each body.
    """

    bodies: tuple[int, ...] = eqx.field(static=True)
    point: Float[Array, " d"]
    normal: Float[Array, " d"]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, bodies: Iterable[int], point, normal, property: int | Sequence[int] = 0):
        self.bodies = tuple(int(b) for b in bodies)
        self.point, normal = as_floats(point), as_floats(normal)
        length = jnp.linalg.norm(normal)
        require(
            self.point.shape == normal.shape and normal.shape in ((2,), (3,)),
            f"DiskPlane point and normal must be vectors of 2 or 3 numbers; their shapes were {self.point.shape} and "
            f"{normal.shape}.",
        )
        require(bool(length > 0), "DiskPlane normal must not be zero: give the direction out of the solid side.")
        self.normal = normal / length
        self.property_index = _property_indices("DiskPlane", property, len(self.bodies))

    def candidates(self, x, radii, table):
        body = np.array(self.bodies)
        centers = np.array(table.center)[body]
        touch: Touch = sphere_plane(x[centers], radii[body], self.point, self.normal)
        weights = table.weights(x, body, -radii[body][:, None] * self.normal)
        return Candidates(touch.gap, _jacobian(weights, touch.frame))

    def reach(self, radii):
        return radii[np.array(self.bodies)]

    def bodies_of(self):
        return tuple((b,) for b in self.bodies)


def all_candidates(
    contacts: Sequence[Contact], x: Float[Array, "n d"], radii: Float[Array, " bodies"], table: BodyTable
) -> Candidates:
    """The candidates of all contact families, in order."""
    parts = [contact.candidates(x, radii, table) for contact in contacts]
    return Candidates(jnp.concatenate([p.gap for p in parts]), jnp.concatenate([p.jacobian for p in parts]))


class Active(NamedTuple):
    """The candidates that enter the solver, deepest first, padded to a fixed number with `active` false.

    `overflow` counts closed contacts that found no place: never to be ignored.
    """

    active: Bool[Array, " K"]
    gap: Float[Array, " K"]
    jacobian: Float[Array, "K d n d"]
    property_index: Int[Array, " K"]
    overflow: Int[Array, ""]


def active_set(candidates: Candidates, property_index: Int[np.ndarray, " C"], max_active: int) -> Active:
    """Choose the closed contacts (`gap < 0`), deepest first; Jacobian rows of the others are zero."""
    closed = candidates.gap < 0
    order = jnp.argsort(candidates.gap)[:max_active]
    active = closed[order]
    return Active(
        active=active,
        gap=candidates.gap[order],
        jacobian=jnp.where(active[:, None, None, None], candidates.jacobian[order], 0),
        property_index=jnp.asarray(property_index)[order],
        overflow=jnp.maximum(jnp.sum(closed) - max_active, 0),
    )
