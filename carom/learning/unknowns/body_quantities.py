"""Quantities of bodies, contact properties, contact models and potentials; see `quantities.py`."""

from collections.abc import Iterable, Iterator

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from carom.checks import as_floats
from carom.contact.candidates import DiskDisk, DiskPlane, RimPlane
from carom.contact.impulses import CMr, Coulomb
from carom.contact.joint_limits import JointReading
from carom.learning.unknowns.quantity import AXES, Entry, FirstMass, Label, MassRatio, Path, Place, Quantity, Size, Slot
from carom.mechanics.bodies import RigidBody
from carom.mechanics.potentials import Gravity, NoPotential, Potential, Springs, Sum
from carom.system import System

SHARE = 0.01
"""Scale of lengths, as a share of the system's."""


def quantity(label: Label, place: Place, scale: float, lower: float = -np.inf, upper: float = np.inf) -> Quantity:
    """A quantity with these bounds of its value, and this scale of its free number."""
    return Quantity(label, place, *(as_floats(number) for number in (lower, upper, scale)))


def mass_quantities(system: System) -> Iterator[Quantity]:
    """`mass:k`, to the first; `first_mass`."""
    for k in range(1, len(system.bodies)):
        yield quantity(Label("mass", str(k), f"body {k} to body 0", "", log=True), MassRatio(k), 0.1, 0.0)
    label = Label("first_mass", "", "body 0, with which all masses and moments go", "kg", log=True)
    yield quantity(label, FirstMass(), 0.1, 0.0)


def inertia_quantities(system: System) -> Iterator[Quantity]:
    """`inertia:k`, the mean moment of inertia; in 3D `moments:k:x` and so on, the second moment along each axis."""
    for k, body in enumerate(system.bodies):
        if not isinstance(body, RigidBody):
            continue
        path, unit = ("bodies", k, "moments"), "kg m^2"
        whole = Label("inertia", str(k), f"body {k}: mean moment of inertia", unit, log=True)
        yield quantity(whole, Size((path,), "inertia"), 0.1, 0.0)
        # In 2D motion depends on the sum of both alone.
        for axis in range(3 if body.moments.shape[0] == 3 else 0):
            of = f"body {k}: integral of {AXES[axis]}^2 dm"
            label = Label("moments", f"{k}:{AXES[axis]}", of, unit, log=True, part_of=whole.name)
            yield quantity(label, Entry((Slot(path, (axis,)),)), 0.1, 0.0)


def radius_quantities(system: System) -> Iterator[Quantity]:
    """`radius:k` of the bodies that touch something with it."""
    touching = {
        b
        for contact in system.contacts
        if isinstance(contact, DiskDisk | DiskPlane | RimPlane)
        for bodies in contact.bodies_of()
        for b in bodies
    }
    for k in sorted(touching):
        label = Label("radius", str(k), f"body {k}", "m")
        yield quantity(label, Entry((Slot(("bodies", k, "radius")),)), SHARE * length_of(system), 0.0)


def property_quantities(system: System) -> Iterator[Quantity]:
    """`friction:p` and `restitution:p` of the contact properties that some contact has."""
    for kind, upper in (("friction", np.inf), ("restitution", 1.0)):
        for p, of in property_owners(system).items():
            yield quantity(Label(kind, str(p), of), Entry((Slot((kind,), (p,)),)), 0.1, 0.0, upper)


def property_owners(system: System) -> dict[int, str]:
    """What each contact property belongs to, in words."""
    owners: dict[int, list[str]] = {}
    for contact in system.contacts:
        if isinstance(contact, JointReading):
            continue  # limits have no friction, and dry friction is a quantity of its own
        for name, index in zip(contact.names(), contact.property_index, strict=True):
            owners.setdefault(index, []).append(name)
    few = 3
    return {
        p: ", ".join(names) if len(names) <= few else f"{names[0]} and {len(names) - 1} more"
        for p, names in sorted(owners.items())
    }


