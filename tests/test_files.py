"""Trajectory files: round trips, what other programs write, and writing that fails or is killed."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp
from trajectory_files import ARRAYS, ATTRIBUTES, STATES, SUFFIXES, a_recording, assert_same, content, write

from carom.errors import CaromError
from carom.recordings.files import load_recording, save_recording
from carom.recordings.recording import Recording

# ------------------------------------------------------------------------------------- round trips

names = st.text(st.characters(codec="utf-8", exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
dtypes = st.sampled_from(["<f8", ">f8", "<f4", "<f2", "<i2", "<i8", "<u1"])


@st.composite
def recorded(draw) -> dict:
    """Arguments of `Recording.of`."""
    shape = draw(st.tuples(*[st.integers(*r) for r in ((1, 4), (2, 7), (1, 4), (2, 3))]))
    length = draw(st.none() | hnp.arrays(np.int64, shape[0], elements=st.integers(2, shape[1])))
    # Any bit pattern of a double is allowed in the padding.
    finite = draw(st.booleans()) or length is None
    values = st.floats(allow_nan=not finite, allow_infinity=not finite)
    padded = np.arange(shape[1]) >= (shape[1] if length is None else length[:, None])

    def states() -> np.ndarray:
        dtype = np.dtype(draw(dtypes))
        plain = {"elements": {"allow_nan": False, "allow_infinity": False}}
        array = draw(hnp.arrays(dtype, shape, **(plain if dtype.kind == "f" else {})))
        if dtype == np.float64:
            array = np.where(padded[..., None, None], draw(values), array)
        return array

    return {
        "x": states(),
        "v": states(),
        "dt": draw(st.floats(1e-9, 1e3)),
        "contact": draw(st.none() | hnp.arrays(bool, shape[:2])),
        "length": length,
        "units": draw(names),
        "task": draw(names),
        "source": draw(names),
    }


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@given(recorded=recorded())
@settings(deadline=None)
def test_what_is_saved_is_loaded(suffix, recorded):
    recording = Recording.of(**recorded)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{suffix}"
        save_recording(path, recording)
        loaded = load_recording(path)
        assert_same(loaded, recording, but=("carom_version",))
        assert loaded.carom_version
        assert [entry.name for entry in Path(folder).iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".NPZ", ".H5"])
def test_suffixes(tmp_path, suffix):
    save_recording(tmp_path / f"a{suffix}", a_recording())
    assert_same(load_recording(tmp_path / f"a{suffix}"), a_recording(), but=("carom_version",))


def test_a_file_has_the_documented_layout(tmp_path):
    ragged = a_recording(contact=np.ones((4, 6), bool), length=np.array([6, 2, 3, 6]), group=np.array([0, 0, 1, 2]))
    save_recording(tmp_path / "a.h5", ragged)
    save_recording(tmp_path / "a.npz", ragged)
    with h5py.File(tmp_path / "a.h5") as file, np.load(tmp_path / "a.npz") as archive:
        assert set(file) == set(ARRAYS)
        assert set(file.attrs) == {*ATTRIBUTES, "checksum"}
        assert set(archive) == {*file, *file.attrs}
        assert file["x"].shape == archive["x"].shape == (4, 6, 3, 2)
        assert file.attrs["task"] == archive["task"] == "cp3"
        assert file.attrs["checksum"] == archive["checksum"]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("dtype", ["<f4", ">f4", ">f8", "<f2", "<i4", "<u1"])
def test_numbers_become_double_precision(tmp_path, suffix, dtype):
    x = np.arange(4 * 6 * 3 * 2).reshape(4, 6, 3, 2).astype(dtype)
    loaded = load_recording(write(tmp_path / f"a{suffix}", content(x=x)))
    assert loaded.x.dtype == np.float64
    np.testing.assert_array_equal(loaded.x, x)


def test_jax_arrays_can_be_recorded():
    jnp = pytest.importorskip("jax.numpy")
    x = jnp.ones((2, 3, 1, 2), dtype=jnp.float32)
    assert Recording.of(x, x, dt=0.1).x.dtype == np.float64


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("parts", "dt", "times"),
    [
        ({"time": None}, 0.01, 0.01 * np.arange(6)),
        ({"dt": None}, 0.01, 0.01 * np.arange(6)),
        ({"dt": np.float32(0.01)}, float(np.float32(0.01)), 0.01 * np.arange(6)),
        ({"dt": np.array([0.01])}, 0.01, 0.01 * np.arange(6)),
        ({"dt": 1, "time": np.arange(6)}, 1.0, np.arange(6.0)),
        ({"time": 3 + 0.01 * np.arange(6)}, 0.01, 3 + 0.01 * np.arange(6)),
        # Single precision, and seconds since 1970: rounded by more than the tolerance of a step.
        ({"time": (5 + 0.01 * np.arange(6)).astype("f4"), "dt": 0.01}, 0.01, None),
        ({"time": 1.7e9 + 0.01 * np.arange(6)}, 0.01, 1.7e9 + 0.01 * np.arange(6)),
        ({"time": np.tile(0.01 * np.arange(6), (4, 1))}, 0.01, 0.01 * np.arange(6)),
        ({"time": np.arange(4)[:, None] + 0.01 * np.arange(6)}, 0.01, 0.01 * np.arange(6)),
    ],
    ids=[
        "from dt", "from time", "single dt", "dt of one element", "integers", "late start",
        "single time", "epoch", "rows", "rows that start apart",
    ],
)  # fmt: skip
def test_time_and_its_step(tmp_path, suffix, parts, dt, times):
    loaded = load_recording(write(tmp_path / f"a{suffix}", content(**parts)))
    assert loaded.dt == pytest.approx(dt, rel=1e-12)
    if times is not None:
        # Up to the rounding of times that are differences of others.
        np.testing.assert_allclose(loaded.time, times, rtol=0, atol=1e-15)


@pytest.mark.parametrize("rows", [False, True])
def test_time_beyond_the_longest_trajectory_goes_on(rows):
    times = 0.01 * np.arange(6)
    times[4:] = np.nan
    length = np.array([3, 4, 2, 4])
    recording = Recording.of(*np.zeros((2, 4, 6, 3, 2)), time=np.tile(times, (4, 1)) if rows else times, length=length)
    # Rounding of a sum.
    np.testing.assert_allclose(recording.time, 0.01 * np.arange(6), rtol=0, atol=1e-16)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_defaults_of_what_a_file_does_not_say(tmp_path, suffix):
    loaded = load_recording(write(tmp_path / f"a{suffix}", content(contact=None)), task="cp3")
    assert (loaded.units, loaded.task, loaded.source, loaded.carom_version) == ("SI", "", "", "")
    assert loaded.contact is None
    np.testing.assert_array_equal(loaded.length, [6, 6, 6, 6])


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("task", ["cp3", b"cp3", np.array(["cp3"])], ids=["text", "bytes", "array"])
def test_texts_as_others_store_them(tmp_path, suffix, task):
    if suffix != ".npz" and isinstance(task, np.ndarray):
        task = task.astype("S")
    assert load_recording(write(tmp_path / f"a{suffix}", content(task=task)), task="cp3").task


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_contact_as_integers(tmp_path, suffix):
    flags = np.arange(24).reshape(4, 6) % 2
    loaded = load_recording(write(tmp_path / f"a{suffix}", content(contact=flags.astype("u1"))))
    np.testing.assert_array_equal(loaded.contact, flags == 1)


def test_other_names_in_a_file_are_left_alone(tmp_path):
    pickled = np.array([{"a": 1}], dtype=object)
    load_recording(write(tmp_path / "a.npz", content(notes=pickled)))


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        ("bp5-e_trajectories", (32, 5, 2)),
        ("cp3_trajectories", (32, 3, 2)),
        ("gyro-e_trajectories", (32, 4, 3)),
        ("rope_trajectories", (32, 10, 2)),
        ("cp3_observed", (400, 3, 2)),
    ],
)
def test_recordings_that_carom_did_not_make(reference_dir, name, shape):
    recording = load_recording(reference_dir / "reference" / f"{name}.npz")
    assert (recording.n_trajectories, recording.n_points, recording.dim) == shape
    assert recording.x.shape[1] == 101
    assert recording.contact is not None
    assert (recording.task, recording.units) == ("", "SI")


@pytest.mark.parametrize(
    ("indices", "rows"),
    [
        ([2, 0], [2, 0]),
        (np.array([True, False, False, True]), [0, 3]),
        (slice(1, 3), [1, 2]),
        (-1, [3]),
        (slice(0, 0), []),
    ],
    ids=["list", "mask", "slice", "one", "none"],
)
@pytest.mark.parametrize("with_contact", [False, True])
def test_select(indices, rows, with_contact):
    contact = np.eye(4, 6, dtype=bool) if with_contact else None
    whole = a_recording(contact=contact, length=np.array([3, 4, 5, 6]))
    part = whole.select(indices)
    assert part.n_trajectories == len(rows)
    np.testing.assert_array_equal(part.x, whole.x[rows])
    np.testing.assert_array_equal(part.v, whole.v[rows])
    np.testing.assert_array_equal(part.length, whole.length[rows])
    if contact is not None:
        np.testing.assert_array_equal(part.contact, contact[rows])
    assert (part.dt, part.task) == (whole.dt, whole.task)


# ------------------------------------------------------------------------------------------ writing


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_missing_folder_is_named(tmp_path, suffix):
    with pytest.raises(CaromError) as caught:
        save_recording(tmp_path / "none" / f"a{suffix}", a_recording())
    assert f"cannot be written in {tmp_path / 'none'} (No such file" in str(caught.value)


def test_a_file_is_not_a_folder(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(CaromError, match=r"cannot be written in .*file \(Not a directory\)"):
        save_recording(tmp_path / "file" / "a.npz", a_recording())


def test_a_folder_that_may_not_be_written_to(tmp_path):
    tmp_path.chmod(0o500)
    try:
        if os.access(tmp_path, os.W_OK):
            pytest.skip("this user may write everywhere")
        with pytest.raises(CaromError, match=r"cannot be written in .* \(Permission denied\)"):
            save_recording(tmp_path / "a.npz", a_recording())
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize(
    ("raised", "seen"),
    [(OSError(28, "No space left on device"), CaromError), (KeyboardInterrupt(), KeyboardInterrupt)],
    ids=["full", "interrupt"],
)
def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch, suffix, step, raised, seen):
    path = tmp_path / f"a{suffix}"
    save_recording(path, a_recording(value=1))

    def fail(*_args):
        raise raised

    with monkeypatch.context() as patch:
        patch.setattr(os, step, fail)
        with pytest.raises(seen, match="No space left" if seen is CaromError else None):
            save_recording(path, a_recording(value=2))
    assert_same(load_recording(path), a_recording(value=1), but=("carom_version",))
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize(
    ("field", "value", "start"),
    [
        ("x", np.full(STATES, np.nan), "x must be finite"),
        ("v", np.zeros((4, 6, 3, 3)), "v must have the shape of x"),
        ("dt", -1.0, "dt must be one positive number"),
        ("task", "cp\0", "task must be a plain text"),
        ("task", "cp\ud800", "task must be a plain text"),
    ],
    ids=["NaN", "shape", "dt", "null", "surrogate"],
)
def test_what_could_not_be_loaded_is_not_saved(tmp_path, suffix, field, value, start):
    good = a_recording()
    parts = {name: getattr(good, name) for name in (*ARRAYS, *ATTRIBUTES)}
    with pytest.raises(CaromError, match=f": {start}"):
        save_recording(tmp_path / f"a{suffix}", unchecked(**{**parts, field: value}))
    assert not list(tmp_path.iterdir())


def unchecked(**parts) -> Recording:
    """A recording that was not made by `Recording.of`."""
    recording = object.__new__(Recording)
    for name, value in parts.items():
        object.__setattr__(recording, name, value)
    return recording


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "folder").mkdir()
    link = tmp_path / "a.npz"
    link.symlink_to(tmp_path / "folder" / "b.npz")
    save_recording(link, a_recording())
    assert link.is_symlink()
    assert_same(load_recording(tmp_path / "folder" / "b.npz"), load_recording(link))


def test_permissions_are_those_of_any_new_file(tmp_path):
    save_recording(tmp_path / "a.npz", a_recording())
    (tmp_path / "other").touch()
    assert (tmp_path / "a.npz").stat().st_mode == (tmp_path / "other").stat().st_mode


WRITER = """
import os, random, signal, sys, time
import numpy as np
from carom.recordings.files import save_recording
from carom.recordings.recording import Recording

