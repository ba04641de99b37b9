"""Trajectories as CSV: what is read, and a line about what is wrong."""

import dataclasses

import numpy as np
import pytest

import carom
from carom.errors import CaromError
from carom.simulation.csv_files import DIFFERENCES

GOOD = """# two trajectories of a point
trajectory,time,x0,y0,vx0,vy0,contact
a,0,0,1,0.5,0,0
a,0.1,0.05,1,0.5,0,1
a,0.2,0.10,1,0.5,0,0
b,5.0,1,2,3,4,0
b,5.1,1.3,2.4,3,4,0
"""


def read(tmp_path, text: str) -> carom.Recording:
    path = tmp_path / "own.csv"
    path.write_text(text)
    return carom.load_recording(path)


def test_rows_become_trajectories(tmp_path):
    recording = read(tmp_path, GOOD)
    assert recording.x.shape == (2, 3, 1, 2)
    assert recording.length.tolist() == [3, 2]
    assert recording.dt == pytest.approx(0.1)
    np.testing.assert_allclose(recording.x[0, :, 0, 0], [0, 0.05, 0.1])
    np.testing.assert_allclose(recording.v[1, 1, 0], [3, 4])
    assert recording.contact is not None
    assert recording.contact[0].tolist() == [False, True, False]


@pytest.mark.parametrize(("old", "new"), [(",", ";"), (",", "\t"), ("time", "t"), ("\n", "\r\n")])
def test_other_ways_to_write_the_same(tmp_path, old, new):
    same, plain = read(tmp_path, GOOD.replace(old, new)), read(tmp_path, GOOD)
    np.testing.assert_array_equal(same.x, plain.x)
    np.testing.assert_array_equal(same.v, plain.v)


def test_columns_may_stand_in_any_order(tmp_path):
    lines = [line.split(",") for line in GOOD.splitlines()[1:]]
    order = [3, 6, 0, 5, 2, 1, 4]
    mixed = "\n".join(",".join(line[k] for k in order) for line in lines)
    np.testing.assert_array_equal(read(tmp_path, mixed).v, read(tmp_path, GOOD).v)


def test_velocities_that_are_not_there_are_differences(tmp_path):
    time = np.arange(8) * 0.1
    rows = "\n".join(f"{t},{3 * t},{1 - t**2},{t}" for t in time)
    recording = read(tmp_path, f"time,x0,y0,z0\n{rows}\n")
    assert recording.source == DIFFERENCES
    # Exact for parabolas, at the ends too.
    np.testing.assert_allclose(recording.v[0, :, 0], np.stack([0 * time + 3, -2 * time, 0 * time + 1], 1), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("b,5.0,1,2", "b,5.0,one,2"), "line 6, column x0 must be a number; it was 'one'"),
        (("b,5.0,1,2", "b,5.0,nan,2"), "line 6, column x0"),
        (("b,5.0,1,2,", "b,5.0,1,"), "line 6 must have 7 values"),
        (("vy0", "speed"), "a column 'speed'"),
        (("x0,y0,vx0", "x0,x1,vx0"), "must have a column y0"),
        ((",vy0", ",vy1"), "look at v"),
        (("time", "trajectory"), "'trajectory' was there twice"),
        (("b,5.1", "a,5.1"), "line 7, column trajectory: 'a' begins again"),
        (("b,5.1,1.3,2.4,3,4,0\n", ""), "at least 2 samples; 'b' had 1"),
        (("0.2,0.10,1,0.5,0,0", "0.2,0.10,1,0.5,0,2"), "contact must be 0 or 1; it was 2"),
        (("a,0.2", "a,0.3"), "time"),
        (("time", "clock"), "must have a column time"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(tmp_path, change, said):
    with pytest.raises(CaromError) as error:
        read(tmp_path, GOOD.replace(*change))
    assert said in str(error.value)
    assert "own.csv" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "time,x0,y0\n", "\x00\x01", "time,x0,y0\n0,0,0\n"])
def test_files_with_nothing_in_them(tmp_path, text):
    with pytest.raises(CaromError, match=r"own\.csv"):
        read(tmp_path, text)


def test_a_recording_comes_back_from_csv(tmp_path):
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(2, 3, 5, 2, 3))
    recording = carom.Recording.of(x, v, dt=0.01, length=[5, 3, 4], contact=rng.random((3, 5)) < 0.5, task="mine")
    carom.save_recording(tmp_path / "a.csv", recording)
    again = carom.load_recording(tmp_path / "a.csv")
    valid = recording.valid
    np.testing.assert_array_equal(again.x[valid], recording.x[valid])
    np.testing.assert_array_equal(again.v[valid], recording.v[valid])
    assert again.contact is not None
    assert recording.contact is not None
    np.testing.assert_array_equal(again.contact[valid], recording.contact[valid])
    assert again.length.tolist() == [5, 3, 4]
    bare = dataclasses.replace(recording, contact=None, length=np.full(3, 5))
    carom.save_recording(tmp_path / "b.csv", bare)
    assert carom.load_recording(tmp_path / "b.csv").contact is None
