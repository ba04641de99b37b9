"""The trainer: it learns, it resumes, it refuses. What it comes to is in `test_acceptance.py`."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.learning.dataset import Dataset
from carom.learning.estimation.refine import can_be_refined
from carom.learning.run import RunFolder
from carom.learning.training.start import initial_unknowns
from carom.learning.training.train import learn
from carom.learning.unknowns.models import NeuralPotential, Unknowns, mass_ratios

TINY = carom.LearnConfig(
    epochs=4, chunks_per_epoch=32, batch_size=16, chunk_length=3, width=16, depth=1, checkpoint_every=1, refine=False
)


def numbers(system):
    return np.concatenate([system.friction, system.restitution, mass_ratios(system)])


def in_single_precision(system):
    """The same system, as it is made where double precision was not asked for."""
    return jax.tree.map(
        lambda a: a.astype(jnp.float32) if isinstance(a, jax.Array) and a.dtype == jnp.float64 else a, system
    )


def test_learning_lowers_the_loss_and_reports_it(cp3, cp3_data, tmp_path):
    run = RunFolder.create(tmp_path / "run", {})
    config = dataclasses.replace(TINY, epochs=8, learning_rate=1e-2)
    system, report = learn(cp3, cp3_data, config, run=run, progress=False)
    run.close()
    metrics = run.metrics()
    assert [m["epoch"] for m in metrics] == list(range(1, 9))
    assert metrics[-1]["val_loss"] < 0.9 * metrics[0]["val_loss"]
    assert report.val_loss == min(m["val_loss"] for m in metrics)
    assert report.friction == system.friction.tolist()
    assert report.skipped_steps == report.overflowed_contacts == 0
    # The skeleton's own values are not what learning starts from, nor what it returns.
    assert not np.allclose(numbers(system), numbers(cp3), atol=1e-2)


def epochs_of(run):
    return [m["epoch"] for m in run.metrics() if "refinement" not in m]


@pytest.mark.slow  # of killed trainings without refinements test_killed.py says the same, in every run
@pytest.mark.parametrize("when", [{"refinement": 2}, {"epoch": 3}])
def test_a_resumed_training_equals_an_uninterrupted_one(cp3, cp3_data, tmp_path, when):
    config = dataclasses.replace(TINY, refine=True, enough=0.0)  # before epoch 1, after epoch 2, and at the end
    whole = RunFolder.create(tmp_path / "whole", {})
    expected, _ = learn(cp3, cp3_data, config, run=whole, progress=False)
    whole.close()

    class KilledError(Exception):
        pass

    class Dying(RunFolder):
        def log(self, metrics):
            super().log(metrics)
            if when.items() <= metrics.items():
                raise KilledError

    dying = Dying.create(tmp_path / "killed", {})
    with pytest.raises(KilledError):
        learn(cp3, cp3_data, config, run=dying, progress=False)
    dying.close()
    again = RunFolder.open(tmp_path / "killed")
    assert when.items() <= again.metrics()[-1].items()  # logged, but its checkpoint was not written
    system, report = learn(cp3, cp3_data, config, run=again, progress=False)
    again.close()
    assert report.epochs == 4
    assert epochs_of(again) == [1, 2, 3, 4]
    assert np.array_equal(numbers(system), numbers(expected))
    assert [m["val_loss"] for m in again.metrics()] == [m["val_loss"] for m in whole.metrics()]


def test_a_refinement_can_be_enough(cp3, cp3_data, tmp_path):
    config = dataclasses.replace(TINY, refine=True, enough=1e-2)
    run = RunFolder.create(tmp_path / "run", {})
    system, report = learn(cp3, cp3_data, config, run=run, progress=False)
    run.close()
    assert (report.epochs, report.stopped_early, report.refined, report.train_loss) == (0, True, True, None)
    assert report.val_loss <= min(m["val_loss"] for m in run.metrics())
    assert epochs_of(run) == []
    assert np.abs(numbers(system) - numbers(cp3)).max() < 1e-2
    assert system.potential.network is None  # gravity is a uniform field
    again = RunFolder.open(tmp_path / "run")
    resumed, report = learn(cp3, cp3_data, config, run=again, progress=False)
    again.close()
    assert (report.epochs, report.stopped_early, report.refined) == (0, True, True)
    assert np.array_equal(numbers(resumed), numbers(system))


def test_early_stopping_keeps_the_best(cp3, cp3_data):
    config = dataclasses.replace(TINY, epochs=40, patience=2, learning_rate=0.5)
    _, report = learn(cp3, cp3_data, config, progress=False)
    assert report.stopped_early
    assert report.epochs < 40


@pytest.mark.slow
@pytest.mark.ci_budget
def test_the_refinement_at_the_end_brings_all_that_is_learned_nearer(cp3, cp3_data, tmp_path):
    config = dataclasses.replace(TINY, epochs=30, chunks_per_epoch=64, learning_rate=1e-2)
    run = RunFolder.create(tmp_path / "run", {})
    rough, before = learn(cp3, cp3_data, config, run=run, progress=False)
    run.close()
    # The same training goes on, from its end.
    run = RunFolder.open(tmp_path / "run")
    refined, after = learn(cp3, cp3_data, dataclasses.replace(config, refine=True), run=run, progress=False)
    run.close()
    assert not before.refined
    assert after.refined
    assert after.train_loss == before.train_loss
    assert after.val_loss < 0.1 * before.val_loss
    rough_error, refined_error = (np.abs(numbers(system) - numbers(cp3)).max() for system in (rough, refined))
    assert refined_error < 0.01 * rough_error
    # Gravity is the uniform field's, not the network's: forces are right far from all data too.
    away = jnp.asarray(np.random.default_rng(0).normal(size=(3, 2)) * 10)
    force, true = (-jax.grad(system.potential_energy)(away) for system in (refined, cp3))
    assert np.abs(force - true).max() < 1e-2 * np.abs(true).max()


def test_what_can_be_refined(cp3):
    unknowns, (rope, longer) = initial_unknowns(cp3, TINY), (carom.task(name) for name in ("rope-50", "rope-100"))
    baseline = eqx.tree_at(lambda u: u.step_model, unknowns, carom.Gravity((0.0, -1.0)), is_leaf=lambda a: a is None)
    assert can_be_refined(unknowns, cp3)
    assert not can_be_refined(unknowns, in_single_precision(cp3))
    assert not can_be_refined(Unknowns(None, None, None, None), cp3)
    assert not can_be_refined(baseline, cp3)
    assert can_be_refined(initial_unknowns(rope, TINY), rope)
    assert not can_be_refined(initial_unknowns(longer, TINY), longer)


def test_single_precision_is_said_to_refine_nothing(cp3, cp3_data):
    config = dataclasses.replace(TINY, refine=True, chunk_length=200)  # too long: nothing is trained
    with pytest.warns(UserWarning, match="single precision"), refused("chunk_length is 200"):
        learn(in_single_precision(cp3), cp3_data, config, progress=False)


@pytest.mark.slow
def test_only_what_is_asked_for_is_learned(cp3, cp3_data):
    config = dataclasses.replace(TINY, learn=("friction", "restitution"), epochs=2)
    system, _ = learn(cp3, cp3_data, config, progress=False)
    assert isinstance(system.potential, carom.Gravity)
    assert np.array_equal(system.masses, cp3.masses)
    assert system.friction.tolist() != [config.initial_friction]


def test_steps_without_a_finite_gradient_are_left_out_and_reported(cp3, cp3_data):
    potential = NeuralPotential(3, 2, width=16, depth=1, key=jax.random.key(0))
    broken = jax.tree.map(lambda a: a * jnp.nan if eqx.is_array(a) else a, potential)
    skeleton = eqx.tree_at(lambda s: s.potential, cp3, broken)
    with refused("the training loss is not finite (6 steps left out)"):
        learn(skeleton, cp3_data, TINY, progress=False)


def test_initial_values_are_those_of_the_configuration(cp3):
    unknowns = initial_unknowns(cp3, dataclasses.replace(TINY, initial_friction=0.4, initial_restitution=1.0))
    assert unknowns.friction.tolist() == [0.4]
    assert unknowns.restitution.tolist() == [1.0]
    assert not unknowns.log_mass_ratio.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"epochs": 0}, "epochs must be at least 1"),
        ({"chunk_length": 1}, "chunk_length"),
        ({"contact_share": 1.5}, "contact_share"),
        ({"learning_rate": 0.0}, "learning_rate"),
        ({"weight_decay": -1.0}, "weight_decay"),
        ({"initial_friction": -0.1}, "initial_friction"),
        ({"initial_restitution": 1.1}, "initial_restitution"),
        ({"compensation_steps": 0.0}, "compensation_steps"),
        ({"model": "hnn"}, "model must be one of"),
        ({"learn": ("colour",)}, "learn must name"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_bad_configuration_is_refused(change, message):
    with refused(message):
        carom.LearnConfig(**change).check()


def test_data_that_do_not_fit_the_system_are_refused(cp3, cp3_data):
    def changed(x):
        return Dataset(carom.Recording.of(x, cp3_data.train.v, dt=0.01), cp3_data.val)

    with refused("3 points in 2D"):
        learn(carom.task("bp5"), cp3_data, TINY, progress=False)
    with refused("do not fit the system's rods"):
        learn(cp3, changed(cp3_data.train.x * 2), TINY, progress=False)
    with refused("chunk_length is 200"):
        learn(cp3, cp3_data, dataclasses.replace(TINY, chunk_length=200), progress=False)
    bp5 = carom.task("bp5-e")
    x0, v0 = carom.sample(bp5, jax.random.key(0), 4)
    moved = carom.Recording.of(*(np.repeat(a[:, None], 9, axis=1) for a in (x0 - 0.5, v0)), dt=0.01)
    with refused("in a wall"):
        learn(bp5, Dataset(moved, moved), TINY, progress=False)


def test_single_precision_trains():
    """Data, masses and properties in single precision: the solver still runs in double inside."""
    skeleton = in_single_precision(carom.task("cp3"))
    unknowns = initial_unknowns(skeleton, dataclasses.replace(TINY, learn=("friction",)))
    assert unknowns.friction.dtype == jnp.float32
    x0, v0 = (a.astype(jnp.float32) for a in carom.sample(carom.task("cp3"), jax.random.key(3), 16))

    def loss(unknowns):
        out = carom.simulate(unknowns.assemble(skeleton), x0, v0, dt=0.01, steps=100, project=False)
        return jnp.mean(jnp.abs(out.x)) + jnp.mean(jnp.abs(out.v))

    gradient = jax.grad(lambda mu: loss(dataclasses.replace(unknowns, friction=mu)))(unknowns.friction)
    assert gradient.dtype == jnp.float32
    assert np.isfinite(gradient).all()
    assert float(gradient[0]) != 0
