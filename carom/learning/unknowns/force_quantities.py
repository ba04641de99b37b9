"""Quantities of what acts in joints and on moving bodies: springs, damping, motors, limits, drag; see `quantities.py`.

They are called by the names of joints, motors and limits, and by the numbers of bodies. Of an array over many joints
those that have none are left out; a number that is one for all is learned as one, of zero too.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from carom.contact.joint_limits import DryFriction, JointLimit, JointReading
from carom.learning.unknowns.body_quantities import SHARE, length_of, potentials, quantity
from carom.learning.unknowns.quantity import Entry, Label, Path, Quantity, Slot
from carom.mechanics.bodies import RigidBody
from carom.mechanics.forces import Actuators, BodyDrag, JointDamping, JointSpring, PointDrag
from carom.mechanics.joints import Joints
from carom.mechanics.potentials import Springs
from carom.system import System

UNITS = {
    "damping": ("N m s/rad", "N s/m"),
    "stiffness": ("N m/rad", "N/m"),
    "rest_angle": ("rad", "m"),
    "armature": ("kg m^2", "kg"),
    "dry_friction": ("N m", "N"),
    "gain": ("N m", "N"),
    "limit": ("rad", "m"),
}
"""Of angles, and of slides."""
ALL = "all"
"""What a number is called that is one for several joints."""
READABLE = str.maketrans({"=": "-", "*": "+", "?": ".", "[": "(", "]": ")"})
"""What means something else where quantities are chosen, and what stands in its place."""
DRAGS = {"drag": "linear", "quadratic_drag": "quadratic", "angular_drag": "angular"}
DRAG_UNITS = {"drag": "kg/s", "quadratic_drag": "kg/m", "angular_drag": "kg m^2/s"}


class Length(NamedTuple):
    """A coordinate of the joints, or a sum of several: its name, and whether it is an angle; `None`: of both kinds."""

    name: str
    angle: bool | None

    def unit(self, kind: str) -> str:
        """Unit of a quantity of this kind; empty where angles and slides are mixed."""
        return "" if self.angle is None else UNITS[kind][0 if self.angle else 1]


class Part(NamedTuple):
    """An entry of an array: where it stands, of which of the things that the array is over, and its value.

    `of` is `None` for one number that is of all of them.
    """

    slot: Slot
    of: int | None
    value: float

    @property
    def is_told_once(self) -> bool:
        """Whether it is one number, and not an entry for one of several things."""
        return self.of is None or not self.slot.index


def force_quantities(system: System) -> Iterator[Quantity]:
    """Of joints `damping`, `stiffness`, `rest_angle`, `armature`, `dry_friction`; `gain` of motors; `limit`; of bodies
    `drag`, `quadratic_drag`, `angular_drag`. No two have one name."""
    springs = sum(isinstance(part, Springs) for _, part in potentials(system))
    taken = {f"stiffness:{k}" for k in range(springs)}
    for found in (*_of_forces(system), *_armatures(system), *_of_contacts(system)):
        label = dataclasses.replace(found.label, which=found.label.which.translate(READABLE))
        label = dataclasses.replace(label, which=_free_name(label.which, taken, f"{label.kind}:"))
        yield dataclasses.replace(found, label=label)


def coordinates_of(system: System) -> list[Length]:
    """The coordinates of a system's joints, each by a name of its own."""
    taken: set[str] = set()
    return [Length(_free_name(name, taken), angle) for joint in system.joints for name, angle in _named(joint)]


# --- joints --------------------------------------------------------------------------------------------------------


def _of_forces(system: System) -> Iterator[Quantity]:
    for k, force in enumerate(system.forces):
        path = ("forces", k)
        if isinstance(force, JointDamping):
            yield from _positive("damping", (*path, "viscous"), force.viscous, _lengths(system, force.gears), system)
        if isinstance(force, JointSpring):
            yield from _springs(system, path, force)
        if isinstance(force, Actuators):
            yield from _gains(system, path, force)
        if isinstance(force, BodyDrag):
            yield from _drags(system, path, force, (force.first,))
        if isinstance(force, PointDrag):
            yield from _drags(system, path, force, force.points)


