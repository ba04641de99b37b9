"""Recordings and trajectory files for the tests of both."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from carom.errors import CaromError
from carom.recordings.files import load_recording
from carom.recordings.recording import Recording

SUFFIXES = (".npz", ".h5", ".hdf5")
ARRAYS = ("x", "v", "time", "contact", "length", "group")
STATES = (4, 6, 3, 2)
"""Shape of x and v in `content`."""
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
