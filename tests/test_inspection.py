"""What recorded data show before learning: each fault that is planted is found, and sound data have none."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.learning.config import LearnConfig
from carom.learning.estimation.inspection import inspect_recording
from carom.recordings.recording_checks import check_recording, compare_rates, position_noise, step_motion

BALL = carom.System(
    bodies=[carom.PointMass(mass=1.0, radius=0.1)],
    contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
    potential=carom.Gravity((0.0, -9.81)),
    friction=0.3,
    restitution=0.7,
)
PENDULUM = carom.System(
    bodies=[carom.PointMass(mass=1.0, radius=0.1)],
    constraints=[carom.Tether(0, anchor=(0.0, 0.0), length=1.0)],
    potential=carom.Gravity((0.0, -9.81)),
)


@pytest.fixture(scope="module")
def tosses() -> carom.Recording:
    rng = np.random.default_rng(0)
    x0 = np.stack([rng.uniform(-1, 1, 20), rng.uniform(0.3, 0.8, 20)], axis=1)[:, None]
    v0 = rng.normal(0, 1, (20, 1, 2))
    return carom.recording_of(carom.simulate(BALL, jnp.asarray(x0), jnp.asarray(v0), dt=0.005, steps=120))


def advice(recording, system=BALL, config=None) -> dict[str, str]:
    findings = inspect_recording(recording, system, config).findings
    return {finding.check: finding.advice for finding in findings if finding.advice}


def changed(recording, **arrays):
    return dataclasses.replace(recording, **arrays)


def test_sound_data_have_no_advice(tosses):
    found = inspect_recording(tosses, BALL)
    assert advice(tosses) == {}
    assert found.closings[0] >= 20
    said = {finding.check: finding.found for finding in found.findings}
    assert said["acceleration in free flight"].startswith("9.81 m/s^2")  # second differences of a parabola are exact
    assert said["velocities"].startswith("1 times")


def test_units_and_time_steps_that_are_wrong(tosses):
    millimetres = changed(tosses, x=tosses.x * 1000, v=tosses.v * 1000)
    found = advice(millimetres)
    assert "1e+03 times what the system says" in found["acceleration in free flight"]
    assert "contacts may pass between samples" in found["longest way of a step"]
    assert "are units right" in advice(changed(tosses, v=tosses.v * 1000))["velocities"]
    slow = advice(changed(tosses, dt=0.01))
    assert "is the time step 0.01 s?" in slow["velocities"]
    assert "0.25 times" in slow["acceleration in free flight"]
    upward = changed(tosses, x=tosses.x * [1, -1], v=tosses.v * [1, -1])
    assert "does it point down?" in advice(upward)["acceleration in free flight"]
    assert "through walls" in advice(upward)["states in contact"]


def test_velocities_that_are_late(tosses):
    backward = np.diff(tosses.x, axis=1, prepend=tosses.x[:, :1] - tosses.dt * tosses.v[:, :1]) / tosses.dt
    rates = compare_rates(changed(tosses, v=backward))
    assert rates is not None
    assert rates.lag == pytest.approx(0.5 * tosses.dt, rel=1e-3)  # half a step, but for the steps next to an impact
    assert "differences of the past" in advice(changed(tosses, v=backward))["velocities are late by"]
    forward = np.roll(backward, -1, axis=1)
    assert "later times" in advice(changed(tosses, v=forward))["velocities are late by"]
    exact = compare_rates(tosses)
    assert exact is not None
    assert abs(exact.lag or 0) < 1e-3 * tosses.dt


def test_noise_is_measured(tosses):
    rng = np.random.default_rng(1)
    for sd in (1e-4, 3e-3):
        noisy = changed(tosses, x=tosses.x + sd * rng.normal(size=tosses.x.shape))
        assert position_noise(noisy) == pytest.approx(sd, rel=0.05)  # 2400 vectors: 1.5 % of a standard deviation
    assert "docs/noise.md" in advice(noisy)["noise of positions"]
    assert step_motion(tosses) == pytest.approx(tosses.dt * np.sqrt(np.mean(np.sum(tosses.v**2, axis=-1))))


def test_rods_that_do_not_fit():
    angle = np.linspace(0, 1, 30)[None] + np.linspace(0, 0.5, 4)[:, None]
    x = np.stack([np.sin(angle), -np.cos(angle)], axis=-1)[:, :, None]
    v = np.gradient(x, 0.01, axis=1)
    right = carom.Recording.of(x, v, dt=0.01)
    assert "rods and joints are off by" not in advice(right, PENDULUM)
    assert "lengths of rods" in advice(changed(right, x=1.005 * x), PENDULUM)["rods and joints are off by"]
    assert "`learn` refuses it" in advice(changed(right, x=1.1 * x), PENDULUM)["rods and joints are off by"]


def test_contacts_that_are_too_few_or_too_fast(tosses):
    flying = changed(tosses, x=tosses.x + np.array([0, 10.0]), contact=None)
    found = advice(flying)
    assert "too few to tell" in found["impacts of property 0"]
    assert "no contact to learn from" in found["chunks of 5 states"]
    every_tenth = changed(
        tosses,
        **{name: getattr(tosses, name)[:, ::10] for name in ("x", "v", "contact")},
        time=tosses.time[::10],
        length=np.full(20, 13),
        dt=0.05,
    )
    assert "record at " in advice(every_tenth)["longest way of a step"]
    assert "give --chunk-length 13" in advice(every_tenth, config=LearnConfig(chunk_length=20))["chunks of 20 states"]


def test_recordings_of_another_system_are_refused(tosses):
    with refused("the recording has 1 points in 2D, the system 3 in 2D"):
        inspect_recording(tosses, carom.task("cp3"))


def test_short_and_motionless_recordings():
    still = carom.Recording.of(np.ones((2, 9, 1, 2)), np.zeros((2, 9, 1, 2)), dt=0.01)
    findings = {finding.check: finding for finding in check_recording(still)}
    assert findings["way of a step, typical"].advice == "nothing moves"
    assert "velocities" not in findings
    short = carom.Recording.of(np.ones((2, 2, 1, 2)), np.ones((2, 2, 1, 2)), dt=0.01)
    assert [finding.check for finding in check_recording(short)] == [
        "positions, by axis",
        "speed, median and largest",
        "way of a step, typical",
    ]
