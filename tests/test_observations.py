"""What people record: positions alone, missing samples, any times, several files."""

import h5py
import numpy as np
import pytest
from systems import refused
from trajectory_files import a_recording, content, write

import carom
from carom.recordings.observations import Observations, load_observations, save_observations

NAN = np.nan
POINT = carom.System(bodies=[carom.PointMass(1.0)])


def fallen(time, *, dim: int = 2) -> np.ndarray:
    """A point that falls, (1, T, 1, dim)."""
    time = np.asarray(time, float)
    axes = [0.3 * time, 1 + time - 4.905 * time**2, 0 * time]
    return np.stack(axes[:dim], axis=-1)[None, :, None]


def same(a: Observations, b: Observations) -> bool:
    pairs = [(p, q) for p, q in zip(a[:4], b[:4], strict=True) if p is not None or q is not None]
    return a.group == b.group and all(
        p is not None and q is not None and np.array_equal(p, q, equal_nan=p.dtype.kind == "f") for p, q in pairs
    )


# --- arrays -----------------------------------------------------------------------------------------------------------


def test_a_recording_is_the_special_case():
    recording = a_recording(3, 6, length=np.array([6, 4, 6]), group=[7, 7, 1], contact=np.ones((3, 6), bool))
    seen = Observations.of(recording)
    assert seen.length.tolist() == [6, 4, 6]
    assert seen.group == ("7", "7", "1")
    assert np.isnan(seen.x[1, 4:]).all()
    assert np.isnan(seen.time[1, 4:]).all()
    assert seen.v is not None
    np.testing.assert_array_equal(seen.v[0], recording.v[0])
    assert seen.contact is not None
    assert seen.contact[1].tolist() == [True] * 4 + [False] * 2
    assert seen.seen.sum() == 16 * 3


def test_masks_and_nan_say_what_was_not_seen():
    x = np.repeat(np.repeat(fallen(np.arange(6) / 100), 2, axis=0), 2, axis=2)
    x[0, 2, 1, 0] = NAN  # one axis of a point is no point
    x[1, 4:] = NAN
    mask = np.ones((2, 6), bool)
    mask[0, 3] = False
    found = Observations.checked(x, np.arange(6) / 100, seen=mask)
    assert found.length.tolist() == [6, 4]
    assert found.seen[0].tolist() == [[True, True], [True, True], [True, False], [False, False], *[[True, True]] * 2]
    assert np.isnan(found.x[0, 2, 1]).all()
    assert np.isnan(found.time[1]).tolist() == [False] * 4 + [True] * 2


def test_trajectories_are_taken_and_put_together():
    one = Observations.checked(np.repeat(fallen(np.arange(5) / 10), 2, axis=0), np.arange(5) / 10, length=[3, 5])
    two = Observations.checked(
        fallen(np.arange(7) / 60), np.arange(7) / 60, v=fallen(np.arange(7) / 60), contact=np.ones((1, 7)) > 0
    )
    short = one.take([0])
    assert short.x.shape == (1, 3, 1, 2)
    both = Observations.concatenate([one, two._replace(group=("a",))])
    assert both.length.tolist() == [3, 5, 7]
    assert both.group == ("0.0", "0.1", "a")
    assert both.contact is None
    assert both.v is not None
    assert np.isnan(both.v[:2]).all()
    assert same(both.take([2]), Observations(*two._replace(contact=None)[:4], ("a",)))
    assert same(both.take(both.length > 3), both.take([1, 2]))


@pytest.mark.parametrize("decimals", [3, 4])
def test_rounded_times_of_equal_steps_are_put_back_on_them(decimals):
    times = np.stack([np.arange(90) / 120, 5.0007 + np.arange(90) / 60])  # cameras of two rates
    found = Observations.checked(np.zeros((2, 90, 1, 2)), np.round(times, decimals)).time
    # Least squares over 90 samples, each off by half a digit at most.
    assert np.abs(np.diff(found, axis=1) - [[1 / 120], [1 / 60]]).max() < 2 * 10.0**-decimals / 90