def _springs(system: System, path: Path, force: JointSpring) -> Iterator[Quantity]:
    lengths = _lengths(system, force.gears)
    yield from _positive("stiffness", (*path, "stiffness"), force.stiffness, lengths, system)
    strength = [np.asarray(part, float) for part in (force.stiffness, force.quadratic, force.cubic)]
    stiff = np.any([np.broadcast_to(part, (len(lengths),)) for part in strength], axis=0)
    for part in _parts((*path, "rest"), force.rest, len(lengths)):
        owners = np.flatnonzero(stiff) if part.of is None else [part.of] * bool(stiff[part.of])
        if len(owners):
            length = _together([lengths[i] for i in owners])
            of = f"where the spring of {length.name} is slack"
            label = Label("rest_angle", length.name, of, length.unit("rest_angle"))
            yield quantity(label, Entry((part.slot,)), _change(system, length, part.value))


def _gains(system: System, path: Path, force: Actuators) -> Iterator[Quantity]:
    gains = np.asarray(force.gain, float)[:, 0]
    for i, length in enumerate(_lengths(system, force.gears)):
        if gains[i]:
            of = f"{force.names[i]}, on {length.name}: its force at a control of one"
            label = Label("gain", force.names[i], of, length.unit("gain"))
            yield quantity(label, Entry((Slot((*path, "gain"), (i, 0)),)), SHARE * abs(gains[i]))


def _armatures(system: System) -> Iterator[Quantity]:
    if system.rotors is not None:
        lengths = _lengths(system, system.rotors.gears)
        yield from _positive("armature", ("rotors", "inertia"), system.rotors.inertia, lengths, system)


def _positive(kind: str, path: Path, array: Array, lengths: Sequence[Length], system: System) -> Iterator[Quantity]:
    """The entries of an array over `lengths` that is nowhere negative."""
    for part in _parts(path, array, len(lengths)):
        if part.value > 0 or part.is_told_once:
            length = _together(lengths) if part.of is None else lengths[part.of]
            # From zero, what would matter within a second.
            size = float(np.sum(np.asarray(system.masses))) * (1 if length.angle is False else length_of(system) ** 2)
            label = Label(kind, length.name, f"{kind} of {length.name}", length.unit(kind), log=part.value > 0)
            yield quantity(label, Entry((part.slot,)), SHARE if part.value > 0 else SHARE * size, 0.0)


# --- limits and dry friction ---------------------------------------------------------------------------------------


def _of_contacts(system: System) -> Iterator[Quantity]:
    for k, contact in enumerate(system.contacts):
        if isinstance(contact, DryFriction):
            for c, name in enumerate(contact.labels):
                name = name.removesuffix(" dry friction")
                if float(contact.loss[c]) > 0:
                    unit = _read(contact, c).unit("dry_friction")
                    label = Label("dry_friction", name, f"dry friction of {name}", unit, log=True)
                    yield quantity(label, Entry((Slot(("contacts", k, "loss"), (c,)),)), SHARE, 0.0)
        if isinstance(contact, JointLimit):
            for c, name in enumerate(contact.labels):
                length, (lower, upper) = _read(contact, c), _room(contact, c)
                of = f"{'lower' if contact.sides[c] > 0 else 'upper'} limit of {length.name}"
                scale = _change(system, length, float(contact.bounds[c]))
                place = Entry((Slot(("contacts", k, "bounds"), (c,)),))
                yield quantity(Label("limit", name, of, length.unit("limit")), place, scale, lower, upper)


def _room(contact: JointLimit, c: int) -> tuple[float, float]:
    """Between what a limit may be: on its side of the middle, where there is another one on the other side."""
    bounds, gears = (np.asarray(part, float) for part in (contact.bounds, contact.gears))
    if contact.ball is not None:
        return 0.0, max(np.pi, bounds[c])
    side = contact.sides[c]
    for other, own in enumerate(contact.sides):
        if own == -side and np.array_equal(gears[other], gears[c]):
            middle = float(bounds[c] + bounds[other]) / 2
            return (-np.inf, middle) if side > 0 else (middle, np.inf)
    return -np.inf, np.inf