def model_quantities(system: System) -> Iterator[Quantity]:
    """What fast impacts lose by `Coulomb`, and the epsilon of `CMr`."""
    model = system.contact_model if property_owners(system) else None
    if isinstance(model, Coulomb):
        for kind in ("friction_loss", "restitution_loss"):
            label = Label(kind, "", f"all contacts: what fast impacts lose of {kind.removesuffix('_loss')}")
            yield quantity(label, Entry((Slot(("contact_model", kind)),)), 0.1, 0.0, 1.0)
        label = Label("loss_speed", "", "all contacts: the speed at which they lose it", "m/s", log=True)
        yield quantity(label, Entry((Slot(("contact_model", "loss_speed")),)), 0.3, 0.02, 5.0)
    if isinstance(model, CMr):
        label = Label("epsilon", "", "the contact model", "1/kg", log=True)
        yield quantity(label, Entry((Slot(("contact_model", "epsilon")),)), 1.0, 1e-9, 10.0)


def force_quantities(system: System) -> Iterator[Quantity]:
    """`gravity:x` and so on, a uniform field; `gravity_strength`, in its direction; springs."""
    springs = 0
    for path, part in potentials(system):
        if isinstance(part, Gravity) and path == gravity_path(system):
            yield from _gravity((*path, "acceleration"), part)
        if isinstance(part, Springs):
            which, of = str(springs), f"springs {springs}, of the points {', '.join(map(str, part.points[:4]))}"
            of += " ..." if len(part.points) > 4 else ""
            for kind, unit in (("stiffness", "J/m^2"), ("rest_length", "m")):
                value = float(getattr(part, kind))
                label, place = Label(kind, which, of, unit, log=value > 0), Entry((Slot((*path, kind)),))
                yield quantity(label, place, 0.1 if value > 0 else 1.0, 0.0)
            springs += 1


def _gravity(path: Path, part: Gravity) -> Iterator[Quantity]:
    strength, unit = float(np.linalg.norm(np.asarray(part.acceleration))), "m/s^2"
    whole = Label("gravity_strength", "", "the uniform field, in its direction", unit) if strength > 0 else None
    for axis in range(part.acceleration.shape[0]):
        of = f"the uniform field, along {AXES[axis]}"
        label = Label("gravity", AXES[axis], of, unit, part_of=whole.name if whole else "")
        yield quantity(label, Entry((Slot(path, (axis,)),)), 0.1)
    if whole:
        yield quantity(whole, Size((path,), "norm"), 0.1, 0.0)


# --- forces --------------------------------------------------------------------------------------------------------


def potentials(system: System) -> Iterable[tuple[Path, Potential]]:
    """All potentials and where they stand, those of sums one by one."""

    def parts(path: Path, part: Potential) -> Iterator[tuple[Path, Potential]]:
        if isinstance(part, Sum):
            for k, each in enumerate(part.parts):
                yield from parts((*path, "parts", k), each)
        else:
            yield path, part

    return parts(("potential",), system.potential)


def gravity_path(system: System) -> Path | None:
    """Where the (first) uniform field stands."""
    return next((path for path, part in potentials(system) if isinstance(part, Gravity)), None)


def with_field(system: System) -> System:
    """The system with a uniform field, of zero if it had none, so that one can be learned."""
    if gravity_path(system) is not None:
        return system
    field = Gravity(jnp.zeros(system.dim, system.friction.dtype))
    there = system.potential
    potential = field if isinstance(there, NoPotential) else Sum(there, field)
    return eqx.tree_at(lambda s: s.potential, system, potential, is_leaf=lambda part: part is there)


# --- sizes ---------------------------------------------------------------------------------------------------------


def length_of(system: System) -> float:
    """A length (m) of the system's: that of its largest body, else of its longest rod, else 1 m."""
    sizes = [float(body.radius) for body in system.bodies]
    sizes += [
        float(np.sqrt(np.sum(np.asarray(body.moments)) / float(body.mass)))
        for body in system.bodies
        if isinstance(body, RigidBody)
    ]
    rods = [float(link.length) for link in system.links if hasattr(link, "length")]  # pyright: ignore[reportAttributeAccessIssue]
    return max(sizes) if max(sizes) > 0 else max(rods, default=1.0)
