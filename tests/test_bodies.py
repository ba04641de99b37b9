"""Point masses and rigid bodies as points: mass, energy, poses."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from systems import MOMENTS, disk, free_body, inertia_about_axes, random_motions, random_rotations, refused, sphere

import carom
from carom.mechanics.bodies import (
    BodyTable,
    embed_pose,
    embed_velocity,
    recover_pose,
    recover_velocity,
    total_inverse_mass_matrix,
    total_mass_matrix,
)

# Rounding of a few dozen operations on numbers of order 1.
ROUNDING = 1e-12

BODIES = {
    "point": (2, [carom.PointMass(0.3)]),
    "rigid 2D": (2, [carom.RigidBody(0.3, MOMENTS[2])]),
    "rigid 3D": (3, [carom.RigidBody(0.3, MOMENTS[3])]),
    "disk": (2, [disk(0.1, 0.1)]),
    "sphere": (3, [sphere(0.1, 0.1)]),
    "several": (3, [carom.PointMass(2.0), carom.RigidBody(0.3, MOMENTS[3]), carom.PointMass(0.01)]),
}


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize(("dim", "bodies"), BODIES.values(), ids=BODIES)
def test_the_inverse_mass_matrix_is_the_inverse(dim, bodies):
    mass, inverse = total_mass_matrix(bodies, dim), total_inverse_mass_matrix(bodies, dim)
    np.testing.assert_allclose(mass @ inverse, np.eye(len(mass)), atol=ROUNDING)
    np.testing.assert_array_equal(mass, mass.T)
    assert np.all(np.linalg.eigvalsh(mass) > 0)


def test_bodies_do_not_share_entries_of_the_mass_matrix():
    mass = np.array(total_mass_matrix(BODIES["several"][1], 3))
    assert mass.shape == (6, 6)
    mass[0, 0], mass[5, 5], mass[1:5, 1:5] = 0, 0, 0
    np.testing.assert_array_equal(mass, 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_kinetic_energy_is_the_classical_one(rng, dim):
    system = free_body(dim)
    rotation, omega, _, v = random_motions(rng, 20, dim)
    if dim == 2:
        turning = np.sum(MOMENTS[2]) * np.asarray(omega)[:, 0] ** 2
    else:
        omega_body = np.einsum("bij,bi->bj", rotation, omega)
        turning = omega_body**2 @ inertia_about_axes(MOMENTS[3])
    classical = (0.8 * np.sum(np.asarray(v)[:, 0] ** 2, axis=1) + turning) / 2
    np.testing.assert_allclose(jax.vmap(system.kinetic_energy)(v), classical, rtol=ROUNDING)


@pytest.mark.parametrize(("body", "dim", "factor"), [(disk(2.0, 0.3), 2, 1 / 2), (sphere(2.0, 0.3), 3, 2 / 5)])
def test_round_bodies_have_their_moment_of_inertia(body, dim, factor):
    omega = jnp.ones(1) if dim == 2 else jnp.array([0.0, 1.0, 0.0])
    v = embed_velocity(jnp.eye(dim), jnp.zeros(dim), omega)
    np.testing.assert_allclose(
        jnp.sum(v * (body.mass_matrix(dim) @ v)), factor * 2.0 * 0.3**2, rtol=ROUNDING
    )  # I omega^2


@pytest.mark.parametrize("dim", [2, 3])
def test_embedding_and_recovering_are_inverse(rng, dim):
    rotation, omega, x, v = random_motions(rng, 20, dim)
    position, found_rotation = recover_pose(x)
    velocity, found_omega = recover_velocity(x, v)
    np.testing.assert_array_equal(position, x[:, 0])
    np.testing.assert_allclose(found_rotation, rotation, atol=ROUNDING)
    np.testing.assert_array_equal(velocity, v[:, 0])
    np.testing.assert_allclose(found_omega, omega, atol=ROUNDING)
    np.testing.assert_allclose(embed_pose(position, found_rotation), x, atol=ROUNDING)
    np.testing.assert_allclose(embed_velocity(found_rotation, velocity, found_omega), v, atol=ROUNDING)


def test_one_body_needs_no_batch_axis(rng):
    rotation, omega, x, v = random_motions(rng, 1, 3)
    np.testing.assert_allclose(recover_pose(x[0])[1], rotation[0], atol=ROUNDING)
    np.testing.assert_allclose(recover_velocity(x[0], v[0])[1], omega[0], atol=ROUNDING)


@pytest.mark.parametrize("dim", [2, 3])
def test_embedded_velocity_is_the_derivative_of_the_embedded_pose(rng, dim):
    rotation, omega, x, v = random_motions(rng, 5, dim)
    if dim == 2:
        cross = omega[..., None] * jnp.array([[0.0, -1.0], [1.0, 0.0]])
    else:
        cross = -jnp.cross(omega[:, None], jnp.eye(3))
        np.testing.assert_allclose(cross[0] @ jnp.ones(3), np.cross(omega[0], np.ones(3)), atol=ROUNDING)
    _, expected = jax.jvp(embed_pose, (x[:, 0], rotation), (v[:, 0], cross @ rotation))
    np.testing.assert_allclose(v, expected, atol=ROUNDING)


@pytest.mark.parametrize("dim", [2, 3])
def test_recovered_rotation_of_points_that_drifted_is_the_nearest(rng, dim):
    rotation = random_rotations(rng, 1, dim)[0]
    x = embed_pose(jnp.zeros(dim), rotation) + 0.05 * rng.standard_normal((dim + 1, dim))
    found = recover_pose(x)[1]
    np.testing.assert_allclose(found @ found.T, np.eye(dim), atol=ROUNDING)
    np.testing.assert_allclose(jnp.linalg.det(found), 1, atol=ROUNDING)
    if dim == 3:  # SciPy solves the same (Wahba's) problem, in 3D only
        axes = np.asarray(x[1:] - x[0])
        np.testing.assert_allclose(found, Rotation.align_vectors(axes, np.eye(3))[0].as_matrix(), atol=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_weights_give_place_and_velocity_of_material_points(rng, dim):
    bodies = [carom.PointMass(1.0), carom.RigidBody(1.0, MOMENTS[dim])]
    table = BodyTable.of(bodies, dim)
    _, omega, body_x, body_v = random_motions(rng, 1, dim)
    x = jnp.concatenate([jnp.ones((1, dim)), body_x[0]])
    v = jnp.concatenate([jnp.full((1, dim), 2.0), body_v[0]])
    offset = jnp.asarray(rng.standard_normal((3, dim)))
    body = np.array([1, 0, 1])
    local, stencil = table.weights(x, body, offset), table.stencil(body)
    weights = jnp.zeros((3, len(x))).at[np.arange(3)[:, None], stencil].add(local)
    arm = np.asarray(offset)[[0, 2]]
    spin = omega[0] * np.stack([-arm[:, 1], arm[:, 0]], axis=1) if dim == 2 else np.cross(omega[0], arm)
    np.testing.assert_allclose(jnp.sum(weights, axis=1), 1, atol=ROUNDING)
    np.testing.assert_allclose((weights @ x)[np.array([0, 2])], body_x[0, 0] + arm, atol=ROUNDING)
    np.testing.assert_allclose((weights @ v)[np.array([0, 2])], body_v[0, 0] + spin, atol=ROUNDING)
    np.testing.assert_allclose(weights[1] @ v, v[0], atol=ROUNDING)  # a point mass does not turn


def test_table_lists_points_in_the_order_of_the_bodies():
    table = BodyTable.of(BODIES["several"][1], 3)
    assert table.center == (0, 1, 5)
    assert table.axes == ((0, 0, 0), (2, 3, 4), (5, 5, 5))
    assert table.n_points == 6


# --- free flight against Euler's equations -----------------------------------------------------------------------


def euler_flight(moments, rotation, omega_body, times):
    """Rotations and angular velocities (world frame) of a free body, from Euler's equations in its own frame."""
    inertia = inertia_about_axes(moments)

    def rate(_, state):
        R, w = state[:9].reshape(3, 3), state[9:]
        spin = np.cross(np.eye(3), w)  # rows e_i x w, which is the cross-product matrix of w
        return np.concatenate([(R @ spin).ravel(), np.cross(inertia * w, w) / inertia])

    start = np.concatenate([np.ravel(rotation), omega_body])
    out = solve_ivp(rate, (0, times[-1]), start, method="DOP853", t_eval=times, rtol=1e-13, atol=1e-13)
    rotations = out.y[:9].T.reshape(-1, 3, 3)
    return rotations, np.einsum("tij,tj->ti", rotations, out.y[9:].T)


