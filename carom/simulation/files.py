"""Trajectory files: HDF5, NPZ and CSV, checked when they are read, written whole or not at all.

The first two hold, under the same names (attributes are 0-d arrays in NPZ):

    x, v        (trajectory, time, point, axis)     m, m/s
    time        (time,) or (trajectory, time)       s
    contact     (trajectory, time)                  optional; the step that ends here had a contact
    length      (trajectory,)                       optional; valid samples, the rest is padding
    group       (trajectory,)                       optional; the session a trajectory is from
    attributes  dt, units, task, source, carom_version, checksum

`checksum` is a SHA-256 over everything else. It and all other attributes may be missing, and so may
one of `time` and `dt`.
CSV is for data from elsewhere: see `csv_files.py`. Reading never unpickles and never follows a file into another one.
"""

import hashlib
import importlib.metadata
import io
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import h5py
import numpy as np
from jaxtyping import Bool, Float64, Int64

from carom.atomic import write_whole
from carom.errors import CaromError
from carom.simulation.csv_files import encode_csv, read_csv

STEP_TOLERANCE = 1e-6
"""Largest difference of two time steps that count as equal, relative to the step."""

STATE_AXES = ("trajectory", "time", "point", "axis")
ARRAYS = ("x", "v", "time", "contact", "length", "group")
TEXTS = ("units", "task", "source", "carom_version")
ATTRIBUTES = ("checksum", "dt", *TEXTS)


class Recording(eqx.Module):
    """Recorded motion of one system: what a trajectory file holds. Make one with `Recording.of`.

    `x`, `v` are positions and velocities in m and m/s; `contact` says whether the step that ends at
    a sample had an active contact, None where that was not recorded; `time` in s; `length` is the
    number of valid samples of each trajectory, beyond which is padding of any value; `group` its
    session, None where each stands alone (trajectories of one session are alike); `dt` the time
    step in s; `task` the task's name or "", `source` where the data come from, `carom_version` what
    wrote the file.
    """

    x: Float64[np.ndarray, "N T n d"]
    v: Float64[np.ndarray, "N T n d"]
    contact: Bool[np.ndarray, "N T"] | None
    time: Float64[np.ndarray, " T"]
    length: Int64[np.ndarray, " N"]
    group: Int64[np.ndarray, " N"] | None
    dt: float = eqx.field(static=True)
    units: str = eqx.field(static=True)
    task: str = eqx.field(static=True)
    source: str = eqx.field(static=True)
    carom_version: str = eqx.field(static=True)

    @property
    def valid(self) -> Bool[np.ndarray, "N T"]:
        """Which samples are not padding."""
        return np.arange(self.x.shape[1]) < self.length[:, None]

    @classmethod
    def of(
        cls,
        x: Any,
        v: Any,
        *,
        time: Any = None,
        dt: Any = None,
        contact: Any = None,
        length: Any = None,
        group: Any = None,
        units: str = "SI",
        task: str = "",
        source: str = "",
        carom_version: str = "",
    ) -> "Recording":
        """Check arrays, of whatever kind NumPy takes, and put them together.

        Numbers become double precision; single precision and integers are converted. Of `time` and
        `dt` one is enough. `time` may have a row for each trajectory: if these start at different
        times, the recording counts each from its own start. `length` is the full one by default.

        Raises:
            CaromError: naming the argument, what it was, and what to do.
        """
        x, v = _states("x", x), _states("v", v)
        _check(v.shape == x.shape, "v", f"have the shape of x, {x.shape}", v.shape)
        length = _lengths(length, x.shape)
        valid = np.arange(x.shape[1]) < length[:, None]
        _check_finite("x", x, valid, STATE_AXES)
        _check_finite("v", v, valid, STATE_AXES)
        time, dt = _clock(time, dt, valid)
        contact = None if contact is None else _flags(contact, x.shape)
        group = None if group is None else _groups(group, x.shape[0])
        texts = {"units": units, "task": task, "source": source, "carom_version": carom_version}
        texts = {name: _text(name, text) for name, text in texts.items()}
        return cls(x=x, v=v, contact=contact, time=time, length=length, group=group, dt=dt, **texts)

    @property
    def n_trajectories(self) -> int:
        return self.x.shape[0]

    @property
    def n_points(self) -> int:
        return self.x.shape[2]

    @property
    def dim(self) -> int:
        return self.x.shape[3]

    def select(self, indices: Any) -> "Recording":
        """The trajectories with these indices, or where a mask is true, in this order."""
        rows = np.arange(self.n_trajectories)[indices].reshape(-1)
        contact, group = (None if part is None else part[rows] for part in (self.contact, self.group))
        return replace(self, x=self.x[rows], v=self.v[rows], contact=contact, length=self.length[rows], group=group)


