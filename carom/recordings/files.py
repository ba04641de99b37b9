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
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from carom.atomic import write_whole
from carom.errors import CaromError
from carom.recordings.csv_files import encode_csv, read_csv, read_samples
from carom.recordings.recording import STATE_AXES, Recording, brief, plain_text, require_part, time_step

ARRAYS = ("x", "v", "time", "contact", "length", "group")
MASKS = ("seen", "mask")
"""What files of positions may have besides: which samples there are."""
TEXTS = ("units", "task", "source", "carom_version")
ATTRIBUTES = ("checksum", "dt", *TEXTS)


def load_recording(path: str | os.PathLike[str], *, task: str | None = None) -> Recording:
    """Read a trajectory file: HDF5 if its name ends in .h5 or .hdf5, NPZ if in .npz, CSV if in .csv.

    `task` is the name of the task that the file should hold; a file that names none passes.

    Raises:
        CaromError: one line with the file, the part that is wrong, what it was, and what to do.
    """
    path = Path(path)
    try:
        recording = Recording.of(**_verified(_read(path)))
        wanted = f"be {task!r}"
        advice = "this is a file of another task: choose another file, name its own task, or take task out of it"
        require_part(task is None or recording.task in ("", task), "task", wanted, recording.task, advice)
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
        good = isinstance(recording, Recording)
        advice = "for what `simulate` returns, give carom.recording_of(motion)"
        require_part(good, "recording", "be a Recording", type(recording).__name__, advice)
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


def read_positions(path: Path) -> dict[str, Any]:
    """What a file holds of which positions are enough: no velocities need be there, and samples may be missing.

    **Raises:** `CaromError` naming the part that is wrong, what it was, and what to do.
    """
    return _verified(_read(path, positions=True))


def write_content(path: Path, content: Mapping[str, Any]) -> None:
    """Write arrays and attributes of a trajectory file, which are taken as right, with a checksum."""
    whole = {**content, "carom_version": _version()}
    write_whole(path, _format(path).encode({"checksum": _checksum(whole), **whole}).getbuffer())


def names_in(path: Path) -> set[str]:
    """The names of the arrays in a file, of NPZ or HDF5; none of others, or of what cannot be read."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                return {name.removesuffix(".npy") for name in archive.namelist()}
        if suffix in (".h5", ".hdf5"):
            _check_heaps(path.read_bytes())
            with h5py.File(path, "r") as file:
                return set(file)
    except Exception:  # whoever reads the file says what is wrong with it
        return set()
    return set()


# ----------------------------------------------------------------------------------------- content


def _verified(content: dict[str, Any]) -> dict[str, Any]:
    """Without its checksum, which must be that of the rest."""
    checksum = content.pop("checksum", None)
    require_part(
        checksum is None or checksum == _checksum(content),
        "checksum",
        "match the data",
        "another: the file was damaged or changed after it was written",
        "copy or make the file again",
    )
    return content


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


def _arrays_in(names: Iterable[str], positions: bool) -> list[str]:
    """Which of these are arrays of a trajectory file; x and, if not `positions` are enough, v must be."""
    names = list(names)
    for name in ("x",) if positions else ("x", "v"):
        was = f"missing, the file holds {', '.join(names) or 'nothing'}"
        require_part(name in names, name, f"be there, with the axes ({', '.join(STATE_AXES)})", was)
    return [name for name in (*ARRAYS, *(MASKS if positions else ())) if name in names]


def _attribute(name: str, value: Any) -> float | str:
    return time_step(value) if name == "dt" else plain_text(name, value)


# ----------------------------------------------------------------------------------------- formats


def _decode_hdf5(path: Path, positions: bool) -> dict[str, Any]:
    require_part(h5py.is_hdf5(path), "the file", "be HDF5", "something else", "name it by its format")
    _check_heaps(path.read_bytes())
    with h5py.File(path, "r") as file:
        arrays = {name: _hdf5_array(file, name) for name in _arrays_in(file, positions)}
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
            require_part(16 <= step <= end - at, "the file", "have whole texts", "damaged", "copy it again")
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
    require_part(numeric, name, "hold floating-point numbers or integers", dataset.dtype)
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


def _decode_npz(path: Path, positions: bool) -> dict[str, Any]:
    advice = "name it by its format, or copy or make it again"
    with path.open("rb") as file:
        good = zipfile.is_zipfile(file)
        require_part(good, "the file", "be NPZ", "something else or truncated", advice)
        file.seek(0)
        archive = np.load(file, allow_pickle=False)
        arrays = {name: _npz_array(archive, name) for name in _arrays_in(archive, positions)}
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
    decode_positions: Callable[[Path], dict[str, Any]]
    encode: Callable[[Mapping[str, Any]], io.BytesIO]


_HDF5 = _Format(partial(_decode_hdf5, positions=False), partial(_decode_hdf5, positions=True), _encode_hdf5)
_NPZ = _Format(partial(_decode_npz, positions=False), partial(_decode_npz, positions=True), _encode_npz)
_FORMATS = {
    ".h5": _HDF5,
    ".hdf5": _HDF5,
    ".npz": _NPZ,
    ".csv": _Format(read_csv, read_samples, encode_csv),
}


def _format(path: Path) -> _Format:
    suffix = path.suffix.lower()
    wanted = f"have a name that ends in {', '.join(_FORMATS)}"
    require_part(suffix in _FORMATS, "the file", wanted, repr(path.name), "rename or convert it")
    return _FORMATS[suffix]


def _read(path: Path, *, positions: bool = False) -> dict[str, Any]:
    require_part(os.path.exists(path), "the file", "exist", "not there", "check its name")
    require_part(os.path.isfile(path), "this", "be a file", "a folder or device", "name a file")
    found = _format(path)
    decode = found.decode_positions if positions else found.decode
    try:
        path.open("rb").close()
    except OSError as error:
        raise CaromError(f"the file cannot be read ({error.strerror}); unlock it.") from error
    try:
        return decode(path)
    except CaromError:
        raise
    except Exception as error:  # inside of a damaged file the libraries fail in all kinds of ways
        raise CaromError(f"the file is damaged or truncated ({brief(error)}); copy or make it again.") from error