@pytest.mark.parametrize("decimals", [3, 4])
def test_rounded_times_are_put_back_on_steps_that_have_gaps(decimals):
    """A camera that drops frames, whose times are written in milliseconds."""
    rng = np.random.default_rng(0)
    whole = np.stack([np.arange(200) / 120, 12.3456 + np.arange(200) / 120])
    kept = np.sort(np.argsort(rng.random((2, 200)), axis=1)[:, :140], axis=1)
    times = np.take_along_axis(whole, kept, axis=1)
    found = Observations.checked(np.zeros((2, 140, 1, 2)), np.round(times, decimals)).time
    off = found - times
    assert np.abs(off - off.mean(axis=1, keepdims=True)).max() < 2 * 10.0**-decimals / np.sqrt(140)
    assert np.abs(off).max() < 10.0**-decimals / 2


def test_uneven_times_are_not_taken_for_rounded_ones():
    rng = np.random.default_rng(0)
    time = np.round(np.arange(120) / 120 + rng.uniform(-2e-3, 2e-3, (20, 120)), 4)[:, rng.random(120) > 0.3]
    assert np.array_equal(Observations.checked(np.zeros((*time.shape, 1, 2)), time).time, time)


def test_other_times_stay_as_they_were_recorded():
    rng = np.random.default_rng(0)
    time = np.round(np.sort(rng.uniform(0, 1, (2, 40)), axis=1), 6)
    assert np.array_equal(Observations.checked(np.zeros((2, 40, 1, 2)), time).time, time)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time": [0, 0.1, 0.1, 0.2]}, "time must grow; at trajectory 0, sample 2 it was 0.1 s after 0.1 s: leave one"),
        ({"time": [0, 0.2, 0.1, 0.3]}, "at trajectory 0, sample 2 it was 0.1 s after 0.2 s: put samples in the order"),
        ({"time": [[0, 1, 2, 3], [0, NAN, 2, 3]]}, "time must be finite in each trajectory up to its end; traj"),
        ({"x": np.full((2, 4, 1, 2), np.inf)}, "x must be finite, or NaN where nothing was seen; trajectory 0, sample"),
        ({"x": np.full((2, 4, 1, 2), NAN)}, "each trajectory must have 2 samples or more in which something was seen"),
        ({"v": np.zeros((2, 4, 2, 2))}, "v must have the shape of x, (2, 4, 1, 2); it was (2, 4, 2, 2)"),
        (
            {"seen": np.ones((2, 3), bool)},
            "seen (or mask) must have the shape (2, 4) or (2, 4, 1), a flag for each sample of x; it was (2, 3)",
        ),
        ({"seen": np.ones((2, 4))}, "seen (or mask) must hold true and false, or 0 and 1; it was float64"),
        ({"group": ["a"]}, "group must name the session of each of 2 trajectories"),
        ({"time": np.zeros(3)}, "time must have the shape (4,), as x"),
    ],
)
def test_what_cannot_be_is_named_with_its_place(change, said):
    good = {"x": np.zeros((2, 4, 1, 2)), "time": np.arange(4) / 10}
    with refused(said):
        Observations.checked(**(good | change))


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_what_is_written_is_read_again(tmp_path, suffix):
    rng = np.random.default_rng(0)
    x, time = rng.normal(size=(3, 6, 2, 2)), np.cumsum(rng.uniform(0.01, 0.02, (3, 6)), axis=1)
    x[0, 2, 1] = NAN
    for found in (
        Observations.checked(x, time, length=[6, 4, 5], group=["a", "ä", "a"]),
        Observations.checked(x, time[0], v=x, contact=rng.random((3, 6)) > 0.5),
    ):
        save_observations(tmp_path / f"own{suffix}", found, task="cp3", source="a test")
        assert same(load_observations(tmp_path / f"own{suffix}"), found)
    with refused("x must be finite"):
        carom.load_recording(tmp_path / f"own{suffix}")
    damaged = (tmp_path / f"own{suffix}").read_bytes().replace(x[1, 1, 1].tobytes(), x[1, 1, 0].tobytes())
    (tmp_path / f"own{suffix}").write_bytes(damaged)
    with refused(f"own{suffix}: "):
        load_observations(tmp_path / f"own{suffix}")


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_files_of_recordings_and_of_others_are_read(tmp_path, suffix):
    recording = a_recording(group=[0, 0, 1, 1])
    carom.save_recording(tmp_path / f"a{suffix}", recording)
    assert same(load_observations(tmp_path / f"a{suffix}"), Observations.of(recording))
    plain = content(v=None, dt=None, contact=None)
    if suffix == ".npz":
        plain |= {"x_true": plain["x"] + 1, "truth": "{}", "mask": np.arange(4 * 6 * 3).reshape(4, 6, 3) == 7}
    found = load_observations(write(tmp_path / f"b{suffix}", plain))
    assert found.v is None
    assert found.seen.sum() == 4 * 6 * 3 - (suffix == ".npz")
    with refused("time and dt are both missing"):
        load_observations(write(tmp_path / f"c{suffix}", content(v=None, time=None, dt=None)))
    with refused("x must be there"):
        load_observations(write(tmp_path / f"d{suffix}", content(x=None)))


