"""What to learn and how: the configuration of a training."""

import dataclasses
from typing import Literal

from carom.checks import require
from carom.contact.impulses import CMr, contact_model_name, contact_model_of
from carom.learning.unknowns.baselines import BASELINES, Baseline
from carom.mechanics.dynamics import Formulation
from carom.simulation.impact import COMPENSATION_STEPS, check_compensation_steps
from carom.system import System

Model = Literal["clnn", "chnn"] | Baseline
Quantity = Literal["mass", "friction", "restitution", "potential"]
FORMULATIONS: dict[Model, Formulation] = {
    "clnn": "lagrangian",
    "chnn": "hamiltonian",
    **dict.fromkeys(BASELINES, "lagrangian"),
}


@dataclasses.dataclass(frozen=True)
class LearnConfig:
    """How to learn. The defaults learn every quantity of the paper's tasks within minutes on two CPU cores."""

    model: Model = "clnn"
    """Constrained Lagrangian (clnn) or Hamiltonian (chnn) neural network, or a baseline: a network for the contacts
    (mlp-cd-clnn, in-cp-clnn) or for the whole step (in-cp-sp)."""
    learn: tuple[str, ...] = ("mass", "friction", "restitution", "potential")
    """What is unknown; all else is taken from the skeleton. What a baseline's network replaces is left out. Without
    `potential`, recorded data are learned from by their positions alone, and any quantity may be named: gravity,
    radius:1, ..."""
    epochs: int = 200
    """How often `chunks_per_epoch` chunks are drawn and learned from."""
    chunks_per_epoch: int = 800
    """Chunks drawn in an epoch, spread evenly over the trajectories."""
    batch_size: int = 200
    """Chunks in a step of the optimiser."""
    chunk_length: int | None = None
    """Consecutive states in a chunk: the first is given, the others are predicted. By default 5, and 2 (one step, as in
    the paper) for a baseline."""
    contact_share: float = 0.5
    """Share of the chunks that are drawn with a contact, where a trajectory has any."""
    learning_rate: float = 3e-3
    """Peak learning rate of the network (AdamW); it decays to zero along a squared cosine."""
    property_learning_rate: float = 2e-2
    """Peak learning rate of masses, friction and restitution."""
    loss_width: float = 0.1
    """Errors below this share of the data's speed count quadratically at the start (see `smooth_error`)."""
    weight_decay: float = 1e-4
    """Weight decay of the network (physical quantities are not decayed)."""
    patience: int = 200
    """Stop after so many epochs without a better validation loss."""
    refine: bool = True
    """Refine masses, contact properties and the potential's linear weights by Gauss-Newton steps: before the first
    epoch, on the way and at the end. What validates better is kept. For up to 64 points, not for baselines."""
    enough: float = 1e-4
    """Stop after a refinement if nine tenths of the validation chunks are then predicted with a mean error below this
    share of the data's speed."""
    width: int = 256
    """Units in a hidden layer of the potential, and of the contact network of mlp-cd-clnn."""
    depth: int = 3
    """Hidden layers of the potential, and of the contact network of mlp-cd-clnn."""
    initial_friction: float = 0.3
    """Friction at the start."""
    initial_restitution: float = 0.5
    """Restitution at the start."""
    contact_model: str | None = None
    """Contact model to learn with: cm, cmr, lcp or coulomb. None: the skeleton's own (cm for the named tasks), and
    coulomb for recorded tosses."""
    epsilon: float | Literal["learn"] | None = None
    """Epsilon of the contact model cmr (1/kg), or "learn" to learn it. None: the skeleton's, or 0.01."""
    compensation_steps: float | None = COMPENSATION_STEPS
    """Time steps over which the contact model undoes a penetration, or None to leave it."""
    project: bool = False
    """Bring predictions back onto the constraints (recorded data may drift; then a projection would be an error)."""
    seed: int = 0
    """Seed of the network's initial weights and of the order of the data."""
    checkpoint_every: int = 10
    """Epochs between checkpoints."""

    @property
    def states(self) -> int:
        """States in a chunk: `chunk_length`, or its default."""
        if self.chunk_length is not None:
            return self.chunk_length
        return 2 if self.model in BASELINES else 5

    @property
    def learns_contact(self) -> bool:
        """Whether friction and restitution, or a network in place of the contact model, are to be learned."""
        return bool({"friction", "restitution"} & set(self.learn)) and self.model != "in-cp-sp"

    @property
    def steps_per_epoch(self) -> int:
        """Steps of the optimiser in an epoch."""
        return -(-self.chunks_per_epoch // self.batch_size)

    def check(self) -> None:
        """Raise `CaromError` for a value that cannot be."""
        for name in ("epochs", "chunks_per_epoch", "batch_size", "patience", "width", "depth", "checkpoint_every"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1; it was {getattr(self, name)}.")
        require(self.states >= 2, f"chunk_length must be at least 2 states; it was {self.chunk_length}.")
        require(0 <= self.contact_share <= 1, f"contact_share must be in [0, 1]; it was {self.contact_share}.")
        for name in ("learning_rate", "property_learning_rate"):
            require(getattr(self, name) > 0, f"{name} must be positive; it was {getattr(self, name)}.")
        require(self.enough >= 0, f"enough must not be negative; it was {self.enough}.")
        require(self.loss_width >= 0, f"loss_width must not be negative; it was {self.loss_width}.")
        require(self.weight_decay >= 0, f"weight_decay must not be negative; it was {self.weight_decay}.")
        check_compensation_steps(self.compensation_steps)
        if self.contact_model is not None:
            contact_model_of(self.contact_model)
        require(
            self.epsilon is None or self.epsilon == "learn" or isinstance(self.epsilon, int | float),
            f'epsilon must be a number, or "learn"; it was {self.epsilon!r}.',
        )
        if isinstance(self.epsilon, int | float):
            CMr(self.epsilon)
        require(self.initial_friction >= 0, f"initial_friction must be at least 0; it was {self.initial_friction}.")
        require(
            0 <= self.initial_restitution <= 1,
            f"initial_restitution must be in [0, 1]; it was {self.initial_restitution}.",
        )
        require(self.model in FORMULATIONS, f"model must be one of {sorted(FORMULATIONS)}; it was {self.model!r}.")
        unknown = set(self.learn) - {"mass", "friction", "restitution", "potential"}
        require(not unknown and len(self.learn) > 0, f"learn must name quantities to learn; it was {self.learn}.")

    def prepare(self, skeleton: System) -> System:
        """`skeleton` with the contact model that is asked for.

        **Raises:** `CaromError` if an epsilon is asked of a contact model that has none.
        """
        if self.contact_model not in (None, contact_model_name(skeleton.contact_model)):
            skeleton = skeleton.with_contact_model(self.contact_model)
        if self.epsilon is None:
            return skeleton
        require(
            isinstance(skeleton.contact_model, CMr),
            f"epsilon belongs to the contact model cmr; the contact model was "
            f"{type(skeleton.contact_model).__name__} and epsilon {self.epsilon!r}. Give contact_model cmr too.",
        )
        return skeleton if self.epsilon == "learn" else skeleton.with_contact_model(CMr(self.epsilon))
