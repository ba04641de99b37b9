"""Recorded poses: read, checked, made into points and back; velocities that know about impacts."""

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from systems import refused

import carom
from carom.mechanics.bodies import recover_velocity
from carom.recordings.corner_impacts import mass_balance
from carom.recordings.pose_checks import check_poses, find_copies, flight_noise
from carom.recordings.poses import (
    PoseRecording,
    flight_acceleration,
    free_flight,
    impacts,
    load_poses,
    poses_of,
    velocity_lag,
    with_velocities,
)

DT = 1 / 148
WIDTH = 0.1024


@pytest.fixture(scope="module")
def tosses(cube_tosses):
    """Eight simulated tosses of the cube: points, velocities (8, 61, 4, 3), and contact (8, 61)."""
    return tuple(part[:8] for part in cube_tosses)


def recorded(tosses, **changes) -> PoseRecording:
    position, quaternion = poses_of(tosses[0])
    return PoseRecording.of(**{"position": position, "quaternion": quaternion, "dt": DT, **changes})


def test_points_and_poses_are_the_same(tosses):
    position, quaternion = poses_of(tosses[0])
    assert np.allclose(np.linalg.norm(quaternion, axis=-1), 1)
    expected = Rotation.from_quat(quaternion[3, 20], scalar_first=True).as_matrix()
    axes = tosses[0][3, 20, 1:] - tosses[0][3, 20, :1]
    assert np.allclose(axes, expected.T, atol=1e-12)
    again = recorded(tosses).to_recording()
    assert np.allclose(again.x, tosses[0], atol=1e-9)
    assert np.allclose(position, tosses[0][:, :, 0])


def test_velocities_are_estimated_up_to_impacts(tosses):
    x, v, contact = tosses
    estimated = recorded(tosses).to_recording()
    # Away from impacts by a sample on each side, where a step with one tells nothing about the velocity at its end.
    near = contact.copy()
    near[:, :-1] |= contact[:, 1:]
    near[:, 1:] |= contact[:, :-1]
    away = ~near
    away[:, 0] = away[:, -1] = False
    assert away.sum() > 100
    velocity, omega = (np.asarray(p) for p in recover_velocity(jnp.asarray(estimated.x), jnp.asarray(estimated.v)))
    true_velocity, true_omega = (np.asarray(p) for p in recover_velocity(jnp.asarray(x), jnp.asarray(v)))
    assert np.median(np.abs(velocity - true_velocity)[away]) < 1e-3
    assert np.median(np.abs(omega - true_omega)[away]) < 0.05
    assert np.quantile(np.linalg.norm(velocity - true_velocity, axis=-1)[away], 0.9) < 0.05


@pytest.mark.parametrize("rate", [2.0, 45.0])
def test_rates_are_estimated_where_few_samples_turn_far(rate):
    """At 30 Hz, 45 rad/s are 1.5 rad from sample to sample, and more than pi within the window of a parabola."""
    axis, time = np.array([2.0, -1.0, 2.0]) / 3, np.arange(20) / 30
    turns = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]) * Rotation.from_rotvec(rate * time[:, None] * axis)
    position = np.zeros((1, 20, 3))
    poses = PoseRecording.of(position, turns.as_quat(scalar_first=True)[None], dt=1 / 30)
    assert np.allclose(with_velocities(poses).omega, rate * axis, atol=1e-6)


def test_impacts_are_found_and_flight_ends_before_them(tosses):
    poses, contact = recorded(tosses), tosses[2]
    found = impacts(poses)
    first_true, first_found = contact.argmax(axis=1), found.argmax(axis=1)
    # A step that ends at sample k with a contact bends the motion between k - 1 and k.
    assert np.all(np.abs(first_true - first_found) <= 1)
    assert not (free_flight(poses) & contact).any()
    assert np.isclose(flight_acceleration(poses), -9.61, atol=1e-3)


def late(tosses, **changes):
    """Velocities as backward differences: half a sample old."""
    position = tosses[0][:, :, 0]
    velocity = np.concatenate([np.zeros((8, 1, 3)), np.diff(position, axis=1) / DT], axis=1)
    velocity[:, 0] = velocity[:, 1] + np.array([0, 0, 9.61 * DT])
    omega = np.zeros_like(velocity)
    return recorded(tosses, velocity=velocity, omega=omega, **changes)


def test_late_velocities_are_noticed(tosses):
    assert np.isclose(velocity_lag(late(tosses)), DT / 2, rtol=0.02)
    exact = recorded(tosses, velocity=tosses[1][:, :, 0], omega=np.zeros((8, 61, 3)))
    assert abs(velocity_lag(exact)) < 0.02 * DT