def load_recording(path: str | os.PathLike[str], *, task: str | None = None) -> Recording:
    """Read a trajectory file: HDF5 if its name ends in .h5 or .hdf5, NPZ if in .npz, CSV if in .csv.

    `task` is the name of the task that the file should hold; a file that names none passes.

    Raises:
        CaromError: one line with the file, the part that is wrong, what it was, and what to do.
    """
    path = Path(path)
    try:
        content = _read(path)
        checksum = content.pop("checksum", None)
        _check(
            checksum is None or checksum == _checksum(content),
            "checksum",
            "match the data",
            "another: the file was damaged or changed after it was written",
            "copy or make the file again",
        )
        recording = Recording.of(**content)
        wanted = f"be {task!r}"
        advice = "this is a file of another task: choose another file or name its own task"
        _check(task is None or recording.task in ("", task), "task", wanted, recording.task, advice)
    except CaromError as error:
        raise CaromError(f"{path}: {error}") from error.__cause__
    return recording


def save_recording(path: str | os.PathLike[str], recording: Recording) -> None:
    """Write a trajectory file: HDF5 if its name ends in .h5 or .hdf5, NPZ if in .npz, CSV if in .csv.

    The file appears whole or not at all, and replaces an older one in one step. A process that is
    killed while it writes may leave a file `.carom-*.tmp` next to it, which can be deleted.

    Raises:
        CaromError: naming the file or the part of the recording that is wrong, and what to do.
    """
    path = Path(path)
    try:
        encode = _format(path).encode
        fields = {name: getattr(recording, name) for name in (*ARRAYS, "dt", *TEXTS)}
        checked = Recording.of(**{**fields, "carom_version": _version()})
        content = {name: getattr(checked, name) for name in fields}
        content = {name: value for name, value in content.items() if value is not None}
        if (checked.length == checked.x.shape[1]).all():
            del content["length"]
        write_whole(path, encode({"checksum": _checksum(content), **content}).getbuffer())
    except CaromError as error:
        raise CaromError(f"{path}: {error}") from error.__cause__


# ------------------------------------------------------------------------------------------ checks


def _check(good: bool, name: str, wanted: str, was: Any, advice: str = "correct it") -> None:
    if not good:
        raise CaromError(f"{name} must {wanted}; it was {_brief(was)}; {advice}.")


def _brief(value: Any) -> str:
    """`value` on one line, shortened."""
    line = " ".join(str(value).split()) or "empty"
    return line if len(line) <= 200 else f"{line[:200]}..."


def _numbers(name: str, value: Any, axes: tuple[str, ...]) -> np.ndarray:
    array = np.asarray(value)
    wanted = "hold floating-point numbers or integers"
    _check(array.dtype.kind in "fiu", name, wanted, array.dtype, "convert it to float64")
    wanted = f"have the axes ({', '.join(axes)})"
    _check(array.ndim == len(axes), name, wanted, f"of shape {array.shape}", "reshape it")
    return array


def _doubles(array: np.ndarray) -> Float64[np.ndarray, "..."]:
    with np.errstate(over="ignore"):  # becomes infinite, which is reported with its place
        return np.asarray(array, dtype=np.float64, order="C")


