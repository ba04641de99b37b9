"""The loss of short chunks of states, a step of the optimiser on it, and its value on chunks that are held out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array, Float, Int

from carom.learning.training.devices import AXIS, shares, sum_over_processes
from carom.learning.training.optimizer import Rates, make_optimizer
from carom.learning.unknowns.models import Unknowns
from carom.simulation.impact import Stepper
from carom.simulation.rollout import step
from carom.system import System


def smooth_error(error: Float[Array, "*shape"], width: Float[Array, ""]) -> Float[Array, "*shape"]:
    """`sqrt(error^2 + width^2) - width`: the absolute error but for a quadratic part of `width`.

    Masses and restitutions meet in valleys of the absolute error with sharp floors, along which no single quantity can
    move: the smooth floor of a wide loss lets them travel together; narrowing it then gives the exact fit of the
    absolute error (Charbonnier et al., 1994; graduated as in Blake and Zisserman, *Visual Reconstruction*, 1987).
    """
    return jnp.sqrt(error**2 + width**2) - width


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


def chunk_loss(unknowns: Unknowns, skeleton: System, stepper: Stepper, x, v, share, width):
    """What is minimised, with (mean absolute error of positions plus that of velocities, overflow) beside it.

    `share` (B,): of each chunk in the means, which is that of a batch if they add up to 1. `width` (m/s) is that of the
    quadratic part for velocities; for positions it is `width dt`.
    """
    error_x, error_v, overflow = chunk_errors(unknowns, skeleton, stepper, x, v)

    def mean(values):
        return jnp.sum(share * jnp.mean(values, axis=(1, 2, 3)))

    loss = mean(smooth_error(error_x, width * stepper.dt)) + mean(smooth_error(error_v, width))
    return loss, (mean(jnp.abs(error_x)) + mean(jnp.abs(error_v)), overflow)


def gather_chunks(x, v, trajectory, start, length: int):
    """Chunks `(B, length, n, d)` of the recorded states."""
    times = start[:, None] + np.arange(length, dtype=np.int32)
    return x[trajectory[:, None], times], v[trajectory[:, None], times]


def gradients(data, unknowns: Unknowns, stepper: Stepper, length: int, width, mesh: Mesh | None):
    """((loss, (error, overflow)), gradient) of chunks `(trajectory, start, share)`, by shares on the devices of `mesh`.

    Their number must be one that can be divided.
    """
    skeleton, x, v, trajectory, start, share = data
    arrays, static = eqx.partition((unknowns, skeleton, stepper), eqx.is_array)

    def of_share(arrays, x, v, trajectory, start, share, width):
        unknowns, skeleton, stepper = eqx.combine(arrays, static)
        chunk = gather_chunks(x, v, trajectory, start, length)
        gradient = eqx.filter_value_and_grad(chunk_loss, has_aux=True)
        out, grads = gradient(unknowns, skeleton, stepper, *chunk, share, width)
        grads = eqx.filter(grads, eqx.is_array)
        return (out, grads) if mesh is None else jax.lax.psum((out, grads), AXIS)

    inputs = (arrays, x, v, trajectory, start, share, width)
    if mesh is None:
        return of_share(*inputs)
    everywhere, divided = PartitionSpec(), PartitionSpec(AXIS)
    specs = (everywhere, everywhere, everywhere, divided, divided, divided, everywhere)
    return jax.shard_map(of_share, mesh=mesh, in_specs=specs, out_specs=everywhere, check_vma=False)(*inputs)


def train_step(data, unknowns, opt_state, rates: Rates, stepper, length: int, width, mesh: Mesh | None = None):
    """One step of the optimiser on chunks `(trajectory, start)`. A step whose gradient is not finite is left out.

    Of several processes each takes a share of the chunks, and adds up what all have found.
    """
    skeleton, x, v, trajectory, start = data
    rows, share = shares(len(start), mesh)
    chunks = (skeleton, x, v, trajectory[rows], start[rows], jnp.asarray(share, x.dtype))
    if jax.process_count() == 1:
        return _step(chunks, unknowns, opt_state, rates, stepper, length, width, mesh)
    found = sum_over_processes(_gradients(chunks, unknowns, stepper, length, width, mesh))
    return _updated(found, unknowns, opt_state, rates)


_gradients = eqx.filter_jit(gradients)


@eqx.filter_jit
def _step(chunks, unknowns, opt_state, rates: Rates, stepper, length, width, mesh: Mesh | None):
    return _update(gradients(chunks, unknowns, stepper, length, width, mesh), unknowns, opt_state, rates)


@eqx.filter_jit
def _updated(found, unknowns, opt_state, rates: Rates):
    return _update(found, unknowns, opt_state, rates)


def _update(found, unknowns, opt_state, rates: Rates):
    (loss, (error, overflow)), grads = found
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
