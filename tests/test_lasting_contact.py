"""Contact that lasts: what rests, slides, rolls and is stacked, against closed forms, in every frame and size."""

from importlib.util import find_spec
from pathlib import Path

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
LENGTHS, MASSES = np.array([1.0, 1e-3, 1e3]), np.array([1.0, 1e-6, 1e6])
"""Sizes of every scene: with times by the root of lengths all its motions are the same."""


def in_other_units(points, unit, unit_of_axes, points_of_body):
    """Points (..., n, d), or their velocities, in other units: the axes of bodies stay of 1 m, whatever their size."""
    bodies = points.reshape(*points.shape[:-2], -1, points_of_body, points.shape[-1])
    center = bodies[..., :1, :]
    return (center * unit + (bodies - center) * unit_of_axes).reshape(points.shape)


def in_every_size(scene, x0, v0=None, *, dt, steps, points_of_body=1, **options):
    """The motion of `scene(length, mass)` from states of the size 1, in units of each size: x, v (size, ..., n, d).

    Also kinetic energies, in units of the weight times the length. One program for all sizes.
    """
    v0 = jnp.zeros_like(x0) if v0 is None else v0

    def moved(length, mass):
        time = jnp.sqrt(length)
        system = scene(length, mass)
        x = in_other_units(x0, length, 1.0, points_of_body)
        v = in_other_units(v0, length / time, 1 / time, points_of_body)
        motion = carom.simulate(system, x, v, dt=dt * time, steps=steps, **options)
        energy = system.kinetic_energy
        for _ in motion.v.shape[:-2]:
            energy = jax.vmap(energy)
        kinetic = energy(motion.v) / (mass * length)
        x = in_other_units(motion.x, 1 / length, 1.0, points_of_body)
        v = in_other_units(motion.v, time / length, time, points_of_body)
        return x, v, kinetic, motion.residual, motion.overflow

    x, v, kinetic, residual, overflow = jax.jit(jax.vmap(moved))(jnp.asarray(LENGTHS), jnp.asarray(MASSES))
    assert jnp.max(residual) < 1e-8
    assert not overflow.any()
    return np.asarray(x), np.asarray(v), np.asarray(kinetic)


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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("impact", "dt", "steps"),
    [
        pytest.param("step", 0.01, 1000, marks=pytest.mark.ci_budget),
        ("step", 0.001, 10_000),
        ("event", 0.01, 1000),
        ("event", 0.001, 1000),
    ],
)
def test_what_friction_holds_stays_where_it_is(impact, dt, steps):
    def scene(length, mass):
        return on_slope(carom.PointMass(mass, 0.1 * length), 0.6)

    x, v, _ = in_every_size(scene, BLOCK, dt=dt, steps=steps, impact=impact)
    assert np.max(np.abs(x - BLOCK)) < 1e-9
    assert np.max(np.abs(v)) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("model", ["coulomb", "lcp"])
def test_a_block_slides_as_it_should(model):
    """Constant forces: exact but for rounding, and without a hop."""

    def scene(length, mass):
        return on_slope(carom.PointMass(mass, 0.1 * length), 0.2, contact_model=model)

    x, v, _ = in_every_size(scene, BLOCK, dt=0.01, steps=100)
    acceleration = GRAVITY * (np.sin(SLOPE) - 0.2 * np.cos(SLOPE))
    time = np.broadcast_to(0.01 * np.arange(101), x.shape[:2])
    moved, speed = x[:, :, 0] - np.asarray(BLOCK[0]), v[:, :, 0]
    np.testing.assert_allclose(moved @ -UP, acceleration * time**2 / 2, atol=1e-12)
    np.testing.assert_allclose(speed @ -UP, acceleration * time, atol=1e-12)
    np.testing.assert_allclose(moved @ OUT, 0, atol=1e-13)


@pytest.mark.slow
def test_a_disk_rolls_down_a_slope():
    """With 2/3 g sin: within 1e-4 at 10 ms, and of second order in the time step."""
    x0 = embed_pose(jnp.asarray(0.1 * OUT), jnp.eye(2))

    def scene(length, mass):
        return on_slope(disk(mass, 0.1 * length), 1.0)

    errors = []
    for dt in (0.02, 0.01):
        x, _, _ = in_every_size(scene, x0, dt=dt, steps=round(1 / dt), points_of_body=3)
        moved = x[:, :, 0] - 0.1 * OUT
        far = moved[:, -1] @ -UP / (GRAVITY * np.sin(SLOPE) / 3)
        np.testing.assert_allclose(far, far[0], rtol=1e-9)
        assert np.max(np.abs(moved @ OUT)) < 1e-12
        errors.append(np.abs(far - 1))
    assert np.all(errors[1] < 1e-4)
    assert np.all(errors[1] < errors[0] / 3)


def ball_on_floor(length=1.0, mass=1.0, **options):
    return carom.System(
        bodies=[sphere(mass, 0.1 * length)],
        contacts=[carom.BallPlane([0], jnp.zeros((1, 3)), 0.1 * length, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))],
        potential=carom.Gravity((0.0, 0.0, -GRAVITY)),
        friction=0.5,
        **options,
    )


