"""Boxes on a plane: where their corners are and how fast, and motions with a closed form."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.tasks.gyroscopes import turn

HALF = (0.1, 0.2, 0.15)
TABLE = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))


def box(half_widths=HALF, *, radius=0.0, center=None, friction=0.0, restitution=0.0, gravity=0.0):
    return carom.System(
        bodies=[carom.RigidBody(2.0, (0.02, 0.01, 0.03))],
        contacts=[carom.CornerPlane([0], half_widths, *TABLE, corner_radius=radius, center=center)],
        potential=carom.Gravity((0.0, 0.0, -gravity)),
        friction=friction,
        restitution=restitution,
    )


@pytest.mark.parametrize(("radius", "center"), [(0.0, (0, 0, 0)), (0.03, (0, 0, 0)), (0.03, (0.02, -0.01, 0.05))])
def test_gaps_and_velocities_of_corners(radius, center):
    rotation = turn(0, jnp.asarray(0.4)) @ turn(1, jnp.asarray(-0.8)) @ turn(2, jnp.asarray(0.3))
    position, velocity, omega = (jnp.array(a) for a in ([0.3, -0.1, 0.5], [1.0, -2.0, 0.5], [3.0, -1.0, 2.0]))
    x, v = embed_pose(position, rotation), embed_velocity(rotation, velocity, omega)
    found = box(radius=radius, center=center).candidates(x)
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    corner = (signs * (np.array(HALF) - radius) + np.array(center)) @ np.asarray(rotation).T
    assert np.allclose(found.gap, position[2] + corner[:, 2] - radius, atol=1e-14)
    touching = corner - radius * np.array([0, 0, 1.0])
    expected = velocity + np.cross(omega, touching)
    moved = jnp.einsum("cipj,cpj->ci", found.rows, v[found.stencil])
    assert np.allclose(moved[:, 0], expected[:, 2], atol=1e-13)
    assert np.allclose(jnp.linalg.norm(moved, axis=1), np.linalg.norm(expected, axis=1), atol=1e-13)


def upright(height, velocity):
    x = embed_pose(jnp.array([0.0, 0.0, 1.0]) * height, jnp.eye(3))
    return x, embed_velocity(jnp.eye(3), jnp.asarray(velocity), jnp.zeros(3))


@pytest.mark.slow
def test_a_flat_landing_and_what_widths_do():
    """Four corners land together: `z = z_0 + v t` before, `h + e v (T - t)` after. So `dz/dh = 1 + e`."""
    start = box(restitution=0.7)

    @jax.jit
    @jax.value_and_grad
    def end(half_width):
        system = eqx.tree_at(lambda s: s.contacts[0].half_widths, start, jnp.full(3, half_width))
        x, v = upright(0.5, [0.0, 0.0, -2.0])
        return carom.simulate(system, x, v, dt=0.02, steps=20, impact="event").x[-1, 0, 2]

    height, slope = end(0.1)
    assert np.isclose(height, 0.1 + 0.7 * 2 * (0.4 - 0.2), atol=1e-9)
    assert np.isclose(slope, 1.7, atol=1e-6)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_box_that_slides_stops_after_the_way_that_friction_allows():
    """A flat box at 1 m/s stops after `v^2 / (2 mu g)`; in steps of the step's rule, to the order of a step."""
    friction, gravity = 0.4, 10.0
    x, v = upright(0.05, [1.0, 0.0, 0.0])
    system = box((0.3, 0.3, 0.05), friction=friction, gravity=gravity)
    motion = carom.simulate(system, x, v, dt=0.002, steps=200)
    assert np.isclose(motion.x[-1, 0, 0], 1 / (2 * friction * gravity), rtol=0.02)
    assert np.abs(motion.v[-1, 0]).max() < 0.02
    assert np.isclose(motion.x[-1, 0, 2], 0.05, atol=1e-3)


@pytest.mark.slow
def test_a_box_with_its_mass_at_the_side_tips_over_an_edge():
    """On a plane that is tilted to the side of its mass, a box tips where its mass is beyond the edge, or rests."""
    rests, tips = (
        carom.simulate(
            box((0.1, 0.1, 0.1), center=(-side, 0.0, 0.0), friction=1.0, gravity=9.81),
            *upright(0.1, [0.0, 0.0, 0.0]),
            dt=0.005,
            steps=60,
        )
        for side in (0.09, 0.11)
    )
    assert np.abs(rests.x[-1, 1, 2] - rests.x[-1, 0, 2]) < 0.02
    assert tips.x[-1, 1, 2] - tips.x[-1, 0, 2] < -0.1


@pytest.mark.slow
def test_a_tossed_cube_comes_to_rest_on_a_face():
    system = carom.task("cube")
    x, v = carom.sample(system, jax.random.key(0), 32)
    assert np.asarray(system.gaps(x)).min() > 0
    motion = carom.simulate(system, x, v, dt=1 / 296, steps=300, impact="event")
    energy = np.asarray(system.energy(motion.x, motion.v))
    assert np.diff(energy, axis=1).max() < 1e-3 * energy[:, 0].max()
    height = np.asarray(motion.x[:, -1, 0, 2])
    half = system.contacts[0].half_widths[0]
    assert np.mean(np.abs(height - half) < 2e-3) > 0.8


def test_what_cannot_be_is_refused():
    with refused("CornerPlane half_widths must be one length or 3; their shape was (2,)"):
        carom.CornerPlane([0], (0.1, 0.2), *TABLE)
    with refused("half_widths"):
        carom.CornerPlane([0], -0.1, *TABLE)
    with refused("CornerPlane center must be 3 coordinates; its shape was (2,)"):
        carom.CornerPlane([0], 0.1, *TABLE, center=(0.0, 0.1))
    with refused("corner_radius"):
        carom.CornerPlane([0], 0.1, *TABLE, corner_radius=0.2)
    balls = carom.System(bodies=[carom.PointMass(1.0, 0.1)], contacts=[carom.CornerPlane([0], 0.1, *TABLE)])
    with refused("CornerPlane is for rigid bodies; the bodies [0] cannot turn"):
        balls.gaps(jnp.ones((1, 3)))
