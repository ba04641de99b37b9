"""What is recorded of a system's motion, checked: `Recording`, which trajectory files hold (`files.py`)."""

from dataclasses import replace
from typing import Any, NoReturn

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float64, Int64

from carom.checks import require
from carom.errors import CaromError
from carom.recordings.clock import Irregular, clock_of, digit_of, rounding_of, slack
from carom.system import System

OTHER_STEPS = "resample to one step, or split the data there"

STATE_AXES = ("trajectory", "time", "point", "axis")


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
        x, v = as_states("x", x), as_states("v", v)
        require_part(v.shape == x.shape, "v", f"have the shape of x, {x.shape}", v.shape)
        length = as_lengths(length, x.shape)
        valid = np.arange(x.shape[1]) < length[:, None]
        _check_finite("x", x, valid, STATE_AXES)
        _check_finite("v", v, valid, STATE_AXES)
        time, dt = _clock(time, dt, valid)
        contact = None if contact is None else as_flags("contact", contact, x.shape[:2])
        group = None if group is None else as_groups(group, x.shape[0])
        texts = {"units": units, "task": task, "source": source, "carom_version": carom_version}
        texts = {name: plain_text(name, text) for name, text in texts.items()}
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

    def cut(self, samples: int) -> "Recording":
        """The same motion in pieces of `samples` samples, each a trajectory; what is left over at ends is left out.

        Raises:
            CaromError: if no trajectory has so many samples.
        """
        longest = int(self.length.max())
        require(2 <= samples <= longest, f"samples must be from 2 to {longest}, the longest; it was {samples}.")
        rows, starts = np.array(
            [(k, s) for k, count in enumerate(self.length) for s in range(0, int(count) - samples + 1, samples)]
        ).T
        at = rows[:, None], starts[:, None] + np.arange(samples)
        return replace(
            self,
            x=self.x[at],
            v=self.v[at],
            contact=None if self.contact is None else self.contact[at],
            time=self.dt * np.arange(samples),
            length=np.full(len(rows), samples),
            group=None if self.group is None else self.group[rows],
        )


def check_system(recording: Recording, system: System, what: str = "the recording") -> None:
    """Raise `CaromError` unless the recording, which the message calls `what`, has the points of the system."""
    require(
        (recording.n_points, recording.dim) == (system.n_points, system.dim),
        f"{what} has {recording.n_points} points in {recording.dim}D, the system {system.n_points} in {system.dim}D. "
        "Is it of another system? Point masses have one point, rigid bodies d + 1.",
    )


def require_part(good: bool, name: str, wanted: str, was: Any, advice: str = "correct it") -> None:
    """Raise `CaromError` unless a part of a recording is good: what it must do, what it was, what to do."""
    if not good:
        raise CaromError(f"{name} must {wanted}; it was {brief(was)}; {advice}.")


def brief(value: Any) -> str:
    """`value` on one line, shortened."""
    line = " ".join(str(value).split()) or "empty"
    return line if len(line) <= 200 else f"{line[:200]}..."


def _numbers(name: str, value: Any, axes: tuple[str, ...]) -> np.ndarray:
    array = np.asarray(value)
    wanted = "hold floating-point numbers or integers"
    require_part(array.dtype.kind in "fiu", name, wanted, array.dtype, "convert it to float64")
    wanted = f"have the axes ({', '.join(axes)})"
    one = axes == STATE_AXES and array.ndim == len(axes) - 1
    advice = f"for one trajectory give {name}[None]" if one else "reshape it"
    require_part(array.ndim == len(axes), name, wanted, f"of shape {array.shape}", advice)
    return array


def _doubles(array: np.ndarray) -> Float64[np.ndarray, "..."]:
    with np.errstate(over="ignore"):  # becomes infinite, which is reported with its place
        return np.asarray(array, dtype=np.float64, order="C")


def as_states(name: str, value: Any) -> Float64[np.ndarray, "N T n d"]:
    """Positions or velocities in double precision; `CaromError` if the axes are wrong."""
    array = _numbers(name, value, STATE_AXES)
    n, samples, points, dim = array.shape
    was = f"of shape {array.shape}"
    require_part(dim in (2, 3), name, "have a last axis of 2 or 3, those of space", was, "reshape it")
    require_part(min(n, points) >= 1, name, "have at least 1 trajectory and 1 point", was)
    require_part(samples >= 2, name, "have at least 2 samples in time", was, "record more")
    return _doubles(array)


def as_lengths(value: Any, shape: tuple[int, ...]) -> Int64[np.ndarray, " N"]:
    """Valid samples of the trajectories of states of this shape, all by default; `CaromError` if they cannot be."""
    n, samples = shape[:2]
    array = np.full(n, samples) if value is None else np.asarray(value)
    was = f"{array.dtype} of shape {array.shape}"
    good = array.dtype.kind in "iu" and array.shape == (n,)
    require_part(good, "length", f"be {n} integers, one a trajectory", was, "count the valid samples")
    bad = (array < 2) | (array > samples)
    was = f"{array.flat[np.argmax(bad)]} at {_place(bad, STATE_AXES[:1])}"
    require_part(not bad.any(), "length", f"be from 2 to {samples}, the number of samples", was)
    return array.astype(np.int64)