def test_a_csv_may_have_gaps_and_any_times(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("trajectory,time,x0,y0\na,0,0,1\na,0.013,,\na,0.02,0.1,nan\na,0.05,0.2,3\nb,7,1,2\nb,7.5,1,1\n")
    found = load_observations(path)
    assert found.v is None
    assert found.length.tolist() == [4, 2]
    assert found.seen[..., 0].tolist() == [[True, False, False, True], [True, True, False, False]]
    np.testing.assert_array_equal(found.time[0], [0, 0.013, 0.02, 0.05])
    np.testing.assert_array_equal(found.x[0, 3, 0], [0.2, 3])
    with refused("line 3, column x0 is empty"):
        carom.load_recording(path)
    path.write_text("time,x0,y0,vx0,vy0,contact\n0,0,1,2,3,1\n1,,,,,\n2,0,1,,,0\n")
    found = load_observations(path)
    assert found.v is not None
    assert np.isnan(found.v[0, :, 0, 0]).tolist() == [False, True, True]
    assert found.contact is not None
    assert found.contact.tolist() == [[True, False, False]]


def test_a_clock_that_goes_back_is_named_with_its_line(tmp_path):
    path = tmp_path / "own.csv"
    path.write_text("trajectory,time,x0,y0\na,0,0,1\na,1,0,1\nb,3,0,1\nb,3,1,1\n")
    with refused("own.csv: line 5, column time must increase; it was 3, after 3 in line 4: leave out one"):
        load_observations(path)
    path.write_text("time,x0,y0\n0,0,1\n,0,1\n2,1,1\n")
    with refused("line 3, column time is empty"):
        load_observations(path)


def test_several_files_are_sessions(tmp_path):
    (tmp_path / "one.csv").write_text("time,x0,y0\n0,0,1\n1,0,2\n")
    write(tmp_path / "two.npz", {"x": np.zeros((2, 3, 1, 2)), "time": np.arange(3.0), "group": np.array([4, 5])})
    found = load_observations([tmp_path / "one.csv", tmp_path / "two.npz"], POINT)
    assert found.group == ("one.csv", "two.npz:4", "two.npz:5")
    assert found.length.tolist() == [2, 3, 3]
    assert load_observations([tmp_path / "one.csv"]).group is None
    write(tmp_path / "three.npz", {"x": np.zeros((2, 3, 1, 3)), "time": np.arange(3.0)})
    with refused("three.npz: 1 points in 3D are not those of"):
        load_observations([tmp_path / "one.csv", tmp_path / "three.npz"])


def test_points_must_be_those_of_the_system(tmp_path):
    write(tmp_path / "centre.npz", {"x": np.zeros((2, 3, 1, 3)), "time": np.arange(3.0)})
    cube = carom.task("cube")
    with refused("Centres alone do not tell how rigid bodies turn"):
        load_observations(tmp_path / "centre.npz", cube)
    with refused("it has 1 points in 3D, the system 1 in 2D. Is it of another system?"):
        load_observations(tmp_path / "centre.npz", POINT)


# --- poses ------------------------------------------------------------------------------------------------------------


def turned(time) -> tuple[np.ndarray, np.ndarray]:
    """Quaternions of a body that turns about z at 2 rad/s, and its points about the centre, by hand."""
    angle = 2 * np.asarray(time, float)
    zero, one = 0 * angle, 0 * angle + 1
    quaternion = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=-1)
    c, s = np.cos(angle), np.sin(angle)
    axes = [np.stack(a, axis=-1) for a in ([zero, zero, zero], [c, s, zero], [-s, c, zero], [zero, zero, one])]
    return quaternion, np.stack(axes, axis=-2)


