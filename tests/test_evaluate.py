"""Measures of a learned system against closed forms and against the true system."""

import io

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

import carom
from carom.cli.outcome import most_eventful, warn_if_far_off
from carom.learning.evaluate import error_allowed, far_off, state_errors


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


def said_of(measures):
    text = io.StringIO()
    warn_if_far_off(Console(file=text, force_terminal=True, color_system="standard"), measures)
    return text.getvalue()


def test_a_system_that_does_not_explain_the_data_is_called_so(elastic):
    system, data = elastic
    measures, _ = carom.evaluate(system, data)
    assert not far_off(measures)
    assert measures["error_allowed"] == pytest.approx(0.1)
    other = eqx.tree_at(lambda s: s.potential.acceleration, system, -system.potential.acceleration)
    measures, _ = carom.evaluate(other, data)
    assert measures["trajectory_error"] > 0.3
    assert far_off(measures)
    said = said_of(measures)
    assert said.startswith("\x1b[1;33mThe learned system does not explain the data")  # bold, yellow
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("median", "bounded", "allowed", "expected"),
    [
        (0.3, 0.25, 0.1, True),
        (0.5, 0.4, 0.1, True),
        (0.02, 0.2, 0.1, True),  # less than half of the trajectories, but many
        (0.001, 0.02, 0.1, False),  # a few that are lost, of whatever mean error
        (0.2, 0.15, 0.3, False),  # noisy data
        (float("inf"), 1.0, 0.1, True),
        (float("nan"), float("nan"), 0.1, True),
    ],
)
def test_how_many_predictions_may_be_off(median, bounded, allowed, expected):
    measures = {"trajectory_error_median": median, "bounded_error": bounded, "error_allowed": allowed}
    assert far_off(measures) == expected
    assert ("does not explain the data" in said_of({**measures, "trajectory_error": 1e9})) == expected


def test_noise_may_be_why():
    """A state of size 5 (3 m, 4 m/s) with errors of 0.1 m and 0.2 m/s in each of four numbers."""
    rng = np.random.default_rng(0)
    x = np.tile([3.0, 0.0], (50, 40, 1, 1)) + 0.1 * rng.normal(size=(50, 40, 1, 2))
    v = np.tile([0.0, 4.0], (50, 40, 1, 1)) + 0.2 * rng.normal(size=(50, 40, 1, 2))
    share = np.sqrt(2 * (0.1**2 + 0.2**2)) / 5
    # 2000 vectors: the median of absolute values is known to 2 %.
    assert error_allowed(carom.Recording.of(x, v, dt=0.01)) == pytest.approx(5 * share, rel=0.05)


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
