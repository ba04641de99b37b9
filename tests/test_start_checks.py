"""Starts: those that simulations lead to are taken, those that cannot be are refused, at every scale."""

import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor, pendulum, refused

import carom

SCALES = [1.0, 0.03, 1e-6]
AT_REST = jnp.zeros((1, 2))


@pytest.mark.parametrize("radius", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("finer", [1, 4])
def test_a_simulation_goes_on_from_its_own_end(radius, finer):
    """What rests is `N g dt^2 / 2` deep, more than a small radius; a smaller time step may follow."""
    system, start = ball_on_floor(radius=radius, friction=0.3), jnp.array([[0.0, radius + 0.05]])
    end = carom.simulate(system, start, AT_REST, dt=0.01, steps=200)
    # Each step takes away an eighth of what is more: after 200 steps 1e-9 of it is left.
    assert float(system.gaps(end.x[-1])[0]) == pytest.approx(-8 * 9.81 * 0.01**2 / 2, rel=1e-6)
    out = carom.simulate(system, end.x[-1], end.v[-1], dt=0.01 / finer, steps=200)
    assert abs(float(system.gaps(out.x[-1])[0])) < 8 * 9.81 * 0.01**2 / 2 * 1.01


def test_the_end_of_a_fast_impact_is_a_start():
    """2 m into a wall with e = 0, left with the velocity that undoes it."""
    system, start = ball_on_floor(radius=0.0, gravity=0.0), jnp.array([[0.0, 0.1]])
    end = carom.simulate(system, start, jnp.array([[0.0, -210.0]]), dt=0.01, steps=1)
    assert float(end.x[-1, 0, 1]) == pytest.approx(-2.0)
    carom.simulate(system, end.x[-1], end.v[-1], dt=0.01, steps=1)


def test_without_compensation_no_depth_is_too_deep():
    system, start = ball_on_floor(radius=1e-3), jnp.array([[0.0, 1e-3]])
    sunk = carom.simulate(system, start, AT_REST, dt=0.01, steps=60, compensation_steps=None)
    assert float(sunk.x[-1, 0, 1]) < -0.02
    carom.simulate(system, sunk.x[-1], sunk.v[-1], dt=0.01, steps=60, compensation_steps=None)


@pytest.mark.parametrize("scale", SCALES)
def test_deep_in_a_wall_is_refused_at_every_scale(scale):
    """All lengths times s, times by the root of it."""
    system, below = ball_on_floor(radius=0.1 * scale), jnp.array([[0.0, -0.3 * scale]])
    with refused("body 0 is inside a wall"):
        carom.simulate(system, below, AT_REST, dt=0.01 * scale**0.5, steps=1)


@pytest.mark.parametrize("scale", SCALES)
@pytest.mark.parametrize(("share", "fits"), [(1.005, True), (0.995, True), (1.02, False), (2.0, False), (0.5, False)])
def test_a_rod_is_off_by_a_share_of_its_length(scale, share, fits):
    system, start = pendulum(length=0.7 * scale), jnp.array([[0.7 * scale * share, 0.0]])
    assert float(system.violation(start)[0]) == pytest.approx(share**2 - 1)
    if not fits:
        with refused("x0 does not obey the constraints: equation 0 of state 0 is off by"):
            carom.simulate(system, start, AT_REST, dt=0.01 * scale**0.5, steps=1)


@pytest.mark.parametrize("scale", SCALES)
def test_violations_of_joints_are_relative_to_bodies(scale):
    """A joint at an arm of 0.3 that is off by 0.03; angles and axes are numbers at every scale."""
    weights, size = carom.place_weights(np.array([0.3, 0.0, 0.0]) * scale), np.full(3, 0.02 * scale**2)
    links = [
        carom.Joint(0, weights, np.zeros(3)),
        carom.Track(0, weights, np.eye(3)[1:2], np.zeros(3)),
        carom.Angles(0, np.eye(3)[:1], np.eye(3)[1:2], 0.25),
    ]
    system = carom.System([carom.RigidBody(1.0, size)], links)
    x = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)]) + jnp.array([-0.3, 0.03, 0.0]) * scale
    assert np.allclose(system.violation(x), [0, 0.1, 0, 0.1, -0.25, *[0] * 6], atol=1e-9)
