"""No impact adds energy: random mechanisms, unlike restitutions, friction up to 2; a cradle of balls."""

import jax.numpy as jnp
import numpy as np
import pytest
from cone_problems import FAMILIES, generate, rigid_bodies
from contact_states import gains
from test_coulomb import ROOM

import carom
from carom.contact.energy import islands


@pytest.mark.slow
@pytest.mark.parametrize(
    "model", [carom.CM(), pytest.param(carom.Coulomb(), marks=pytest.mark.ci_budget)], ids=["cm", "coulomb"]
)
def test_impacts_add_no_energy(model):
    rng = np.random.default_rng(2)
    made = [generate(rng, family, 64, ROOM, 3) for family in FAMILIES]
    A, v, mu = (
        np.concatenate(part) for part in zip(*(rigid_bodies(rng, 64, ROOM, 3, k) for k in (2, 4, 6)), strict=True)
    )
    e = rng.uniform(0, 1, mu.shape)
    made.append(made[0]._replace(A=A, v=v, friction=mu, restitution=e, v_star=0 * v, lower=0 * mu))
    everything = made[0]._replace(
        **{name: np.concatenate([getattr(p, name) for p in made]) for name in made[0]._fields}
    )
    gained, residual = gains(everything, model)
    assert np.mean(residual < 1e-8) > 0.99
    assert np.max(gained[residual < 1e-8]) < 1e-10


@pytest.mark.slow
def test_a_gain_of_newtons_hypothesis_is_in_the_residual():
    """One contact is hit and presses the other together, which was opening: that one is stopped, and pushes."""
    A = np.array([[[1.0, 0, -0.9, 0], [0, 1, 0, 0], [-0.9, 0, 1, 0], [0, 0, 0, 1]]])
    made = generate(np.random.default_rng(0), "gaussian", 1, 2, 2)
    v = np.array([[[-1.0, 0.0], [0.5, 0.0]]])
    problem = made._replace(A=A, v=v, friction=np.zeros((1, 2)), v_star=0 * v, restitution=np.ones((1, 2)))
    gained, residual = gains(problem, carom.LCP())
    assert gained[0] > 1
    assert residual[0] > 0.01
    assert gains(problem, carom.CM())[0][0] <= 1e-12


def test_islands_are_what_acts_on_each_other():
    A = np.zeros((5, 5))
    A[np.diag_indices(5)] = 1
    A[0, 3] = A[3, 0] = A[3, 4] = A[4, 3] = 0.1
    found = np.asarray(islands(jnp.asarray(A), 1))
    expected = np.eye(5, dtype=bool)
    expected[np.ix_([0, 3, 4], [0, 3, 4])] = True
    np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
@pytest.mark.parametrize("gap", [pytest.param(1e-3, marks=pytest.mark.ci_budget), 1e-6])
def test_the_last_ball_of_a_cradle_leaves_with_the_speed_of_the_first(gap):
    """Balls in a row, a little apart, e = 1: all impacts are within one time step."""
    count, radius, speed = 5, 0.05, 1.0
    system = carom.System(
        bodies=[carom.PointMass(0.3, radius)] * count,
        contacts=[carom.DiskDisk([(k, k + 1) for k in range(count - 1)])],
        restitution=1.0,
        dim=2,
    )
    places = np.arange(count) * (2 * radius + gap)
    places[0] -= 0.0123
    x0 = jnp.asarray(np.stack([places, 0 * places], axis=1))
    v0 = jnp.zeros_like(x0).at[0, 0].set(speed)
    motion = carom.simulate(system, x0, v0, dt=0.01, steps=6, impact="event")
    np.testing.assert_allclose(motion.v[-1, :, 0], [0, 0, 0, 0, speed], atol=1e-9)
    np.testing.assert_allclose(system.energy(motion.x, motion.v), 0.3 * speed**2 / 2, rtol=1e-9)