@pytest.mark.slow
def test_a_ball_that_slides_ends_rolling():
    """Angular momentum about the floor is kept: 5/7 of its speed, whatever friction is."""
    x0 = embed_pose(jnp.array([0.0, 0.0, 0.1]), jnp.eye(3))
    v0 = embed_velocity(jnp.eye(3), jnp.array([2.0, 0.0, 0.0]), jnp.zeros(3))
    _, v, _ = in_every_size(ball_on_floor, x0, v0, dt=0.01, steps=50, points_of_body=4)
    np.testing.assert_allclose(v[:, -1, 0], np.tile([10 / 7, 0, 0], (3, 1)), atol=1e-5)
    np.testing.assert_allclose(v, v[:1].repeat(3, 0), atol=1e-9)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_dropped_ball_has_no_sideways_speed_whatever_its_axes():
    turns = Rotation.random(100, random_state=0).as_matrix()
    x0 = jnp.stack([embed_pose(jnp.array([0.0, 0.0, 0.15]), jnp.asarray(turn)) for turn in turns])
    x, v, _ = in_every_size(ball_on_floor, x0, dt=0.005, steps=60, points_of_body=4)
    # It has fallen and been stopped.
    assert np.all(x[:, :, -1, 0, 2] < 0.11)
    assert np.all(np.abs(v[:, :, -1, 0]) < 0.05)
    assert np.max(np.abs(v[..., 0, :2])) < 1e-12
    spin = (v[..., 1:, :] - v[..., :1, :]) * 0.1
    assert np.max(np.abs(spin)) < 1e-12
    np.testing.assert_allclose(x[..., 0, :], np.broadcast_to(x[:1, :1, :, 0], x[..., 0, :].shape), atol=1e-12)


def pyramid():
    """Ten disks in rows of 4, 3, 2 and 1: a scene, and their place."""
    radius = 0.1
    places = np.array([((2 * j + i) * radius, radius + i * 3**0.5 * radius) for i in range(4) for j in range(4 - i)])
    pairs = [(a, b) for a in range(10) for b in range(a) if np.hypot(*(places[a] - places[b])) < 2.5 * radius]

    def scene(length, mass):
        return carom.System(
            bodies=[disk(mass, radius * length)] * 10,
            contacts=[carom.DiskDisk(pairs), carom.DiskPlane(range(4), (0.0, 0.0), (0.0, 1.0))],
            potential=carom.Gravity((0.0, -GRAVITY)),
            friction=0.6,
        )

    return scene, jnp.concatenate([embed_pose(jnp.asarray(place), jnp.eye(2)) for place in places])


def tower():
    """Five boxes on a floor, each with a ball in each corner: a scene, and their place."""
    half, inner, radius = 0.1, 0.08, 0.02
    between = [((side * inner, inner), (side * inner, -inner)) for _ in range(4) for side in (-1, 1)]

    def scene(length, mass):
        corners = length * jnp.array([(-inner, -inner), (inner, -inner)])
        return carom.System(
            bodies=[carom.RigidBody(mass, (mass * (half * length) ** 2 / 3,) * 2)] * 5,
            contacts=[
                carom.BallPlane([0, 0], corners, radius * length, (0.0, 0.0), (0.0, 1.0)),
                carom.BallBall(
                    [(k, k + 1) for k in range(4) for _ in range(2)],
                    length * jnp.array(between),
                    length * jnp.full((8, 2), radius),
                ),
            ],
            potential=carom.Gravity((0.0, -GRAVITY)),
            friction=0.5,
        )

    return scene, jnp.concatenate([embed_pose(jnp.array([0.0, half * (1 + 2 * k)]), jnp.eye(2)) for k in range(5)])


def heavy_on_light():
    """A ball of 1000 times the mass that stands exactly on another, in 3D: an unstable equilibrium."""

    def scene(length, mass):
        return carom.System(
            bodies=[sphere(mass, 0.1 * length), sphere(1000 * mass, 0.1 * length)],
            contacts=[
                carom.BallPlane([0, 1], jnp.zeros((2, 3)), 0.1 * length, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
                carom.BallBall([(0, 1)], jnp.zeros((1, 2, 3)), length * jnp.array([[0.1, 0.1]])),
            ],
            potential=carom.Gravity((0.0, 0.0, -GRAVITY)),
            friction=0.5,
        )

    return scene, jnp.concatenate([embed_pose(jnp.array([0.0, 0.0, z]), jnp.eye(3)) for z in (0.1, 0.3)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stack", "dt", "steps"),
    [
        pytest.param(tower, 0.01, 1000, marks=pytest.mark.ci_budget),
        (tower, 0.01, 6000),
        pytest.param(pyramid, 0.01, 6000, marks=pytest.mark.timeout(3600)),
        (heavy_on_light, 0.005, 2000),
    ],
)
def test_what_is_stacked_rests(stack, dt, steps):
    scene, x0 = stack()
    x, _, kinetic = in_every_size(scene, x0, dt=dt, steps=steps, points_of_body=x0.shape[1] + 1)
    assert np.max(np.abs(x - x0)) < 1e-6
    assert np.max(kinetic) < 1e-12


@pytest.mark.slow
@pytest.mark.skipif(find_spec("gymnasium") is None or find_spec("mujoco") is None, reason="needs gymnasium and mujoco")
def test_a_hopper_stands_on_its_foot():
    """gymnasium's, which falls from where its file has it; what carom cannot represent is left out."""
    import gymnasium

    path = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets" / "hopper.xml"
    ignored = ("actuators", "limits", "damping", "armature", "contacts", "margin")
    model = carom.load_mujoco(path, ignore=ignored)
    motion = carom.simulate(model.system, model.x0, model.v0, dt=0.002, steps=2500)
    gap = np.asarray(jax.vmap(model.system.gaps)(motion.x))
    assert np.max(np.abs(gap[-500:].min(axis=1))) < 1e-4
    assert np.max(np.abs(motion.v[-500:])) < 1e-6


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
