"""Contact types: from the points of a system to gaps and the contact Jacobian, and the choice of the active ones.

A new contact type is one new class: a `Contact` with its gaps and Jacobian rows. Those of chains (bend and stretch
limits) are in `limits.py`.
"""

import abc
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.checks import as_floats, at_once_if_known, require, require_values, whole, whole_numbers
from carom.contact.geometry import Touch, deepest_direction, sphere_plane, sphere_sphere
from carom.mechanics.bodies import BodyTable


class Candidates(NamedTuple):
    """All contacts that could be: `gap` (C,) in m (or rad), and the Jacobian in its sparse form.

    Candidate c depends on the points `stencil[c]` (P,) alone; `rows[c]` (d, P, d) maps their velocities to the relative
    velocity in the contact frame (normal, tangents). A point may stand in a stencil more than once: its rows add up.
    """

    gap: Float[Array, " C"]
    stencil: Int[np.ndarray, "C P"]
    rows: Float[Array, "C d P d"]


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
    def travel(self, radii: Float[Array, " bodies"]) -> Float[Array, " c"]:
        """How much (m or rad) points may move while a gap changes smoothly: by more, it may close and open unseen."""

    @abc.abstractmethod
    def bodies_of(self) -> tuple[tuple[int, ...], ...]:
        """The bodies of each candidate."""

    @abc.abstractmethod
    def names(self) -> tuple[str, ...]:
        """What each candidate is called in tables and messages."""

    @abc.abstractmethod
    def dimension(self) -> int | None:
        """The dimension of space that this family asks for, if it asks for one."""


def property_indices(name: str, value: int | Sequence[int], count: int) -> tuple[int, ...]:
    """The property index of each of `count` contacts of the family `name`."""
    if np.ndim(value) == 0:
        return (whole(f"{name} property", value),) * count
    indices = whole_numbers(f"{name} property", value)  # pyright: ignore[reportArgumentType]
    require(
        len(indices) == count,
        f"{name} property must be one index or one for each of the {count} contacts; it had {len(indices)}.",
    )
    return indices


def _rows(weights: Float[Array, "c p"], frame: Float[Array, "c d d"]) -> Float[Array, "c d p d"]:
    """Rows that map point velocities to the velocity of a material point in the contact frame."""
    return weights[:, None, :, None] * frame[:, :, None, :]


def plane(name: str, point, normal) -> tuple[Float[Array, " d"], Float[Array, " d"]]:
    """`point` and unit `normal` of a plane, checked."""
    point, normal = as_floats(point), as_floats(normal)
    require(
        point.shape == normal.shape and normal.shape in ((2,), (3,)),
        f"{name} point and normal must be vectors of 2 or 3 numbers; their shapes were {point.shape} and "
        f"{normal.shape}.",
    )
    require_values(f"{name} point", point, np.isfinite, "a place in m")
    wanted = "the direction out of the solid side, which is not zero"
    require_values(f"{name} normal", normal, lambda n: np.isfinite(n).all() and np.any(n != 0), wanted)
    with at_once_if_known(normal):
        return point, normal / jnp.linalg.norm(normal)


