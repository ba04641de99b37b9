"""Quantities of planes; see `quantities.py`.

What was told twice is one thing: families of contacts with one plane share its quantities.
"""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from carom.learning.body_quantities import SHARE, length_of, quantity
from carom.learning.quantity import AXES, Label, PlaneHeight, Quantity, Tilt
from carom.system import System


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
