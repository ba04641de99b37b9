"""States of contacts made of random friction-cone problems, and what impacts there do to the energy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import carom
from carom.contact.candidates import Active
from carom.contact.energy import dissipative


def _normal(problem):
    """Each contact's normal entry of the matrix; zero is padding."""
    return np.diagonal(problem.A, axis1=1, axis2=2)[:, :: problem.v.shape[2]]


def state_of(problem) -> carom.ContactState:
    """A batch of states whose points move by the impulses themselves: the velocity jump of a model is its impulse."""
    batch, k, d = problem.v.shape
    present = _normal(problem) > 0
    ones = np.ones((batch, k))
    return carom.ContactState(
        x=jnp.zeros_like(problem.v),
        v=jnp.asarray(problem.v),
        active=Active(
            active=jnp.asarray(present),
            gap=jnp.asarray(-ones),
            jacobian=jnp.zeros((batch, k, d, k, d)),
            property_index=jnp.zeros((batch, k), int),
            candidate=jnp.broadcast_to(jnp.arange(k), (batch, k)),
            closed=jnp.asarray(present),
            overflow=jnp.zeros(batch, int),
        ),
        response=jnp.broadcast_to(jnp.eye(k * d).reshape(k * d, k, d), (batch, k * d, k, d)),
        delassus=jnp.asarray(problem.A),
        velocity=jnp.asarray(problem.v),
        target=jnp.asarray(problem.v_star),
        friction=jnp.asarray(problem.friction),
        restitution=jnp.asarray(problem.restitution),
    )


@eqx.filter_jit
def _jumps(model, states):
    return jax.vmap(lambda one: dissipative(one, model(one)))(states)


def gains(problem, model):
    """Change of the energy by each impact, relative to that of the contacts' velocities."""
    state = state_of(problem)._replace(target=jnp.zeros_like(jnp.asarray(problem.v)))
    jump = _jumps(model, state)
    impulse = np.asarray(jump.impulse).sum(1)
    change = np.einsum("bxy,by->bx", problem.A, impulse.reshape(len(impulse), -1)).reshape(impulse.shape)
    gained = np.sum(impulse * (problem.v + change / 2), axis=(1, 2))
    normal = np.sqrt(_normal(problem))[..., None]
    energy = np.sum(np.where(normal > 0, problem.v**2 / np.where(normal > 0, normal, 1), 0), axis=(1, 2))
    return gained / np.where(energy > 0, energy, np.inf), np.asarray(jump.residual)