def _states(name: str, value: Any) -> Float64[np.ndarray, "N T n d"]:
    array = _numbers(name, value, STATE_AXES)
    n, samples, points, dim = array.shape
    was = f"of shape {array.shape}"
    _check(dim in (2, 3), name, "have a last axis of 2 or 3, those of space", was, "reshape it")
    _check(min(n, points) >= 1, name, "have at least 1 trajectory and 1 point", was)
    _check(samples >= 2, name, "have at least 2 samples in time", was, "record more")
    return _doubles(array)


def _lengths(value: Any, shape: tuple[int, ...]) -> Int64[np.ndarray, " N"]:
    n, samples = shape[:2]
    array = np.full(n, samples) if value is None else np.asarray(value)
    was = f"{array.dtype} of shape {array.shape}"
    good = array.dtype.kind in "iu" and array.shape == (n,)
    _check(good, "length", f"be {n} integers, one a trajectory", was, "count the valid samples")
    bad = (array < 2) | (array > samples)
    was = f"{array.flat[np.argmax(bad)]} at {_place(bad, STATE_AXES[:1])}"
    _check(not bad.any(), "length", f"be from 2 to {samples}, the number of samples", was)
    return array.astype(np.int64)


def _flags(value: Any, shape: tuple[int, ...]) -> Bool[np.ndarray, "N T"]:
    array = np.asarray(value)
    wanted = f"have the shape {shape[:2]}, a flag for each sample of x"
    _check(array.shape == shape[:2], "contact", wanted, array.shape, "correct or remove it")
    kind = array.dtype.kind
    good = kind == "b" or (kind in "iu" and bool(np.isin(array, (0, 1)).all()))
    wanted = "hold true and false, or 0 and 1"
    _check(good, "contact", wanted, array.dtype, "convert it to bool or remove it")
    return array.astype(bool)


def _groups(value: Any, count: int) -> Int64[np.ndarray, " N"]:
    array = np.asarray(value)
    good = array.dtype.kind in "iu" and array.shape == (count,)
    was = f"{array.dtype} of shape {array.shape}"
    _check(good, "group", f"be {count} integers, one a trajectory", was, "number the sessions, or remove it")
    return array.astype(np.int64)


def _text(name: str, value: Any) -> str:
    """A text, from what either format makes of it."""
    text = value
    if not isinstance(value, str | bytes):
        text = np.asarray(value).item() if np.size(value) == 1 else None
    if isinstance(text, bytes):
        text = text.decode("utf-8", errors="surrogateescape")
    # No format holds a null character, and a lone surrogate stands for bytes that are no text.
    if not isinstance(text, str) or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in text):
        raise CaromError(f"{name} must be a plain text; it was {_brief(repr(value))}; correct it.")
    return text


def _check_finite(name: str, array: np.ndarray, valid: np.ndarray, axes: tuple[str, ...]) -> None:
    if np.isfinite(array).all():
        return
    bad = ~np.isfinite(array) & valid.reshape(valid.shape + (1,) * (array.ndim - valid.ndim))
    was = f"NaN or infinite in {bad.sum()} places, the first at {_place(bad, axes)}"
    advice = "repair or leave out these trajectories, or set length to end them before"
    _check(not bad.any(), name, "be finite", was, advice)


def _place(bad: np.ndarray, axes: tuple[str, ...]) -> str:
    first = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return ", ".join(f"{axis} {int(i)}" for axis, i in zip(axes, first, strict=True))


def _time_step(value: Any) -> float:
    array = np.asarray(value)
    number = float(array.item()) if array.size == 1 and array.dtype.kind in "fiu" else np.nan
    advice = "give the time step in seconds"
    _check(0 < number < np.inf, "dt", "be one positive number", repr(array.tolist()), advice)
    return number


