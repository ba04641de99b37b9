"""States of contacts made of random friction-cone problems."""

import jax.numpy as jnp
import numpy as np

import carom
from carom.contact.candidates import Active


def state_of(problem) -> carom.ContactState:
    """A batch of states whose points move by the impulses themselves: the velocity jump of a model is its impulse."""
    batch, k, d = problem.v.shape
    present = np.diagonal(problem.A, axis1=1, axis2=2)[:, ::d] > 0
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
