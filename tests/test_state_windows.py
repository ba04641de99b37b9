"""Unknowns estimated together with the start states of windows: from noisy recordings of a ball on a floor."""

import dataclasses
from contextlib import closing

import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor

import carom
from carom.learning.config import LearnConfig
from carom.learning.dataset import Dataset, contact_flags
from carom.learning.estimation import state_shooting
from carom.learning.estimation.identify import identify
from carom.learning.estimation.state_shooting import Shooting, Shot, estimate, shoot
from carom.learning.estimation.state_windows import choose_windows, is_noisy, step_errors, window_directions
from carom.learning.run import RunFolder
from carom.learning.training import train
from carom.learning.training.start import initial_unknowns
from carom.learning.unknowns.models import Unknowns
from carom.learning.unknowns.parameters import at_bounds, moved, physical_vector
from carom.recordings.recording import Recording
from carom.simulation.impact import Stepper

DT, STEPS, NOISE = 0.01, 60, 0.03
FRICTION, RESTITUTION = 0.2, 0.7
CONFIG = LearnConfig(width=8, depth=1)
STEPPER = Stepper(dt=jnp.asarray(DT), project=False, compensation_steps=CONFIG.compensation_steps, consistent=True)


@pytest.fixture(scope="module")
def system():
    return ball_on_floor(friction=FRICTION, restitution=RESTITUTION)


@pytest.fixture(scope="module")
def exact(system):
    rng = np.random.default_rng(0)
    x = np.stack([rng.uniform(-1, 1, 120), rng.uniform(0.3, 1.2, 120)], axis=1)[:, None]
    v = np.stack([rng.normal(0, 2, 120), rng.uniform(-3, 0, 120)], axis=1)[:, None]
    motion = carom.simulate(system, jnp.asarray(x), jnp.asarray(v), dt=DT, steps=STEPS)
    return Recording.of(motion.x, motion.v, time=motion.time, contact=motion.contact)


def with_noise(recording: Recording, sd: float, seed: int = 1) -> Recording:
    rng = np.random.default_rng(seed)
    x, v = (part + rng.normal(0, sd, part.shape) for part in (recording.x, recording.v))
    return dataclasses.replace(recording, x=x, v=v)


@pytest.fixture(scope="module")
def dataset(exact):
    noisy = with_noise(exact, NOISE)
    return Dataset(noisy.select(np.arange(100)), noisy.select(np.arange(100, 120)))


@pytest.fixture(scope="module")
def start(system, dataset):
    unknowns = initial_unknowns(system, CONFIG, dataset.train)
    assert unknowns.potential is not None
    return dataclasses.replace(unknowns, potential=unknowns.potential.simpler()[0])


def test_windows_begin_with_free_motion(system, exact):
    windows = choose_windows(exact, system, seed=0)
    flags = contact_flags(exact, system)
    length = windows.x.shape[1]
    assert len(windows.x) > 50
    impacts = 0
    for x, run_in, k in zip(windows.x, windows.run_in, windows.trajectory, strict=True):
        (s,) = np.flatnonzero((exact.x[k, : STEPS + 2 - length] == x[0]).all(axis=(1, 2)))
        assert not flags[k, s : s + run_in].any()
        assert run_in == length or flags[k, s + run_in]
        impacts += run_in < length
    assert impacts > 0.5 * len(windows.x)


def test_no_window_fits_into_a_recording_that_is_always_in_contact(system, exact):
    closed = dataclasses.replace(exact, contact=np.ones_like(flags := contact_flags(exact, system)))
    assert flags.any()
    assert len(choose_windows(closed, system, seed=0).x) == 0


def test_noise_is_measured_against_what_a_step_moves(system, exact, start):
    truth = dataclasses.replace(start, potential=start.potential.with_linear_weights((jnp.array([[0.0, 9.81]]),)))
    for sd in (1e-5, 1e-3, NOISE):
        errors = step_errors(truth, system, STEPPER, with_noise(exact, sd), seed=0)
        np.testing.assert_allclose(errors, sd, rtol=0.15)
        assert is_noisy(errors, exact) == (sd == NOISE)


@pytest.mark.slow
def test_properties_and_potential_from_noisy_states(system, dataset, start):
    shot = estimate(start, system, STEPPER, dataset, seed=0)
    assert shot is not None
    assert shot.fits
    assert shot.unknowns.friction[0] == pytest.approx(FRICTION, abs=0.01)
    assert shot.unknowns.restitution[0] == pytest.approx(RESTITUTION, abs=0.01)
    np.testing.assert_allclose(shot.unknowns.potential.slope, [[0.0, 9.81]], atol=0.1)


