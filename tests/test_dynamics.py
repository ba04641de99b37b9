"""Constrained Lagrangian and Hamiltonian dynamics against minimal coordinates, each other, and differences."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import GRAVITY, free_body, heavy_top, random_motions

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.mechanics.dynamics import FIELDS, saddle_point
from carom.tasks.pendulums import chain_state

LENGTHS, MASSES = np.array([0.35, 0.4, 0.35]), np.array([0.1, 0.2, 0.15])


def field_of(system, formulation, x, v, push=None):
    """Rates of `x` and `v` of a system without contact, with an added force `push`."""
    force = -jax.grad(system.potential_energy)(x)
    if push is not None:
        force = force + push
    inverse = system.inverse_mass_matrix()
    return FIELDS[formulation](x, v, force=force, inverse_mass=inverse, constraints=system.constraints)


@eqx.filter_jit
def rates(system, formulation, x, v, push):
    return jax.vmap(partial(field_of, system, formulation))(x, v, push)


def chain_motion(rng, count):
    angles, spins = rng.uniform(-np.pi, np.pi, (count, 3)), rng.standard_normal((count, 3))
    return (angles, spins, *chain_state(jnp.asarray(angles), jnp.asarray(spins), jnp.asarray(LENGTHS)))


def motions(name, count=8):
    """A system and `count` states that obey its constraints."""
    rng = np.random.default_rng(5)
    if name == "chain":
        return carom.task("cp3"), *chain_motion(rng, count)[2:]
    if name == "top":
        rotation, omega, _, _ = random_motions(rng, count, 3)
        center = 0.3 * rotation[:, :, 2]
        return (
            heavy_top(arm=0.3),
            embed_pose(center, rotation),
            embed_velocity(rotation, jnp.cross(omega, center), omega),
        )
    dim = {"body 2D": 2, "body 3D": 3}[name]
    return free_body(dim), *random_motions(rng, count, dim)[2:]


NAMES = ("chain", "body 2D", "body 3D", "top")


def chain_accelerations(angles, spins):
    """Angular accelerations of a chain of pendulums, from its equations of motion in angles.

    `sum_j c_ij l_i l_j (cos(a_i - a_j) a_j'' + sin(a_i - a_j) a_j'^2) + c_ii g l_i sin a_i = 0`, where `c_ij` is the
    mass that hangs below both joints.
    """
    below = np.cumsum(MASSES[::-1])[::-1]
    c = below[np.maximum.outer(np.arange(3), np.arange(3))] * np.outer(LENGTHS, LENGTHS)
    difference = angles[:, None] - angles
    rhs = -np.sum(c * np.sin(difference) * spins**2, axis=1) - below * GRAVITY * LENGTHS * np.sin(angles)
    return np.linalg.solve(c * np.cos(difference), rhs)


@pytest.mark.parametrize("formulation", FIELDS)
def test_chain_accelerates_as_in_minimal_coordinates(formulation):
    angles, spins, x, v = chain_motion(np.random.default_rng(2), 20)
    accelerations = np.array([chain_accelerations(a, s) for a, s in zip(angles, spins, strict=True)])
    turn, radial = np.stack([np.cos(angles), np.sin(angles)], -1), np.stack([-np.sin(angles), np.cos(angles)], -1)
    links = LENGTHS[:, None] * (turn * accelerations[..., None] + radial * (spins**2)[..., None])
    x_rate, v_rate = rates(carom.task("cp3"), formulation, x, v, None)
    np.testing.assert_allclose(x_rate, v, atol=1e-12)
    # The saddle-point matrix has a condition number up to 1e3 where the chain is folded.
    np.testing.assert_allclose(v_rate, np.cumsum(links, axis=1), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", NAMES)
def test_lagrangian_and_hamiltonian_agree_where_constraints_hold(name):
    system, x, v = motions(name)
    push = jnp.asarray(np.random.default_rng(6).standard_normal(x.shape))
    one, other = (rates(system, formulation, x, v, push) for formulation in FIELDS)
    np.testing.assert_allclose(one[0], other[0], atol=1e-11)
    scale = np.max(np.abs(one[1]))
    np.testing.assert_allclose(one[1], other[1], atol=1e-11 * scale)  # two solves with a condition number of 1e3


@pytest.mark.parametrize("formulation", FIELDS)
@pytest.mark.parametrize("name", NAMES)
def test_accelerations_keep_the_constraints_and_only_forces_do_work(name, formulation):
    system, x, v = motions(name)
    push = jnp.asarray(np.random.default_rng(6).standard_normal(x.shape))
    x_rate, v_rate = rates(system, formulation, x, v, push)

    def second_derivative(x, v, a):
        rate = lambda x, v: jax.jvp(system.constraints, (x,), (v,))[1]  # noqa: E731
        return jax.jvp(rate, (x, v), (v, a))[1]

    scale = np.max(np.abs(v_rate))
    np.testing.assert_allclose(jax.vmap(second_derivative)(x, x_rate, v_rate), 0, atol=1e-11 * scale)
    power = jax.vmap(lambda x, v, dx, dv: jax.jvp(system.energy, (x, v), (dx, dv))[1])(x, v, x_rate, v_rate)
    np.testing.assert_allclose(power, jnp.sum(push * v, axis=(1, 2)), atol=1e-11 * scale)


def test_hamiltonian_positions_obey_the_velocity_constraint_from_anywhere():
    # S.7 projects momenta that do not fit; a Lagrangian field takes the velocity as it is.
    system, x, v = motions("chain")
    wild = v + jnp.asarray(np.random.default_rng(8).standard_normal(v.shape))
    x_rate, _ = rates(system, "hamiltonian", x, wild, None)
    np.testing.assert_allclose(
        jax.vmap(jax.jacrev(system.constraints))(x).reshape(-1, 3, 6) @ x_rate.reshape(-1, 6, 1), 0, atol=1e-11
    )
    np.testing.assert_array_equal(rates(system, "lagrangian", x, wild, None)[0], wild)


@pytest.mark.parametrize("formulation", FIELDS)
def test_without_constraints_it_is_newtons_law(formulation):
    system = carom.System([carom.PointMass(0.5), carom.PointMass(2.0)], potential=carom.Gravity((0.0, -GRAVITY)))
    x, v = jnp.zeros((2, 2)), jnp.ones((2, 2))
    x_rate, v_rate = field_of(system, formulation, x, v, jnp.ones((2, 2)))
    np.testing.assert_array_equal(x_rate, v)
    np.testing.assert_allclose(v_rate, [[2.0, 2.0 - GRAVITY], [0.5, 0.5 - GRAVITY]], rtol=1e-14)


@pytest.mark.parametrize("name", NAMES)
def test_projected_velocities_are_the_nearest_that_obey(name):
    system, x, _ = motions(name, 1)
    saddle = saddle_point(system.constraints, x[0], system.inverse_mass_matrix())
    wild = jnp.asarray(np.random.default_rng(9).standard_normal((4, *x[0].shape)))
    found = saddle.project(wild)
    np.testing.assert_allclose(saddle.to_rows(found), 0, atol=1e-11)
    np.testing.assert_allclose(saddle.project(found), found, atol=1e-11)
    # What was taken away is at right angles, in the metric of the mass, to everything that obeys.
    product = jnp.einsum("aid,ij,bjd->ab", found, system.mass_matrix(), wild - found)
    np.testing.assert_allclose(product, 0, atol=1e-11)


@pytest.mark.parametrize("formulation", FIELDS)
@pytest.mark.parametrize("name", ["chain", "top"])
def test_derivatives_of_the_field(name, formulation):
    """The factor inside of the saddle-point solve is held constant: the derivative must not notice."""
    system, x, v = motions(name, 1)
    start = (x[0], v[0])
    rng = np.random.default_rng(10)
    direction, weight = (tuple(jnp.asarray(rng.standard_normal(x[0].shape)) for _ in start) for _ in range(2))

    def loss(state):
        return sum(jnp.sum(w * r) for w, r in zip(weight, field_of(system, formulation, *state), strict=True))

    @jax.jit
    def along(h):
        return loss(jax.tree.map(lambda s, d: s + h * d, start, direction))

    h = 1e-5
    difference = (along(h) - along(-h)) / (2 * h)  # error h^2 f''' / 6 = 2e-11 f''' and rounding 1e-16 f / h
    _, forward = jax.jvp(loss, (start,), (direction,))
    backward = sum(jnp.sum(g * d) for g, d in zip(jax.grad(loss)(start), direction, strict=True))
    np.testing.assert_allclose(forward, difference, rtol=1e-6)
    np.testing.assert_allclose(backward, forward, rtol=1e-11)
