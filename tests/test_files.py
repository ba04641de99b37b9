"""Trajectory files: round trips, every way in which a file can be wrong, damage, and kills."""

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

from carom.errors import CaromError
from carom.simulation.files import Recording, load_recording, save_recording

SUFFIXES = (".npz", ".h5", ".hdf5")
ARRAYS = ("x", "v", "time", "contact", "length", "group")
ATTRIBUTES = ("dt", "units", "task", "source", "carom_version")


def a_recording(n=4, samples=6, points=3, dim=2, *, value=None, **fields) -> Recording:
    rng = np.random.default_rng(n)
    shape = (n, samples, points, dim)
    x = rng.normal(size=shape) if value is None else np.full(shape, float(value))
    v = rng.normal(size=shape) if value is None else np.full(shape, -float(value))
    defaults = {"dt": 0.01, "task": "cp3", "source": "a test"}
    return Recording.of(x, v, **{**defaults, **fields})


def content(**changes) -> dict:
    """What a good file holds; None leaves a part out."""
    rng = np.random.default_rng(0)
    good = {
        "x": rng.normal(size=(4, 6, 3, 2)),
        "v": rng.normal(size=(4, 6, 3, 2)),
        "time": 0.01 * np.arange(6),
        "contact": np.zeros((4, 6), bool),
        "dt": 0.01,
    }
    return {name: value for name, value in {**good, **changes}.items() if value is not None}


def write(path: Path, parts: dict) -> Path:
    """A file as other programs write it: in the plainest way, without a checksum."""
    if path.suffix == ".npz":
        np.savez(path, **parts)
        return path
    with h5py.File(path, "w") as file:
        for name, value in parts.items():
            if name in ARRAYS:
                file[name] = value
            else:
                file.attrs[name] = value
    return path


def changed(name: str, index, value, **others) -> dict:
    parts = content(**others)
    parts[name][index] = value
    return parts


def assert_same(a: Recording, b: Recording, *, but: tuple[str, ...] = ()) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    names = [name for name in ATTRIBUTES if name not in but]
    assert [getattr(a, name) for name in names] == [getattr(b, name) for name in names]


def error_of(path: Path, **options) -> str:
    """The one line that says why a file cannot be loaded, without the file's name."""
    with pytest.raises(CaromError) as caught:
        load_recording(path, **options)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert "\n" not in line
    return line.removeprefix(f"{path}: ")


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


# ------------------------------------------------------------------------------------ wrong content

