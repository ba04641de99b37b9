"""Balls that are fixed in rigid bodies: where they touch, how fast, and motions with a closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import random_motions, refused

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.view.scene import lines_of, touching, walls_of

ROUNDING = 1e-12
CENTERS = np.array([[0.3, -0.2, 0.1], [0.0, 0.0, 0.0]])
RADII = np.array([0.1, 0.25])


def bodies(count=1):
    return [carom.RigidBody(2.0, (0.02, 0.01, 0.03)) for _ in range(count)]


def test_gaps_and_velocities_on_a_plane():
    rotation, omega, x, v = random_motions(np.random.default_rng(0), 1, 3)
    rotation, omega, x, v = np.asarray(rotation[0]), np.asarray(omega[0]), x[0], v[0]
    normal = np.array([0.0, 0.6, 0.8])
    plane = carom.BallPlane([0, 0], CENTERS, RADII, (0.1, 0.0, -1.0), 2 * normal)
    found = carom.System(bodies(), contacts=[plane]).candidates(x)
    place = np.asarray(x[0]) + CENTERS @ rotation.T
    np.testing.assert_allclose(found.gap, (place - [0.1, 0, -1]) @ normal - RADII, atol=ROUNDING)
    moved = jnp.einsum("cipj,cpj->ci", found.rows, v[found.stencil])
    expected = np.asarray(v[0]) + np.cross(omega, place - RADII[:, None] * normal - np.asarray(x[0]))
    np.testing.assert_allclose(moved[:, 0], expected @ normal, atol=ROUNDING)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), np.linalg.norm(expected, axis=1), atol=ROUNDING)


def test_gaps_and_velocities_of_two_balls_and_one_in_space():
    rotation, omega, x, v = (np.asarray(part) for part in random_motions(np.random.default_rng(1), 2, 3))
    centers = np.array([[CENTERS[0], [0.1, 0.2, 0.3]], [CENTERS[1], [2.0, 1.0, 0.0]]])
    contact = carom.BallBall([(0, 1), (1, None)], centers, [[0.1, 0.2], [0.3, 0.4]])
    found = carom.System(bodies(2), contacts=[contact]).candidates(jnp.asarray(x.reshape(8, 3)))
    a, b = (x[k, 0] + centers[0, k] @ rotation[k].T for k in (0, 1))
    normal, other = a - b, x[1, 0] - centers[1, 1]
    gaps = [np.linalg.norm(normal) - 0.3, np.linalg.norm(other) - 0.7]
    np.testing.assert_allclose(found.gap, gaps, atol=ROUNDING)
    # The rate of the gap, and with it the normal velocity, from finite differences of the motion of the centres.
    speed = [v[k, 0] + np.cross(omega[k], c - x[k, 0]) for k, c in ((0, a), (1, b))]
    moved = np.einsum("cipj,cpj->ci", found.rows, v.reshape(8, 3)[found.stencil])
    rates = [(speed[0] - speed[1]) @ normal / np.linalg.norm(normal), v[1, 0] @ other / np.linalg.norm(other)]
    np.testing.assert_allclose(moved[:, 0], rates, atol=ROUNDING)
    # What touches slides: the size of its velocity does not hang on the frame.
    normal = normal / np.linalg.norm(normal)
    touch = [v[k, 0] + np.cross(omega[k], c - x[k, 0] + s * normal) for k, c, s in ((0, a, -0.1), (1, b, 0.2))]
    np.testing.assert_allclose(np.linalg.norm(moved[0]), np.linalg.norm(touch[0] - touch[1]), atol=ROUNDING)


@pytest.mark.parametrize("order", ["forward", "reverse"])
def test_gaps_tell_of_centers_and_radii(order):
    """`dgap/dradius = -1`, `dgap/dcenter = R^T N`."""
    rotation, _, x, _ = random_motions(np.random.default_rng(2), 1, 3)

    def gap(center, radius):
        plane = carom.BallPlane([0], center[None], radius[None], (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        return carom.System(bodies(), contacts=[plane]).gaps(x[0])[0]

    derivative = jax.jacfwd if order == "forward" else jax.jacrev
    by_center, by_radius = derivative(gap, argnums=(0, 1))(jnp.asarray(CENTERS[0]), jnp.asarray(0.1))
    np.testing.assert_allclose(by_center, rotation[0, 2], atol=ROUNDING)
    np.testing.assert_allclose(by_radius, -1, atol=ROUNDING)


@pytest.mark.slow
def test_a_capsule_falls_flat_and_bounces():
    """Both ends land together, without friction: `z = z_0 - u t` before, `r + e u (t - t_1)` after."""
    ends = np.array([[0.0, 0.0, -0.3], [0.0, 0.0, 0.3]])
    system = carom.System(
        bodies(), contacts=[carom.BallPlane([0, 0], ends, 0.1, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))], restitution=0.5
    )
    x = embed_pose(jnp.array([0.0, 0.5, 0.0]), jnp.eye(3))
    v = embed_velocity(jnp.eye(3), jnp.array([1.0, -2.0, 0.0]), jnp.zeros(3))
    motion = carom.simulate(system, x, v, dt=0.02, steps=20, impact="event")
    np.testing.assert_allclose(motion.x[-1, 0], [0.4, 0.1 + 0.5 * 2 * 0.2, 0], atol=1e-9)
    np.testing.assert_allclose(motion.v[-1], jnp.broadcast_to(jnp.array([1.0, 1.0, 0.0]), (4, 3)), atol=1e-9)


def test_what_there_is_to_see():
    contacts = [
        carom.BallPlane([0, 0], CENTERS, RADII, (0.0, 0.0, -1.0), (0.0, 0.0, 1.0)),
        carom.BallBall([(0, None)], [[CENTERS[1], [2.0, 0.0, 0.0]]], [[0.25, 0.5]]),
    ]
    joint = carom.Track(0, carom.place_weights((0.0, 0.0, 0.5)), [[1.0, 0.0, 0.0]], (0.0, 0.0, 0.5))
    system = carom.System([carom.RigidBody(2.0, (0.02, 0.01, 0.03), 0.25)], [joint], contacts)
    x = embed_pose(jnp.zeros(3), jnp.eye(3))
    lines = lines_of(system)
    ends = np.einsum("lsn,nd->lsd", lines.weights, x) + lines.offset
    np.testing.assert_allclose(ends[0], [[0, 0, 0], [0, 0, 0.5]])  # the joint
    # Three axes; rings around the ball at the side and that in space, and a spoke. The third ball is the body's disk.
    assert len(ends) == 1 + 3 + 2 * 24 + 1
    np.testing.assert_allclose(np.linalg.norm(ends[4:28] - CENTERS[0], axis=-1), 0.1)
    np.testing.assert_allclose(ends[28], [[0, 0, 0], CENTERS[0]])
    np.testing.assert_allclose(np.linalg.norm(ends[29:] - [2, 0, 0], axis=-1), 0.5)
    assert len(walls_of(system)) == 1
    still = jnp.zeros(2)
    motion = carom.Trajectory(jnp.stack([x, x]), jnp.zeros((2, 4, 3)), still > 0, still, still.astype(int), still)
    places, closed = touching(system, motion)
    np.testing.assert_allclose(places[0], [[0.3, -0.2, 0.0], [0, 0, -0.25], [0.25, 0, 0]], atol=ROUNDING)
    assert not closed.any()


PLANE = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
BAD = {
    "centers": (lambda: carom.BallPlane([0], CENTERS, 0.1, *PLANE), "BallPlane centers must be 1 places of 3"),
    "radii": (lambda: carom.BallPlane([0, 0], CENTERS, [0.1] * 3, *PLANE), "BallPlane radii must be one or 2"),
    "negative": (lambda: carom.BallPlane([0, 0], CENTERS, -0.1, *PLANE), "radii must be zero or positive lengths"),
    "itself": (lambda: carom.BallBall([(0, 0)], CENTERS[None], [[0.1, 0.1]]), "BallBall pairs two different bodies"),
    "places": (lambda: carom.BallBall([(0, 1)], CENTERS, [[0.1, 0.1]]), "BallBall centers must be 1 pairs of places"),
    "pairs": (lambda: carom.BallBall([(0, 1)], CENTERS[None], [0.1, 0.1]), "BallBall radii must be 1 pairs"),
    "points": (lambda: carom.BallBall([(0, 1)], CENTERS[None], [[0.0, 0.1]]), "radii must be positive lengths in m"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD)
def test_what_cannot_be_is_refused(make, message):
    with refused(message):
        make()


def test_point_masses_have_contacts_of_their_own():
    system = carom.System([carom.PointMass(1.0)], contacts=[carom.BallPlane([0], CENTERS[:1], 0.1, *PLANE)])
    with refused("BallPlane is for rigid bodies; of the bodies [0] some cannot turn. Use DiskPlane or DiskDisk"):
        system.gaps(jnp.ones((1, 3)))