def test_checks_say_what_is_wrong(tosses):
    sound = {f.check: f for f in check_poses(recorded(tosses), WIDTH)}
    assert sound["gravity in free flight"].found == "9.610 m/s^2"
    assert "2.0% too short" in sound["gravity in free flight"].advice
    # Simulated bodies sink in by a millimetre or two where they rest.
    narrow = {f.check: f for f in check_poses(recorded(tosses), 0.95 * WIDTH)}
    assert narrow["deepest corner (1 % quantile)"].advice == ""
    rest = float(sound["height at rest"].found.removesuffix(" mm")) / 1e3
    assert WIDTH / 2 - 1.5e-3 < rest <= WIDTH / 2
    assert f"{rest / (0.95 * WIDTH / 2) - 1:.1%} off; learn half_width" in narrow["height at rest"].advice
    assert sound["copies"].advice == ""
    wide = {f.check: f for f in check_poses(late(tosses), 1.1 * WIDTH)}
    assert "sinks into the table" in wide["deepest corner (1 % quantile)"].advice
    assert "half" not in wide["velocities are late by"].advice
    assert "free fall" in wide["velocities are late by"].advice
    noisy = recorded(tosses, position=poses_of(tosses[0])[0] + 1e-3 * np.random.default_rng(0).normal(size=(8, 61, 3)))
    assert 0.7e-3 < flight_noise(noisy) < 1.1e-3


def test_copies_are_found_however_they_are_turned(tosses):
    position, quaternion = poses_of(tosses[0][:3])
    turn = Rotation.from_euler("z", 0.7)
    turned = (turn * Rotation.from_quat(quaternion[1], scalar_first=True)).as_quat(scalar_first=True)
    moved = np.concatenate([position, turn.apply(np.array(position[1]))[None]])
    both = PoseRecording.of(moved, np.concatenate([quaternion, turned[None]]), dt=DT)
    assert find_copies(both) == [(1, 3)]


def content(tosses, ragged=False):
    position, quaternion = poses_of(tosses[0])
    if not ragged:
        return {"position": position, "quaternion": quaternion, "dt": DT}
    lengths = np.array([61, 30, 61, 20, 61, 61, 10, 61])
    rows = [np.s_[k, :length] for k, length in enumerate(lengths)]
    return {
        "pos": np.concatenate([position[r] for r in rows]),
        "quat": np.concatenate([quaternion[r] for r in rows]),
        "offsets": np.concatenate([[0], np.cumsum(lengths)]),
        "group": np.arange(8) // 2,
        "dup_of": np.where(np.arange(8) == 5, 2, -1),
        "dt": DT,
    }


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("ragged", [False, True])
def test_pose_files(tmp_path, tosses, suffix, ragged):
    path, arrays = tmp_path / f"poses{suffix}", content(tosses, ragged)
    if suffix == ".npz":
        np.savez(path, **arrays)
    else:
        with h5py.File(path, "w") as file:
            for name, value in arrays.items():
                file[name] = value
    poses, copies = load_poses(path)
    assert copies == (1 if ragged else 0)
    assert len(poses.length) == 8 - copies
    if ragged:
        assert poses.length.tolist() == [61, 30, 61, 20, 61, 10, 61]
        assert poses.group.tolist() == [0, 0, 1, 1, 2, 3, 3]
        assert load_poses(path, keep_copies=True)[0].length.sum() == arrays["offsets"][-1]
    recording = poses.to_recording(task="cube")
    assert np.allclose(recording.x[0], tosses[0][0], atol=1e-9)
    carom.save_recording(tmp_path / "out.h5", recording)
    again = carom.load_recording(tmp_path / "out.h5", task="cube")
    assert (again.group is None) == (not ragged)
    assert np.array_equal(again.length, recording.length)


@pytest.mark.parametrize("decimals", [3, 4, 6])
def test_times_of_poses_may_be_rounded(tmp_path, tosses, decimals):
    arrays = content(tosses)
    times = np.round(1.7e9 + np.arange(61) / 120, decimals)
    del arrays["dt"]
    np.savez(tmp_path / "poses.npz", **arrays, time=times)
    assert abs(load_poses(tmp_path / "poses.npz")[0].dt - 1 / 120) < 2 * 10.0**-decimals / 61
    np.savez(tmp_path / "gap.npz", **arrays, time=times + (times > times[30]))
    with refused("time must have equal steps; that after sample 30 was 1.008"):
        load_poses(tmp_path / "gap.npz")


