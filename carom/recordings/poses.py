"""Recordings of poses, as motion capture gives them: read, checked, and turned into trajectories of points.

A pose file (NPZ or HDF5) holds, under the first or the second name,

    position, pos          (trajectory, time, 3) or (sample, 3)     m
    quaternion, quat       (trajectory, time, 4) or (sample, 4)     body to world, w first
    velocity, vel          as position, optional                    m/s, world frame
    omega                  as position, optional                    rad/s, body frame
    dt or time             () or (time,)                            s
    offsets                (trajectory + 1,)                        where trajectories begin, of (sample, ...)
    length                 (trajectory,), optional                  valid samples, of (trajectory, time, ...)
    group                  (trajectory,), optional                  session
    dup_of                 (trajectory,), optional                  of which trajectory it is a copy, -1: of none
"""

import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import equinox as eqx
import h5py
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from carom.checks import require
from carom.errors import CaromError
from carom.mechanics.bodies import embed_pose, embed_velocity, recover_pose
from carom.recordings.clock import Irregular, clock_of, digit_of, rounding_of
from carom.recordings.recording import Recording

NAMES = {
    "position": ("position", "pos"),
    "quaternion": ("quaternion", "quat"),
    "velocity": ("velocity", "vel"),
    "omega": ("omega", "angular_velocity"),
    "dt": ("dt",),
    "time": ("time",),
    "offsets": ("offsets",),
    "length": ("length",),
    "group": ("group",),
    "dup_of": ("dup_of",),
}
POSE_STEP_TOLERANCE = 1e-3
"""Largest difference of two time steps that count as equal, relative to the step: the clocks of cameras jitter."""
AS_THEY_ARE = "(`carom import poses --positions-only` keeps what was seen, and when.)"
UNIT = 0.01
"""Largest difference of a quaternion's length from 1."""
WINDOW = 3
"""Samples on each side that a velocity is estimated from, as far as no impact lies between."""


