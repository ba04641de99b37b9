"""Trajectory files: every way in which one can be wrong, and damage."""

import os
from pathlib import Path

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings
from trajectory_files import ATTRIBUTES, STATES, SUFFIXES, a_recording, assert_same, changed, content, error_of, write

from carom.errors import CaromError
from carom.recordings.files import load_recording, save_recording
from carom.recordings.recording import Recording

# ------------------------------------------------------------------------------------ wrong content

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
    line = error_of(tmp_path / name)
    assert line.startswith(wanted)
    assert f"it was '{name}'" in line
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
