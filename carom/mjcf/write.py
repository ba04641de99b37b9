"""Values of a learned system written back into the MJCF or URDF file that it came from."""

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from carom.atomic import write_whole
from carom.checks import require
from carom.contact.joint_limits import DryFriction, JointLimit
from carom.errors import CaromError
from carom.mechanics.forces import Actuators, Force, JointDamping, JointSpring
from carom.mechanics.potentials import Gravity
from carom.mjcf.load import is_urdf, load_mujoco
from carom.system import System

GAINS = {"motor": "gear", "position": "kp", "velocity": "kv"}
"""The attribute that holds the gain of an actuator of a kind."""


class _Change(NamedTuple):
    """One number of an element: its tag (or one of several) and name, the attribute, and what becomes of its text."""

    tags: tuple[str, ...]
    name: str
    attribute: str
    text: Callable[[str | None], str]


def save_mujoco(
    system: System, path: str | os.PathLike[str], *, source: str | os.PathLike[str] | None = None, **options: Any
) -> None:
    """Write a system's numbers into the MJCF or URDF file that it was loaded from; all else in the file stays.

    Those are damping, stiffness, slack positions, armature, dry friction and limits of joints, gains of motors and
    servos, and gravity: what differs from what the file gives.

    **Arguments:** `system`, of the file's structure; `path`, to write; `source`, the file it came from, by default
    `path` itself; `options` of `load_mujoco` that it was loaded with (`ignore`, `restitution`).

    **Raises:** `CaromError` for another structure; for a number that differs and has no place in such a file, or whose
    element is not in the file itself but in one that it includes, by name: nothing is written then.
    """
    origin = Path(path if source is None else source)
    told = load_mujoco(origin, **options).system
    same = jax.tree.structure(told) == jax.tree.structure(system)
    shapes = [np.shape(a) for a in jax.tree.leaves(told)] == [np.shape(a) for a in jax.tree.leaves(system)]
    require(same and shapes, f"system must be of the structure of {origin}, as load_mujoco gives it; it is another.")
    text = origin.read_text()
    tree = _parsed(text)
    urdf = is_urdf(origin)
    changes = _changes(told, system, _angles_in(tree, urdf), urdf)
    for change in changes:
        _apply(tree, change, origin, urdf)
    new = _written(text, tree)
    _check(new, system, origin, options)
    write_whole(Path(path), new.encode())


def _check(text: str, system: System, origin: Path, options: dict[str, Any]) -> None:
    """Read what is to be written, beside the file that it came from, as that may include others.

    **Raises:** `CaromError` if it is another system: a default class or a tendon has a part in a number, say.
    """
    probe = origin.with_name(f".{origin.stem}-carom{origin.suffix}")
    try:
        write_whole(probe, text.encode())
        again = load_mujoco(probe, **options).system
    finally:
        probe.unlink(missing_ok=True)
    off = [
        jax.tree_util.keystr(where).lstrip(".")
        for (where, a), b in zip(
            jax.tree_util.tree_leaves_with_path(_as_laws(again)), jax.tree.leaves(_as_laws(system)), strict=True
        )
        if not jax.tree_util.keystr(where).endswith(".near") and not np.allclose(a, b, rtol=1e-9, atol=1e-12)
    ]
    require(
        not off,
        f"{', '.join(off[:3])} cannot be written into {origin} by the elements' own attributes: a default class, a "
        "tendon, a servo's two gains or an included file has a part in them. Write these out in the elements first.",
    )


def _as_laws(system: System) -> System:
    """With the gains of actuators times their gears, as a gain may be written into a gear."""
    forces = []
    for force in system.forces:
        if isinstance(force, Actuators):
            size = jax.numpy.max(jax.numpy.abs(force.gears), axis=1, keepdims=True)
            where = (force.gears / size, force.gain * size, force.bias * size)
            force = eqx.tree_at(lambda f: (f.gears, f.gain, f.bias), force, where)
        forces.append(force)
    return eqx.tree_at(lambda s: s.forces, system, tuple(forces))


def _parsed(text: str) -> ElementTree.Element:
    parser = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    return ElementTree.fromstring(text, parser)