def test_free_flight_follows_eulers_equations(rng):
    # Turning about the middle axis, which is unstable: the body tumbles.
    omega_body = np.array([1.0, 5.0, 0.5])
    rotation = random_rotations(rng, 1, 3)[0]
    velocity = jnp.array([0.3, -0.2, 0.5])
    x0 = embed_pose(jnp.zeros(3), rotation)
    v0 = embed_velocity(rotation, velocity, rotation @ omega_body)
    out = carom.simulate(free_body(3), x0, v0, dt=1e-3, steps=1000)
    rotations, omega = euler_flight(MOMENTS[3], rotation, omega_body, np.asarray(out.time))
    # RK4: (5 rad/s 1 ms)^4 = 6e-10 a radian turned. The oracle is good to 1e-12.
    np.testing.assert_allclose(recover_pose(out.x)[1], rotations, atol=1e-8)
    np.testing.assert_allclose(recover_velocity(out.x, out.v)[1], omega, atol=1e-8)
    np.testing.assert_allclose(out.x[:, 0], out.time[:, None] * velocity, atol=1e-11)
    assert np.ptp(np.asarray(omega)[:, 0]) > 1  # it did tumble


# --- bad input ---------------------------------------------------------------------------------------------------

BAD_BODIES = {
    "negative mass": (lambda: carom.PointMass(-1.0), "mass must be a positive number"),
    "no mass": (lambda: carom.PointMass(0.0), "mass must be a positive number"),
    "NaN mass": (lambda: carom.PointMass(np.nan), "mass must be a positive number"),
    "negative radius": (lambda: carom.PointMass(1.0, -0.1), "radius must be"),
    "rigid: negative mass": (lambda: carom.RigidBody(-1.0, (0.1, 0.1)), "mass must be a positive number"),
    "rigid: negative moment": (lambda: carom.RigidBody(1.0, (0.1, -0.1)), "moments must be positive"),
    "rigid: negative radius": (lambda: carom.RigidBody(1.0, (0.1, 0.1), -1.0), "radius must be"),
    "rigid: one moment": (lambda: carom.RigidBody(1.0, 0.1), "moments must"),
    "rigid: four moments": (lambda: carom.RigidBody(1.0, (0.1,) * 4), "moments must"),
    "two masses": (lambda: carom.PointMass((1.0, 2.0)), "mass must be"),
}


@pytest.mark.parametrize(("make", "message"), BAD_BODIES.values(), ids=BAD_BODIES)
def test_bad_bodies_are_refused(make, message):
    with refused(message):
        make()
