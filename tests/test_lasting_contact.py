"""Contact that lasts: what rests, slides, rolls and is stacked, against closed forms, in every frame and size."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from systems import GRAVITY, disk, sphere

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity

SLOPE = np.radians(20.0)
OUT, UP = np.array([-np.sin(SLOPE), np.cos(SLOPE)]), np.array([np.cos(SLOPE), np.sin(SLOPE)])


def on_slope(body, friction, **options):
    """A round body in the plane on a slope of 20 degrees."""
    return carom.System(
        bodies=[body],
        contacts=[carom.DiskPlane([0], (0.0, 0.0), OUT)],
        potential=carom.Gravity((0.0, -GRAVITY)),
        friction=friction,
        **options,
    )


BLOCK = jnp.array([0.1 * OUT])
REST = jnp.zeros((1, 2))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("impact", "length", "mass"),
    [
        pytest.param("step", 1.0, 1.0, marks=pytest.mark.ci_budget),
        ("step", 1e-3, 1e-6),
        ("step", 1e3, 1e6),
        ("event", 1.0, 1.0),
        ("event", 1e-3, 1e-6),
    ],
)
def test_what_friction_holds_stays_where_it_is(impact, length, mass):
    """For 10 s; all lengths times `length`, and times its root in time: the same motion."""
    system = on_slope(carom.PointMass(mass, 0.1 * length), 0.6)
    for dt in (0.01, 0.001):
        steps = round(10 / dt) if length == 1.0 and impact == "step" else 500
        motion = carom.simulate(
            system, BLOCK * length, REST, dt=dt * length**0.5, steps=steps, impact=impact, max_events=4
        )
        assert jnp.max(jnp.abs(motion.x - BLOCK * length)) < 1e-9 * length
        assert jnp.max(jnp.abs(motion.v)) < 1e-9 * length**0.5


@pytest.mark.slow
@pytest.mark.parametrize("model", ["coulomb", "lcp"])
def test_a_block_slides_as_it_should(model):
    """Constant forces: exact but for rounding, and without a hop."""
    motion = carom.simulate(
        on_slope(carom.PointMass(1.0, 0.1), 0.2, contact_model=model), BLOCK, REST, dt=0.01, steps=100
    )
    acceleration = GRAVITY * (np.sin(SLOPE) - 0.2 * np.cos(SLOPE))
    time = np.asarray(motion.time)
    moved = np.asarray(motion.x[:, 0] - BLOCK[0])
    np.testing.assert_allclose(moved @ -UP, acceleration * time**2 / 2, atol=1e-12)
    np.testing.assert_allclose(np.asarray(motion.v[:, 0]) @ -UP, acceleration * time, atol=1e-12)
    np.testing.assert_allclose(moved @ OUT, 0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_disk_rolls_down_a_slope():
    """With 2/3 g sin: within 1e-4 at 10 ms, and of second order in the time step."""
    system = on_slope(disk(), 1.0)
    x0 = embed_pose(jnp.asarray(0.1 * OUT), jnp.eye(2))
    errors = []
    for dt in (0.02, 0.01):
        motion = carom.simulate(system, x0, jnp.zeros_like(x0), dt=dt, steps=round(1 / dt))
        far = float((motion.x[-1, 0] - x0[0]) @ -UP) / (GRAVITY * np.sin(SLOPE) / 3)
        errors.append(abs(far - 1))
        assert jnp.max(jnp.abs((motion.x[:, 0] - x0[0]) @ OUT)) < 1e-12
    assert errors[1] < 1e-4
    assert errors[1] < errors[0] / 3


def ball_on_floor(**options):
    return carom.System(
        bodies=[sphere()],
        contacts=[carom.BallPlane([0], jnp.zeros((1, 3)), 0.1, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))],
        potential=carom.Gravity((0.0, 0.0, -GRAVITY)),
        friction=0.5,
        **options,
    )


@pytest.mark.slow
def test_a_ball_that_slides_ends_rolling():
    """Angular momentum about the floor is kept: 5/7 of its speed, whatever friction is."""
    x0 = embed_pose(jnp.array([0.0, 0.0, 0.1]), jnp.eye(3))
    v0 = embed_velocity(jnp.eye(3), jnp.array([2.0, 0.0, 0.0]), jnp.zeros(3))
    motion = carom.simulate(ball_on_floor(), x0, v0, dt=0.01, steps=50)
    np.testing.assert_allclose(motion.v[-1, 0], [10 / 7, 0, 0], atol=1e-5)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_dropped_ball_has_no_sideways_speed_whatever_its_axes():
    turns = Rotation.random(100, random_state=0).as_matrix()
    x0 = jnp.stack([embed_pose(jnp.array([0.0, 0.0, 0.15]), jnp.asarray(turn)) for turn in turns])
    motion = carom.simulate(ball_on_floor(), x0, jnp.zeros_like(x0), dt=0.005, steps=60)
    assert motion.contact.any()
    assert jnp.max(jnp.abs(motion.v[:, :, 0, :2])) < 1e-12
    spin = (motion.v[:, :, 1:] - motion.v[:, :, :1]) * 0.1
    assert jnp.max(jnp.abs(spin)) < 1e-12
    np.testing.assert_allclose(
        motion.x[:, :, 0], jnp.broadcast_to(motion.x[:1, :, 0], motion.x[:, :, 0].shape), atol=1e-12
    )


def pyramid(length=1.0, mass=1.0):
    """Ten disks in rows of 4, 3, 2 and 1, and their place."""
    radius = 0.1 * length
    places = np.array([((2 * j + i) * radius, radius + i * 3**0.5 * radius) for i in range(4) for j in range(4 - i)])
    pairs = [(a, b) for a in range(10) for b in range(a) if np.hypot(*(places[a] - places[b])) < 2.5 * radius]
    system = carom.System(
        bodies=[disk(mass, radius)] * 10,
        contacts=[carom.DiskDisk(pairs), carom.DiskPlane(range(4), (0.0, 0.0), (0.0, 1.0))],
        potential=carom.Gravity((0.0, -GRAVITY)),
        friction=0.6,
    )
    return system, jnp.concatenate([embed_pose(jnp.asarray(place), jnp.eye(2)) for place in places])


def tower():
    """Five boxes on a floor, each with a ball in each corner, and their place."""
    half, inner, radius = 0.1, 0.08, 0.02
    between = [((side * inner, inner), (side * inner, -inner)) for _ in range(4) for side in (-1, 1)]
    system = carom.System(
        bodies=[carom.RigidBody(1.0, (half**2 / 3,) * 2)] * 5,
        contacts=[
            carom.BallPlane([0, 0], [(-inner, -inner), (inner, -inner)], radius, (0.0, 0.0), (0.0, 1.0)),
            carom.BallBall(
                [(k, k + 1) for k in range(4) for _ in range(2)], np.array(between), np.full((8, 2), radius)
            ),
        ],
        potential=carom.Gravity((0.0, -GRAVITY)),
        friction=0.5,
    )
    return system, jnp.concatenate([embed_pose(jnp.array([0.0, half * (1 + 2 * k)]), jnp.eye(2)) for k in range(5)])


def heavy_on_light():
    """A ball of 1000 kg that stands exactly on one of 1 kg, in 3D, and their place: an unstable equilibrium."""
    system = carom.System(
        bodies=[sphere(1.0), sphere(1000.0)],
        contacts=[
            carom.BallPlane([0, 1], jnp.zeros((2, 3)), 0.1, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
            carom.BallBall([(0, 1)], jnp.zeros((1, 2, 3)), [[0.1, 0.1]]),
        ],
        potential=carom.Gravity((0.0, 0.0, -GRAVITY)),
        friction=0.5,
    )
    return system, jnp.concatenate([embed_pose(jnp.array([0.0, 0.0, z]), jnp.eye(3)) for z in (0.1, 0.3)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scene", "dt", "steps"),
    [
        pytest.param(tower, 0.01, 1000, marks=pytest.mark.ci_budget),
        (tower, 0.01, 6000),
        pytest.param(pyramid, 0.01, 6000, marks=pytest.mark.timeout(1800)),
        (heavy_on_light, 0.005, 2000),
    ],
)
def test_what_is_stacked_rests(scene, dt, steps):
    system, x0 = scene()
    motion = carom.simulate(system, x0, jnp.zeros_like(x0), dt=dt, steps=steps)
    assert jnp.max(jnp.abs(motion.x - x0)) < 1e-6
    assert jnp.max(jax.vmap(system.kinetic_energy)(motion.v)) < 1e-12


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.parametrize("impact", ["step", "event"])
def test_a_ball_comes_to_rest_and_never_gains_energy(impact):
    """By events to rounding; by steps but for the depth that is undone, a share of a step at the speed of impact."""
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.1)],
        contacts=[carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0))],
        potential=carom.Gravity((0.0, -GRAVITY)),
        friction=0.3,
        restitution=0.5,
    )
    motion = carom.simulate(system, jnp.array([[0.0, 0.5]]), jnp.array([[1.0, 0.0]]), dt=0.01, steps=300, impact=impact)
    energy = np.asarray(system.energy(motion.x, motion.v))
    np.testing.assert_allclose(motion.x[-1, 0, 1], 0.1, atol=1e-10)
    np.testing.assert_allclose(motion.v[-1], 0, atol=1e-10)
    assert np.max(energy) <= energy[0] * (1 + 1e-12)
    if impact == "event":
        assert np.max(np.diff(energy)) < 1e-12 * energy[0]


@pytest.mark.slow
def test_derivatives_through_lasting_contact_are_those_of_differences():
    """By friction and by the speed at the start, forward and reverse: a ball that slides, then rolls; and one held."""
    x0 = embed_pose(jnp.array([0.0, 0.0, 0.1]), jnp.eye(3))
    system = ball_on_floor()

    def end(parameters):
        friction, speed = parameters
        given = carom.System(system.bodies, (), system.contacts, system.potential, friction, 0.0)
        v0 = embed_velocity(jnp.eye(3), jnp.array([1.0, 0.0, 0.0]) * speed, jnp.zeros(3))
        motion = carom.simulate(given, x0, v0, dt=0.01, steps=20)
        return jnp.stack([motion.x[-1, 0, 0], motion.v[-1, 0, 0]])

    end = jax.jit(end)
    at = jnp.array([0.1, 2.0])  # slides to the end
    forward, reverse = jax.jacfwd(end)(at), jax.jacrev(end)(at)
    step = 1e-5
    differences = jnp.stack([(end(at + step * e) - end(at - step * e)) / (2 * step) for e in jnp.eye(2)], axis=1)
    np.testing.assert_allclose(forward, differences, atol=1e-6)
    np.testing.assert_allclose(reverse, forward, atol=1e-9)