def _written(text: str, tree: ElementTree.Element) -> str:
    """The tree as text, with what stands before the first element as it was."""
    start = re.search(r"<\s*" + re.escape(tree.tag), text)
    before = text[: start.start()] if start else ""
    return before + ElementTree.tostring(tree, encoding="unicode") + "\n"


def _angles_in(tree: ElementTree.Element, urdf: bool) -> float:
    """How many of the file's units of angle a radian is."""
    compiler = tree.find("compiler")
    radians = urdf or (compiler is not None and compiler.get("angle", "degree") == "radian")
    return 1.0 if radians else float(np.rad2deg(1))


def _number(value: float) -> Callable[[str | None], str]:
    """The number in place of the first, as others may follow: a polynomial's."""

    def text(old: str | None) -> str:
        return " ".join([f"{value:.12g}", *([] if old is None else old.split()[1:])])

    return text


def _changes(told: System, new: System, degrees: float, urdf: bool) -> list[_Change]:
    """What differs. What has been looked at is made alike, so that what is left has no place in the file."""
    found: list[_Change] = []
    names, hinges = [], []
    for joint in told.joints:
        for name, size, kind in zip(joint.names, joint.sizes, joint.kinds, strict=True):
            names += [name] * size
            hinges += [kind == "hinge"] * size
    joint_tags = ("joint", "freejoint")

    def each(attribute: str, before, after, unit=None) -> None:
        before, after = (np.broadcast_to(np.asarray(a, float), (len(names),)) for a in (before, after))
        for k in np.flatnonzero(before != after):
            scale = 1.0 if unit is None or not hinges[k] else unit
            change = _Change(joint_tags, names[k], attribute, _number(after[k] * scale))
            if not any((c.name, c.attribute) == (change.name, attribute) for c in found):
                found.append(change)

    forces: list[Force] = []
    for old, force in zip(told.forces, new.forces, strict=True):
        if isinstance(old, JointDamping) and isinstance(force, JointDamping) and old.gears is None:
            each("damping", old.viscous, force.viscous)
            force = eqx.tree_at(lambda f: f.viscous, force, old.viscous)
        if isinstance(old, JointSpring) and isinstance(force, JointSpring) and old.gears is None:
            each("stiffness", old.stiffness, force.stiffness)
            each("springref", old.rest, force.rest, degrees)
            force = eqx.tree_at(lambda f: (f.stiffness, f.rest), force, (old.stiffness, old.rest))
        if isinstance(old, Actuators) and isinstance(force, Actuators):
            for k in np.flatnonzero(np.asarray(old.gain[:, 0]) != np.asarray(force.gain[:, 0])):
                ratio = float(force.gain[k, 0]) / float(old.gain[k, 0])
                found.append(_Change(tuple(GAINS), old.names[k], "gain", _scaled(ratio)))
            force = eqx.tree_at(lambda f: f.gain, force, force.gain.at[:, 0].set(old.gain[:, 0]))
        forces.append(force)
    rest = eqx.tree_at(lambda s: s.forces, new, tuple(forces))
    if told.rotors is not None and new.rotors is not None:
        single = (np.count_nonzero(told.rotors.gears, axis=1) == 1) & (np.asarray(told.rotors.gears).max(axis=1) == 1)
        inertia = np.array(new.rotors.inertia)
        for r in np.flatnonzero(single & (inertia != np.asarray(told.rotors.inertia))):
            name = names[int(np.argmax(told.rotors.gears[r]))]
            found.append(_Change(joint_tags, name, "armature", _number(float(inertia[r]))))
            inertia[r] = told.rotors.inertia[r]
        rest = eqx.tree_at(lambda s: s.rotors.inertia, rest, jax.numpy.asarray(inertia))
    contacts = []
    for old, contact in zip(told.contacts, new.contacts, strict=True):
        if isinstance(old, DryFriction) and isinstance(contact, DryFriction) and len(old.joints) == 1:
            own = _names_of(old)
            for k in np.flatnonzero(np.asarray(old.loss) != np.asarray(contact.loss)):
                found.append(_Change(joint_tags, own[k], "frictionloss", _number(float(contact.loss[k]))))
            contact = eqx.tree_at(lambda c: c.loss, contact, old.loss)
        if isinstance(old, JointLimit) and isinstance(contact, JointLimit) and len(old.joints) == 1:
            own, moved = _names_of(old), np.asarray(old.bounds) != np.asarray(contact.bounds)
            for k in np.flatnonzero(moved):
                turns = old.ball is not None or hinges[names.index(own[k])]
                bound = float(contact.bounds[k]) * (degrees if turns else 1.0)
                which = 1 if old.sides[k] < 0 else 0
                found.append(_Change(joint_tags, own[k], "range", _part(which, bound)))
            contact = eqx.tree_at(lambda c: c.bounds, contact, old.bounds)
        contacts.append(contact)
    rest = eqx.tree_at(lambda s: s.contacts, rest, tuple(contacts))
    old, potential = told.potential, new.potential
    if isinstance(old, Gravity) and isinstance(potential, Gravity) and not urdf:
        if np.any(np.asarray(old.acceleration) != np.asarray(potential.acceleration)):
            vector = " ".join(f"{a:.12g}" for a in np.asarray(potential.acceleration, float))
            found.append(_Change(("option",), "", "gravity", lambda _: vector))
        rest = eqx.tree_at(lambda s: s.potential, rest, old)
    left = [
        jax.tree_util.keystr(where).lstrip(".")
        for (where, a), b in zip(jax.tree_util.tree_leaves_with_path(rest), jax.tree.leaves(told), strict=True)
        if np.any(np.asarray(a) != np.asarray(b))
    ]
    require(
        not left,
        f"{', '.join(left[:3])} differ from the file's, and have no place in it that save_mujoco knows: it writes "
        "numbers of joints, gains of actuators and gravity. Set them back, or save the model as a carom file.",
    )
    return found


