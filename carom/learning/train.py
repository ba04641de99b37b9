"""The trainer: one for every system and model. `learn` fits the unknowns of a skeleton to a dataset."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int

from carom.checks import require
from carom.contact.cones import ConeSettings
from carom.learning.dataset import Chunks, Dataset, batches, closed_contacts, contact_flags
from carom.learning.models import NeuralPotential, Unknowns, mass_ratios
from carom.learning.run import RunFolder
from carom.simulation.rollout import COMPENSATION_STEPS, Stepper, step
from carom.system import System

Model = Literal["clnn", "chnn"]
Quantity = Literal["mass", "friction", "restitution", "potential"]
FORMULATIONS = {"clnn": "lagrangian", "chnn": "hamiltonian"}


@dataclasses.dataclass(frozen=True)
class LearnConfig:
    """How to learn. The defaults learn every quantity of the paper's tasks within minutes on two CPU cores."""

    model: Model = "clnn"
    """Constrained Lagrangian (clnn) or Hamiltonian (chnn) neural network."""
    learn: tuple[Quantity, ...] = ("mass", "friction", "restitution", "potential")
    """What is unknown; all else is taken from the skeleton."""
    epochs: int = 250
    """Passes over the training trajectories; each draws a new chunk of every trajectory."""
    batch_size: int = 200
    """Chunks in a step of the optimiser."""
    chunk_length: int = 5
    """Consecutive states in a chunk: the first is given, the others are predicted."""
    contact_share: float = 0.5
    """Share of the chunks that are drawn with a contact, where a trajectory has any."""
    learning_rate: float = 3e-3
    """Peak learning rate of AdamW; it decays to zero along a cosine."""
    weight_decay: float = 1e-4
    """Weight decay of the network (physical quantities are not decayed)."""
    patience: int = 100
    """Stop after so many epochs without a better validation loss."""
    width: int = 256
    """Units in a hidden layer of the potential."""
    depth: int = 3
    """Hidden layers of the potential."""
    initial_friction: float = 0.3
    """Friction at the start."""
    initial_restitution: float = 0.5
    """Restitution at the start."""
    compensation_steps: float = COMPENSATION_STEPS
    """Time steps over which the contact model undoes a penetration."""
    project: bool = False
    """Bring predictions back onto the constraints (recorded data may drift; then a projection would be an error)."""
    seed: int = 0
    """Seed of the network's initial weights and of the order of the data."""
    checkpoint_every: int = 10
    """Epochs between checkpoints."""

    def __post_init__(self):
        for name in ("epochs", "batch_size", "patience", "width", "depth", "checkpoint_every"):
            require(getattr(self, name) >= 1, f"{name} must be at least 1; it was {getattr(self, name)}.")
        require(self.chunk_length >= 2, f"chunk_length must be at least 2 states; it was {self.chunk_length}.")
        require(0 <= self.contact_share <= 1, f"contact_share must be in [0, 1]; it was {self.contact_share}.")
        require(self.learning_rate > 0, f"learning_rate must be positive; it was {self.learning_rate}.")
        require(self.weight_decay >= 0, f"weight_decay must not be negative; it was {self.weight_decay}.")
        require(self.compensation_steps > 0, f"compensation_steps must be positive; it was {self.compensation_steps}.")
        require(self.initial_friction >= 0, f"initial_friction must be at least 0; it was {self.initial_friction}.")
        require(
            0 <= self.initial_restitution <= 1,
            f"initial_restitution must be in [0, 1]; it was {self.initial_restitution}.",
        )
        require(self.model in FORMULATIONS, f"model must be one of {sorted(FORMULATIONS)}; it was {self.model!r}.")
        unknown = set(self.learn) - {"mass", "friction", "restitution", "potential"}
        require(not unknown and len(self.learn) > 0, f"learn must name quantities to learn; it was {self.learn}.")


@dataclasses.dataclass(frozen=True)
class LearnReport:
    """What a training came to. `mass_ratio` is to the first body."""

    friction: list[float]
    restitution: list[float]
    mass_ratio: list[float]
    train_loss: float
    val_loss: float
    epochs: int
    seconds: float
    stopped_early: bool
    skipped_steps: int
    overflowed_contacts: int


