"""The numbers of a tossed body that can be learned: how each is read and changed, its unit, bounds and scale."""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.learning.protocols import box_of
from carom.system import System

Quantity = Literal[
    "half_width",
    "corner_radius",
    "inertia",
    "center_of_mass_x",
    "center_of_mass_y",
    "center_of_mass_z",
    "gravity",
    "friction",
    "restitution",
    "friction_loss",
    "restitution_loss",
    "loss_speed",
    "table_height",
    "table_tilt_x",
    "table_tilt_y",
]
CENTER: tuple[Quantity, ...] = ("center_of_mass_x", "center_of_mass_y", "center_of_mass_z")
PLAIN: tuple[Quantity, ...] = ("half_width", "corner_radius", "inertia", *CENTER, "friction", "restitution")


class Parameter(NamedTuple):
    """One number of a system: how to read and to change it, its bounds, and a change of it that matters."""

    read: Callable[[System], Any]
    write: Callable[[System, Float[Array, ""]], System]
    lower: float
    upper: float
    scale: float
    unit: str


def _leaf(where: Callable[[System], Any], scale: float, unit: str, lower=0.0, upper=np.inf) -> Parameter:
    """A number that stands in one array, in all of its places."""

    def write(system, value):
        return eqx.tree_at(where, system, jnp.broadcast_to(value, where(system).shape).astype(where(system).dtype))

    return Parameter(lambda system: where(system).reshape(-1)[0], write, lower, upper, scale, unit)


def _half_width(system: System, value):
    """The mean half width; a box keeps its proportions."""
    half = box_of(system).half_widths
    return eqx.tree_at(lambda s: box_of(s).half_widths, system, half * value / jnp.mean(half))


def _of_box(where: Callable[[Any], Any], scale: float, upper: float) -> Parameter:
    """The box's own value of a contact property; those of other contacts stay."""

    def index(system: System) -> int:
        return box_of(system).property_index[0]

    def write(system: System, value):
        return eqx.tree_at(where, system, where(system).at[index(system)].set(value))

    return Parameter(lambda system: where(system)[index(system)], write, 0.0, upper, scale, "")


def _acceleration(system: Any) -> Any:
    return system.potential.acceleration


def _gravity(system: System, value):
    g = _acceleration(system)
    return eqx.tree_at(_acceleration, system, value * g / jnp.linalg.norm(g))


def _moments(system: Any) -> Any:
    return system.bodies[0].moments


def _inertia(system: System, value):
    """The mean of the three moments of inertia is two thirds of the sum of the second moments."""
    moments = _moments(system)
    return eqx.tree_at(_moments, system, moments / jnp.sum(moments) * 1.5 * value)


def _center_of_mass(axis: int) -> Parameter:
    """The centre of mass is to the box's centre as the box's centre is to it, turned round."""

    def write(system, value):
        return eqx.tree_at(lambda s: box_of(s).center, system, box_of(system).center.at[axis].set(-value))

    return Parameter(lambda s: -box_of(s).center[axis], write, -1.0, 1.0, 1e-3, "m")


def _contact_model(system: Any) -> Any:
    return system.contact_model


def _tilt(axis: int) -> Parameter:
    def write(system, value):
        normal = box_of(system).normal
        tilted = normal.at[axis].set(value * normal[2])
        return eqx.tree_at(lambda s: box_of(s).normal, system, tilted / jnp.linalg.norm(tilted))

    return Parameter(lambda s: box_of(s).normal[axis] / box_of(s).normal[2], write, -0.1, 0.1, 0.005, "rad")


PARAMETERS: dict[str, Parameter] = {
    "half_width": Parameter(lambda s: jnp.mean(box_of(s).half_widths), _half_width, 1e-6, np.inf, 5e-4, "m"),
    "corner_radius": _leaf(lambda s: box_of(s).corner_radius, 2e-3, "m"),
    "inertia": Parameter(lambda s: jnp.sum(_moments(s)) * 2 / 3, _inertia, 1e-9, np.inf, 6e-5, "kg m^2"),
    **{name: _center_of_mass(axis) for axis, name in enumerate(CENTER)},
    "gravity": Parameter(lambda s: jnp.linalg.norm(_acceleration(s)), _gravity, 0.0, np.inf, 0.1, "m/s^2"),
    "friction": _of_box(lambda s: s.friction, 0.03, np.inf),
    "restitution": _of_box(lambda s: s.restitution, 0.08, 1.0),
    "friction_loss": _leaf(lambda s: _contact_model(s).friction_loss, 0.1, "", 0.0, 1.0),
    "restitution_loss": _leaf(lambda s: _contact_model(s).restitution_loss, 0.1, "", 0.0, 1.0),
    "loss_speed": _leaf(lambda s: _contact_model(s).loss_speed, 0.1, "m/s", 0.02, 5.0),
    "table_height": Parameter(
        lambda s: box_of(s).point[2],
        lambda s, value: eqx.tree_at(lambda s: box_of(s).point, s, box_of(s).point.at[2].set(value)),
        -0.1,
        0.1,
        5e-4,
        "m",
    ),
    "table_tilt_x": _tilt(0),
    "table_tilt_y": _tilt(1),
}
"""What can be learned of a tossed body."""


def read_values(system: System, names: Sequence[str]) -> Float[np.ndarray, " p"]:
    """The numbers of these names."""
    return np.array([float(PARAMETERS[name].read(system)) for name in names])


def with_values(system: System, names: Sequence[str], values) -> System:
    """The system with other numbers of these names."""
    for name, value in zip(names, values, strict=True):
        system = PARAMETERS[name].write(system, value)
    return system


def limits(names: Sequence[str]) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Lower and upper bounds of the numbers of these names."""
    lower, upper = np.array([(PARAMETERS[name].lower, PARAMETERS[name].upper) for name in names]).T
    return lower, upper