def _names_of(reading: DryFriction | JointLimit) -> list[str]:
    """The joint behind each row."""
    joint = reading.joints[0]
    own = [name for name, size in zip(joint.names, joint.sizes, strict=True) for _ in range(size)]
    return [own[int(np.flatnonzero(row)[0])] for row in np.asarray(reading.gears)]


def _scaled(ratio: float) -> Callable[[str | None], str]:
    def text(old: str | None) -> str:
        first, *others = ("1" if old is None else old).split()
        return " ".join([f"{float(first) * ratio:.12g}", *others])

    return text


def _part(which: int, value: float) -> Callable[[str | None], str]:
    def text(old: str | None) -> str:
        ends = ["0", "0"] if old is None else old.split()
        ends[which] = f"{value:.12g}"
        return " ".join(ends)

    return text


URDF_PLACES = {
    "damping": ("dynamics", "damping"),
    "frictionloss": ("dynamics", "friction"),
    "lower": ("limit", "lower"),
    "upper": ("limit", "upper"),
}


def _apply(tree: ElementTree.Element, change: _Change, origin: Path, urdf: bool) -> None:
    """Make one change.

    **Raises:** `CaromError` if the element is not in the file.
    """
    if change.tags == ("option",):
        element = tree.find("option")
        if element is None:
            element = ElementTree.Element("option")
            tree.insert(0, element)
    else:
        there = [e for e in tree.iter() if e.tag in change.tags and e.get("name") == change.name]
        require(
            len(there) == 1,
            f"{origin} has no element of its own called {change.name!r} to write {change.attribute} into: name it, and "
            "write out what it includes.",
        )
        element = there[0]
    attribute = GAINS.get(str(element.tag), change.attribute) if change.attribute == "gain" else change.attribute
    if urdf:
        if attribute == "range":
            # Which end it is shows in where the text has changed.
            ends = change.text("nan nan").split()
            attribute, value = ("lower", ends[0]) if ends[1] == "nan" else ("upper", ends[1])
        else:
            value = change.text(None)
        if attribute not in URDF_PLACES:
            raise CaromError(f"a URDF file has no place for {attribute} of {change.name!r}; use an MJCF file.")
        tag, attribute = URDF_PLACES[attribute]
        child = element.find(tag)
        child = ElementTree.SubElement(element, tag) if child is None else child
        child.set(attribute, value)
        return
    if attribute == "range" and element.get("range") is None:
        raise CaromError(
            f"{origin} tells the range of {change.name!r} in a default class: write it out in the element itself."
        )
    element.set(attribute, change.text(element.get(attribute)))
    if attribute == "range" and element.get("limited") is None:
        element.set("limited", "true")
