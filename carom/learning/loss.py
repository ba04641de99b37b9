"""The loss of short chunks of states, a step of the optimiser on it, and its value on chunks that are held out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from carom.learning.models import Unknowns
from carom.learning.optimizer import Rates, make_optimizer
from carom.simulation.impact import Stepper
from carom.simulation.rollout import step
from carom.system import System


def smooth_error(error: Float[Array, "*shape"], width: Float[Array, ""]) -> Float[Array, ""]:
    """Mean of `sqrt(error^2 + width^2) - width`: the mean absolute error but for a quadratic part of `width`.

    Masses and restitutions meet in valleys of the absolute error with sharp floors, along which no single quantity can
    move: the smooth floor of a wide loss lets them travel together; narrowing it then gives the exact fit of the
    absolute error (Charbonnier et al., 1994; graduated as in Blake and Zisserman, *Visual Reconstruction*, 1987).
    """
    return jnp.mean(jnp.sqrt(error**2 + width**2) - width)


def chunk_errors(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, x: Float[Array, "B L n d"], v: Float[Array, "B L n d"]
) -> tuple[Float[Array, "B M n d"], Float[Array, "B M n d"], Int[Array, ""]]:
    """Errors of positions (m) and velocities (m/s) predicted from each chunk's first state, for the others.

    Also how many closed contacts found no place in the solver.
    """
    system = unknowns.assemble(skeleton)

    def predict(x0, v0):
        def body(state, _):
            out = step(system, state[0], state[1], stepper)
            return (out.x, out.v), out

        return jax.lax.scan(body, (x0, v0), length=x.shape[1] - 1)[1]

    out = jax.vmap(predict)(x[:, 0], v[:, 0])
    return out.x - x[:, 1:], out.v - v[:, 1:], jnp.sum(out.overflow)


def chunk_loss(unknowns: Unknowns, skeleton: System, stepper: Stepper, x, v, width):
    """What is minimised, with (mean absolute error of positions plus that of velocities, overflow) beside it.

    `width` (m/s) is that of the quadratic part for velocities; for positions it is `width dt`.
    """
    error_x, error_v, overflow = chunk_errors(unknowns, skeleton, stepper, x, v)
    loss = smooth_error(error_x, width * stepper.dt) + smooth_error(error_v, width)
    return loss, (jnp.mean(jnp.abs(error_x)) + jnp.mean(jnp.abs(error_v)), overflow)


def gather_chunks(x, v, trajectory, start, length: int):
    """Chunks `(B, length, n, d)` of the recorded states."""
    times = start[:, None] + np.arange(length, dtype=np.int32)
    return x[trajectory[:, None], times], v[trajectory[:, None], times]


@eqx.filter_jit
def train_step(data, unknowns, opt_state, rates: Rates, stepper, length, width):
    """One step of the optimiser. A step whose gradient is not finite is left out and counted."""
    skeleton, x, v, trajectory, start = data
    chunk = gather_chunks(x, v, trajectory, start, length)
    gradient = eqx.filter_value_and_grad(chunk_loss, has_aux=True)
    (loss, (error, overflow)), grads = gradient(unknowns, skeleton, stepper, *chunk, width)
    with jax.numpy_dtype_promotion("standard"):  # optax mixes its counters with floats
        updates, new_state = make_optimizer(rates).update(grads, opt_state, eqx.filter(unknowns, eqx.is_inexact_array))
    new = eqx.apply_updates(unknowns, updates).project()
    finite = jnp.isfinite(loss)
    for leaf in jax.tree.leaves(grads):
        finite = finite & jnp.isfinite(leaf).all()

    def choose(a, b):
        return jnp.where(finite, a, b) if eqx.is_array(a) else a

    unknowns = jax.tree.map(choose, new, unknowns)
    opt_state = jax.tree.map(choose, new_state, opt_state)
    return unknowns, opt_state, error, overflow, ~finite


@eqx.filter_jit
def validate(unknowns, skeleton, x, v, stepper):
    """Mean absolute error of positions plus that of velocities, for chunks that are not trained on.

    And the same for the better nine tenths of the chunks.
    """
    error_x, error_v, _ = chunk_errors(unknowns, skeleton, stepper, x, v)
    chunk = jnp.mean(jnp.abs(error_x) + jnp.abs(error_v), axis=(1, 2, 3))
    return jnp.mean(chunk), jnp.mean(jnp.sort(chunk)[: max(1, chunk.size * 9 // 10)])
