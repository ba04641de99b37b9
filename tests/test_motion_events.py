"""Breaks of motion: none in noise and in smooth motion, and impacts where closed forms have them."""

import numpy as np
import pytest

from carom.recordings.motion_events import motion_breaks
from carom.recordings.motion_windows import series_of
from carom.recordings.observations import Observations


def observed(time, x) -> Observations:
    return Observations(np.broadcast_to(time, x.shape[:2]).copy(), x)


def kinked(time, tau, jump, rng, forces: float = 0.0) -> np.ndarray:
    """Points (N, T, 1, 2) that move evenly, but for a smooth force, and jump by `jump` (m/s) along x at `tau`."""
    v, phase = rng.normal(size=(len(tau), 1, 2)), rng.uniform(0, 6, (len(tau), 1, 2))
    x = v * time[..., None] + forces * np.sin(7 * time[..., None] + phase)
    x[..., 0] += jump * np.maximum(time - tau, 0)
    return x[:, :, None]


@pytest.mark.parametrize(("missing", "jitter", "dim"), [(0.0, 0.0, 2), (0.3, 2e-3, 3)])
def test_noise_alone_breaks_no_motion(missing, jitter, dim):
    rng = np.random.default_rng(0)
    time = np.arange(120) / 120 + rng.uniform(-jitter, jitter, (100, 120))
    wave = 0.1 * np.sin(2 * time)[..., None] * rng.normal(size=(100, 1, dim))
    x = (wave + time[..., None] + 1e-3 * rng.normal(size=(100, 120, dim)))[:, :, None]
    x[rng.random((100, 120)) < missing] = np.nan
    found = motion_breaks(observed(time, x))
    # About one in a thousand samples at most: 12 (8), with a standard deviation of 3.
    assert len(found.time) < 1e-3 * np.isfinite(x[..., 0]).sum() + 9


def test_each_session_has_its_own_noise():
    """Two cameras, of which one is a hundred times better."""
    rng = np.random.default_rng(0)
    time = np.arange(60) / 120
    size = np.repeat([1e-4, 1e-2], [40, 20])
    x = (np.broadcast_to(time[:, None], (60, 60, 2)) + size[:, None, None] * rng.normal(size=(60, 60, 2)))[:, :, None]
    apart = observed(time, x)._replace(group=("good",) * 40 + ("bad",) * 20)
    assert len(motion_breaks(apart).time) <= 6
    series = series_of(apart, (0,))
    assert series is not None
    # A median of some 1000 differences, which overlap: known to a few per cent.
    np.testing.assert_allclose(series.unit, np.repeat(size[:, None], 2, axis=1), rtol=0.15)


@pytest.mark.parametrize("rate", [60, 500])
@pytest.mark.parametrize("forces", [0.0, 0.05])
def test_smooth_exact_motion_does_not_break(rate, forces):
    time = np.arange(100) / rate
    x = kinked(time, np.full((20, 1), np.inf), 0.0, np.random.default_rng(0), forces)
    assert len(motion_breaks(observed(time, x)).time) == 0


@pytest.mark.parametrize(("rate", "noise"), [(60, 0.0), (120, 2e-4), (500, 2e-4)])
def test_a_jump_of_velocity_is_found_where_it_is(rate, noise):
    """One jump a trajectory, of 10 standard errors of a parabola with a kink at a known time, in 40 samples."""
    rng = np.random.default_rng(1)
    count = 100
    time = np.arange(60) / rate
    tau = rng.uniform(time[20], time[40], (count, 1))
    t = time[:40] - time[:40].mean()
    columns = np.stack([t**0, t, t**2, np.maximum(t, 0)], axis=1)
    error = noise * np.sqrt(np.linalg.inv(columns.T @ columns)[-1, -1])
    jump = 10 * error if noise else 1e-3
    x = kinked(time, tau, jump, rng, forces=0.02 if rate == 500 else 0.0)
    found = motion_breaks(observed(time, x + noise * rng.normal(size=x.shape)))
    first = [
        np.flatnonzero(found.trajectory == k)[np.argsort(-found.size[found.trajectory == k])[:1]] for k in range(count)
    ]
    seen = np.array([k for k, own in enumerate(first) if len(own)])
    at = np.concatenate(first)
    off = found.time[at] - tau[seen, 0]
    if noise == 0:
        assert len(found.time) == count
        assert np.all((time[found.before] <= tau[:, 0]) & (tau[:, 0] <= time[found.after]))
        np.testing.assert_allclose(off, 0, atol=1e-9 / rate * 1e3)
        np.testing.assert_allclose(found.jump, np.tile([jump, 0], (count, 1)), atol=1e-9)
    else:
        assert len(seen) > 0.9 * count
        assert np.mean(np.abs(off) < 2 / rate) > 0.9
        z = (found.jump[at] - [jump, 0]) * found.size[at, None] / np.linalg.norm(found.jump[at], axis=1)[:, None]
        assert 0.7 < z.std() < 1.4


