"""Trajectories as CSV: what is read, and a line about what is wrong."""

import dataclasses

import numpy as np
import pytest

import carom
from carom.errors import CaromError
from carom.recordings.csv_files import DIFFERENCES

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


def falling(times, shown, name="time", sep=",") -> list[str]:
    """The header and the rows of a point that falls."""
    rows = [f"{s}{sep}{0.3 * t:.12f}{sep}{1 + t - 4.905 * t**2:.12f}" for t, s in zip(times, shown, strict=True)]
    return [sep.join((name, "x0", "y0")), *rows]


def text_of(lines: list[str]) -> str:
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("start", [0.0, 12.3456789, 1.7e9])
@pytest.mark.parametrize(
    ("rate", "decimals"), [(120, 3), (360, 3), (240, 4), (30, 2), (30, 6), (120, 6), (360, 7), (80, 3)]
)
def test_times_may_be_rounded(tmp_path, rate, decimals, start):
    times = np.arange(90) / rate
    recording = read(tmp_path, text_of(falling(times, [f"{start + t:.{decimals}f}" for t in times])))
    # Least squares of errors of half a digit at most, and of the float of so large a time.
    digit = 10.0**-decimals + np.spacing(start)
    assert abs(recording.dt - 1 / rate) < 2 * digit / 90
    # Velocities by differences are not those of rounded times: a step of 3 ms for one of 2.8 would show.
    np.testing.assert_allclose(recording.v[0, :, 0, 0], 0.3 / (rate * recording.dt), rtol=1e-6)
    np.testing.assert_allclose(np.diff(recording.time), recording.dt, atol=2 * np.spacing(start + 1))
    carom.save_recording(tmp_path / "again.h5", recording)
    assert carom.load_recording(tmp_path / "again.h5").dt == recording.dt


@pytest.mark.parametrize("form", ["{:.6g}", "{:.5e}", "{!r}"])
def test_times_may_have_digits_of_any_kind(tmp_path, form):
    times = np.arange(400) / 30  # to 13.3 s: the last of six digits is a hundred thousand times the first time's
    recording = read(tmp_path, text_of(falling(times, [form.format(float(t)) for t in times])))
    assert recording.dt == pytest.approx(1 / 30, rel=1e-6)


def test_trajectories_share_a_rounded_clock(tmp_path):
    rows = [f"{k},{t:.3f},{t},0" for k, start in enumerate((0.0, 5.0007)) for t in start + np.arange(30 - 9 * k) / 360]
    recording = read(tmp_path, text_of(["trajectory,time,x0,y0", *rows]))
    assert recording.length.tolist() == [30, 21]
    assert recording.dt == pytest.approx(1 / 360, rel=2e-3)


CLOCKS = {
    "doubled": (
        lambda s: [*s[:20], s[19], *s[20:]],
        "line 21, column time must increase; it was 0.15, after 0.15 in l",
    ),
    "swapped": (lambda s: [*s[:20], s[21], s[20], *s[22:]], "line 22, column time must increase; it was 0.158"),
    "gap": (lambda s: [*s[:20], *s[21:]], "line 21, column time must have equal steps; it was 0.017 s after line 20"),
    "jump": (
        lambda s: [*s[:20], s[20].replace("0.158", "0.161"), *s[21:]],
        "line 21, column time must have equal steps",
    ),
}


@pytest.mark.parametrize("name", CLOCKS)
def test_an_uneven_clock_is_named_with_its_line(tmp_path, name):
    change, said = CLOCKS[name]
    times = np.arange(60) / 120
    with pytest.raises(CaromError) as error:
        read(tmp_path, text_of(change(falling(times, [f"{t:.3f}" for t in times]))))
    assert said in str(error.value)
    assert ("1 of the samples is missing" in str(error.value)) == (name == "gap")
    assert len(str(error.value).partition("own.csv: ")[2]) < 220  # two lines


def test_digits_too_coarse_to_tell_are_refused(tmp_path):
    times = np.arange(60) / 75  # steps of 1.3 hundredths: a lost sample would look like a rounded one
    with pytest.raises(CaromError, match="write times with more decimals"):
        read(tmp_path, text_of(falling(times, [f"{t:.2f}" for t in times])))
    exact = np.arange(60) / 100
    lines = falling(exact, [f"{t:.2f}" for t in exact])
    with pytest.raises(CaromError, match=r"line 31, column time must have equal steps.* 1 of the samples is missing"):
        read(tmp_path, text_of([*lines[:30], *lines[31:]]))


SPREADSHEETS = {
    "decimal commas": (
        text_of(falling([0, 0.1], ["0", "0.1"], sep=";")).replace(".", ","),
        "line 2, column x0 must be a num",
    ),
    "and commas between": (
        "time,x0,y0\n0,00,1,5,2,5\n0,10,1,5,2,5\n",
        "it had 6: if decimals have commas, write points",
    ),
    "quoted": ('time,x0,y0\n"0,0","1,5","2,5"\n"0,1","1,5","2,5"\n', "it was '0,0': replace decimal commas by points"),
    "units": ("t [s],x0,y0\n0,1,2\n1,1,2\n", "a column 't [s]': call it t, without a unit; its values must be in s"),
    "other units": (
        "t,x1 (mm),y1 (mm)\n0,1,2\n1,1,2\n",
        "'x1 (mm)': call it x1, without a unit; its values must be in m.",
    ),
    "speed": ("t,x0,y0,vx0_mm/s,vy0\n0,1,2,1,1\n1,1,2,1,1\n", "call it vx0, without a unit; its values must be in m/s"),
    "row of units": ("t,x0,y0\ns,m,m\n0,1,2\n1,1,2\n", "line 2 holds no numbers (s, m, m): leave it out"),
    "empty": ("t,x0,y0\n0,1,2\n1,,2\n2,1,2\n", "line 3, column x0 is empty: fill it in, or leave the row out"),
    "not a number": (
        "t,x0,y0\n0,1,2\n1,NaN,2\n2,1,2\n",
        "line 3, column x0 must be a number; it was 'NaN': fill it in",
    ),
    "comma at the end": ("t,x0,y0,\n0,1,2,\n1,1,2,\n", "column 4 of the header has no name"),
    "from 1": ("t,x1,y1\n0,1,2\n1,1,2\n", "must have a column x0 (m); it had t, x1, y1. Points are numbered from 0."),
    "no number": ("t,x,y\n0,1,2\n1,1,2\n", "a column 'x': call it x0, points are numbered from 0"),
}


@pytest.mark.parametrize("name", SPREADSHEETS)
def test_what_spreadsheets_write_is_named_with_what_to_do(tmp_path, name):
    text, said = SPREADSHEETS[name]
    with pytest.raises(CaromError) as error:
        read(tmp_path, text)
    assert said in str(error.value)
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