def as_flags(name: str, value: Any, *shapes: tuple[int, ...]) -> Bool[np.ndarray, "..."]:
    """Flags, in one of these shapes if any are given; `CaromError` if they are not."""
    array = np.asarray(value)
    good = not shapes or array.shape in shapes
    wanted = f"have the shape {' or '.join(map(str, shapes))}, a flag for each sample of x"
    require_part(good, name, wanted, array.shape, "correct or remove it")
    kind = array.dtype.kind
    good = kind == "b" or (kind in "iu" and bool(np.isin(array, (0, 1)).all()))
    require_part(good, name, "hold true and false, or 0 and 1", array.dtype, "convert it to bool or remove it")
    return array.astype(bool)


def as_groups(value: Any, count: int) -> Int64[np.ndarray, " N"]:
    """The sessions of so many trajectories; `CaromError` if they are not integers."""
    array = np.asarray(value)
    good = array.dtype.kind in "iu" and array.shape == (count,)
    was = f"{array.dtype} of shape {array.shape}"
    require_part(good, "group", f"be {count} integers, one a trajectory", was, "number the sessions, or remove it")
    return array.astype(np.int64)


def plain_text(name: str, value: Any) -> str:
    """A text, from what either format makes of it."""
    text = value
    if not isinstance(value, str | bytes):
        text = np.asarray(value).item() if np.size(value) == 1 else None
    if isinstance(text, bytes):
        text = text.decode("utf-8", errors="surrogateescape")
    # No format holds a null character, and a lone surrogate stands for bytes that are no text.
    if not isinstance(text, str) or any(c == "\0" or "\ud800" <= c <= "\udfff" for c in text):
        raise CaromError(f"{name} must be a plain text; it was {brief(repr(value))}; correct it.")
    return text


def _check_finite(name: str, array: np.ndarray, valid: np.ndarray, axes: tuple[str, ...]) -> None:
    if np.isfinite(array).all():
        return
    bad = ~np.isfinite(array) & valid.reshape(valid.shape + (1,) * (array.ndim - valid.ndim))
    was = f"NaN or infinite in {bad.sum()} places, the first at {_place(bad, axes)}"
    advice = "repair or leave out these trajectories, or set length to end them before"
    require_part(not bad.any(), name, "be finite", was, advice)


def _place(bad: np.ndarray, axes: tuple[str, ...]) -> str:
    first = np.unravel_index(int(np.argmax(bad)), bad.shape)
    return ", ".join(f"{axis} {int(i)}" for axis, i in zip(axes, first, strict=True))


def time_step(value: Any) -> float:
    """A time step (s), from what any format makes of it."""
    array = np.asarray(value)
    number = float(array.item()) if array.size == 1 and array.dtype.kind in "fiu" else np.nan
    advice = "give the time step in seconds"
    require_part(0 < number < np.inf, "dt", "be one positive number", repr(array.tolist()), advice)
    return number


def as_times(value: Any, shape: tuple[int, ...]) -> Float64[np.ndarray, "N T"]:
    """Times in double precision, a row for each trajectory; `CaromError` if they are not as many as the samples."""
    raw = _times(value, shape)
    return np.broadcast_to(_doubles(raw), shape).copy()


def _times(value: Any, shape: tuple[int, ...]) -> np.ndarray:
    raw = _numbers("time", value, STATE_AXES[:2] if np.ndim(value) == 2 else STATE_AXES[1:2])
    wanted = shape[-raw.ndim :]
    require_part(raw.shape == wanted, "time", f"have the shape {wanted}, as x", raw.shape)
    return raw


def _clock(time: Any, dt: Any, valid: np.ndarray) -> tuple[Float64[np.ndarray, " T"], float]:
    """The times of the samples and the step between them, from either or both."""
    n, samples = valid.shape
    dt = None if dt is None else time_step(dt)
    if time is None:
        if dt is None:
            raise CaromError("dt and time are both missing; give dt, the time step in seconds.")
        return dt * np.arange(samples), dt

    raw = _times(time, (n, samples))
    axes = STATE_AXES[:2] if raw.ndim == 2 else STATE_AXES[1:2]
    longest = int(np.argmax(valid.sum(axis=1)))
    inside = valid[longest]
    valid = valid if raw.ndim == 2 else inside
    array = _doubles(raw)
    _check_finite("time", array, valid, axes)
    rows, valid = np.atleast_2d(np.where(valid, array, 0.0)), np.atleast_2d(valid)
    # A time was rounded to the digits it was stored with: half a unit at either end of a step, and
    # as much again where times were added up.
    rounding = 2 * rounding_of(raw, float(np.max(np.abs(rows))))
    digit = digit_of(np.atleast_2d(raw), valid)
    found = clock_of(rows, valid, digit=np.full((1, 1), digit), rounding=rounding, step=dt)
    if isinstance(found, Irregular):
        _refuse(found, axes)

    step, rows = time_step(found.step), found.time
    row = rows[longest if raw.ndim == 2 else 0][inside]
    good = dt is None or abs(dt - step) <= slack(step, digit, rounding, len(row))
    require_part(good, "dt", f"be the step of time, {step:.9g} s", dt, "correct whichever is wrong")
    dt = step if dt is None else dt
    if (rows[..., 0] != row[0]).any():
        row = row - row[0]
    beyond = row[0] + dt * np.arange(len(row), samples)
    return np.concatenate([row, beyond]), dt


def _refuse(found: Irregular, axes: tuple[str, ...]) -> NoReturn:
    place = ", ".join(
        f"{axis} {k}" for axis, k in zip(axes, (found.trajectory, found.sample)[-len(axes) :], strict=True)
    )
    raise CaromError(
        f"time must {'increase' if found.back else 'have equal steps'}; the step after {place} was {found.step:.9g} s, "
        f"most were {found.typical:.9g} s; {'give times with more digits' if found.coarse else OTHER_STEPS}."
    )
