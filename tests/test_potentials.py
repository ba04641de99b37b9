"""Potential energies and the forces that follow from them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import GRAVITY, MOMENTS, random_motions, refused

import carom

ROUNDING = 1e-12  # of a few dozen operations on numbers of order 1


class Spring(carom.Potential):
    """A potential of a user's own: every point is pulled to the origin."""

    stiffness: float

    def __call__(self, x, mass_matrix):
        return self.stiffness * jnp.sum(x**2) / 2


@pytest.mark.parametrize("dim", [2, 3])
def test_gravity_acts_on_centres_of_mass(dim):
    rng = np.random.default_rng(3)
    g = -GRAVITY * np.eye(dim)[1]
    system = carom.System([carom.PointMass(2.0), carom.RigidBody(0.5, MOMENTS[dim])], potential=carom.Gravity(g))
    _, _, body, _ = random_motions(rng, 1, dim)
    x = jnp.concatenate([jnp.asarray(rng.standard_normal((1, dim))), body[0]])
    energy = GRAVITY * (2.0 * x[0, 1] + 0.5 * x[1, 1])
    np.testing.assert_allclose(system.potential_energy(x), energy, rtol=ROUNDING)
    force = -jax.grad(system.potential_energy)(x)
    # Every point falls alike: a rigid body does not start to turn.
    np.testing.assert_allclose(system.inverse_mass_matrix() @ force, np.tile(g, (dim + 2, 1)), atol=1e-11)


def test_without_a_potential_there_is_no_force():
    system = carom.System([carom.PointMass(1.0)])
    x = jnp.ones((1, 2))
    assert system.potential_energy(x) == 0
    np.testing.assert_array_equal(jax.grad(system.potential_energy)(x), 0)


def test_a_potential_of_ones_own():
    # Harmonic motion x = cos(w t), w^2 = k / m. RK4 after half a period: local errors (w dt)^5 / 120, 157 of them.
    system = carom.System([carom.PointMass(0.5)], potential=Spring(2.0), dim=2)
    out = carom.simulate(system, jnp.array([[1.0, 0.0]]), jnp.array([[0.0, 1.0]]), dt=0.01, steps=157)
    phase = 2 * out.time
    expected = jnp.stack([jnp.cos(phase), jnp.sin(phase) / 2], axis=-1)
    np.testing.assert_allclose(out.x[:, 0], expected, atol=157 * 0.02**5 / 120)


@pytest.mark.parametrize("acceleration", [9.81, (9.81,), (0.0,) * 4, ((0.0, -9.81),)])
def test_gravity_must_be_a_vector(acceleration):
    with refused("acceleration must be a vector of 2 or 3 numbers"):
        carom.Gravity(acceleration)