class DiskDisk(Contact):
    """Contacts between round bodies (disks in 2D, spheres in 3D), with their radii.

    **Arguments:** `pairs`, the two bodies of each contact; `property`, index into the system's `friction` and
    `restitution`: one for all, or one for each pair.
    """

    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, pairs: Iterable[tuple[int, int]], property: int | Sequence[int] = 0):
        self.pairs = tuple((whole("DiskDisk pairs", a), whole("DiskDisk pairs", b)) for a, b in pairs)
        seen = set()
        for a, b in self.pairs:
            require(a != b, f"DiskDisk pairs two different bodies; a pair was ({a}, {b}).")
            require(frozenset((a, b)) not in seen, f"DiskDisk pairs two bodies once; ({a}, {b}) was there twice.")
            seen.add(frozenset((a, b)))
        self.property_index = property_indices("DiskDisk", property, len(self.pairs))

    def candidates(self, x, radii, table):
        a, b = np.array(self.pairs, int).reshape(-1, 2).T
        centers = np.array(table.center)
        touch = sphere_sphere(x[centers[a]], x[centers[b]], radii[a], radii[b])
        normal = touch.frame[:, 0]
        first = _rows(table.weights(x, a, -radii[a][:, None] * normal), touch.frame)
        second = _rows(table.weights(x, b, radii[b][:, None] * normal), touch.frame)
        stencil = np.concatenate([table.stencil(a), table.stencil(b)], axis=1)
        return Candidates(touch.gap, stencil, jnp.concatenate([first, -second], axis=2))

    def reach(self, radii):
        a, b = np.array(self.pairs, int).reshape(-1, 2).T
        return radii[a] + radii[b]

    def travel(self, radii):
        return self.reach(radii) / 2

    def bodies_of(self):
        return self.pairs

    def names(self):
        return tuple(f"{a}-{b}" for a, b in self.pairs)

    def dimension(self):
        return None


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
        self.bodies = whole_numbers("DiskPlane bodies", bodies, once=True)
        self.point, self.normal = plane("DiskPlane", point, normal)
        self.property_index = property_indices("DiskPlane", property, len(self.bodies))

    def candidates(self, x, radii, table):
        body = np.array(self.bodies, int)
        centers = np.array(table.center)[body]
        touch: Touch = sphere_plane(x[centers], radii[body], self.point, self.normal)
        weights = table.weights(x, body, -radii[body][:, None] * self.normal)
        return Candidates(touch.gap, table.stencil(body), _rows(weights, touch.frame))

    def reach(self, radii):
        return radii[np.array(self.bodies, int)]

    def travel(self, radii):
        # Nothing is behind a plane, and the gap of a body that moves straight on is a straight line.
        return jnp.full(len(self.bodies), jnp.inf, radii.dtype)

    def bodies_of(self):
        return tuple((b,) for b in self.bodies)

    def names(self):
        return tuple(f"{b}-wall" for b in self.bodies)

    def dimension(self):
        return self.normal.shape[0]


class RimPlane(Contact):
    """Contacts between the rims of rigid bodies in 3D and a fixed plane: a gyroscope's wheel, a coin, a wheel.

    The rim is the circle of the body's radius about its centre of mass, at right angles to its third axis. The contact
    is at the deepest point.

    **Arguments:** `bodies`, which; `point` (3,), on the plane (m); `normal` (3,), out of the solid side, of any length;
    `angles` (rad), if given: the rim is these points of it alone, by angle from the first axis to the second;
    `property`, index into the system's `friction` and `restitution`: one for all, or one for each body.
    """

    bodies: tuple[int, ...] = eqx.field(static=True)
    point: Float[Array, " 3"]
    normal: Float[Array, " 3"]
    angles: tuple[float, ...] | None = eqx.field(static=True)
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(
        self,
        bodies: Iterable[int],
        point,
        normal,
        angles: Sequence[float] | None = None,
        property: int | Sequence[int] = 0,
    ):
        self.bodies = whole_numbers("RimPlane bodies", bodies, once=True)
        self.point, self.normal = plane("RimPlane", point, normal)
        require(self.normal.shape == (3,), f"RimPlane normal must have 3 numbers; it had {self.normal.shape[0]}.")
        self.angles = None if angles is None else tuple(float(a) for a in angles)
        require(self.angles is None or len(self.angles) > 0, "RimPlane angles must name at least one point of the rim.")
        self.property_index = property_indices("RimPlane", property, len(self.bodies))

    def candidates(self, x, radii, table):
        body = np.array(self.bodies, int)
        stencil = table.stencil(body)
        center = x[stencil[:, 0]]
        axes = x[stencil[:, 1:]] - center[:, None]
        if self.angles is None:
            direction = deepest_direction(axes[:, :2], self.normal)
        else:
            rim = np.stack([np.cos(self.angles), np.sin(self.angles)], axis=1).astype(x.dtype)
            heights = jnp.einsum("ka,cad,d->ck", rim, axes[:, :2], self.normal)
            direction = jnp.asarray(rim)[jnp.argmin(heights, axis=1)]
        # Coordinates in the body frame, so that the point is the same material point where the axes have drifted.
        local = radii[body][:, None] * jnp.concatenate([direction, jnp.zeros_like(direction[:, :1])], axis=1)
        touching = center + jnp.einsum("ca,cad->cd", local, axes)
        touch = sphere_plane(touching, jnp.zeros_like(radii[body]), self.point, self.normal)
        weights = jnp.concatenate([1 - jnp.sum(local, axis=1, keepdims=True), local], axis=1)
        return Candidates(touch.gap, stencil, _rows(weights, touch.frame))

    def reach(self, radii):
        return 2 * radii[np.array(self.bodies, int)]

    def travel(self, radii):
        # Less than the arc from one point of the rim to the next: the deepest one changes.
        angle = 0.5 if self.angles is None else min(0.5, np.pi / len(self.angles))
        return angle * radii[np.array(self.bodies, int)]

    def bodies_of(self):
        return tuple((b,) for b in self.bodies)

    def names(self):
        return tuple(f"{b}-wall" for b in self.bodies)

    def dimension(self):
        return 3