def bounced(time, height: float, e: float, g: float = 9.81) -> tuple[np.ndarray, list[float]]:
    """Heights of a ball dropped from `height`, in closed form, and the times of its impacts."""
    impact, speed = np.sqrt(2 * height / g), np.sqrt(2 * g * height) * e
    impacts, y, start = [], height - g * time**2 / 2, impact
    while start < time[-1] and speed > 0.05:
        impacts.append(start)
        after = time - start
        y = np.where(after > 0, speed * after - g * after**2 / 2, y)
        start, speed = start + 2 * speed / g, e * speed
    return y, impacts


@pytest.mark.parametrize("noise", [0.0, 5e-4])
def test_a_bouncing_ball_breaks_at_its_impacts(noise):
    rng = np.random.default_rng(0)
    time = np.arange(180) / 120
    truth, parts = [], []
    for k in range(20):
        y, impacts = bounced(time, 0.5 + 0.02 * k, 0.8)
        parts.append(np.stack([0.3 * time, y], axis=-1))
        truth += [(k, tau) for tau in impacts if time[4] < tau < time[-5]]
    x = np.array(parts)[:, :, None]
    found = motion_breaks(observed(time, x + noise * rng.normal(size=x.shape)))
    hit = [np.any((found.trajectory == k) & (np.abs(found.time - tau) < 1 / 120)) for k, tau in truth]
    assert len(truth) == 50
    assert np.mean(hit) > 0.98
    assert len(found.time) < 1.05 * len(truth) + 2
    np.testing.assert_allclose(found.jump[:, 0], 0, atol=1e-8 if noise == 0 else 0.2)


def test_two_disks_break_at_once_and_only_then():
    """Head on, of masses 1 and 2: v1' - v1 = -2 (v2' - v2), at an instant between two samples."""
    rng = np.random.default_rng(0)
    time, tau = np.arange(60) / 100, 0.3033
    after = np.maximum(time - tau, 0)[:, None]
    one, two = np.array([-1.2, 0.0]), np.array([0.6, 0.0])
    x = np.stack([0.7 * (time[:, None] - tau) + one * after, -0.2 * (time[:, None] - tau) + two * after], axis=1)
    x = x + [[0, 0], [0.2, 0]] + 1e-4 * rng.normal(size=(30, 60, 2, 2))
    found = motion_breaks(observed(time, x))
    at = found.before == 30
    assert at.sum() >= 58
    np.testing.assert_allclose(np.mean(found.jump[at & (found.body == 0)], axis=0), one, atol=0.01)
    np.testing.assert_allclose(np.mean(found.jump[at & (found.body == 1)], axis=0), two, atol=0.01)
    assert (~at).sum() <= 4


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_two_impacts_in_short_succession_are_one_between_the_samples_around_both(noise):
    """In a corner: first x, then y turns around, with a sample in between."""
    rng = np.random.default_rng(0)
    time = np.arange(60) / 100
    first, second = 0.3033 + 0.01 * rng.uniform(0, 0.6, (20, 1)), 0.3033 + 0.01 * rng.uniform(0.7, 1.6, (20, 1))
    x = np.stack([time - 1.9 * np.maximum(time - first, 0), 0.7 * time - 1.3 * np.maximum(time - second, 0)], axis=-1)
    found = motion_breaks(observed(time, x[:, :, None] + noise * rng.normal(size=(20, 60, 1, 2))))
    assert found.trajectory.tolist() == list(range(20))
    around = (time[found.before] < first[:, 0]) & (second[:, 0] < time[found.after])
    # With noise the sample in between may pass for one after both, or before, where one of the two is next to it.
    assert around.all() if noise == 0 else np.mean(around) > 0.75
    assert np.all(found.after - found.before <= 3)
    np.testing.assert_allclose(found.jump, np.tile([-1.9, -1.3], (20, 1)), atol=1e-8 if noise == 0 else 0.1)


