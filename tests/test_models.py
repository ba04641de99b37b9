"""Unknowns and learned potentials, and the file that holds a learned model."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import carom
from carom.learning.model_file import load_model_into, read_model_header
from carom.learning.training.optimizer import Rates, make_optimizer
from carom.learning.unknowns.models import NeuralPotential, Unknowns, mass_ratios


@pytest.fixture(scope="module")
def unknowns():
    potential = NeuralPotential(3, 2, width=8, depth=2, key=jax.random.key(0))
    return Unknowns(jnp.log(jnp.array([3.0, 0.5])), jnp.array([0.7]), jnp.array([0.2]), potential)


def test_assemble_fills_in_every_unknown_and_keeps_geometry(cp3, unknowns):
    system = unknowns.assemble(cp3)
    assert np.allclose(mass_ratios(system), [1, 3, 0.5], rtol=1e-12)
    assert np.allclose(system.masses[0], cp3.masses[0])
    assert system.friction.tolist() == [0.7]
    assert system.restitution.tolist() == [0.2]
    assert np.array_equal(system.radii, cp3.radii)
    assert isinstance(system.potential, NeuralPotential)


def test_what_is_known_stays_the_skeletons(cp3):
    system = Unknowns(None, None, jnp.array([0.2]), None).assemble(cp3)
    assert np.array_equal(system.masses, cp3.masses)
    assert np.array_equal(system.friction, cp3.friction)
    assert isinstance(system.potential, carom.Gravity)


def test_a_rigid_bodys_moments_scale_with_its_mass():
    disk = carom.RigidBody(2.0, (0.3, 0.5), 0.1)
    skeleton = carom.System(bodies=[carom.PointMass(1.0), disk])
    system = Unknowns(jnp.log(jnp.array([4.0])), None, None, None).assemble(skeleton)
    assert np.allclose(system.bodies[1].mass, 4.0)
    assert np.allclose(system.bodies[1].moments, [0.6, 1.0])


@pytest.mark.parametrize(
    ("friction", "restitution", "expected"),
    [(-0.1, 1.2, (0.0, 1.0)), (0.0, 0.0, (0.0, 0.0)), (1.5, 0.3, (1.5, 0.3))],
    ids=["outside", "at the ends", "inside"],
)
def test_project_reaches_the_ends_exactly(friction, restitution, expected):
    out = Unknowns(None, jnp.array([friction]), jnp.array([restitution]), None).project()
    assert (float(out.friction[0]), float(out.restitution[0])) == expected


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_learned_potential_works_in_either_precision(dtype):
    potential = NeuralPotential(3, 2, width=8, depth=2, key=jax.random.key(1), dtype=dtype)
    x = jax.random.normal(jax.random.key(2), (3, 2), jnp.float64)
    value, gradient = jax.value_and_grad(potential)(x, jnp.eye(3))
    assert value.dtype == gradient.dtype == jnp.float64
    step = 1e-2 if dtype == jnp.float32 else 1e-5
    direction = jax.random.normal(jax.random.key(3), (3, 2), jnp.float64)
    difference = potential(x + step * direction, jnp.eye(3)) - potential(x - step * direction, jnp.eye(3))
    # Central differences: rounding of the network over the step, plus its third derivative times the step squared.
    tolerance = 1e-4 if dtype == jnp.float32 else 1e-8
    assert np.isclose(difference / (2 * step), jnp.sum(gradient * direction), atol=tolerance)


def test_model_file_round_trip(tmp_path, cp3, unknowns):
    system = unknowns.assemble(cp3)
    carom.save_model(tmp_path / "model.carom", system, formulation="hamiltonian")
    header = read_model_header(tmp_path / "model.carom")
    assert (header["task"], header["formulation"], header["points"]) == ("cp3", "hamiltonian", 3)
    again = carom.load_model(tmp_path / "model.carom")
    leaves, expected = jax.tree.leaves(again), jax.tree.leaves(system)
    assert all(np.array_equal(a, b) for a, b in zip(leaves, expected, strict=True) if hasattr(a, "dtype"))
    x = jnp.ones((3, 2))
    assert again.potential_energy(x) == system.potential_energy(x)


def rope_potential():
    """A potential of the task `rope`, scaled to recorded states, and the positions of these, (S, 10, 2)."""
    rng = np.random.default_rng(0)
    angle, length = rng.uniform(0, 3, (50, 10)), 0.05 + rng.normal(0, 0.003, (50, 10))
    x = np.cumsum(length[..., None] * np.stack([np.sin(angle), -np.cos(angle)], axis=-1), axis=1)
    recording = carom.Recording.of(x[None], rng.normal(size=x.shape)[None], dt=0.005)
    rope = carom.task("rope")
    return rope, NeuralPotential.of(rope, recording, key=jax.random.key(1), width=8, depth=2), jnp.asarray(x)


def test_the_elastic_energy_of_segments_holds_springs():
    rope, potential, x = rope_potential()
    segments, springs = potential.segments, carom.Springs(range(10), 50.0, 0.05, anchor=(0.0, 0.0))
    assert segments is not None
    # 50 (mean + spread q - .05)^2, but for a constant.
    linear = 100 * segments.spread * (segments.mean - 0.05)
    square = jnp.full(10, 50 * segments.spread**2)
    polynomial = jnp.stack([linear, square, 0 * square, 0 * square], axis=1) / segments.energy
    segments = eqx.tree_at(lambda s: s.coefficients, segments, polynomial)
    forces = jax.jit(jax.vmap(jax.grad(lambda x: segments(x))))(x)
    assert np.allclose(forces, jax.jit(jax.vmap(jax.grad(lambda x: springs(x, rope.mass_matrix()))))(x), atol=1e-10)


def test_simpler_potentials_have_fewer_parameters_and_come_back_to_the_whole_one():
    _, potential, x = rope_potential()
    state, rng = x[5], np.random.default_rng(0)
    linear, bare = potential.simpler()
    assert [p.network for p in (linear, bare)] == [None, None]
    assert [p.segments.coefficients.shape for p in (linear, bare)] == [(10, 2), (10, 4)]
    assert bare.simpler() == []
    for simple in (linear, bare):
        simple = simple.with_linear_weights(
            tuple(jnp.asarray(rng.normal(size=w.shape)) for w in simple.linear_weights())
        )
        force = jax.grad(simple)(state, jnp.eye(10))
        whole = simple.extended(potential)
        assert jax.tree.structure(whole) == jax.tree.structure(potential)
        assert np.any(np.asarray(whole.network.layers[0].weight))  # it can be learned on
        assert np.allclose(jax.grad(whole)(state, jnp.eye(10)), force, atol=1e-12)
        assert whole.pruned().network is None
        assert np.allclose(jax.grad(whole.pruned())(state, jnp.eye(10)), force, atol=1e-12)
    assert potential.pruned() is potential


def test_segments_without_recordings_or_limits(cp3):
    assert NeuralPotential.of(cp3, None, key=jax.random.key(0), width=8, depth=2).segments is None
    hung = NeuralPotential.of(carom.task("rope"), None, key=jax.random.key(0), width=8, depth=2)
    assert np.isfinite(eqx.filter_jit(hung)(jnp.asarray(np.linspace(0.1, 1, 20).reshape(10, 2)), jnp.eye(10)))


@pytest.mark.parametrize("network", [True, False])
def test_a_model_with_segments_comes_back_from_its_file(tmp_path, network):
    rope, potential, x = rope_potential()
    potential = potential if network else potential.simpler()[-1]
    potential = eqx.tree_at(lambda p: p.segments.coefficients, potential, jnp.ones((10, 4)))
    system = Unknowns(None, None, None, potential).assemble(rope)
    carom.save_model(tmp_path / "model.carom", system)
    again = carom.load_model(tmp_path / "model.carom")
    state = x[5]
    assert again.potential_energy(state) == system.potential_energy(state)
    assert again.potential_energy(state) != rope.potential_energy(state)


def test_a_model_of_an_own_system_needs_its_skeleton(tmp_path):
    own = carom.System(bodies=[carom.PointMass(2.0)])
    carom.save_model(tmp_path / "model.carom", own)
    with pytest.raises(carom.CaromError, match="give the skeleton"):
        carom.load_model(tmp_path / "model.carom")
    again = carom.load_model(tmp_path / "model.carom", carom.System(bodies=[carom.PointMass(1.0)]))
    assert again.masses.tolist() == [2.0]


@pytest.mark.parametrize("damage", ["flip", "cut", "foreign", "header", "missing"])
def test_a_damaged_model_file_is_refused(tmp_path, cp3, unknowns, damage):
    path = tmp_path / "model.carom"
    carom.save_model(path, unknowns.assemble(cp3))
    data = bytearray(path.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 1
    elif damage == "cut":
        del data[-10:]
    elif damage == "foreign":
        data[:] = b"something else"
    elif damage == "header":
        data[14:20] = b"\xff" * 6
    path.write_bytes(data)
    if damage == "missing":
        path.unlink()
    with pytest.raises(carom.CaromError, match=r"model\.carom"):
        carom.load_model(path)


def test_a_model_of_another_system_is_refused(tmp_path, cp3, unknowns):
    carom.save_model(tmp_path / "model.carom", unknowns.assemble(cp3))
    with pytest.raises(carom.CaromError, match="3 points in 2D"):
        load_model_into(tmp_path / "model.carom", carom.task("bp5"))


def test_weights_decay_and_scales_do_not():
    _, potential, _ = rope_potential()
    unknowns = eqx.filter(Unknowns(None, None, None, potential), eqx.is_inexact_array)
    with jax.numpy_dtype_promotion("standard"):
        optimizer = make_optimizer(Rates.of(carom.LearnConfig(), 1e-3))
        zero = jax.tree.map(jnp.zeros_like, unknowns)
        change: Any = optimizer.update(zero, optimizer.init(unknowns), unknowns)[0]
    assert all(np.any(layer.weight) for layer in change.potential.network.layers)
    scales = eqx.tree_at(lambda s: s.coefficients, change.potential.segments, jnp.zeros(1))
    assert not any(np.any(a) for a in jax.tree.leaves(scales))
