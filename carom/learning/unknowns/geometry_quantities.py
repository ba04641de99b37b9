"""Quantities of what bodies meet and hang from: planes, rods, anchors, limits of chains; see `quantities.py`.

What was told in two places is one thing where it is equal there: families of contacts with one plane, or chains and
springs with one anchor, share its quantities.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from carom.contact.limits import BendLimit, StretchLimit
from carom.learning.unknowns.body_quantities import SHARE, length_of, potentials, quantity
from carom.learning.unknowns.quantity import AXES, Entry, Label, Path, PlaneHeight, Quantity, Slot, Tilt, leaf
from carom.mechanics.constraints import Distance, Joint, Tether
from carom.mechanics.potentials import Springs
from carom.system import System

# --- planes --------------------------------------------------------------------------------------------------------


def plane_quantities(system: System) -> Iterator[Quantity]:
    """`plane:k`, along its normal; `tilt:k:x` and so on, in 2D `tilt:k`."""
    for number, families in enumerate(planes_of(system)):
        contact: Any = system.contacts[families[0]]
        names = [name for k in families for name in system.contacts[k].names()]
        of = f"the plane of {names[0]}" + (" ..." if len(names) > 1 else "")
        label = Label("plane", str(number), f"{of}: distance from the origin along its normal", "m")
        yield quantity(label, PlaneHeight(families, contact.normal), SHARE * length_of(system))
        for axis, tangent in _tangents(np.asarray(contact.normal, float)):
            which = f"{number}:{AXES[axis]}" if system.dim == 3 else str(number)
            label = Label("tilt", which, f"{of}: of its normal towards {AXES[axis]}", "rad")
            place = Tilt(families, contact.normal, jnp.asarray(tangent, contact.normal.dtype))
            yield quantity(label, place, 0.005, -1.0, 1.0)


def planes_of(system: System) -> list[tuple[int, ...]]:
    """The contact families of each plane."""
    found: list[list[int]] = []
    for k, contact in enumerate(system.contacts):
        if not (hasattr(contact, "point") and hasattr(contact, "normal")):
            continue
        same = next((group for group in found if _same_plane(system.contacts[group[0]], contact)), None)
        if same is None:
            found.append([k])
        else:
            same.append(k)
    return [tuple(group) for group in found]


def _same_plane(one: Any, other: Any) -> bool:
    normal, point = (np.asarray(part, float) for part in (one.normal, one.point))
    return bool(
        np.allclose(normal, np.asarray(other.normal), atol=1e-9)
        and np.isclose(normal @ point, normal @ np.asarray(other.point, float), atol=1e-9)
    )


def _tangents(normal: Float[np.ndarray, " d"]) -> list[tuple[int, Float[np.ndarray, " d"]]]:
    """Unit vectors at right angles to `normal` and each other, each with the coordinate axis that it is nearest to."""
    kept, out = [normal], []
    for axis in np.delete(np.arange(len(normal)), np.argmax(np.abs(normal))):
        tangent = np.eye(len(normal))[axis]
        for other in kept:
            tangent = tangent - (tangent @ other) * other
        kept.append(tangent / np.linalg.norm(tangent))
        out.append((int(axis), kept[-1]))
    return out


# --- rods and anchors ----------------------------------------------------------------------------------------------


def rod_quantities(system: System) -> Iterator[Quantity]:
    """`rod:k`, the length of the k-th constraint, a `Distance` or `Tether`."""
    for k, link in enumerate(system.links):
        if isinstance(link, Distance | Tether):
            ends = f"point {link.i} to " + (f"point {link.j}" if isinstance(link, Distance) else "its anchor")
            label = Label("rod", str(k), ends, "m", log=True)
            yield quantity(label, Entry((Slot(("links", k, "length")),)), SHARE, 0.0)


def anchor_quantities(system: System) -> Iterator[Quantity]:
    """`anchor:k:x` and so on, the coordinates of places in space that something hangs from."""
    found: dict[tuple[float, ...], list[tuple[Path, str]]] = {}
    for path, what in _anchors(system):
        found.setdefault(tuple(np.asarray(leaf(system, path), float).tolist()), []).append((path, what))
    for number, (place, uses) in enumerate(found.items()):
        words = ", ".join(dict.fromkeys(what for _, what in uses))
        for axis in range(len(place)):
            slots = tuple(Slot(path, (axis,)) for path, _ in uses)
            label = Label("anchor", f"{number}:{AXES[axis]}", f"anchor of {words}", "m")
            yield quantity(label, Entry(slots), SHARE * length_of(system))


def _anchors(system: System) -> Iterator[tuple[Path, str]]:
    """Where anchors stand, and whose they are."""
    for k, link in enumerate(system.links):
        if isinstance(link, Tether | Joint):
            yield ("links", k, "anchor"), f"constraint {k}"
    for k, contact in enumerate(system.contacts):
        if isinstance(contact, BendLimit | StretchLimit) and contact.chain.anchor is not None:
            yield ("contacts", k, "chain", "anchor"), "a chain"
    for path, part in potentials(system):
        if isinstance(part, Springs) and part.anchor is not None:
            yield (*path, "anchor"), "springs"


# --- limits of chains ----------------------------------------------------------------------------------------------


def limit_quantities(system: System) -> Iterator[Quantity]:
    """`bend:k` of the k-th contact family; `shortest:k` and `longest:k`, which stay on their sides of the middle."""
    for k, contact in enumerate(system.contacts):
        if isinstance(contact, BendLimit):
            label = Label("bend", str(k), f"limit of {contact.names()[0]} ...", "rad")
            yield quantity(label, Entry((Slot(("contacts", k, "limit")),)), 0.01, 1e-6, np.pi)
        if isinstance(contact, StretchLimit):
            middle = float(contact.shortest + contact.longest) / 2
            for kind, lower, upper in (("shortest", 0.0, middle), ("longest", middle, np.inf)):
                label = Label(kind, str(k), f"limit of {contact.names()[0]} ...", "m", log=True)
                yield quantity(label, Entry((Slot(("contacts", k, kind)),)), SHARE, lower, upper)
