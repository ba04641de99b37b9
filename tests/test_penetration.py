"""Penetration compensation over N time steps or none: the paper's figure S.2, its system and its picture."""

import jax
import numpy as np
import pytest
from PIL import Image
from systems import ball_on_floor, refused

import carom
from docs.figures import penetration

GRAVITY, DT = 9.81, penetration.DT


@pytest.fixture(scope="module")
def gaps():
    """Gap (m) over time for each number of steps, and the step of the impact, which is the same for all."""
    out = {steps: penetration.gaps(penetration.drop(steps)) for steps in penetration.ROWS}
    impact = {int(np.argmax(gap < 0)) for gap in out.values()}
    assert len(impact) == 1
    return out, impact.pop()


def test_undone_in_one_step_it_bounces(gaps):
    gap, k = gaps[0][1], gaps[1]
    # It leaves with the depth over dt, and a step's fall later that is still nearly all of its speed.
    up = -gap[k] / DT
    time = DT * np.arange(len(gap) - k)
    np.testing.assert_allclose(gap[k:], gap[k] + up * time - GRAVITY * time**2 / 2, atol=1e-9)  # the solver's tolerance
    assert gap.max() > 0.9 * penetration.HEIGHT
    assert gap[-1] > 0.1  # although e = 0


def test_undone_in_four_steps_it_stays(gaps):
    gap, k = gaps[0][4], gaps[1]
    assert gap[k] < -0.019
    # Never clear of the ground again, and the penetration is undone but for what gravity adds in each step: at rest
    # depth / (N dt) dt = g dt^2 / 2.
    assert np.all(gap[k:] < 0)
    rest = -4 * GRAVITY * DT**2 / 2
    # Each step undoes a quarter of what is above that: closed form of the recursion.
    steps = np.arange(len(gap) - k)
    late = gap[k + 3 :], rest + (gap[k + 3] - rest) * 0.75 ** steps[: len(gap) - k - 3]
    np.testing.assert_allclose(*late, atol=1e-8)


def test_not_undone_it_sinks_by_each_steps_fall(gaps):
    gap, k = gaps[0][None], gaps[1]
    steps = np.arange(len(gap) - k)
    np.testing.assert_allclose(gap[k:], gap[k] - steps * GRAVITY * DT**2 / 2, atol=1e-8)  # the solver's tolerance


def test_the_figure_is_drawn(tmp_path):
    with Image.open(penetration.draw(tmp_path / "penetration.png")) as picture:
        assert picture.size[0] > 1200
        colors = np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)
    assert len(colors) > 50


@pytest.mark.parametrize("steps", [0, -1.0, float("nan"), float("inf")])
def test_bad_compensation_steps_are_refused(steps):
    message = f"compensation_steps must be a positive number, or None for no compensation; it was {steps}"
    start = np.array([[0.0, 0.1]]), np.zeros((1, 2))
    with refused(message):
        carom.simulate(ball_on_floor(), *start, dt=0.01, steps=1, compensation_steps=steps)
    with refused(message):
        carom.LearnConfig(compensation_steps=steps).check()


@pytest.mark.slow
def test_recordings_and_evaluations_take_compensation_steps():
    """Predictions equal a recording that was made with the same, and differ from others."""
    system = carom.task("cp3")
    with_none = carom.make_recording(system, jax.random.key(0), 20, compensation_steps=None)
    assert with_none.contact.any()
    same, _ = carom.evaluate(system, with_none, compensation_steps=None)
    other, _ = carom.evaluate(system, with_none)
    assert same["trajectory_error"] == 0
    assert other["trajectory_error"] > 1e-4