def test_poses_are_points_of_the_body(tmp_path):
    time = np.array([0, 0.01, 0.025, 0.03, 0.06])
    quaternion, points = turned(time)
    position = np.broadcast_to([1.0, 2, 3], (5, 3)).copy()
    quaternion[2], position[3] = NAN, NAN
    parts = {"pos": position[None], "quat": quaternion[None], "time": time[None], "length": [5]}
    found = load_observations(write(tmp_path / "poses.npz", parts), carom.task("cube"))
    assert found.v is None
    assert found.seen[0].sum(axis=1).tolist() == [4, 4, 1, 0, 4]  # without a quaternion the centre was seen
    np.testing.assert_allclose(found.x[0, 4], points[4] + [1, 2, 3], atol=1e-15)
    np.testing.assert_array_equal(found.time[0], time)
    with pytest.raises(carom.CaromError):
        carom.load_poses(tmp_path / "poses.npz")


def test_recorded_rates_and_copies_of_poses(tmp_path):
    time = np.arange(6) / 100
    quaternion, _ = turned(np.tile(time, 2))
    with h5py.File(tmp_path / "poses.h5", "w") as file:
        file["position"], file["quaternion"] = np.zeros((12, 3)), quaternion
        file["velocity"], file["omega"] = np.full((12, 3), 0.5), np.tile([0, 0, 2.0], (12, 1))
        file["offsets"], file["dt"], file["dup_of"] = [0, 6, 12], 0.01, [-1, 0]
    found = load_observations(tmp_path / "poses.h5")
    assert found.n_trajectories == 1
    assert found.v is not None
    c, s = np.cos(2 * time), np.sin(2 * time)
    np.testing.assert_allclose(found.v[0, :, 1], 0.5 + 2 * np.stack([-s, c, 0 * c], axis=-1), atol=1e-14)
    quaternion[3] *= 1.1
    with h5py.File(tmp_path / "poses.h5", "a") as file:
        file["quaternion"][3] = quaternion[3]
    with refused("quaternion must have length 1"):
        load_observations(tmp_path / "poses.h5")


@pytest.mark.parametrize("name", ["pucks_noisy", "ball_video"])
def test_worlds_of_another_program_are_read(reference_dir, name):
    path = reference_dir / "worlds" / f"{name}.npz"
    with np.load(path) as file:
        x, time = file["x"], file["time"]
    found = load_observations(path)
    np.testing.assert_array_equal(found.x, x)
    np.testing.assert_allclose(found.time, np.broadcast_to(time, found.time.shape), atol=1e-12)
    assert found.v is None