@pytest.mark.parametrize("size", [0.01, 1.0])
def test_a_sample_that_is_wrong_is_no_impact(size):
    rng = np.random.default_rng(0)
    time = np.arange(60) / 100
    x = np.broadcast_to(time[:, None], (20, 60, 2)) + 1e-4 * rng.normal(size=(20, 60, 2))
    x[:, 30] += size
    assert len(motion_breaks(observed(time, x[:, :, None])).time) == 0


def test_a_rigid_body_breaks_where_only_its_rotation_does():
    rng = np.random.default_rng(0)
    time = np.arange(80) / 150
    angle = 3 * time + 2.0 * np.maximum(time - 0.2513, 0) + rng.uniform(0, 6, (10, 1))
    c, s, zero = np.cos(angle), np.sin(angle), 0 * angle
    planar = np.stack([np.stack([zero, zero], -1), np.stack([c, s], -1), np.stack([-s, c], -1)], axis=2)
    found = motion_breaks(observed(time, planar + time[:, None, None]), [(0, 1, 2)])
    assert found.before.tolist() == [37] * 10
    np.testing.assert_allclose(found.jump, 0, atol=1e-9)
    zero = np.stack([zero] * 3, axis=-1)
    axes = [np.stack(a, -1) for a in ((c, s, 0 * c), (-s, c, 0 * c), (0 * c, 0 * c, 1 + 0 * c))]
    solid = np.stack([zero, *axes], axis=2) + 1e-5 * rng.normal(size=(10, 80, 1, 3))
    found = motion_breaks(observed(time, solid), [(0, 1, 2, 3)])
    assert np.all(np.abs(found.before - 37) <= 1)
    assert len(found.before) >= 10


def test_what_is_too_short_or_still_does_not_break():
    still = np.zeros((3, 40, 1, 2))
    assert len(motion_breaks(observed(np.arange(40) / 100, still)).time) == 0
    assert len(motion_breaks(observed(np.arange(4) / 100, still[:, :4])).time) == 0


def test_impacts_of_worlds_that_carom_did_not_make(reference_dir):
    """Velocities of the file, which are the true ones, jump there, and hardly anywhere else."""
    with np.load(reference_dir / "worlds" / "pucks_noisy.npz") as file:
        x, v, time = (file[name][:40] if name != "time" else file[name] for name in ("x", "v_true", "time"))
    found = motion_breaks(observed(time, x))
    change = np.linalg.norm(np.diff(v, axis=1), axis=-1)  # free motion is straight here
    jumps = change > 1e-6
    near = jumps.copy()
    near[:, 1:] |= jumps[:, :-1]
    near[:, :-1] |= jumps[:, 1:]
    assert np.mean(near[found.trajectory, found.before, found.body]) > 0.97
    clear = jumps.copy()  # by themselves, for 8 samples, and not at an end
    for shift in range(1, 9):
        clear[shift:] &= True
        clear[:, shift:] &= ~jumps[:, :-shift]
        clear[:, :-shift] &= ~jumps[:, shift:]
    clear[:, :8] = clear[:, -8:] = False
    clear &= change > 0.1
    hit = np.zeros(jumps.shape, bool)
    hit[found.trajectory, found.before, found.body] = True
    hit[:, 1:] |= hit[:, :-1].copy()
    hit[:, :-1] |= hit[:, 1:].copy()
    assert clear.sum() > 100
    assert np.mean(hit[clear]) > 0.98
