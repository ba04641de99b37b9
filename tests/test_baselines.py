"""Baselines: they learn on every kind of system, do nothing without contact, and treat bodies that are alike alike."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor, refused, two_bodies

import carom
from carom.contact.impulses import ContactModel, Jump
from carom.learning.dataset import Chunks, Dataset
from carom.learning.training.loss import train_step
from carom.learning.training.optimizer import Rates
from carom.learning.training.start import fresh_state
from carom.learning.training.train import learn
from carom.learning.unknowns.baselines import (
    BASELINES,
    InteractionContact,
    InteractionNetwork,
    InteractionStep,
    MLPContact,
    new_baseline,
    physical_quantities,
    rebuild_baseline,
    with_baseline,
)
from carom.learning.unknowns.baselines.graph import WORLD, Graph
from carom.simulation.impact import Stepper, contact_jump
from carom.simulation.rollout import step

NARROW = {"relation_width": 16, "object_width": 16}
SMALL = {"mlp-cd-clnn": {"width": 16, "depth": 2}, "in-cp-clnn": NARROW, "in-cp-sp": NARROW}
STEPPER = Stepper(dt=jnp.asarray(0.01), project=False)


def small(name, system, seed=0):
    return with_baseline(system, new_baseline(name, system, jax.random.key(seed), **SMALL[name]))


def jump_of(system, x, v):
    return contact_jump(system, x, v, system.inverse_mass_matrix(), STEPPER)[1].velocity


# --- the networks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mlp-cd-clnn", "in-cp-clnn"])
def test_no_contact_means_no_jump(name):
    system = small(name, ball_on_floor())
    v = jnp.array([[1.0, -1.0]])
    assert (jump_of(system, jnp.array([[0.0, 0.2]]), v) == 0).all()
    assert (jump_of(system, jnp.array([[0.0, 0.05]]), v) != 0).all()


def test_a_whole_step_is_semi_implicit():
    system = small("in-cp-sp", ball_on_floor())
    x, v = jnp.array([[0.0, 0.2]]), jnp.array([[1.0, -1.0]])
    out = step(system, x, v, STEPPER)
    assert (out.v != v).all()
    assert np.allclose(out.x, x + 0.01 * out.v, rtol=1e-15)
    assert not out.contact
    assert step(system, jnp.array([[0.0, 0.05]]), v, STEPPER).contact
    with refused("force must be None"):
        step(system, x, v, STEPPER, force=jnp.zeros_like(x))


@pytest.mark.parametrize("name", ["in-cp-clnn", "in-cp-sp"])
def test_bodies_that_are_alike_can_change_places(name):
    """Five equal balls, two of which touch each other and one a wall."""
    system = small(name, carom.task("bp5-e"))
    x = jnp.array([[0.3, 0.3], [0.45, 0.35], [0.7, 0.7], [0.95, 0.2], [0.2, 0.8]])
    v = jax.random.normal(jax.random.key(1), x.shape, x.dtype)
    order = np.array([3, 0, 4, 2, 1])
    assert int((system.gaps(x) < 0).sum()) == 2

    def change(x, v):
        return jump_of(system, x, v) if name == "in-cp-clnn" else step(system, x, v, STEPPER).v - v

    once, other = change(x, v), change(x[order], v[order])
    assert np.allclose(other, once[order], atol=1e-6)  # single precision sums effects in another order
    assert np.abs(once - once[order]).max() > 1e-3


def test_whether_a_contact_is_closed_is_seen():
    network = InteractionNetwork(two_bodies(), key=jax.random.key(0), relation_width=16, object_width=16)
    x, v = jnp.array([[0.0, 0.0], [0.5, 0.0]]), jnp.ones((2, 2))
    changes = [network(x, v, jnp.array([closed])) for closed in (False, True)]
    assert np.abs(changes[0] - changes[1]).max() > 1e-4


def test_the_graph_has_contacts_and_constraints():
    pendulum = Graph.of(carom.task("cp3"))  # a tether and two rods; three contacts with the ground
    assert set(zip(pendulum.sender, pendulum.receiver, strict=True)) == {
        *((WORLD, k) for k in range(3)),
        *((0, 1), (1, 0), (1, 2), (2, 1)),
    }
    assert pendulum.n_kinds == 3
    gyroscope = Graph.of(carom.task("gyro"))  # one body of four points; its joint and the wall are of the world
    assert gyroscope.points == ((0, 1, 2, 3),)
    assert gyroscope.slot == (0, 1, 2, 3)
    assert gyroscope.sender == (WORLD, WORLD)
    assert gyroscope.candidate == (0, 1)
    mixed = Graph.of(
        carom.System(
            bodies=[carom.PointMass(1.0, 0.1), carom.RigidBody(1.0, (0.1, 0.1), 0.1)],
            contacts=[carom.DiskDisk([(0, 1)])],
        )
    )
    assert mixed.points == ((0, 0, 0), (1, 2, 3))
    assert (mixed.owner, mixed.slot) == ((0, 1, 1, 1), (0, 0, 1, 2))


def test_bodies_without_contacts_or_constraints_move_alone():
    free = small("in-cp-sp", carom.System(bodies=[carom.PointMass(1.0)] * 2, dim=2))
    x, v = jnp.zeros((2, 2)), jnp.ones((2, 2))
    nudged = step(free, x.at[1].add(1.0), v, STEPPER)
    assert np.array_equal(step(free, x, v, STEPPER).v[0], nudged.v[0])


# --- learning -------------------------------------------------------------------------------------------------------


class Reversal(ContactModel):
    """A contact turns all velocities round: data without the solver, which takes long to compile."""

    def __call__(self, state, *, smoothing=0.0):
        return Jump(jnp.where(jnp.any(state.active.active), -2 * state.v, 0), jnp.zeros(()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "name"),
    [(task, name) for task in ("cp3", "bp5-e", "gyro", "rope") for name in BASELINES],
)
def test_training_steps_are_finite_and_lower_the_loss(task, name):
    """On one batch of half smooth, half contact steps."""
    system = carom.task(task)
    data = carom.make_recording(with_baseline(system, Reversal()), jax.random.key(0), 16)
    config = carom.LearnConfig(model=name, width=32, depth=2)
    state = fresh_state(system, config)
    drawn = Chunks.of(data.contact, data.length, config.states).draw(np.random.default_rng(0), 32, 0.5)
    inputs = (system, jnp.asarray(data.x), jnp.asarray(data.v), *(jnp.asarray(part) for part in drawn))
    stepper = Stepper(dt=jnp.asarray(data.dt), project=False)
    rates = Rates.of(config, config.learning_rate)
    unknowns, opt_state, errors = state.unknowns, state.optimizer, []
    for _ in range(100):
        unknowns, opt_state, error, _, bad = train_step(
            inputs, unknowns, opt_state, rates, stepper, config.states, jnp.asarray(0.01)
        )
        assert not bad
        errors.append(float(error))
    assert np.mean(errors[-5:]) < 0.8 * errors[0]


def test_a_baseline_has_only_the_unknowns_it_uses():
    system = carom.task("rope")
    wanted = {"mlp-cd-clnn": ("mass",), "in-cp-clnn": ("mass",), "in-cp-sp": ()}
    for name in BASELINES:
        config = carom.LearnConfig(model=name, width=8, depth=1)
        assert config.states == 2
        assert dataclasses.replace(config, chunk_length=4).states == 4
        unknowns = fresh_state(system, config).unknowns
        assert unknowns.friction is unknowns.restitution is None
        assert (unknowns.potential is None) == (unknowns.log_mass_ratio is None) == (name == "in-cp-sp")
        assert physical_quantities(unknowns.assemble(system)) == wanted[name]
    assert physical_quantities(system) == ("mass", "friction", "restitution")


@pytest.mark.slow
def test_a_baseline_is_learned_evaluated_and_saved(tmp_path):
    truth = ball_on_floor()
    x0 = jnp.array([[[0.1 * k, 0.12 + 0.02 * k]] for k in range(12)])
    v0 = jnp.broadcast_to(jnp.array([[0.5, -1.0]]), x0.shape)
    data = carom.recording_of(carom.simulate(with_baseline(truth, Reversal()), x0, v0, dt=0.01, steps=30))
    config = carom.LearnConfig(
        model="mlp-cd-clnn", epochs=6, chunks_per_epoch=64, batch_size=32, width=16, depth=1, checkpoint_every=10
    )
    system, report = learn(truth, Dataset.split(data), config, progress=False)
    assert isinstance(system.contact_model, MLPContact)
    assert report.friction == report.restitution == []
    measures, predicted = carom.evaluate(system, data, truth=truth)
    assert np.isfinite(measures["trajectory_error"])
    assert "friction_error" not in measures
    assert measures["mass_ratio_error"] == [0.0]
    carom.save_model(tmp_path / "model.carom", system)
    again = carom.load_model(tmp_path / "model.carom", truth)
    assert np.array_equal(carom.evaluate(again, data)[1].x, predicted.x)


@pytest.mark.parametrize("name", BASELINES)
def test_model_files_hold_baselines(tmp_path, name):
    system = small(name, carom.task("rope"), seed=3)
    carom.save_model(tmp_path / "model.carom", system)
    again = carom.load_model(tmp_path / "model.carom")
    arrays = [jax.tree.leaves(eqx.filter(s, eqx.is_array)) for s in (system, again)]
    assert all(np.array_equal(a, b) for a, b in zip(*arrays, strict=True))
    assert jax.tree.structure(eqx.filter(again, eqx.is_array)) == jax.tree.structure(eqx.filter(system, eqx.is_array))


def test_baselines_can_be_in_double_precision():
    system = two_bodies()
    network = InteractionNetwork(system, key=jax.random.key(0), relation_width=8, object_width=8, dtype=jnp.float64)
    for baseline in (
        MLPContact(system, key=jax.random.key(0), width=8, depth=1, dtype=jnp.float64),
        InteractionContact(network),
        InteractionStep(network),
    ):
        held = with_baseline(system, baseline)
        x, v = jnp.array([[0.0, 0.0], [0.15, 0.0]]), jnp.array([[1.0, 0.0], [0.0, 0.0]])
        assert step(held, x, v, STEPPER).v.dtype == jnp.float64
    name = {"name": "in-cp-sp", "sizes": {"relation_width": 8, "object_width": 8}, "dtype": "float64"}
    assert rebuild_baseline(name, system).step_model.network.relation.layers[0].weight.dtype == jnp.float64