class TrainState(eqx.Module):
    """Everything a training needs to go on from."""

    unknowns: Unknowns
    optimizer: Any
    best: Unknowns
    best_loss: Float[Array, ""]
    best_epoch: Int[Array, ""]
    epoch: Int[Array, ""]
    skipped: Int[Array, ""]
    overflow: Int[Array, ""]


def initial_unknowns(skeleton: System, config: LearnConfig) -> Unknowns:
    """Starting values: equal masses, the configured friction and restitution, a random network.

    A potential of the skeleton that is itself a `NeuralPotential` is taken as the starting point.
    """
    floats = skeleton.friction.dtype
    count = skeleton.n_properties

    def chosen(name, value):
        return value if name in config.learn else None

    if isinstance(skeleton.potential, NeuralPotential):
        potential = skeleton.potential
    else:
        potential = NeuralPotential(
            skeleton.n_points, skeleton.dim, width=config.width, depth=config.depth, key=jax.random.key(config.seed)
        )
    return Unknowns(
        log_mass_ratio=chosen("mass", jnp.zeros(len(skeleton.bodies) - 1, floats)),
        friction=chosen("friction", jnp.full(count, config.initial_friction, floats)),
        restitution=chosen("restitution", jnp.full(count, config.initial_restitution, floats)),
        potential=chosen("potential", potential),
    )


def make_optimizer(config: LearnConfig, steps: int, unknowns: Unknowns) -> optax.GradientTransformation:
    """AdamW with cosine decay; weight decay acts on the network alone."""
    schedule = optax.cosine_decay_schedule(config.learning_rate, steps)
    arrays = eqx.filter(unknowns, eqx.is_inexact_array)
    decayed = eqx.tree_at(
        lambda u: u.potential,
        jax.tree.map(lambda _: False, arrays),
        jax.tree.map(lambda _: True, arrays.potential),
        is_leaf=lambda x: x is None,
    )
    return optax.adamw(schedule, weight_decay=config.weight_decay, mask=decayed)


def chunk_loss(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, x: Float[Array, "B L n d"], v: Float[Array, "B L n d"]
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """Mean absolute error of positions (m) and velocities (m/s) predicted from each chunk's first state.

    Also returns how many closed contacts found no place in the solver.
    """
    system = unknowns.assemble(skeleton)

    def predict(x0, v0):
        def body(state, _):
            out = step(system, *state, stepper)
            return (out.x, out.v), out

        return jax.lax.scan(body, (x0, v0), length=x.shape[1] - 1)[1]

    out = jax.vmap(predict)(x[:, 0], v[:, 0])
    loss = jnp.mean(jnp.abs(out.x - x[:, 1:])) + jnp.mean(jnp.abs(out.v - v[:, 1:]))
    return loss, jnp.sum(out.overflow)


def gather_chunks(x, v, trajectory, start, length: int):
    """Chunks `(B, length, n, d)` of the recorded states."""
    times = start[:, None] + np.arange(length, dtype=np.int32)
    return x[trajectory[:, None], times], v[trajectory[:, None], times]


@eqx.filter_jit
def train_step(data, unknowns, opt_state, optimizer, stepper, length):
    """One step of the optimiser. A step whose gradient is not finite is left out and counted."""
    skeleton, x, v, trajectory, start = data
    chunk = gather_chunks(x, v, trajectory, start, length)
    (loss, overflow), grads = eqx.filter_value_and_grad(chunk_loss, has_aux=True)(unknowns, skeleton, stepper, *chunk)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its counters with floats
        updates, new_state = optimizer.update(grads, opt_state, eqx.filter(unknowns, eqx.is_inexact_array))
    new = eqx.apply_updates(unknowns, updates).project()
    finite = jnp.isfinite(loss)
    for leaf in jax.tree.leaves(grads):
        finite = finite & jnp.isfinite(leaf).all()

    def choose(a, b):
        return jnp.where(finite, a, b) if eqx.is_array(a) else a

    unknowns = jax.tree.map(choose, new, unknowns)
    opt_state = jax.tree.map(choose, new_state, opt_state)
    return unknowns, opt_state, loss, overflow, ~finite


@eqx.filter_jit
def validate(unknowns, skeleton, x, v, stepper):
    """Loss of chunks that are not trained on."""
    return chunk_loss(unknowns, skeleton, stepper, x, v)[0]
