"""How to learn from recorded tosses, and what: quantities of the registry, by short names of their own too."""

import dataclasses
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import require
from carom.contact.boxes import CornerPlane
from carom.learning.estimation.protocols import box_of
from carom.learning.unknowns.geometry_quantities import planes_of
from carom.learning.unknowns.quantities import Learned
from carom.learning.unknowns.quantity import Quantity
from carom.system import System

ContactName = Literal["coulomb", "cm", "cmr", "lcp"]
LOSSES = {"friction_loss", "restitution_loss", "loss_speed"}
CENTER = ("center_of_mass_x", "center_of_mass_y", "center_of_mass_z")
PLAIN = ("half_width", "corner_radius", "inertia", *CENTER, "friction", "restitution")
STEPS = {
    "half_width": 5e-4,
    "corner_radius": 2e-3,
    "inertia": 6e-5,
    "center_of_mass": 1e-3,
    "gravity_strength": 0.1,
    "friction": 0.03,
    "restitution": 0.08,
    "friction_loss": 0.1,
    "restitution_loss": 0.1,
    "loss_speed": 0.1,
    "plane": 5e-4,
    "tilt": 0.005,
}
"""Changes that matter, in the unit of each kind: steps of the search, which is sensitive to them."""


@dataclasses.dataclass(frozen=True)
class TossConfig:
    """How to learn from recorded tosses."""

    learn_of_toss: tuple[str, ...] = PLAIN
    """What is learned of a tossed body; all else is taken from the task. half_width is the mean of a box's: it keeps
    its proportions. gravity, table_height, table_tilt_x and table_tilt_y absorb biases of the recording. Besides, all
    that `carom check --quantities` lists of the system, by name: half_widths:0:x, moments:0:z."""
    toss_extras: tuple[str, ...] = ()
    """What is learned besides: friction_loss and restitution_loss are what fast impacts lose of friction and
    restitution."""
    toss_contact_model: ContactName | None = "coulomb"
    """Contact model of the tossed body (None: that of the task)."""
    horizons: tuple[int, ...] = (8, 16)
    """Samples that segments around impacts are predicted over, one stage after the other."""
    segments: int = 1000
    """Most segments in a stage."""
    toss_rounds: int = 5
    """Gauss-Newton steps in each stage."""
    evaluations: int = 60
    """Most evaluations of whole tosses at the end; 0: leave it at the segments."""
    toss_samples: int = 120
    """Samples of a toss that are fitted at the end: bodies rest after that."""
    substeps: int = 1
    """Steps of the simulation in one sample."""
    toss_seed: int = 0
    """Seed of which segments are used where there are more."""

    @property
    def names(self) -> tuple[str, ...]:
        """All that is learned, each once."""
        return tuple(dict.fromkeys((*self.learn_of_toss, *self.toss_extras)))

    def check(self) -> None:
        """Raise `CaromError` for a value that cannot be."""
        require(len(self.names) > 0, f"learn_of_toss must name something, such as {', '.join(PLAIN)}; it was ().")
        losses = sorted(LOSSES & set(self.names))
        require(
            not losses or self.toss_contact_model in ("coulomb", None),
            f"{', '.join(losses)} belong to the contact model coulomb; toss_contact_model was "
            f"{self.toss_contact_model!r}.",
        )
        for name in ("segments", "toss_rounds", "toss_samples", "substeps"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1; it was {getattr(self, name)}.")
        require(self.evaluations >= 0, f"evaluations must not be negative; it was {self.evaluations}.")
        require(all(h >= 2 for h in self.horizons), f"horizons must be at least 2 samples; they were {self.horizons}.")


# --- what is learned -----------------------------------------------------------------------------------------------


class TossQuantity(eqx.Module):
    """A quantity of a tossed body: the name that it was asked for by, and a change of it that matters."""

    name: str = eqx.field(static=True)
    quantity: Quantity
    step: float = eqx.field(static=True)


def short_names(system: System) -> dict[str, str]:
    """What is called by a shorter name where there is one body and the plane that it is tossed onto."""
    families = [k for k, contact in enumerate(system.contacts) if isinstance(contact, CornerPlane)]
    table = next(k for k, plane in enumerate(planes_of(system)) if families[0] in plane)
    contact = box_of(system).property_index[0]
    return {
        "half_width": "half_width:0",
        "corner_radius": "corner_radius:0",
        "inertia": "inertia:0",
        **{name: f"center_of_mass:0:{name[-1]}" for name in CENTER},
        "gravity": "gravity_strength",
        "friction": f"friction:{contact}",
        "restitution": f"restitution:{contact}",
        "table_height": f"plane:{table}",
        "table_tilt_x": f"tilt:{table}:x",
        "table_tilt_y": f"tilt:{table}:y",
    }


def toss_quantities(system: System, names: Sequence[str]) -> tuple[TossQuantity, ...]:
    """The quantities of these names, short ones or those of the registry.

    **Raises:** `CaromError` for names of nothing that the system has, and for ties.
    """
    short, found = short_names(system), []
    for name in names:
        require("=" not in name, f"tosses learn every quantity for itself; one was the tie {name!r}.")
        for quantity in Learned.chosen(system, [short.get(name, name)]).quantities:
            scale = float(quantity.scale) * (abs(float(quantity.value(system))) if quantity.label.log else 1.0)
            step = STEPS.get(quantity.label.kind, scale)
            found.append(TossQuantity(name if name in short else quantity.name, quantity, step))
    Learned.chosen(system, [each.quantity.name for each in found])  # raises for two of one number
    return tuple({each.quantity.name: each for each in found}.values())


def read_values(system: System, learned: Sequence[TossQuantity]) -> Float[np.ndarray, " p"]:
    """The numbers."""
    return np.array([float(each.quantity.value(system)) for each in learned])


def with_values(system: System, learned: Sequence[TossQuantity], values: Float[Array, " p"]) -> System:
    """The system with other numbers."""
    for each, value in zip(learned, jnp.asarray(values), strict=True):
        system = each.quantity.put(system, value)
    return system


def limits(learned: Sequence[TossQuantity]) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
    """Lower and upper bounds of the numbers; of those that must be positive, a small number above zero."""
    bounds = [
        (max(float(q.lower), 1e-9) if q.label.log else float(q.lower), float(q.upper))
        for q in (each.quantity for each in learned)
    ]
    lower, upper = np.array(bounds).T
    return lower, upper