class PoseRecording(eqx.Module):
    """Recorded poses of one rigid body in 3D; make one with `PoseRecording.of` or `load_poses`.

    `position` (m), `quaternion` (w first, body to world), `velocity` (m/s) and `omega` (rad/s, body frame), which are
    None where they were not recorded; padded to the longest, `length` valid samples each; `group`, sessions or None;
    `dt` in s.
    """

    position: Float[np.ndarray, "N T 3"]
    quaternion: Float[np.ndarray, "N T 4"]
    velocity: Float[np.ndarray, "N T 3"] | None
    omega: Float[np.ndarray, "N T 3"] | None
    length: Int[np.ndarray, " N"]
    group: Int[np.ndarray, " N"] | None
    dt: float

    @classmethod
    def of(cls, position, quaternion, *, dt, velocity=None, omega=None, length=None, group=None) -> "PoseRecording":
        """Check arrays and put them together.

        **Raises:** `CaromError` for shapes that do not fit, numbers that are not finite, or quaternions that are not
        unit ones (to 1 %; they are normalised).
        """
        position, quaternion = np.asarray(position, float), np.asarray(quaternion, float)
        require(
            position.ndim == 3 and position.shape[2] == 3 and position.shape[1] >= 4,
            f"position must have the shape (trajectory, time, 3) with at least 4 times; it was {position.shape}.",
        )
        shape = position.shape[:2]
        require(
            quaternion.shape == (*shape, 4),
            f"quaternion must have the shape {(*shape, 4)}, w first; it was {quaternion.shape}.",
        )
        length = np.full(shape[0], shape[1]) if length is None else np.asarray(length)
        require(
            length.shape == shape[:1] and bool(np.all((length >= 4) & (length <= shape[1]))),
            f"length must be {shape[0]} numbers from 4 to {shape[1]}; it was {np.unique(length)}.",
        )
        valid = np.arange(shape[1]) < length[:, None]
        parts: dict[str, Any] = {"position": position, "quaternion": quaternion, "velocity": velocity, "omega": omega}
        for name, part in parts.items():
            if part is None:
                continue
            part = np.asarray(part, float)
            require(
                part.shape[:2] == shape and (name == "quaternion" or part.shape[2:] == (3,)),
                f"{name} must have the shape {(*shape, 3)}; it was {part.shape}.",
            )
            bad = ~np.isfinite(part).all(axis=2) & valid
            require(not bad.any(), f"{name} must be finite; trajectory {_first(bad)} was not. {AS_THEY_ARE}")
            parts[name] = _hold_last(part, length)
        size = np.linalg.norm(parts["quaternion"], axis=2)
        bad = (np.abs(size - 1) > UNIT) & valid
        require(
            not bad.any(),
            f"quaternion must have length 1; in trajectory {_first(bad)} it was {size[bad][:1]}.",
        )
        parts["quaternion"] = parts["quaternion"] / size[..., None]
        dt = float(np.asarray(dt))
        require(0 < dt < np.inf, f"dt must be a positive number of seconds; it was {dt}.")
        group = None if group is None else np.asarray(group, int)
        return cls(**parts, length=length.astype(int), group=group, dt=dt)

    @property
    def valid(self) -> Bool[np.ndarray, "N T"]:
        """Which samples are not padding."""
        return np.arange(self.position.shape[1]) < self.length[:, None]

    @property
    def rotation(self) -> Float[np.ndarray, "N T 3 3"]:
        """Body to world; columns are the body's axes."""
        flat = Rotation.from_quat(self.quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
        return flat.reshape(*self.quaternion.shape[:2], 3, 3)

    def select(self, rows: Any) -> "PoseRecording":
        """The trajectories with these indices, or where a mask is true."""

        return jax.tree.map(lambda part: part[rows] if isinstance(part, np.ndarray) else part, self)

    def to_recording(self, *, task: str = "", source: str = "") -> Recording:
        """Points and their velocities, as a trajectory file holds them; velocities are estimated if there are none."""
        known = self if self.velocity is not None and self.omega is not None else with_velocities(self)
        assert known.velocity is not None
        assert known.omega is not None
        position, rotation, velocity, omega = map(
            jnp.asarray, (self.position, self.rotation, known.velocity, known.omega)
        )
        x = embed_pose(position, rotation)
        v = embed_velocity(rotation, velocity, jnp.einsum("ntij,ntj->nti", rotation, omega))
        return Recording.of(
            np.asarray(x), np.asarray(v), dt=self.dt, length=self.length, group=self.group, task=task, source=source
        )


def poses_of(x: Float[np.ndarray, "*b 4 3"]) -> tuple[Float[np.ndarray, "*b 3"], Float[np.ndarray, "*b 4"]]:
    """Position (m) and quaternion (w first, body to world) from the points of a rigid body."""
    position, rotation = (np.asarray(part) for part in recover_pose(jnp.asarray(x)))
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat(scalar_first=True)
    return position, flat.reshape(*position.shape[:-1], 4)


def load_poses(path: str | os.PathLike[str], *, keep_copies: bool = False) -> tuple[PoseRecording, int]:
    """Read a pose file (see the top of this file), and how many copies it left out.

    **Arguments:** `path`, ending in .npz, .h5 or .hdf5; `keep_copies`, of trajectories (`dup_of`).

    **Raises:** `CaromError` if it cannot be read, or its arrays do not fit.
    """
    path = Path(path)
    try:
        arrays = _read(path)
        for name in ("position", "quaternion"):
            require(name in arrays, f"{' or '.join(NAMES[name])} is missing. Give a file with poses.")
        dt = _time_step(arrays)
        copies = arrays.pop("dup_of", None)
        if "offsets" in arrays:
            arrays |= _padded(arrays)
        names = ("position", "quaternion", "velocity", "omega", "length", "group")
        poses = PoseRecording.of(**{name: arrays[name] for name in names if name in arrays}, dt=dt)
    except CaromError as error:
        raise CaromError(f"{path}: {error}") from error.__cause__
    if copies is None or keep_copies:
        return poses, 0
    return poses.select(copies < 0), int((copies >= 0).sum())


def is_pose_file(names: Collection[str]) -> bool:
    """Whether arrays of these names are poses, and not points."""
    return "x" not in names and all(any(name in names for name in NAMES[part]) for part in ("position", "quaternion"))


def pose_points(path: Path) -> dict[str, Any]:
    """The points of a pose file's body and their times, as `Observations.checked` takes them.

    Nothing is estimated: points have velocities where the file has both `velocity` and `omega`; times are as recorded,
    and samples may be missing (NaN). Copies (`dup_of`) are left out.

    **Raises:** `CaromError` naming what does not fit.
    """
    arrays = _read(path)
    copies, dt = arrays.pop("dup_of", None), arrays.pop("dt", None)
    if "offsets" in arrays:
        arrays |= _padded(arrays)
    position, quaternion = np.asarray(arrays["position"], float), np.asarray(arrays["quaternion"], float)
    require(
        position.ndim == 3 and position.shape[2] == 3 and quaternion.shape == (*position.shape[:2], 4),
        "position and quaternion must have the shapes (trajectory, time, 3) and (trajectory, time, 4), w first; they "
        f"were {position.shape} and {quaternion.shape}.",
    )
    size = np.linalg.norm(quaternion, axis=2)
    valid = np.arange(position.shape[1]) < arrays.get("length", np.full(len(position), position.shape[1]))[:, None]
    bad = (np.abs(size - 1) > UNIT) & valid  # NaN is no number that is wrong
    require(
        not bad.any(),
        f"quaternion must have length 1, or be NaN where it was not seen; in trajectory {_first(bad)} it was "
        f"{size[bad][:1]}.",
    )
    whole = np.isfinite(size) & (size > 0)
    flat = np.where(whole[..., None], quaternion, [1.0, 0, 0, 0]).reshape(-1, 4)
    rotation = Rotation.from_quat(flat, scalar_first=True).as_matrix().reshape(*size.shape, 3, 3)
    axes = np.where(whole[..., None, None], np.swapaxes(rotation, 2, 3), np.nan)
    out: dict[str, Any] = {"x": np.concatenate([position[:, :, None], position[:, :, None] + axes], axis=2)}
    if "velocity" in arrays and "omega" in arrays:
        velocity = np.asarray(arrays["velocity"], float)[:, :, None]
        spin = np.cross(np.einsum("ntij,ntj->nti", rotation, np.asarray(arrays["omega"], float))[:, :, None], axes)
        out["v"] = np.concatenate([velocity, velocity + spin], axis=2)
    require("time" in arrays or dt is not None, "dt (s) is missing, and there is no time.")
    out["time"] = arrays["time"] if "time" in arrays else float(np.asarray(dt)) * np.arange(position.shape[1])
    out |= {name: arrays[name] for name in ("length", "group") if name in arrays}
    if copies is not None:
        out = {n: part[copies < 0] if n != "time" or np.ndim(part) == 2 else part for n, part in out.items()}
    return out


def _read(path: Path) -> dict[str, np.ndarray]:
    require(path.suffix.lower() in (".npz", ".h5", ".hdf5"), "a pose file must end in .npz, .h5 or .hdf5.")
    require(path.is_file(), "there is no such file.")
    try:
        if path.suffix.lower() == ".npz":
            with np.load(path, allow_pickle=False) as file:
                whole = {name: np.asarray(file[name]) for name in file.files}
        else:
            with h5py.File(path, "r") as file:
                whole = {name: np.asarray(part[()]) for name, part in file.items() if isinstance(part, h5py.Dataset)}
    except Exception as error:  # inside of a damaged file the libraries fail in all kinds of ways
        raise CaromError(f"the file cannot be read ({str(error)[:100]}). Copy or make it again.") from error
    out = {}
    for name, names in NAMES.items():
        found = [whole[n] for n in names if n in whole]
        if found:
            require(found[0].dtype.kind in "fiu", f"{name} must hold numbers; it was {found[0].dtype}.")
            out[name] = found[0]
    return out


def _time_step(arrays: dict[str, np.ndarray]) -> float:
    time = arrays.pop("time", None)
    if "dt" in arrays:
        return float(arrays.pop("dt"))
    require(time is not None and time.ndim == 1 and len(time) > 1, "dt (s) is missing, and there is no time (time,).")
    assert time is not None
    rows = np.asarray(time, float)[None]
    require(bool(np.isfinite(rows).all()), "time must be finite. Give dt in its place, or repair it.")
    valid = np.ones(rows.shape, bool)
    digit = np.full((1, 1), digit_of(time[None], valid))
    rounding = 2 * rounding_of(time, float(np.abs(rows).max()))
    found = clock_of(rows, valid, digit=digit, rounding=rounding, tolerance=POSE_STEP_TOLERANCE)
    if isinstance(found, Irregular):
        raise CaromError(
            f"time must {'increase' if found.back else 'have equal steps'}; that after sample {found.sample} was "
            f"{found.step:.6g} s, most were {found.typical:.6g} s. Resample to one rate. {AS_THEY_ARE}"
        )
    return found.step


def _padded(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Arrays (sample, ...) as (trajectory, time, ...), with their lengths."""
    offsets = arrays.pop("offsets").astype(int)
    count, total = len(offsets) - 1, len(arrays["position"])
    good = count > 0 and offsets[0] == 0 and offsets[-1] == total and bool(np.all(np.diff(offsets) > 0))
    require(good, f"offsets must rise from 0 to the number of samples, {total}; they were {offsets[:3]} ...")
    length = np.diff(offsets)
    rows = (offsets[:-1, None] + np.arange(length.max())).clip(max=total - 1)
    names = [name for name in ("position", "quaternion", "velocity", "omega") if name in arrays]
    if "time" in arrays and arrays["time"].shape == (total,):
        names.append("time")
    for name in names:
        require(
            len(arrays[name]) == total, f"{name} must have {total} samples, as position; it had {len(arrays[name])}."
        )
    return {name: arrays[name][rows] for name in names} | {"length": length}


def _hold_last(part: np.ndarray, length: np.ndarray) -> np.ndarray:
    """With each trajectory's last valid sample in place of its padding."""
    return part[np.arange(len(part))[:, None], np.minimum(np.arange(part.shape[1]), length[:, None] - 1)]


def _first(bad: np.ndarray) -> str:
    k, t = np.argwhere(bad)[0] if bad.any() else (0, 0)
    return f"{k}, sample {t}"


# --- velocities ---------------------------------------------------------------------------------------------------


def impacts(poses: PoseRecording, threshold: float = 6.0) -> Bool[np.ndarray, "N T"]:
    """Samples after which the motion bends: the velocity to the next sample is not the one before, carried on.

    A bend is a change of velocity or rate that is `threshold` times larger than is usual, and than free fall makes.
    """
    velocity = (poses.position[:, 1:] - poses.position[:, :-1]) / poses.dt
    turn = _body_turn(poses.quaternion[:, :-1], poses.quaternion[:, 1:]) / poses.dt
    out = np.zeros(poses.valid.shape, bool)
    for rate in (velocity, turn):
        change = np.linalg.norm(rate[:, 1:] - rate[:, :-1], axis=2)
        inside = poses.valid[:, 2:]
        usual = np.median(change[inside])
        out[:, 1:-1] |= (change > threshold * usual) & inside
    return out


def with_velocities(poses: PoseRecording) -> PoseRecording:
    """The same poses with velocities and rates from local parabolas, which do not reach across impacts."""
    bends = impacts(poses)
    velocity, omega = np.zeros_like(poses.position), np.zeros_like(poses.position)
    for k, count in enumerate(poses.length):
        # Number of the smooth piece that each sample is in; a bend ends its piece.
        piece = np.concatenate([[0], np.cumsum(bends[k, : count - 1])])
        for t in range(count):
            near = np.arange(max(0, t - WINDOW), min(count, t + WINDOW + 1))
            near = near[piece[near] == piece[t]]
            if len(near) < 2:  # between two impacts: from the sample before
                near = np.array([max(t - 1, 0), max(t - 1, 0) + 1])
            time = (near - t) * poses.dt
            basis = np.stack([time**j for j in range(min(3, len(near)))], axis=1)
            turned, rate = _turns_about_mean(poses.quaternion[k, near], time)
            both = np.concatenate([poses.position[k, near], turned], axis=1)
            slope = np.linalg.lstsq(basis, both, rcond=None)[0][1]
            velocity[k, t], omega[k, t] = slope[:3], slope[3:] + rate
    held = (_hold_last(part, poses.length) for part in (velocity, omega))
    return eqx.tree_at(lambda p: (p.velocity, p.omega), poses, tuple(held), is_leaf=lambda part: part is None)


def _turns_about_mean(quaternion: Float[np.ndarray, "m 4"], time: Float[np.ndarray, " m"]):
    """Rotation vectors in the frame of the body at time 0, beyond those of turning at the mean rate; and that rate.

    Those alone would lose whole turns: a rotation vector has at most half a turn.
    """
    rate = np.mean(_body_turn(quaternion[:-1], quaternion[1:]), axis=0) / (time[1] - time[0])
    turns = Rotation.from_quat(quaternion, scalar_first=True)
    start = turns[int(np.argmin(np.abs(time)))]
    return (Rotation.from_rotvec(-rate * time[:, None]) * start.inv() * turns).as_rotvec(), rate


def _body_turn(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Rotation vectors, in the body's frame, that lead from the quaternions `before` to `after`."""
    shape = before.shape[:-1]
    first, second = (Rotation.from_quat(q.reshape(-1, 4), scalar_first=True) for q in (before, after))
    return (first.inv() * second).as_rotvec().reshape(*shape, 3)


def velocity_lag(poses: PoseRecording) -> float:
    """By how much (s) recorded velocities are older than their positions: half a step for backward differences.

    From free flight, where velocities fall evenly: the recorded one against the difference of the samples around it.
    """
    require(poses.velocity is not None, "the recording must have velocities to find their lag.")
    assert poses.velocity is not None
    centred = (poses.position[:, 2:] - poses.position[:, :-2]) / (2 * poses.dt)
    flight = free_flight(poses)[:, 1:-1]
    fall = -flight_acceleration(poses)
    return float(np.median((poses.velocity[:, 1:-1, 2] - centred[..., 2])[flight]) / fall)


def free_flight(poses: PoseRecording) -> Bool[np.ndarray, "N T"]:
    """Samples before the first impact of each trajectory, and not next to it."""
    bends = impacts(poses)
    first = np.where(bends.any(axis=1), bends.argmax(axis=1), poses.length - 1)
    return np.arange(bends.shape[1]) < (first - 1)[:, None]


def flight_acceleration(poses: PoseRecording) -> float:
    """Vertical acceleration (m/s^2) before first impacts: mean over trajectories of the parabola that fits best."""
    flight, found = free_flight(poses), []
    for k in np.flatnonzero(flight.sum(axis=1) >= 8):
        time = np.flatnonzero(flight[k]) * poses.dt
        found.append((2 * np.polyfit(time, poses.position[k, flight[k], 2], 2)[0], len(time)))
    require(len(found) > 0, "no trajectory has 8 samples of free flight.")
    values, counts = np.array(found).T
    return float(np.average(values, weights=counts**5.0))  # the variance falls with the fifth power of the length


def at_samples(poses: PoseRecording, lag: float) -> PoseRecording:
    """Recorded velocities that are `lag` old, brought to their samples by free fall."""
    fall = flight_acceleration(poses)
    return eqx.tree_at(lambda p: p.velocity, poses, poses.velocity + np.array([0.0, 0.0, fall * lag]))
