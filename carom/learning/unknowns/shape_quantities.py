"""Quantities of the shapes of rigid bodies, in the frames of these: boxes, balls, joints; see `quantities.py`.

A box that meets two planes, or a ball that meets a plane and another ball, is one shape where it was told alike. A
shape's coordinates are from the centre of mass, so that a centre of mass that is elsewhere moves all of it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from carom.contact.balls import BallBall, BallPlane
from carom.contact.boxes import CornerPlane
from carom.learning.unknowns.body_quantities import SHARE, length_of, potentials, quantity
from carom.learning.unknowns.quantity import AXES, Entry, Label, Path, Quantity, Shift, Size, Slot
from carom.mechanics.bodies import RigidBody
from carom.mechanics.constraints import Distance, Joint, Pivot, Tether, Track
from carom.mechanics.joints import Joints
from carom.mechanics.potentials import Springs
from carom.system import System


class Part(NamedTuple):
    """A part of a body's shape: a box, a ball or a joint. `slots`: of each coordinate, all places where it stands.

    `body` is `None` for a ball that is fixed in space. `radii`: where a ball's radius stands.
    """

    kind: str
    which: str
    body: int | None
    of: str
    slots: tuple[tuple[Slot, ...], ...]
    radii: tuple[Slot, ...] = ()


def shape_quantities(system: System) -> Iterator[Quantity]:
    """Of boxes `half_width`, `half_widths`, `corner_radius`; `ball_radius`; `center_of_mass`; places of single parts.

    A part's own place, `ball:...` or `joint:...`, and the centre of mass of its body cannot both be learned.
    """
    size = SHARE * length_of(system)
    parts = [*_boxes(system), *_balls(system), *_joints(system)]
    for families in box_families(system):
        yield from _box_quantities(system, families, size)
    for part in parts:
        if part.radii:
            label = Label("ball_radius", part.which, part.of, "m")
            yield quantity(label, Entry(part.radii), size, 0.0)
    for body in dict.fromkeys(part.body for part in parts):
        mine = [part for part in parts if part.body == body]
        movable = body is not None and _can_move(system, body)
        for axis in range(system.dim):
            whole = _center_of_mass(system, mine, axis, size) if movable else None
            if whole is not None:
                yield whole
            for part in (part for part in mine if part.kind != "box"):
                label = Label(
                    part.kind,
                    f"{part.which}:{AXES[axis]}",
                    f"{part.of}: where it is",
                    "m",
                    part_of="" if whole is None else whole.name,
                )
                yield quantity(label, Entry(part.slots[axis]), size)


# --- boxes ---------------------------------------------------------------------------------------------------------


def box_families(system: System) -> list[tuple[int, ...]]:
    """The contact families of each box (or of several boxes of one family, which are alike)."""
    found: dict[tuple, list[int]] = {}
    for k, contact in enumerate(system.contacts):
        if isinstance(contact, CornerPlane):
            numbers = (contact.half_widths, contact.corner_radius, contact.center)
            key = contact.bodies, *(tuple(np.asarray(part, float).reshape(-1).tolist()) for part in numbers)
            found.setdefault(key, []).append(k)
    return [tuple(families) for families in found.values()]


def _box_quantities(system: System, families: tuple[int, ...], size: float) -> Iterator[Quantity]:
    which, of = _box_names(system, families)
    paths = tuple(("contacts", k, "half_widths") for k in families)
    whole = Label("half_width", which, f"{of}: mean, in its proportions", "m", log=True)
    yield quantity(whole, Size(paths, "mean"), SHARE, 0.0)
    for axis in range(system.dim):
        label = Label("half_widths", f"{which}:{AXES[axis]}", of, "m", log=True, part_of=whole.name)
        yield quantity(label, Entry(tuple(Slot(path, (axis,)) for path in paths)), SHARE, 0.0)
    slots = tuple(Slot(("contacts", k, "corner_radius")) for k in families)
    largest = float(np.min(np.asarray(system.contacts[families[0]].half_widths)))  # pyright: ignore[reportAttributeAccessIssue]
    yield quantity(Label("corner_radius", which, of, "m"), Entry(slots), size, 0.0, largest)


def _box_names(system: System, families: tuple[int, ...]) -> tuple[str, str]:
    """What the boxes of these families are called, `0` or `0,1`, and in words."""
    contact = system.contacts[families[0]]
    assert isinstance(contact, CornerPlane)
    which = ",".join(map(str, contact.bodies))
    return which, f"the box of body {which}" if len(contact.bodies) == 1 else f"the boxes of the bodies {which}"


def _boxes(system: System) -> Iterator[Part]:
    for families in box_families(system):
        contact = system.contacts[families[0]]
        assert isinstance(contact, CornerPlane)
        which, of = _box_names(system, families)
        slots = tuple(tuple(Slot(("contacts", k, "center"), (axis,)) for k in families) for axis in range(system.dim))
        for body in contact.bodies:
            yield Part("box", which, body, of, slots)


# --- balls and joints ----------------------------------------------------------------------------------------------


def _balls(system: System) -> Iterator[Part]:
    """Balls of `BallPlane` and `BallBall`, each once."""
    found: dict[tuple, list[tuple[Path, tuple[int, ...]]]] = {}
    for k, contact in enumerate(system.contacts):
        if isinstance(contact, BallPlane):
            entries = [((c,), body) for c, body in enumerate(contact.bodies)]
        elif isinstance(contact, BallBall):
            entries = [((c, side), body) for c, pair in enumerate(contact.pairs) for side, body in enumerate(pair)]
        else:
            continue
        centers, radii = (np.asarray(part, float) for part in (contact.centers, contact.radii))
        for index, body in entries:
            key = body, tuple(centers[index].tolist()), float(radii[index])
            found.setdefault(key, []).append((("contacts", k), index))
    count: dict[int | None, int] = {}
    for (body, *_), places in found.items():
        number = count.setdefault(body, 0)
        count[body] += 1
        owner, of = ("fixed", "a fixed ball") if body is None else (str(body), f"a ball of body {body}")
        slots = tuple(
            tuple(Slot((*path, "centers"), (*index, axis)) for path, index in places) for axis in range(system.dim)
        )
        radii = tuple(Slot((*path, "radii"), index) for path, index in places)
        yield Part("ball", f"{owner}.{number}", body, of, slots, radii)


def _joints(system: System) -> Iterator[Part]:
    """Where joints are in rigid bodies."""
    for k, link in enumerate(system.links):
        if isinstance(link, Joint):
            ends = [(str(k), link.first, "weights", True)]
        elif isinstance(link, Pivot):
            ends = [(f"{k}.0", link.i, "weights_i", True), (f"{k}.1", link.j, "weights_j", True)]
        elif isinstance(link, Track):
            ends = [(f"{k}.0", link.i, "weights", True)]
            # An anchor in space is no part of a body.
            ends += [] if link.j is None else [(f"{k}.1", link.j, "anchor", False)]
        else:
            continue
        for which, first, name, balanced in ends:
            body = system.table.center.index(first)
            if isinstance(system.bodies[body], RigidBody):
                slots = tuple((Slot(("links", k, name), (axis + balanced,), balanced),) for axis in range(system.dim))
                yield Part("joint", which, body, f"constraint {k} in body {body}", slots)


# --- centre of mass ------------------------------------------------------------------------------------------------


def _center_of_mass(system: System, parts: list[Part], axis: int, size: float) -> Quantity | None:
    """From the middle of the body's box, if it has one, else from where it was told to be."""
    if any("," in part.which for part in parts):  # boxes of several bodies have one centre
        return None
    parts = sorted(parts, key=lambda part: part.kind != "box")
    slots = tuple(slot for part in parts for slot in part.slots[axis])
    told = jnp.stack([slot.read(system) for slot in slots])
    box = parts[0].kind == "box"
    beside = "the middle of its box" if box else "where it was told to be"
    label = Label("center_of_mass", f"{parts[0].body}:{AXES[axis]}", f"body {parts[0].body}, beside {beside}", "m")
    return quantity(label, Shift(slots, told, jnp.zeros_like(told[0]) if box else told[0]), size)


def _can_move(system: System, body: int) -> bool:
    """Whether all of a body's shape is told beside its centre of mass, and nothing is fixed to that itself."""
    first = system.table.center[body]
    points = set(range(first, first + system.bodies[body].n_points(system.dim)))
    shaped = all(
        isinstance(contact, CornerPlane | BallPlane | BallBall)
        for contact in system.contacts
        if any(body in bodies for bodies in contact.bodies_of())
    )
    tied = any(isinstance(link, Distance | Tether | Joints) and points & set(link.points()) for link in system.links)
    sprung = any(isinstance(part, Springs) and points & set(part.points) for _, part in potentials(system))
    return shaped and not tied and not sprung