BROKEN = {
    "no poses": ({"position": None}, "position or pos is missing"),
    "shape": ({"quaternion": np.zeros((8, 61, 3))}, "quaternion must have the shape"),
    "not unit": ({"quaternion": np.ones((8, 61, 4))}, "quaternion must have length 1"),
    "no time": ({"dt": None}, "dt (s) is missing"),
    "uneven": ({"dt": None, "time": np.arange(61) ** 1.1}, "time must have equal steps"),
    "nan": ({"position": np.full((8, 61, 3), np.nan)}, "position must be finite; trajectory 0, sample 0"),
    "offsets": ({"offsets": np.array([0, 5, 3])}, "offsets must rise"),
    "text": ({"position": np.array(["a"])}, "position must hold numbers"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_pose_file_is_refused(tmp_path, tosses, name):
    change, message = BROKEN[name]
    arrays = {k: v for k, v in (content(tosses) | change).items() if v is not None}
    np.savez(tmp_path / "poses.npz", **arrays)
    with refused(message):
        load_poses(tmp_path / "poses.npz")


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "poses.npz").write_text("no zip")
    for path, message in (("poses.npz", "cannot be read"), ("none.npz", "no such file"), ("poses.csv", "must end in")):
        with refused(message):
            load_poses(tmp_path / path)


def test_the_recorded_cube_shows_its_quirks(reference_dir):
    """What its description found by hand."""
    poses, copies = load_poses(reference_dir / "cube_tosses_val.npz")
    assert (len(poses.length), copies) == (109, 7)
    assert np.isclose(flight_acceleration(poses), -9.61, atol=0.02)
    assert np.isclose(velocity_lag(poses) / poses.dt, 0.5, atol=0.05)
    findings = {f.check: f for f in check_poses(poses, 0.1048)}
    assert "2.0% too short" in findings["gravity in free flight"].advice
    assert findings["height at rest"].found.startswith("51.2")
    assert find_copies(poses) == []
    assert len(find_copies(load_poses(reference_dir / "cube_tosses_val.npz", keep_copies=True)[0])) == 7
    assert np.median(impacts(poses).argmax(axis=1)) == 15
    # Estimated from poses alone, velocities are those that were recorded, but for their age and noise.
    flight = free_flight(poses)[:, :-1]
    estimated = with_velocities(poses).velocity[:, :-1]
    assert np.median(np.abs(estimated - poses.velocity[:, :-1])[..., :2][flight]) < 5e-3


def test_impacts_at_one_corner_tell_where_the_mass_is():
    """Impulses of any size and direction at the lowest corner of a box with its mass off the middle; noise too."""
    rng = np.random.default_rng(0)
    center, inertia, fall = np.array([2e-3, -1e-3, 6e-3]), 2.5e-3, np.array([0, 0, -9.81])
    signs = np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)])
    position, rotation = np.zeros((80, 21, 3)), np.zeros((80, 21, 3, 3))
    time = (np.arange(21) - 10.4) * DT  # the impact is at time 0
    for k in range(80):
        turn = Rotation.random(random_state=k)
        v, w = np.array([*rng.normal(size=2), -1.2]), rng.normal(size=3) * 4
        corners = turn.apply(signs * WIDTH / 2 - center)
        arm = corners[corners[:, 2].argmin()]
        impulse = np.array([*0.1 * rng.normal(size=2), rng.uniform(0.4, 0.7)])
        after = v + impulse, w + np.cross(arm, impulse) / inertia
        for t, moment in enumerate(time):
            speed, rate = (v, w) if moment < 0 else after
            now = Rotation.from_rotvec(rate * moment) * turn
            position[k, t] = np.array([0, 0, -arm[2]]) + speed * moment + fall * moment**2 / 2 - now.apply(center)
            rotation[k, t] = now.as_matrix()
    quaternion = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True).reshape(80, 21, 4)
    position += 2e-5 * rng.normal(size=position.shape)
    poses = PoseRecording.of(position, quaternion, dt=DT)
    found = mass_balance(poses, WIDTH)
    assert found is not None
    assert found.impacts > 30
    assert np.allclose(found.center, center, atol=3e-4)
    assert found.inertia == pytest.approx(inertia, rel=0.03)
    middle, best = found.unexplained
    assert best < 0.05 < middle
    (finding,) = [f for f in check_poses(poses, WIDTH) if f.check.startswith("centre of mass")]
    assert "not in the middle" in finding.advice
    assert mass_balance(poses.select(np.arange(5)), WIDTH) is None
