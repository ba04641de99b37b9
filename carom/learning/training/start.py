"""What a training carries from step to step, and how it begins."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from carom.contact.impulses import CMr, ContactModel
from carom.errors import CaromError
from carom.learning.config import LearnConfig
from carom.learning.training.optimizer import fresh_optimizer
from carom.learning.unknowns.baselines import BASELINES, new_baseline, physical_quantities, with_baseline
from carom.learning.unknowns.models import NeuralPotential, Unknowns
from carom.recordings.recording import Recording
from carom.system import StepModel, System


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
    settled: Bool[Array, ""]  # masses and contact properties: they have been refined
    shot: Unknowns  # estimated together with start states before the first epoch, if `has_shot`
    has_shot: Bool[Array, ""]


def initial_unknowns(skeleton: System, config: LearnConfig, recording: Recording | None = None) -> Unknowns:
    """Starting values: equal masses, the configured friction and restitution, a random network scaled to `recording`.

    An epsilon that is learned starts from the skeleton's, whose contact model must be CMr.
    A potential of the skeleton that is itself a `NeuralPotential` is taken as the starting point.
    """
    floats = skeleton.friction.dtype
    count = skeleton.n_properties
    baseline = initial_baseline(skeleton, config)
    has = physical_quantities(skeleton if baseline is None else with_baseline(skeleton, baseline))

    def chosen(name, value):
        return value if name in config.learn and ("mass" if name == "potential" else name) in has else None

    key = jax.random.key(config.seed)
    potential = NeuralPotential.of(skeleton, recording, key=key, width=config.width, depth=config.depth)
    if isinstance(skeleton.potential, NeuralPotential):
        potential = skeleton.potential.extended(potential)
    return Unknowns(
        log_mass_ratio=chosen("mass", jnp.zeros(len(skeleton.bodies) - 1, floats)),
        friction=chosen("friction", jnp.full(count, config.initial_friction, floats)),
        restitution=chosen("restitution", jnp.full(count, config.initial_restitution, floats)),
        potential=chosen("potential", potential),
        log_epsilon=_initial_log_epsilon(skeleton) if config.epsilon == "learn" else None,
        contact_model=baseline if isinstance(baseline, ContactModel) else None,
        step_model=baseline if isinstance(baseline, StepModel) else None,
    )


def _initial_log_epsilon(skeleton: System) -> Float[Array, ""]:
    model = skeleton.contact_model
    if not isinstance(model, CMr) or float(model.epsilon) == 0:
        raise CaromError('epsilon "learn" starts from the skeleton\'s: its contact model must be CMr, epsilon above 0.')
    return jnp.log(model.epsilon)


def initial_baseline(skeleton: System, config: LearnConfig) -> ContactModel | StepModel | None:
    """The untrained network of a baseline; None for the others."""
    if config.model not in BASELINES:
        return None
    sizes = {"width": config.width, "depth": config.depth} if config.model == "mlp-cd-clnn" else {}
    return new_baseline(config.model, skeleton, jax.random.fold_in(jax.random.key(config.seed), 1), **sizes)


def fresh_state(skeleton: System, config: LearnConfig, recording: Recording | None = None) -> TrainState:
    """The state before the first epoch; a network is scaled to `recording`."""
    unknowns = initial_unknowns(skeleton, config, recording)
    zero = jnp.asarray(0)
    infinity = jnp.asarray(jnp.inf)
    optimizer = fresh_optimizer(unknowns, config)
    no = jnp.asarray(False)
    return TrainState(unknowns, optimizer, unknowns, infinity, zero, zero, zero, zero, no, unknowns, no)
