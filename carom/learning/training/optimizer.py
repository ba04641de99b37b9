"""How the trainer's optimiser steps: AdamW with rates of their own for networks and for physical quantities."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, ArrayLike, Float

from carom.learning.config import LearnConfig
from carom.learning.unknowns.models import Unknowns


def learning_rate_schedule(config: LearnConfig, steps: int) -> optax.Schedule:
    """Half a cosine, squared: in late steps the unknowns settle, which takes longer than finding where."""
    return optax.cosine_decay_schedule(config.learning_rate, steps, exponent=2.0)


SETTLED = 0.01
"""What the rates of masses and contact properties are multiplied by once they have been refined."""


class Rates(NamedTuple):
    """What the optimiser's steps are multiplied by. Data, not part of the program: all trainings share one."""

    learning_rate: Float[Array, ""]  # of the networks, now
    property_share: Float[Array, ""]  # that of masses, friction and restitution over it
    weight_decay: Float[Array, ""]  # of the networks

    @classmethod
    def of(cls, config: LearnConfig, learning_rate: ArrayLike, settled: ArrayLike = False) -> "Rates":
        share = config.property_learning_rate / config.learning_rate * jnp.where(settled, SETTLED, 1.0)
        # Single precision, so that networks in single precision stay what they are.
        return cls(*(jnp.asarray(a, jnp.float32) for a in (learning_rate, share, config.weight_decay)))


def make_optimizer(rates: Rates) -> optax.GradientTransformation:
    """AdamW: weight decay for networks alone, a rate of their own for the properties."""
    return optax.chain(
        optax.adamw(rates.learning_rate, weight_decay=rates.weight_decay, mask=_is_network),
        optax.masked(optax.scale(rates.property_share), _is_property),
    )


def _is_network(unknowns: Unknowns):
    """Which arrays are weights of a network, or the coefficients beside it."""

    def flag(path, _):
        names = [getattr(key, "name", "") for key in path]
        fixed = "segments" in names and names[-1] != "coefficients"  # the scales of a `SegmentEnergy`
        return names[0] in ("potential", "contact_model", "step_model") and not fixed

    return jax.tree_util.tree_map_with_path(flag, unknowns)


def _is_property(unknowns: Unknowns):
    return jax.tree.map(lambda flag: not flag, _is_network(unknowns))


def fresh_optimizer(unknowns: Unknowns, config: LearnConfig):
    """The state of the optimiser before its first step."""
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its counters with floats
        return make_optimizer(Rates.of(config, 0)).init(eqx.filter(unknowns, eqx.is_inexact_array))
