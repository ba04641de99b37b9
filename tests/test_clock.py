"""Times in equal steps, rounded to decimals or to what floats hold; and times that are not."""

import numpy as np
import pytest

import carom


def step_of(times, **others) -> float:
    times = np.asarray(times)
    states = np.zeros((len(times) if times.ndim == 2 else 2, times.shape[-1], 1, 2))
    return carom.Recording.of(states, states, time=times, **others).dt


@pytest.mark.parametrize("start", [0.0, 7.2345678, 1.7e9])
@pytest.mark.parametrize("decimals", [3, 4, 6, 7])
@pytest.mark.parametrize("rate", [30, 120, 240, 360])
def test_times_rounded_to_decimals(rate, decimals, start):
    times = np.round(start + np.arange(200) / rate, decimals)
    digit = 10.0**-decimals + np.spacing(start)
    assert abs(step_of(times) - 1 / rate) < 2 * digit / 200
    # Several that start apart, in rows; with the step beside them, which is then taken.
    rows = np.stack([times, np.round(start + 0.12345 + np.arange(200) / rate, decimals)])
    assert abs(step_of(rows) - 1 / rate) < 2 * digit / 200
    assert step_of(times, dt=1 / rate) == 1 / rate


@pytest.mark.parametrize("decimals", [3, 6, None])
def test_times_since_1970_from_which_the_first_was_taken(decimals):
    times = 1.7e9 + np.arange(500) / 240
    times = times if decimals is None else np.round(times, decimals)
    assert step_of(times - times[0]) == pytest.approx(1 / 240, rel=1e-3 if decimals == 3 else 1e-6)


@pytest.mark.parametrize("later", [np.float32, float])
def test_times_in_single_precision(later):
    times = np.arange(5000) / 120
    assert step_of(times.astype(np.float32).astype(later)) == pytest.approx(1 / 120, rel=1e-7)
    assert step_of(np.round(times, 3).astype(np.float32).astype(later)) == pytest.approx(1 / 120, rel=1e-5)


def test_summed_times_have_equal_steps():
    times = np.cumsum(np.full(100_000, 1 / 240))
    assert step_of(times) == pytest.approx(1 / 240, rel=1e-11)


def test_rounded_times_become_the_line():
    states = np.zeros((1, 60, 1, 2))
    recording = carom.Recording.of(states, states, time=np.round(np.arange(60) / 360, 3))
    np.testing.assert_allclose(np.diff(recording.time), recording.dt, rtol=1e-12)
    np.testing.assert_allclose(recording.time, np.arange(60) / 360, atol=5e-4)  # half of the last digit


UNEVEN = {
    "gap": (lambda t: np.delete(t, 20), "have equal steps; the step after time 19 was 0.01"),
    "doubled": (lambda t: np.insert(t, 20, t[20]), "increase; the step after time 20 was 0 s"),
    "back": (lambda t: np.concatenate([t[:20], t[20:22][::-1], t[22:]]), "increase; the step after time 20 was -0.00"),
    "late": (lambda t: t + 0.003 * (np.arange(60) == 30), "have equal steps; the step after time 29 was 0.01"),
}


@pytest.mark.parametrize("decimals", [3, 6, 12])
@pytest.mark.parametrize("name", UNEVEN)
def test_other_irregularities_are_refused(name, decimals):
    change, said = UNEVEN[name]
    with pytest.raises(carom.CaromError) as error:
        step_of(change(np.round(np.arange(60) / 120, decimals)))
    assert said in str(error.value)


@pytest.mark.parametrize("times", [np.delete(np.arange(20) * 0.25, 9), np.delete(np.arange(20) * 0.01, 9)])
def test_a_lost_sample_is_not_taken_for_rounding(times):
    with pytest.raises(carom.CaromError, match="the step after time 8 was"):
        step_of(times)


@pytest.mark.parametrize("sd", [1e-4, 1e-5])
def test_a_clock_that_jitters_is_refused(sd):
    times = np.arange(60) / 100 + np.random.default_rng(0).normal(0, sd, 60)
    with pytest.raises(carom.CaromError, match="time must have equal steps"):
        step_of(np.round(times, 6))


def test_digits_as_coarse_as_the_step_are_named():
    with pytest.raises(carom.CaromError, match="give times with more digits"):
        step_of(np.round(np.arange(60) / 75, 2))