STATES = (4, 6, 3, 2)
WRONG = {
    "no x": (content(x=None), "x must be there,", "it was missing, the file holds "),
    "no v": (content(v=None), "v must be there,", "it was missing, the file holds "),
    "3 axes": (
        content(x=np.zeros((4, 6, 6))),
        "x must have the axes (trajectory, time, point, axis)",
        "of shape (4, 6, 6)",
    ),
    "shapes": (content(v=np.zeros((4, 6, 2, 2))), "v must have the shape of x", "(4, 6, 2, 2)"),
    "1D": (content(x=np.zeros((4, 6, 3, 1))), "x must have a last axis of 2 or 3", "(4, 6, 3, 1)"),
    "4D": (content(v=np.zeros((4, 6, 3, 4))), "v must have a last axis of 2 or 3", "(4, 6, 3, 4)"),
    "empty": (content(x=np.zeros((0, 6, 3, 2))), "x must have at least 1 trajectory", "(0, 6"),
    "no points": (content(x=np.zeros((4, 6, 0, 2))), "x must have at least 1 traj", "(4, 6, 0"),
    "short": (content(x=np.zeros((4, 1, 3, 2))), "x must have at least 2 samples", "(4, 1, 3, 2)"),
    "complex": (content(x=np.zeros(STATES, complex)), "x must hold floating-point", "complex128"),
    "bool": (content(v=np.zeros(STATES, bool)), "v must hold floating-point numbers", "bool"),
    "text": (content(x=np.zeros(STATES, "S3")), "x must hold floating-point numbers", "|S3"),
    "time text": (content(time=np.zeros(6, "S3")), "time must hold floating-point", "|S3"),
    "time length": (content(time=np.arange(5.0)), "time must have the shape (6,)", "(5,)"),
    "time rows": (content(time=np.zeros((3, 6))), "time must have the shape (4, 6)", "(3, 6)"),
    "time axes": (content(time=np.zeros((4, 6, 1))), "time must have the axes (time)", "(4, 6, 1)"),
    "contact shape": (
        content(contact=np.zeros((4, 5), bool)),
        "contact must have the shape (4, 6)",
        "it was (4, 5)",
    ),
    "contact type": (
        content(contact=np.zeros((4, 6))),
        "contact must hold true and false",
        "float64",
    ),
    "group": (
        content(group=np.zeros(3, int)),
        "group must be 4 integers, one a trajectory",
        "shape (3,)",
    ),
    "contact 2": (
        content(contact=np.full((4, 6), 2)),
        "contact must hold true and false",
        "int64",
    ),
    "length shape": (content(length=np.full(3, 6)), "length must be 4 integers", "shape (3,)"),
    "length type": (content(length=np.full(4, 6.0)), "length must be 4 integers", "float64"),
    "length 7": (
        content(length=np.array([6, 6, 7, 9])),
        "length must be from 2 to 6",
        "it was 7 at trajectory 2",
    ),
    "length 1": (
        content(length=np.array([6, 1, 6, 6])),
        "length must be from 2 to 6",
        "it was 1 at trajectory 1",
    ),
    "NaN": (
        changed("x", (2, 3, slice(1, 3), 0), np.nan),
        "x must be finite",
        "in 2 places, the first at trajectory 2, time 3, point 1, axis 0",
    ),
    "Inf": (
        changed("v", (3, 5, 2, 1), -np.inf),
        "v must be finite",
        "in 1 places, the first at trajectory 3, time 5, point 2, axis 1",
    ),
    "NaN before the padding": (
        changed("x", (1, slice(2, 4), 0, 0), np.nan, length=np.array([6, 3, 6, 6])),
        "x must be finite",
        "in 1 places, the first at trajectory 1, time 2, point 0, axis 0",
    ),
    "NaN time": (changed("time", 3, np.nan), "time must be finite", "the first at time 3"),
    "unequal steps": (
        changed("time", slice(4, 6), (0.0401, 0.0501)),
        "time must have equal steps",
        "the step after time 3 was 0.0101 s, most were 0.01 s",
    ),
    "barely unequal": (
        changed("time", 5, 0.05 + 2e-8),
        "time must have equal steps",
        "the step after time 4 was",
    ),
    "unequal steps in rows": (
        changed("time", (2, 5), 0.06, time=np.tile(0.01 * np.arange(6), (4, 1))),
        "time must have equal steps",
        "the step after trajectory 2, time 4 was 0.02 s",
    ),
    "step of another trajectory": (
        changed("time", 3, 0.02 * np.arange(6), time=np.tile(0.01 * np.arange(6), (4, 1))),
        "time must have equal steps",
        "the step after trajectory 3, time 0 was 0.02 s",
    ),
    "time back": (
        changed("time", 2, 0.005),
        "time must increase",
        "the step after time 1 was -0.005 s",
    ),
    "time stands": (content(time=np.zeros(6)), "time must increase", "after time 0 was 0 s"),
    "huge time": (
        content(time=6e307 * np.arange(-2.5, 3), dt=None),
        "dt must be one positive number",
        "inf",
    ),
    "dt contradicts time": (content(dt=0.02), "dt must be the step of time, 0.01 s", "was 0.02"),
    "dt 0": (content(dt=0.0), "dt must be one positive number", "0.0"),
    "dt negative": (content(dt=-0.01), "dt must be one positive number", "-0.01"),
    "dt NaN": (content(dt=np.nan), "dt must be one positive number", "nan"),
    "dt infinite": (content(dt=np.inf), "dt must be one positive number", "inf"),
    "dt many": (content(dt=np.array([0.01, 0.01])), "dt must be one positive number", "[0.01, 0.01]"),
    "dt text": (content(dt=b"0.01"), "dt must be one positive number", "0.01"),
    "no time": (content(time=None, dt=None), "dt and time are both missing", "give dt"),
    "task a number": (content(task=3), "task must be a plain text", "3"),
    "task not UTF-8": (content(task=b"cp\xff"), "task must be a plain text", "it was"),
    "checksum of another": (content(checksum="0" * 64), "checksum must match", "damaged or changed"),
}


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
@pytest.mark.parametrize("case", WRONG)
def test_wrong_content_is_named(tmp_path, suffix, case):
    parts, start, also = WRONG[case]
    line = error_of(write(tmp_path / f"a{suffix}", parts))
    assert line.startswith(start)
    assert also in line


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_of_another_task(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    save_recording(path, a_recording())
    assert load_recording(path, task="cp3").task == "cp3"
    line = error_of(path, task="bp5")
    assert line.startswith("task must be 'bp5'; it was cp3; this is a file of another task")


def test_padding_may_hold_anything(tmp_path):
    path = write(tmp_path / "a.npz", changed("x", (1, slice(3, 6)), np.nan, length=np.array([6, 3, 6, 6])))
    np.testing.assert_array_equal(load_recording(path).length, [6, 3, 6, 6])


class Trap:
    """Makes a folder when unpickled."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


@pytest.mark.parametrize("name", ["x", "task"])
def test_a_pickle_is_not_loaded(tmp_path, name):
    trap = np.array([Trap(tmp_path / "sprung")], dtype=object)
    line = error_of(write(tmp_path / "a.npz", content(**{name: trap})))
    assert line.startswith(f"{name} must hold")
    assert "pickled objects, which are never loaded" in line
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("kind", ["external link", "soft link", "virtual", "external", "group"])
def test_data_in_other_places_are_not_read(tmp_path, kind):
    write(tmp_path / "other.h5", content())
    path = write(tmp_path / "a.h5", content())
    with h5py.File(path, "r+") as file:
        del file["x"]
        if kind == "external link":
            file["x"] = h5py.ExternalLink("other.h5", "/x")
        elif kind == "soft link":
            file["x"] = h5py.SoftLink("/v")
        elif kind == "virtual":
            layout = h5py.VirtualLayout(STATES, dtype="f8")
            layout[...] = h5py.VirtualSource(tmp_path / "other.h5", "x", STATES)
            file.create_virtual_dataset("x", layout)
        elif kind == "external":
            size = 8 * int(np.prod(STATES))
            (tmp_path / "raw").write_bytes(bytes(size))
            file.create_dataset("x", STATES, "f8", external=[(str(tmp_path / "raw"), 0, size)])
        else:
            file.create_group("x")
    assert error_of(path).startswith("x must be a dataset in the file itself")


@pytest.mark.parametrize("dtype", [h5py.string_dtype(), h5py.vlen_dtype("f8"), h5py.ref_dtype])
def test_object_types_of_hdf5(tmp_path, dtype):
    path = write(tmp_path / "a.h5", content(x=None))
    with h5py.File(path, "r+") as file:
        file.create_dataset("x", STATES, dtype)
    assert error_of(path).startswith("x must hold floating-point numbers or integers; it was object")


@pytest.mark.parametrize("suffix", [".npz", ".h5"])
def test_an_empty_dataset_or_attribute(tmp_path, suffix):
    parts = content(x=np.zeros(0)) if suffix == ".npz" else content(x=h5py.Empty("f8"))
    assert error_of(write(tmp_path / f"a{suffix}", parts)).startswith("x must h")
    parts = content(dt=np.zeros(0)) if suffix == ".npz" else content(dt=h5py.Empty("f8"))
    assert error_of(write(tmp_path / f"b{suffix}", parts)).startswith("dt must be one positive")


# --------------------------------------------------------------------------------------- wrong files


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    ("data", "start"),
    [
        (b"", "the file must be "),
        (b"time,x,v\n0,1,2\n", "the file must be "),
        (b"\x80\x04\x95.", "the file must be "),
        (b"\x93NUMPY\x01\0v\0{'descr': '<f8', 'fortran_order': False, 'shape': (), }\n", "the file "),
    ],
    ids=["empty", "text", "pickle", "npy"],
)
def test_not_a_trajectory_file(tmp_path, suffix, data, start):
    (tmp_path / f"a{suffix}").write_bytes(data)
    assert error_of(tmp_path / f"a{suffix}").startswith(start)


@pytest.mark.parametrize(("is_now", "was"), [(".npz", ".h5"), (".h5", ".npz")])
def test_a_file_named_as_the_other_format(tmp_path, is_now, was):
    save_recording(tmp_path / f"a{was}", a_recording())
    (tmp_path / f"a{was}").rename(tmp_path / f"a{is_now}")
    line = error_of(tmp_path / f"a{is_now}")
    assert line.startswith("the file must be ")
    assert "name it by its format" in line


@pytest.mark.parametrize("name", ["a", "a.txt", "a.npz.gz", ".npz"])
def test_wrong_suffix(tmp_path, name):
    wanted = "the file must have a name that ends in .h5, .hdf5, .npz"
    (tmp_path / name).write_bytes(b"")
    assert error_of(tmp_path / name).startswith(wanted)
    with pytest.raises(CaromError, match=wanted):
        save_recording(tmp_path / name, a_recording())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_no_such_file(tmp_path, suffix):
    assert error_of(tmp_path / f"a{suffix}").startswith("the file must exist")
    assert error_of(tmp_path / ("a" * 300 + suffix)).startswith("the file must exist")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_folder_is_not_a_file(tmp_path, suffix):
    folder = tmp_path / f"a{suffix}"
    folder.mkdir()
    assert error_of(folder).startswith("this must be a file; it was a folder or device")
    with pytest.raises(CaromError, match="cannot be written"):
        save_recording(folder, a_recording())
    assert [entry.name for entry in tmp_path.iterdir()] == [folder.name]


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    # By chmod it could not be tested as root, whom nothing is forbidden.
    path = write(tmp_path / "a.h5", content())

    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    assert error_of(path).startswith("the file cannot be read (Permission denied)")


# ------------------------------------------------------------------------------------------- damage


@pytest.fixture(scope="module", params=[".npz", ".h5"])
def sound(request, tmp_path_factory) -> tuple[Path, bytes, Recording]:
    path = tmp_path_factory.mktemp("damage") / f"a{request.param}"
    contact = np.eye(2, 3, dtype=bool)
    recording = a_recording(2, 3, 2, 2, contact=contact, length=np.array([2, 3]))
    save_recording(path, recording)
    return path, path.read_bytes(), load_recording(path)


def load_damaged(path: Path, data: bytes) -> Recording | None:
    """Any other exception than a CaromError fails the test."""
    path.write_bytes(data)
    try:
        return load_recording(path)
    except CaromError:
        return None


@given(data=st.data())
@settings(max_examples=300, deadline=None)
def test_a_changed_byte_is_found_or_harmless(sound, data):
    path, whole, original = sound
    damaged = bytearray(whole)
    damaged[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    loaded = load_damaged(path, bytes(damaged))
    if loaded is not None:
        assert_same(loaded, original)


@given(data=st.data())
@settings(max_examples=100, deadline=None)
def test_a_truncated_file_is_found(sound, data):
    path, whole, _ = sound
    kept = data.draw(st.integers(0, len(whole) - 1))
    assert load_damaged(path, whole[:kept]) is None


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_stretch_of_noise_or_zeros_raises_nothing_else(sound, data):
    path, whole, _ = sound
    start = data.draw(st.integers(0, len(whole) - 1))
    size = data.draw(st.integers(2, min(300, len(whole))))
    noise = data.draw(st.just(bytes(size)) | st.binary(min_size=size, max_size=size))
    load_damaged(path, (whole[:start] + noise + whole[start + size :])[: len(whole)])


@pytest.mark.parametrize("name", ["x", "v", "time", "contact", "length"])
def test_a_flipped_bit_of_the_data_is_found(tmp_path, name):
    """HDF5 itself does not protect the data, nor does ours when it was packed anew."""
    path = tmp_path / "a.h5"
    recording = a_recording(contact=np.zeros((4, 6), bool), length=np.array([6, 5, 5, 6]))
    save_recording(path, recording)
    with h5py.File(path, "r+") as file:
        data = file[name][()]
        data.reshape(-1).view(np.uint8)[0] ^= 1
        file[name][...] = data
    assert error_of(path).startswith("checksum must match the data")


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_a_changed_attribute_is_found(tmp_path, name):
    path = tmp_path / "a.h5"
    save_recording(path, a_recording())
    with h5py.File(path, "r+") as file:
        file.attrs[name] = 0.010000001 if name == "dt" else "bp5"
    assert error_of(path).startswith("checksum must match the data")


def test_the_checksum_survives_another_way_of_storing(tmp_path):
    path = tmp_path / "a.h5"
    save_recording(path, a_recording())
    with h5py.File(path) as file, h5py.File(tmp_path / "b.h5", "w") as packed:
        for name in file:
            packed.create_dataset(name, data=file[name], chunks=True, compression="gzip")
        packed.attrs.update(file.attrs)
    assert_same(load_recording(tmp_path / "b.h5"), load_recording(path))


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
from carom.simulation.files import Recording, save_recording

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