@pytest.mark.slow
def test_estimated_starts_are_nearer_to_the_truth_than_recorded_ones(system, exact, dataset, start):
    windows = choose_windows(dataset.train, system, seed=0)
    shooting = Shooting(system, STEPPER, windows, window_directions(start, system, windows))
    found = shoot(shooting, start)
    assert np.all(found.standard_error[-2:] < 0.02)
    states = shooting.states()
    rows = zip(windows.x[:, 0], windows.trajectory, strict=True)
    true = np.stack([exact.x[k, (dataset.train.x[k] == x).all(axis=(1, 2))][0] for x, k in rows])
    before, after = (np.sqrt(np.mean((x - true) ** 2)) for x in (windows.x[:, 0], states.x[:, 0]))
    assert before == pytest.approx(NOISE, rel=0.1)
    assert after < 0.5 * before


@pytest.mark.slow
def test_what_noisy_states_tell(system, dataset, start):
    shot = estimate(start, system, STEPPER, dataset, seed=0)
    assert shot is not None
    learned = shot.unknowns.assemble(system)
    told = identify(learned, dataset.train)
    for found, true in ((told.friction[0], FRICTION), (told.restitution[0], RESTITUTION)):
        assert found.verdict == "identified"
        assert 1e-4 < found.standard_error < 0.02
        assert abs(found.value - true) < 4 * found.standard_error
    assert told.sliding[0] > 20


def test_exact_data_need_no_estimated_starts(system, exact, start):
    data = Dataset(exact.select(np.arange(100)), exact.select(np.arange(100, 120)))
    truth = dataclasses.replace(start, potential=start.potential.with_linear_weights((jnp.array([[0.0, 9.81]]),)))
    assert estimate(truth, system, STEPPER, data, seed=0) is None


@pytest.mark.slow
def test_learning_says_that_starts_were_estimated(system, dataset):
    learned, report = carom.learn(system, dataset, CONFIG, progress=False)
    assert report.starts_estimated
    assert (report.epochs, report.refined, report.stopped_early) == (0, True, True)
    assert float(learned.friction[0]) == pytest.approx(FRICTION, abs=0.01)


@pytest.mark.slow
def test_a_resumed_training_remembers_what_was_estimated_at_first(system, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(state_shooting, "AS_GOOD", 0.0)  # never good enough: epochs follow
    rivals: list[Unknowns | None] = []

    def at_first_only(*arguments, rival, **options):
        """Before the first epoch of the whole training and of the killed one; at their ends, what was found then."""
        rivals.append(rival)
        return estimate(*arguments, **options) if rival is None else Shot(rival, fits=False)

    monkeypatch.setattr(train, "estimate", at_first_only)
    config = dataclasses.replace(CONFIG, epochs=4, checkpoint_every=1)
    whole, expected = carom.learn(system, dataset, config, progress=False)
    assert expected.starts_estimated
    assert expected.epochs == 4

    class KilledError(Exception):
        pass

    class Dying(RunFolder):
        def log(self, metrics):
            super().log(metrics)
            if metrics["epoch"] == 3:
                raise KilledError

    with pytest.raises(KilledError), closing(Dying.create(tmp_path / "run", {})) as run:
        carom.learn(system, dataset, config, run=run, progress=False)
    with closing(RunFolder.open(tmp_path / "run")) as run:
        resumed, report = carom.learn(system, dataset, config, run=run, progress=False)
    assert [rival is not None for rival in rivals] == [False, True, False, True]
    assert report.starts_estimated
    assert report.val_loss == expected.val_loss
    assert np.array_equal(resumed.friction, whole.friction)
    assert np.array_equal(resumed.restitution, whole.restitution)


def test_changes_of_the_unknowns_follow_their_vector(start):
    count, features = len(physical_vector(start)), np.eye(2)
    new = moved(start, features, np.arange(1.0, count + 3) / 10)
    np.testing.assert_allclose(physical_vector(new) - physical_vector(start), np.arange(1.0, count + 1) / 10)
    np.testing.assert_allclose(new.potential.slope - start.potential.slope, [[(count + 1) / 10, (count + 2) / 10]])
    near = dataclasses.replace(start, friction=jnp.array([0.01]), restitution=jnp.array([0.99]))
    np.testing.assert_array_equal(physical_vector(at_bounds(near)), [0.0, 1.0])
