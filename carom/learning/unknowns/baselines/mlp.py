"""MLP-CD-CLNN: contact detection is given, and a multi-layer perceptron gives the velocity jump."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from carom.contact.impulses import ContactModel, Jump
from carom.system import System


class MLPContact(ContactModel):
    """Velocity jump from all positions (m), velocities (m/s) and which contact candidates are closed.

    **Arguments:** `system`, for the sizes; `key`, of the initial weights; `width`, `depth`: units of a hidden layer,
    number of hidden layers (paper: 3 of 256); `dtype`, of the weights and the evaluation.
    """

    network: eqx.nn.MLP

    def __init__(self, system: System, *, key: PRNGKeyArray, width: int = 256, depth: int = 3, dtype=jnp.float32):
        size = system.n_points * system.dim
        self.network = eqx.nn.MLP(2 * size + system.n_candidates, size, width, depth, key=key, dtype=dtype)

    def __call__(self, state, *, smoothing=0.0):
        dtype = self.network.layers[0].weight.dtype
        parts = (state.x.reshape(-1), state.v.reshape(-1), state.active.closed)
        jump = self.network(jnp.concatenate([part.astype(dtype) for part in parts]))
        jump = jump.reshape(state.v.shape).astype(state.v.dtype)
        return Jump(jnp.where(jnp.any(state.active.active), jump, 0), jnp.zeros((), state.v.dtype))
