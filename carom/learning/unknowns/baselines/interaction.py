"""Interaction networks (Battaglia et al., 2016) for the contact jump (IN-CP-CLNN) and the whole step (IN-CP-SP)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from carom.contact.impulses import ContactModel, Jump
from carom.learning.unknowns.baselines.graph import Graph
from carom.system import StepModel, System

EFFECT = 50
"""Numbers in the effect of a relation (Battaglia et al., 2016)."""
RELATION_DEPTH, OBJECT_DEPTH = 4, 1
"""Hidden layers of both networks (Battaglia et al., 2016)."""


class InteractionNetwork(eqx.Module):
    """Velocity change of all points: each relation has an effect; a body feels the sum of those on it.

        effect_r = relation(object_sender, object_receiver, kind, closed)
        dv_b = object(object_b, sum of the effects on b)

    An object is a body's point positions (m), velocities (m/s) and radius (m); the fixed world is an object of zeros.
    Both networks are shared, so that bodies that are alike can change places.

    **Arguments:** `system`, whose graph it has; `key`, of the initial weights; `relation_width` and `object_width`,
    units in a hidden layer (paper: 300 and 200); `dtype`, of the weights and the evaluation.
    """

    graph: Graph
    relation: eqx.nn.MLP
    object: eqx.nn.MLP

    def __init__(
        self,
        system: System,
        *,
        key: PRNGKeyArray,
        relation_width: int = 300,
        object_width: int = 200,
        dtype=jnp.float32,
    ):
        self.graph = Graph.of(system)
        size = len(self.graph.points[0]) * system.dim
        features = 2 * size + 1
        keys = jax.random.split(key)
        inputs = 2 * features + self.graph.n_kinds + 1
        self.relation = eqx.nn.MLP(inputs, EFFECT, relation_width, RELATION_DEPTH, key=keys[0], dtype=dtype)
        self.object = eqx.nn.MLP(features + EFFECT, size, object_width, OBJECT_DEPTH, key=keys[1], dtype=dtype)

    def __call__(
        self, x: Float[Array, "n d"], v: Float[Array, "n d"], closed: Bool[Array, " C"]
    ) -> Float[Array, "n d"]:
        """Change of the velocities (m/s) at positions `x` (m) and velocities `v` with these contacts `closed`."""
        graph, dtype = self.graph, self.relation.layers[0].weight.dtype
        points = np.array(graph.points)
        bodies = len(points)
        objects = jnp.concatenate(
            [x[points].reshape(bodies, -1), v[points].reshape(bodies, -1), jnp.array(graph.radius, x.dtype)[:, None]],
            axis=1,
        ).astype(dtype)
        felt = jnp.zeros((bodies, EFFECT), dtype)
        if graph.sender:
            with_world = jnp.concatenate([objects, jnp.zeros_like(objects[:1])])  # which index WORLD = -1 finds
            flags = jnp.append(closed, False)[np.array(graph.candidate)].astype(dtype)
            attributes = [jax.nn.one_hot(np.array(graph.kind), graph.n_kinds, dtype=dtype), flags[:, None]]
            ends = [with_world[np.array(end)] for end in (graph.sender, graph.receiver)]
            effects = jax.vmap(self.relation)(jnp.concatenate([*ends, *attributes], axis=1))
            felt = felt.at[np.array(graph.receiver)].add(effects)
        change = jax.vmap(self.object)(jnp.concatenate([objects, felt], axis=1)).reshape(*points.shape, -1)
        return change[np.array(graph.owner), np.array(graph.slot)].astype(x.dtype)


class InteractionContact(ContactModel):
    """IN-CP-CLNN's contact: an interaction network gives the velocity jump where a contact is closed."""

    network: InteractionNetwork

    def __call__(self, state, *, smoothing=0.0):
        jump = self.network(state.x, state.v, state.active.closed)
        return Jump(jnp.where(jnp.any(state.active.active), jump, 0), jnp.zeros((), state.v.dtype))


class InteractionStep(StepModel):
    """IN-CP-SP: an interaction network gives the velocity change of a whole step; positions follow semi-implicitly.

        v+ = v + dv(x, v, closed),   x+ = x + dt v+

    `closed` are the contacts at `x + dt v`. Neither masses nor constraints enter, and the time step is learned too.
    """

    network: InteractionNetwork

    def __call__(self, system, x, v, dt):
        v = v + self.network(x, v, system.gaps(x + dt * v) < 0)
        return x + dt * v, v
