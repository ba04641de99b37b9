"""How to learn from recorded tosses, and by which steps."""

import dataclasses

import numpy as np
from jaxtyping import Float

from carom.checks import require
from carom.contact.impulses import Coulomb
from carom.learning.estimation.protocols import box_of
from carom.learning.unknowns.quantities import Learned, describe, matches
from carom.system import System

LOSSES = ("friction_loss", "restitution_loss")
STEPS = {
    "half_width": 5e-4,
    "half_widths": 5e-4,
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

    horizons: tuple[int, ...] = (8, 16)
    """Samples that segments of tosses around impacts are predicted over, one stage after the other."""
    segments: int = 400
    """Most segments in a stage."""
    toss_rounds: int = 5
    """Gauss-Newton steps in each stage."""
    evaluations: int = 32
    """Most evaluations of whole tosses at the end; 0: leave it at the segments."""
    toss_count: int = 88
    """Most whole tosses that are fitted at the end; more take longer."""
    toss_samples: int = 120
    """Samples of a toss that are fitted at the end: bodies rest after that."""
    substeps: int = 1
    """Steps of the simulation in one sample of a toss."""

    def check(self) -> None:
        """Raise `CaromError` for a value that cannot be."""
        for name in ("segments", "toss_rounds", "toss_count", "toss_samples", "substeps"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1; it was {getattr(self, name)}.")
        require(self.evaluations >= 0, f"evaluations must not be negative; it was {self.evaluations}.")
        require(all(h >= 2 for h in self.horizons), f"horizons must be at least 2 samples; they were {self.horizons}.")


def tossed_names(system: System) -> tuple[str, ...]:
    """What is learned of a tossed body if nothing is said: its shape, inertia and contact with the plane.

    Of a box's widths the mean: it keeps its proportions. With Coulomb's law also what fast impacts lose.
    """
    contact = box_of(system).property_index[0]
    wanted = ("half_width", "corner_radius", "inertia", "center_of_mass")
    wanted += (f"friction:{contact}", f"restitution:{contact}")
    wanted += LOSSES if isinstance(system.contact_model, Coulomb) else ()
    there = [name for name, *_ in describe(system)]
    return tuple(name for name in wanted if any(matches(name, other) for other in there))


def search_steps(learned: Learned) -> Float[np.ndarray, " P"]:
    """Changes of the free numbers that matter."""
    steps = []
    for quantity, scale in zip(learned.quantities, np.asarray(learned.scale), strict=True):
        step = STEPS.get(quantity.label.kind)
        if step is not None and quantity.label.log:
            step /= abs(float(quantity.value(learned.skeleton)))
        steps.append(float(scale) if step is None else step)
    return np.array(steps)
