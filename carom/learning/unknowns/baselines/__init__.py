"""The paper's baselines (its section 5, supplement L): networks in place of the contact model, or of the whole step.

Each is a part of a `System`, so that a learned baseline is simulated, evaluated and saved like any other system.
Written from their descriptions; what those leave open follows Battaglia et al., *Interaction Networks for Learning
about Objects, Relations and Physics*, NeurIPS 2016.
"""

from typing import Any, Literal

import equinox as eqx
import jax
from jaxtyping import PRNGKeyArray

from carom.contact.impulses import ContactModel
from carom.learning.unknowns.baselines.interaction import InteractionContact as InteractionContact
from carom.learning.unknowns.baselines.interaction import InteractionNetwork as InteractionNetwork
from carom.learning.unknowns.baselines.interaction import InteractionStep as InteractionStep
from carom.learning.unknowns.baselines.mlp import MLPContact as MLPContact
from carom.system import StepModel, System

Baseline = Literal["mlp-cd-clnn", "in-cp-clnn", "in-cp-sp"]
BASELINES: tuple[Baseline, ...] = ("mlp-cd-clnn", "in-cp-clnn", "in-cp-sp")


def new_baseline(name: str, system: System, key: PRNGKeyArray, **sizes: int) -> ContactModel | StepModel:
    """A baseline with random weights for `system`; `sizes` as those of its class, or the paper's."""
    if name == "mlp-cd-clnn":
        return MLPContact(system, key=key, **sizes)
    network = InteractionNetwork(system, key=key, **sizes)
    return InteractionContact(network) if name == "in-cp-clnn" else InteractionStep(network)


def with_baseline(system: System, baseline: ContactModel | StepModel) -> System:
    """`system` with this baseline in its place."""
    if isinstance(baseline, ContactModel):
        return eqx.tree_at(lambda s: s.contact_model, system, baseline)
    return eqx.tree_at(lambda s: s.step_model, system, baseline, is_leaf=lambda part: part is None)


def describe_baseline(system: System) -> dict[str, Any] | None:
    """Name and sizes of a system's baseline, from which `rebuild_baseline` makes its structure; None without one."""
    if isinstance(model := system.contact_model, MLPContact):
        sizes, network = {"width": model.network.width_size, "depth": model.network.depth}, model.network
        return {"name": "mlp-cd-clnn", "sizes": sizes, "dtype": str(network.layers[0].weight.dtype)}
    part = model if isinstance(model, InteractionContact) else system.step_model
    if not isinstance(part, InteractionContact | InteractionStep):
        return None
    relation, other = part.network.relation, part.network.object
    return {
        "name": "in-cp-clnn" if part is model else "in-cp-sp",
        "sizes": {"relation_width": relation.width_size, "object_width": other.width_size},
        "dtype": str(relation.layers[0].weight.dtype),
    }


def rebuild_baseline(description: dict[str, Any], skeleton: System) -> System:
    """`skeleton` with a baseline of this description, whose weights are yet to be filled in."""
    name, sizes, dtype = (description[part] for part in ("name", "sizes", "dtype"))
    baseline = new_baseline(name, skeleton, jax.random.key(0), **sizes)
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, baseline)
    return with_baseline(skeleton, cast)


def physical_quantities(system: System) -> tuple[str, ...]:
    """Which of masses, friction and restitution a learned system has: a baseline's network replaces the others."""
    if system.step_model is not None:
        return ()
    network = isinstance(system.contact_model, MLPContact | InteractionContact)
    return ("mass",) if network else ("mass", "friction", "restitution")
