"""What was seen of a system's motion, as people record it: `Observations`, and the files they are in.

Positions suffice. Times may be anything that grows: irregular, rounded, with gaps, each trajectory with a clock of its
own; samples, or single points of them, may be missing. A `Recording` is the special case with velocities and equal
steps. Read are

    trajectory files    HDF5 or NPZ as in `files.py`: `x` (trajectory, time, point, axis), `time` (time,) or
                        (trajectory, time) or `dt`, if they are there `v`, `contact`, `length`, `group`; missing samples
                        are NaN, or False in `seen` (or True in `mask`, as numpy.ma has it), (trajectory, time) or
                        (trajectory, time, point)
    CSV                 as in `csv_files.py`; missing samples are empty cells, or rows that are not there
    pose files          as in `poses.py`: positions and quaternions of one rigid body

`save_observations` writes the first: the same layout as that of recordings, which lacks `v` where none were recorded,
has a row of `time` for each trajectory where they have clocks of their own, and NaN where nothing was seen.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from carom.checks import require
from carom.errors import CaromError
from carom.recordings.clock import Clock, clock_of, digit_of, rounding_of, with_gaps
from carom.recordings.files import names_in, read_positions, write_content
from carom.recordings.poses import is_pose_file, pose_points
from carom.recordings.recording import Recording, as_flags, as_groups, as_lengths, as_states, as_times, plain_text
from carom.system import System


class Observations(NamedTuple):
    """Trajectories that were seen, padded to the longest with NaN: made by `of`, `checked` and `load_observations`.

    `time` in s, growing in each trajectory; `x` in m, NaN where a point was not seen; `v` in m/s and `contact` (the
    step that ends at the sample had one) where they were recorded, else None; `group`, the session of each trajectory,
    None where each stands alone.
    """

    time: Float[np.ndarray, "N T"]
    x: Float[np.ndarray, "N T n d"]
    v: Float[np.ndarray, "N T n d"] | None = None
    contact: Bool[np.ndarray, "N T"] | None = None
    group: tuple[str, ...] | None = None

    @classmethod
    def of(cls, recording: Recording) -> "Observations":
        """What a recording holds."""
        valid = recording.valid
        gone = ~valid[..., None, None]
        group = None if recording.group is None else tuple(str(k) for k in recording.group)
        return cls(
            time=np.where(valid, recording.time, np.nan),
            x=np.where(gone, np.nan, recording.x),
            v=np.where(gone, np.nan, recording.v),
            contact=None if recording.contact is None else recording.contact & valid,
            group=group,
        )

    @classmethod
    def checked(
        cls,
        x: Any,
        time: Any,
        *,
        v: Any = None,
        contact: Any = None,
        length: Any = None,
        group: Any = None,
        seen: Any = None,
        digit: Any = None,
    ) -> "Observations":
        """Check arrays, of whatever kind NumPy takes, and put them together.

        **Arguments:** `x` (N, T, n, d), `v` as it, NaN where nothing was seen; `time` (T,) or (N, T); `length` (N,),
        valid samples, by default up to the last that has a time and a position; `group` (N,), names or integers;
        `seen` (N, T) or (N, T, n), False for what is to be left out of `x` and `v`; `digit` (N, T), what the last
        digit of each time is worth (s), by default judged by the numbers. Times that were rounded from equal steps are
        put back on them.

        **Raises:** `CaromError` naming the argument, the trajectory and sample, and what to do.
        """
        x = _left_out(as_states("x", x), seen)
        times = as_times(time, x.shape[:2])
        v = None if v is None else _left_out(as_states("v", v), seen)
        if v is not None:
            require(v.shape == x.shape, f"v must have the shape of x, {x.shape}; it was {v.shape}.")
        for name, part in (("x", x), ("v", v)):
            bad = np.zeros(1, bool) if part is None else np.isinf(part)
            require(not bad.any(), f"{name} must be finite, or NaN where nothing was seen; {_at(bad)} is infinite.")
        given = np.full(len(x), x.shape[1]) if length is None else as_lengths(length, x.shape)
        length = np.minimum(given, _last(np.isfinite(times) & np.isfinite(x).all(axis=3).any(axis=2)))
        bad = length < 2
        require(
            not bad.any(),
            f"each trajectory must have 2 samples or more in which something was seen; {_at(bad)} has "
            f"{length[bad][:1].sum()}. Leave it out.",
        )
        valid = np.arange(x.shape[1]) < length[:, None]
        flags = None if contact is None else as_flags("contact", contact, x.shape[:2]) & valid
        groups = None if group is None else _names(group, len(x))
        times = _grown(times, np.asarray(time), valid, digit)
        gone = ~valid[:, : length.max()]
        return cls(
            time=np.where(gone, np.nan, times[:, : length.max()]),
            x=np.where(gone[..., None, None], np.nan, x[:, : length.max()]),
            v=None if v is None else np.where(gone[..., None, None], np.nan, v[:, : length.max()]),
            contact=None if flags is None else flags[:, : length.max()],
            group=groups,
        )

    @property
    def length(self) -> Int[np.ndarray, " N"]:
        """Samples of each trajectory, what was not seen among them."""
        return np.isfinite(self.time).sum(axis=1)

    @property
    def valid(self) -> Bool[np.ndarray, "N T"]:
        """Which samples are not padding."""
        return np.isfinite(self.time)

    @property
    def seen(self) -> Bool[np.ndarray, "N T n"]:
        """Which points were seen."""
        return np.isfinite(self.x).all(axis=3) & self.valid[..., None]

    @property
    def n_trajectories(self) -> int:
        return self.x.shape[0]

    @property
    def n_points(self) -> int:
        return self.x.shape[2]

    @property
    def dim(self) -> int:
        return self.x.shape[3]

    def take(self, indices: Any) -> "Observations":
        """The trajectories with these indices, or where a mask is true, in this order."""
        rows = np.arange(self.n_trajectories)[indices].reshape(-1)
        require(len(rows) > 0, "indices must name at least one trajectory; there was none.")
        most = int(self.length[rows].max())
        return Observations(
            time=self.time[rows, :most],
            x=self.x[rows, :most],
            v=None if self.v is None else self.v[rows, :most],
            contact=None if self.contact is None else self.contact[rows, :most],
            group=None if self.group is None else tuple(self.group[k] for k in rows),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["Observations"]) -> "Observations":
        """All trajectories of several observations of one system.

        Where only some recorded velocities, those of the others are NaN; contact flags are kept if all have them.
        """
        require(len(parts) > 0, "parts must hold observations; it was empty.")
        shapes = {part.x.shape[2:] for part in parts}
        require(len(shapes) == 1, f"all must have the same points and axes; they had {sorted(shapes)}.")
        most = max(part.x.shape[1] for part in parts)

        def joined(pieces: Sequence[np.ndarray], fill: Any) -> np.ndarray:
            widths = ([(0, 0), (0, most - piece.shape[1]), *[(0, 0)] * (piece.ndim - 2)] for piece in pieces)
            return np.concatenate(
                [np.pad(piece, width, constant_values=fill) for piece, width in zip(pieces, widths, strict=True)]
            )

        v = [np.full_like(part.x, np.nan) if part.v is None else part.v for part in parts]
        contact = [part.contact for part in parts if part.contact is not None]
        # Sessions are named apart from those trajectories that stand alone, each one of its own.
        grouped = any(part.group is not None for part in parts)
        names = [part.group or tuple(f"{i}.{k}" for k in range(len(part.x))) for i, part in enumerate(parts)]
        return cls(
            time=joined([part.time for part in parts], np.nan),
            x=joined([part.x for part in parts], np.nan),
            v=None if all(part.v is None for part in parts) else joined(v, np.nan),
            contact=joined(contact, False) if len(contact) == len(parts) else None,
            group=tuple(name for group in names for name in group) if grouped else None,
        )


# --- files ------------------------------------------------------------------------------------------------------------


def load_observations(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], system: System | None = None
) -> Observations:
    """Read one file or several, of the kinds that the top of this file tells of, as one set of trajectories.

    Of several files each is a session, or has its own (`group`), named after the file.

    **Raises:** `CaromError` with the file, what is wrong in it and where, and what to do; also if `system` is given and
    has other points.
    """
    if isinstance(paths, str | os.PathLike):
        return _load(Path(paths), system)
    files = [Path(path) for path in paths]
    require(len(files) > 0, "paths must name at least one file; it was empty.")
    parts = [_load(path, system) for path in files]
    if len(parts) == 1:
        return parts[0]
    names = _apart(files)
    for path, part in zip(files, parts, strict=True):
        same = part.x.shape[2:] == parts[0].x.shape[2:]
        require(
            same,
            f"{path}: {part.n_points} points in {part.dim}D are not those of {files[0]}, {parts[0].n_points} in "
            f"{parts[0].dim}D: files that are read at once must be of one system.",
        )
    return Observations.concatenate(
        [part._replace(group=_named(part, n)) for part, n in zip(parts, names, strict=True)]
    )


def save_observations(
    path: str | os.PathLike[str], observations: Observations, *, task: str = "", source: str = ""
) -> None:
    """Write a trajectory file (.h5, .hdf5 or .npz): velocities where they were recorded, NaN where nothing was seen.

    **Raises:** `CaromError` naming the file and what is wrong.
    """
    path, length = Path(path), observations.length
    try:
        require(path.suffix.lower() != ".csv", "observations are written as .h5, .hdf5 or .npz.")
        longest = observations.time[int(length.argmax())]
        common = all(np.array_equal(row[:n], longest[:n]) for row, n in zip(observations.time, length, strict=True))
        group = None if observations.group is None else np.array([name.encode() for name in observations.group])
        content = {
            "x": observations.x,
            "v": observations.v,
            "time": longest if common else observations.time,
            "contact": observations.contact,
            "length": None if (length == observations.x.shape[1]).all() else length,
            "group": group,
            "units": "SI",
            "task": plain_text("task", task),
            "source": plain_text("source", source),
        }
        write_content(path, {name: value for name, value in content.items() if value is not None})
    except CaromError as error:
        raise CaromError(f"{path}: {error}") from error.__cause__


def task_in(path: str | os.PathLike[str]) -> str:
    """The task that a trajectory file says it is of, or ""."""
    path = Path(path)
    return "" if is_pose_file(names_in(path)) else str(read_positions(path).get("task", ""))


def _load(path: Path, system: System | None) -> Observations:
    try:
        content = pose_points(path) if is_pose_file(names_in(path)) else read_positions(path)
        found = Observations.checked(**_taken(content))
        if system is not None:
            check_points(found, system)
    except CaromError as error:
        text = str(error)
        raise CaromError(text if text.startswith(f"{path}: ") else f"{path}: {text}") from error.__cause__
    return found


def _taken(content: dict[str, Any]) -> dict[str, Any]:
    """The arguments of `checked`, of what a file holds."""
    names = ("x", "v", "time", "contact", "length", "group", "seen", "digit")
    out = {name: content[name] for name in names if name in content}
    if "mask" in content:
        require("seen" not in out, "seen and mask must not both be there: leave one out.")
        out["seen"] = ~as_flags("mask", content["mask"])
    if "time" not in out:
        require("dt" in content, "time and dt are both missing; give time (s), (time,) or (trajectory, time).")
        out["time"] = content["dt"] * np.arange(as_states("x", out["x"]).shape[1])
    return out


def check_points(found: Observations, system: System) -> None:
    """Raise `CaromError` unless the points are those of the system."""
    own, wanted = (found.n_points, found.dim), (system.n_points, system.dim)
    if own == wanted:
        return
    text = f"it has {own[0]} points in {own[1]}D, the system {wanted[0]} in {wanted[1]}D. "
    if own == (len(system.bodies), wanted[1]):
        raise CaromError(
            f"{text}Centres alone do not tell how rigid bodies turn: give for each its centre and the ends of its unit "
            f"axes from there ({system.dim + 1} points), or, of a single body, a pose file (position and quaternion)."
        )
    raise CaromError(f"{text}Is it of another system? Point masses have one point, rigid bodies d + 1.")


def _apart(files: Sequence[Path]) -> list[str]:
    """A name for each file: its own, or with its folders where two have the same."""
    names = [path.name for path in files]
    return [str(path) if names.count(path.name) > 1 else path.name for path in files]


def _named(part: Observations, name: str) -> tuple[str, ...]:
    return tuple(f"{name}:{group}" for group in part.group) if part.group else (name,) * len(part.x)


# --- checks -----------------------------------------------------------------------------------------------------------


def _left_out(x: Float[np.ndarray, "N T n d"], seen: Any) -> Float[np.ndarray, "N T n d"]:
    """With NaN for all axes of a point that was not seen, or of which an axis is missing."""
    # The infinite is kept, and reported with its place.
    kept = np.asarray(np.isfinite(x).all(axis=3) | np.isinf(x).any(axis=3))
    if seen is not None:
        flags = np.asarray(as_flags("seen (or mask)", seen, x.shape[:2], x.shape[:3]))
        kept &= flags.reshape(*flags.shape, *[1] * (3 - flags.ndim))
    return np.where(kept[..., None], x, np.nan)


def _grown(
    times: Float[np.ndarray, "N T"], raw: np.ndarray, valid: Bool[np.ndarray, "N T"], digit: Any
) -> Float[np.ndarray, "N T"]:
    """Times, which must be there and grow; put on equal steps where they were rounded from some."""
    bad = ~np.isfinite(times) & valid
    require(not bad.any(), f"time must be finite in each trajectory up to its end; {_at(bad)} was not: leave it out.")
    back = np.zeros(valid.shape, bool)
    with np.errstate(invalid="ignore", over="ignore"):
        back[:, 1:] = (np.diff(times, axis=1) <= 0) & valid[:, 1:]
    if back.any():
        k, s = np.argwhere(back)[0]
        now, before = times[k, s], times[k, s - 1]
        what = "leave one of the two samples out" if now == before else "put samples in the order of time"
        raise CaromError(
            f"time must grow; at {_at(back)} it was {now:.15g} s after {before:.15g} s: {what}, or give times with "
            "more digits."
        )
    held = np.where(valid, times, 0.0)
    kind = raw if raw.dtype.kind == "f" else times
    typed = held.astype(kind.dtype)
    if digit is None:
        digit = np.full(times.shape, digit_of(typed, valid))
    rounding = 2 * rounding_of(typed, float(np.abs(held).max()))
    return _on_steps(held, valid, np.broadcast_to(digit, times.shape), rounding)


def _on_steps(
    times: Float[np.ndarray, "N T"], valid: Bool[np.ndarray, "N T"], digit: Float[np.ndarray, "N T"], rounding: float
) -> Float[np.ndarray, "N T"]:
    """Times on the equal steps that they were rounded from: one step for all, or each its own; others as they are."""
    found = _one_step(times, valid, digit, rounding)
    if found is not None:
        return found
    out = times.copy()
    for k in range(len(times)):
        row = slice(k, k + 1)
        found = _one_step(times[row], valid[row], digit[row], rounding)
        if found is not None:
            out[row] = found
    return out


def _one_step(times, valid, digit, rounding: float) -> Float[np.ndarray, "m T"] | None:
    found = clock_of(times, valid, digit=digit, rounding=rounding)
    return found.time if isinstance(found, Clock) else with_gaps(times, valid, digit=digit, rounding=rounding)


def _last(good: Bool[np.ndarray, "N T"]) -> Int[np.ndarray, " N"]:
    """How many samples there are up to the last good one."""
    return np.where(good.any(axis=1), good.shape[1] - np.argmax(good[:, ::-1], axis=1), 0)


def _names(group: Any, count: int) -> tuple[str, ...]:
    array = np.asarray(group)
    if array.dtype.kind not in "SU":
        array = as_groups(array, count)
    require(
        array.shape == (count,), f"group must name the session of each of {count} trajectories; it had {array.shape}."
    )
    return tuple(name.decode() if isinstance(name, bytes) else str(name) for name in array.tolist())


def _at(bad: Any) -> str:
    """Where the first bad one is."""
    place = np.argwhere(bad)[0] if bad.any() else []
    return ", ".join(f"{axis} {k}" for axis, k in zip(("trajectory", "sample", "point", "axis"), place, strict=False))