def all_candidates(
    contacts: Sequence[Contact], x: Float[Array, "n d"], radii: Float[Array, " bodies"], table: BodyTable
) -> Candidates:
    """The candidates of all contact families, in order, with stencils of one width."""
    parts = [contact.candidates(x, radii, table) for contact in contacts if contact.property_index]
    width = max(p.stencil.shape[1] for p in parts)

    def widen(part: Candidates) -> Candidates:
        # A stencil is filled up with its first point, whose added rows are zero.
        more = width - part.stencil.shape[1]
        stencil = np.concatenate([part.stencil, np.repeat(part.stencil[:, :1], more, axis=1)], axis=1)
        return Candidates(part.gap, stencil, jnp.pad(part.rows, ((0, 0), (0, 0), (0, more), (0, 0))))

    parts = [widen(p) for p in parts]
    return Candidates(
        jnp.concatenate([p.gap for p in parts]),
        np.concatenate([p.stencil for p in parts]),
        jnp.concatenate([p.rows for p in parts]),
    )


class _Stencil(eqx.Module):
    points: tuple[tuple[int, ...], ...] = eqx.field(static=True)


@eqx.filter_jit
def _traced(contacts, x, radii, table):
    gap, stencil, rows = all_candidates(contacts, x, radii, table)
    return gap, _Stencil(tuple(map(tuple, stencil.tolist()))), rows


def traced_candidates(
    contacts: Sequence[Contact], x: Float[Array, "n d"], radii: Float[Array, " bodies"], table: BodyTable
) -> Candidates:
    """`all_candidates`, traced once for each system: a step asks for them dozens of times."""
    gap, stencil, rows = _traced(contacts, x, radii, table)
    return Candidates(gap, np.array(stencil.points), rows)


class Active(NamedTuple):
    """The candidates that enter the solver, in their order, padded to a fixed number with `active` false.

    `overflow` counts closed contacts that found no place: never to be ignored.
    """

    active: Bool[Array, " K"]
    gap: Float[Array, " K"]
    jacobian: Float[Array, "K d n d"]
    property_index: Int[Array, " K"]
    candidate: Int[Array, " K"]  # which of all candidates each is
    closed: Bool[Array, " C"]  # the candidates that are here
    overflow: Int[Array, ""]


def active_set(
    candidates: Candidates,
    property_index: Int[np.ndarray, " C"],
    max_active: int,
    n_points: int,
    closed: Bool[Array, " C"] | None = None,
) -> Active:
    """Choose the closed contacts (by default, `gap < 0`); Jacobian rows of the others are zero.

    Only the chosen contacts get a full Jacobian: candidates may be many. If they are too many these are the deepest.
    Their order is that of the candidates: by depth it would hang on the unit, as a bend is in other ones than a
    stretch, and where the law has several solutions a solver may find another in another order.
    """
    count = candidates.gap.shape[0]
    by_gap = candidates.gap if closed is None else jnp.where(closed, candidates.gap, jnp.inf)
    closed = candidates.gap < 0 if closed is None else closed
    order = jnp.argsort(by_gap)[:max_active]
    order = order[jnp.argsort(jnp.where(closed[order], order, count))]
    active = closed[order]
    rows = jnp.where(active[:, None, None, None], candidates.rows[order], 0)
    points = jax.nn.one_hot(jnp.asarray(candidates.stencil)[order], n_points, dtype=rows.dtype)
    return Active(
        active=active,
        gap=candidates.gap[order],
        jacobian=jnp.einsum("kipj,kpn->kinj", rows, points),
        property_index=jnp.asarray(property_index)[order],
        candidate=order,
        closed=jnp.zeros(closed.shape[0], bool).at[order].set(active),
        overflow=jnp.maximum(jnp.sum(closed) - max_active, 0),
    )