def _clock(time: Any, dt: Any, valid: np.ndarray) -> tuple[Float64[np.ndarray, " T"], float]:
    """The times of the samples and the step between them, from either or both."""
    n, samples = valid.shape
    dt = None if dt is None else _time_step(dt)
    if time is None:
        if dt is None:
            raise CaromError("dt and time are both missing; give dt, the time step in seconds.")
        return dt * np.arange(samples), dt

    axes = STATE_AXES[:2] if np.ndim(time) == 2 else STATE_AXES[1:2]
    raw = _numbers("time", time, axes)
    shape = (n, samples)[-raw.ndim :]
    _check(raw.shape == shape, "time", f"have the shape {shape}, as x", raw.shape)
    longest = int(np.argmax(valid.sum(axis=1)))
    inside = valid[longest]
    valid = valid if raw.ndim == 2 else inside
    array = _doubles(raw)
    _check_finite("time", array, valid, axes)
    array = np.where(valid, array, 0.0)
    # A time was rounded to the digits it was stored with: half a unit at either end of a step, and
    # as much again where times were added up.
    last = np.max(np.abs(array)).astype(raw.dtype)
    rounding = 2 * float(np.spacing(last)) if raw.dtype.kind == "f" else 0.0
    _check_steps(array, valid, rounding, axes)

    row = (array[longest] if raw.ndim == 2 else array)[inside]
    with np.errstate(over="ignore"):
        step = _time_step((row[-1] - row[0]) / (len(row) - 1))
    good = dt is None or abs(dt - step) <= STEP_TOLERANCE * step + rounding
    _check(good, "dt", f"be the step of time, {step:.9g} s", dt, "correct whichever is wrong")
    dt = step if dt is None else dt
    if (array[..., 0] != row[0]).any():
        row = row - row[0]
    beyond = row[0] + dt * np.arange(len(row), samples)
    return np.concatenate([row, beyond]), dt


def _check_steps(time: np.ndarray, valid: np.ndarray, rounding: float, axes: tuple[str, ...]) -> None:
    valid = valid[..., 1:]
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is reported as unequal
        steps = np.diff(time, axis=-1)
        typical = float(np.median(steps[valid]))
        back = ~(steps > 0) & valid
        uneven = ~(np.abs(steps - typical) <= STEP_TOLERANCE * typical + rounding) & valid
    for bad, wanted in ((back, "increase"), (uneven, "have equal steps")):
        if bad.any():
            raise CaromError(
                f"time must {wanted}; the step after {_place(bad, axes)} was {steps[bad][0]:.9g} s, "
                f"most were {typical:.9g} s; resample to one step, or split the data there."
            )


# ----------------------------------------------------------------------------------------- content


def _checksum(content: Mapping[str, Any]) -> str:
    """SHA-256 over names, types, shapes and bytes."""
    digest = hashlib.sha256()
    for name in sorted(content):
        value = content[name]
        array = np.frombuffer(value.encode(), np.uint8) if isinstance(value, str) else value
        array = np.ascontiguousarray(array)
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return f"sha256:{digest.hexdigest()}"


def _version() -> str:
    try:
        return importlib.metadata.version("carom")
    except importlib.metadata.PackageNotFoundError:  # a checkout that is not installed
        return "unknown"


def _arrays_in(names: Iterable[str]) -> list[str]:
    """Which of these are arrays of a trajectory file; x and v must be."""
    names = list(names)
    for name in ("x", "v"):
        was = f"missing, the file holds {', '.join(names) or 'nothing'}"
        _check(name in names, name, f"be there, with the axes ({', '.join(STATE_AXES)})", was)
    return [name for name in ARRAYS if name in names]


def _attribute(name: str, value: Any) -> float | str:
    return _time_step(value) if name == "dt" else _text(name, value)


# ----------------------------------------------------------------------------------------- formats


def _decode_hdf5(path: Path) -> dict[str, Any]:
    _check(h5py.is_hdf5(path), "the file", "be HDF5", "something else", "name it by its format")
    _check_heaps(path.read_bytes())
    with h5py.File(path, "r") as file:
        arrays = {name: _hdf5_array(file, name) for name in _arrays_in(file)}
        names = [name for name in ATTRIBUTES if name in file.attrs]
        return {**arrays, **{name: _attribute(name, file.attrs[name]) for name in names}}


