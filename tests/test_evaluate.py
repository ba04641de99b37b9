"""Measures of a learned system against closed forms and against the true system."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import carom
from carom.cli.outcome import most_eventful
from carom.learning.evaluate import state_errors


@pytest.fixture(scope="module")
def elastic():
    system = carom.task("cp3-e")
    return system, carom.make_recording(system, jax.random.key(1), 6)


def test_the_true_system_is_without_error(elastic):
    system, data = elastic
    measures, predicted = carom.evaluate(system, data, truth=system)
    assert np.array_equal(predicted.x, data.x)
    for name in ("trajectory_error", "bounded_error", "trajectory_error_median"):
        assert measures[name] == 0
    assert measures["friction_error"] == measures["restitution_error"] == [0]
    assert measures["mass_ratio_error"] == [0, 0, 0]
    assert measures["constraint_error"] < 1e-12
    # Elastic, but the step rule acts up to one step late and penetration is compensated.
    assert 0 < measures["energy_drift"] < 0.1


def test_state_errors_have_the_closed_form():
    x = np.zeros((1, 3, 1, 2))
    x[..., 0] = 3.0
    v = np.zeros_like(x)
    v[..., 1] = 4.0  # |z| = 5
    data = carom.Recording.of(x, v, dt=0.1, length=[2])
    guess = x.copy()
    guess[:, 1, 0, 0] = 4.0
    predicted = carom.Trajectory(
        x=jnp.asarray(guess),
        v=jnp.asarray(v),
        contact=jnp.zeros((1, 3), bool),
        time=jnp.arange(3.0),
        overflow=jnp.zeros((1, 3), int),
        residual=jnp.zeros((1, 3)),
    )
    relative, bounded = state_errors(data, predicted)
    assert np.allclose(relative[0, :2], [0, 1 / 5])
    assert np.allclose(bounded[0, :2], [0, 1 / np.sqrt(25 + 32)])
    assert np.isnan(relative[0, 2])  # beyond the trajectory's end


def test_what_comes_after_a_trajectory_has_ended_is_not_measured(elastic, monkeypatch):
    system, data = elastic
    length = np.array([5, 9, 20, 33, 40, 41])
    ragged = carom.Recording.of(data.x, data.v, dt=data.dt, contact=data.contact, length=length)
    after = ~ragged.valid
    predicted = carom.Trajectory(
        x=jnp.asarray(np.where(after[..., None, None], 2 * data.x, data.x)),
        v=jnp.asarray(np.where(after[..., None, None], 3 * data.v, data.v)),
        contact=jnp.asarray(data.contact),
        time=jnp.asarray(data.time),
        overflow=jnp.asarray(7 * after),
        residual=jnp.zeros(after.shape),
    )
    monkeypatch.setattr("carom.learning.evaluate.predict", lambda *arguments, **options: predicted)
    measures, _ = carom.evaluate(system, ragged, truth=system)
    assert measures["constraint_error"] < 1e-12
    assert measures["overflowed_contacts"] == 0
    whole = np.asarray(system.energy(jnp.asarray(data.x), jnp.asarray(data.v)))
    energy = [part[:n] for part, n in zip(whole, length, strict=True)]
    drift = max(np.abs(part - part[0]).max() for part in energy) / max(np.abs(part).max() for part in energy)
    assert measures["energy_drift"] == pytest.approx(drift, rel=1e-12)
    assert measures["trajectory_error"] == 0
    # The busiest trajectory is that with the most contact before its end.
    flags = after.copy()
    flags[5, 3] = True
    busy = carom.Recording.of(data.x, data.v, dt=data.dt, contact=flags, length=length)
    assert most_eventful(busy) == 5


def test_a_prediction_that_is_lost_counts_as_lost(elastic):
    _, data = elastic
    predicted = carom.Trajectory(
        x=jnp.full(data.x.shape, jnp.nan),
        v=jnp.asarray(data.v),
        contact=jnp.asarray(data.contact),
        time=jnp.asarray(data.time),
        overflow=jnp.zeros(data.contact.shape, int),
        residual=jnp.zeros(data.contact.shape),
    )
    relative, bounded = state_errors(data, predicted)
    assert np.isinf(relative).all()
    assert (bounded == 1).all()


def test_a_recording_of_another_system_is_refused(elastic):
    with pytest.raises(carom.CaromError, match="Is it of another system"):
        carom.evaluate(carom.task("bp5"), elastic[1])