def _read(contact: JointReading, c: int) -> Length:
    """What a limit or dry friction is of."""
    own = [Length(*pair) for joint in contact.joints for pair in _named(joint)]
    return _sum(own, np.asarray(contact.gears, float)[c])


# --- drag ----------------------------------------------------------------------------------------------------------


def _drags(system: System, path: Path, force: BodyDrag | PointDrag, points: Sequence[int]) -> Iterator[Quantity]:
    centers = np.array(system.table.center)
    bodies = [int(np.searchsorted(centers, p, side="right")) - 1 for p in points]
    names = [f"{b}.{p - centers[b]}" if p != centers[b] else str(b) for b, p in zip(bodies, points, strict=True)]
    few = 4
    together = ",".join(names[:few]) + (f" and {len(names) - few} more" if len(names) > few else "")
    for kind, field in DRAGS.items():
        for part in _parts((*path, field), getattr(force, field), len(points)) if hasattr(force, field) else ():
            if part.value > 0 or part.is_told_once:
                which = together if part.of is None else names[part.of]
                words = f"{field} drag of {'bodies' if part.of is None else 'body'} {which}"
                label = Label(kind, which, words, DRAG_UNITS[kind], log=part.value > 0)
                zero = SHARE * _resistance(system, kind, bodies[part.of or 0])
                yield quantity(label, Entry((part.slot,)), SHARE if part.value > 0 else zero, 0.0)


def _resistance(system: System, kind: str, k: int) -> float:
    """A drag that would matter within a second, or within the system's length."""
    body, size = system.bodies[k], length_of(system)
    if kind == "angular_drag" and isinstance(body, RigidBody):
        return float(np.sum(np.asarray(body.moments)))
    return float(body.mass) / (size if kind == "quadratic_drag" else 1)


# --- names and entries ---------------------------------------------------------------------------------------------


def _parts(path: Path, array: Array, count: int) -> list[Part]:
    """The entries of an array over `count` things, or the one that is for all of them."""
    values = np.asarray(array, float)
    if values.size == 1 and count > 0:
        return [Part(Slot(path, (0,) * values.ndim), 0 if count == 1 else None, float(values.reshape(())))]
    return [Part(Slot(path, (k,)), k, float(values[k])) for k in range(count)]


def _lengths(system: System, gears: Float[Array, "s q"] | None) -> list[Length]:
    """The joints' coordinates, or the lengths `gears q` of them."""
    own = coordinates_of(system)
    return own if gears is None else [_sum(own, row) for row in np.asarray(gears, float)]


def _sum(coordinates: Sequence[Length], gears: Float[np.ndarray, " q"]) -> Length:
    """The sum of coordinates with these weights, called by those that it has."""
    used = [length for length, gear in zip(coordinates, gears, strict=True) if gear]
    return Length("+".join(length.name for length in used), _kind(used))


def _together(lengths: Sequence[Length]) -> Length:
    """What is one number for several."""
    return lengths[0] if len(lengths) == 1 else Length(ALL, _kind(lengths))


def _kind(lengths: Sequence[Length]) -> bool | None:
    kinds = {length.angle for length in lengths}
    return kinds.pop() if len(kinds) == 1 else None


def _named(joint: Joints) -> list[tuple[str, bool]]:
    """The coordinates of a body's joints by name, and whether each is an angle."""
    angles: list[bool] = []
    for kind, size in zip(joint.kinds, joint.sizes, strict=True):
        shifts = {"slide": 1, "free": joint.dim}.get(kind, 0)
        angles += [False] * shifts + [True] * (size - shifts)
    return list(zip(joint.coordinate_names(), angles, strict=True))


def _change(system: System, length: Length, value: float) -> float:
    """How far a bound or a rest angle moves if it matters."""
    return SHARE * max(abs(value), length_of(system) if length.angle is False else 1.0)


def _free_name(name: str, taken: set[str], before: str = "") -> str:
    """The name, or the first of `name (2)`, `name (3)` and so on that is not `taken`; then it is."""
    found, number = name, 2
    while before + found in taken:
        found, number = f"{name} ({number})", number + 1
    taken.add(before + found)
    return found