def _check_heaps(data: bytes) -> None:
    """Raise where a heap, in which HDF5 keeps texts, has an impossible size: libhdf5 would hang."""

    def number(at: int, width: int) -> int:
        return int.from_bytes(data[at : at + width], "little")

    mark = b"GCOL\x01\0\0\0"  # then the size of the heap, then its objects
    heap = data.find(mark)
    while heap >= 0:
        at, end = heap + 16, heap + number(heap + 8, 8)
        while at + 16 <= end:  # an object: 2 bytes index, 6 others, 8 bytes size, its data
            size = number(at + 8, 8)
            step = 16 + (size + 7) // 8 * 8 if number(at, 2) else size  # index 0: what is free
            _check(16 <= step <= end - at, "the file", "have whole texts", "damaged", "copy it again")
            at += step
        heap = data.find(mark, heap + 1)


def _hdf5_array(file: h5py.File, name: str) -> np.ndarray:
    inside = isinstance(file.get(name, getlink=True), h5py.HardLink)
    dataset = file[name] if inside else None
    if not isinstance(dataset, h5py.Dataset) or dataset.is_virtual or dataset.external:
        raise CaromError(
            f"{name} must be a dataset in the file itself; it was a group, a link or kept in "
            "another file; copy the numbers into this one."
        )
    numeric = dataset.shape is not None and not dataset.dtype.hasobject
    _check(numeric, name, "hold floating-point numbers or integers", dataset.dtype)
    return np.asarray(dataset[()])


def _encode_hdf5(content: Mapping[str, Any]) -> io.BytesIO:
    buffer = io.BytesIO()
    # The format of HDF5 1.8 (2008) is the first to protect its own structures by checksums.
    with h5py.File(buffer, "w", libver="v108") as file:
        for name, value in content.items():
            if name in ARRAYS:
                file.create_dataset(name, data=value)
            else:
                file.attrs[name] = value
    return buffer


def _decode_npz(path: Path) -> dict[str, Any]:
    advice = "name it by its format, or copy or make it again"
    with path.open("rb") as file:
        good = zipfile.is_zipfile(file)
        _check(good, "the file", "be NPZ", "something else or truncated", advice)
        file.seek(0)
        archive = np.load(file, allow_pickle=False)
        arrays = {name: _npz_array(archive, name) for name in _arrays_in(archive)}
        names = [name for name in ATTRIBUTES if name in archive]
        return {**arrays, **{name: _attribute(name, _npz_array(archive, name)) for name in names}}


def _npz_array(archive: np.lib.npyio.NpzFile, name: str) -> np.ndarray:
    try:
        return archive[name]
    except ValueError as error:
        if "allow_pickle" not in str(error):
            raise
        raise CaromError(
            f"{name} must hold plain numbers or text; it was pickled objects, which are never loaded; convert it."
        ) from error


def _encode_npz(content: Mapping[str, Any]) -> io.BytesIO:
    buffer = io.BytesIO()
    # The checksum comes first and x second: damage to the table of contents that hides the checksum
    # and what follows is then found by the missing x, any other by the checksum.
    np.savez(buffer, **content)
    return buffer


class _Format(NamedTuple):
    decode: Callable[[Path], dict[str, Any]]
    encode: Callable[[Mapping[str, Any]], io.BytesIO]


_HDF5 = _Format(_decode_hdf5, _encode_hdf5)
_FORMATS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".npz": _Format(_decode_npz, _encode_npz),
    ".csv": _Format(read_csv, encode_csv),
}


def _format(path: Path) -> _Format:
    suffix = path.suffix.lower()
    wanted = f"have a name that ends in {', '.join(_FORMATS)}"
    _check(suffix in _FORMATS, "the file", wanted, repr(suffix), "rename or convert it")
    return _FORMATS[suffix]


def _read(path: Path) -> dict[str, Any]:
    decode = _format(path).decode
    _check(os.path.exists(path), "the file", "exist", "not there", "check its name")
    _check(os.path.isfile(path), "this", "be a file", "a folder or device", "name a file")
    try:
        path.open("rb").close()
    except OSError as error:
        raise CaromError(f"the file cannot be read ({error.strerror}); unlock it.") from error
    try:
        return decode(path)
    except CaromError:
        raise
    except Exception as error:  # inside of a damaged file the libraries fail in all kinds of ways
        raise CaromError(f"the file is damaged or truncated ({_brief(error)}); copy or make it again.") from error