def write_forever(path):
    for k in range(10**9):
        x = np.full((50, 101, 10, 2), float(k))
        save_recording(path, Recording.of(x, -x, dt=0.01, source=str(k)))

rng = random.Random(0)
for _ in range(10):
    child = os.fork()
    if child == 0:
        write_forever(sys.argv[1])
    while not os.path.exists(sys.argv[1]):
        time.sleep(0.001)
    time.sleep(rng.uniform(0, 0.1))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    print("killed", flush=True)
    sys.stdin.readline()
"""


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_a_killed_writer_leaves_a_whole_file(tmp_path, suffix):
    """Killed at 10 random times: the file is whole, and the next writer is not disturbed."""
    path = tmp_path / f"a{suffix}"
    sources = []
    with subprocess.Popen(
        [sys.executable, "-c", WRITER, str(path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,  # jax warns of forks; the children do not use it
        cwd=Path(__file__).resolve().parent.parent,
        text=True,
    ) as killer:
        assert killer.stdin is not None
        assert killer.stdout is not None
        while killer.stdout.readline():
            loaded = load_recording(path)
            assert (loaded.x == float(loaded.source)).all()
            assert (loaded.v == -float(loaded.source)).all()
            sources.append(loaded.source)
            killer.stdin.write("\n")
            killer.stdin.flush()
    assert len(sources) == 10
    others = [entry.name for entry in tmp_path.iterdir() if entry != path]
    assert all(name.startswith(".carom-") and ".tmp" in name for name in others)
