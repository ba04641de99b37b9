"""Derivatives of steps whose contacts are redundant: those of the impulse of least norm, against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import frames_of, made

from carom.simulation.impact import Stepper, closed_contacts
from carom.simulation.projection import project_state
from carom.simulation.rollout import step

COUNT = 96
STEPS = np.array([1e-5, 1e-6])


@pytest.mark.slow
def test_derivatives_by_positions_velocities_friction_and_restitution():
    """Of chains that are at eight limits at once; where differences of two sizes, and both ways, agree."""
    keys = jax.random.split(jax.random.key(11), COUNT)
    frame = frames_of(np.random.default_rng(7), "chain", COUNT)["plain"]

    def one(key, frame):
        system, x, v = made("chain", key, frame)
        stepper = Stepper(dt=1e-3 * frame.time)
        dx, dv = (s * jax.random.normal(jax.random.fold_in(key, k), x.shape) for k, s in ((1, 0.05), (2, 1.0)))

        def end(a):
            now = eqx.tree_at(
                lambda s: (s.friction, s.restitution),
                system,
                (system.friction * (1 + 0.3 * a), system.restitution * (1 - 0.5 * a)),
            )
            mass = now.inverse_mass_matrix()
            return step(now, *project_state(now.constraints, x + a * dx, v + a * dv, mass), stepper).v

        value, slope = jax.jvp(end, (jnp.zeros(()),), (jnp.ones(()),))
        sides = jax.vmap(end)(jnp.asarray(np.concatenate([STEPS, -STEPS])))
        contacts = closed_contacts(system, x, v, system.inverse_mass_matrix(), stepper)
        rank = jnp.linalg.matrix_rank(contacts.delassus, rtol=1e-9)
        return value, slope, sides, rank < 2 * jnp.sum(contacts.active.active)

    value, slope, sides, redundant = map(np.asarray, jax.jit(jax.vmap(one))(keys, frame))
    assert redundant.all()
    way = STEPS[:, None, None]
    both, ahead = (sides[:, :2] - sides[:, 2:]) / (2 * way), (sides[:, :2] - value[:, None]) / way
    scale = np.maximum(np.abs(both[:, 1]), np.abs(value)).max((1, 2), keepdims=True)

    def near(a, b):
        return (np.abs(a - b) < 1e-4 * scale).all((1, 2))

    smooth = near(both[:, 0], both[:, 1]) & near(both[:, 1], ahead[:, 1])
    assert smooth.mean() > 0.5
    assert near(slope, both[:, 1])[smooth].all()
