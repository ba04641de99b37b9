"""What a recording of points shows without a model of the system: sizes, speeds, noise, and whether velocities fit."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from carom.recordings.recording import Recording

ENOUGH = 2
"""Fewer trajectories are one recording alone."""


class Finding(NamedTuple):
    """One check: what was found, and what to do about it ("" if nothing)."""

    check: str
    found: str
    advice: str


class Rates(NamedTuple):
    """How recorded velocities go with differences of positions.

    `slope`: recorded velocity over difference, 1 if units and time step are right; `lag` (s): by how much velocities
    are older than their positions, None where the motion has too little acceleration to tell; `scatter`: median
    distance of the two as a share of the typical speed.
    """

    slope: float
    lag: float | None
    scatter: float


def check_recording(recording: Recording) -> list[Finding]:
    """What the arrays alone show."""
    speed = np.linalg.norm(recording.v, axis=-1)[recording.valid]
    low, high = (f(recording.x[recording.valid].reshape(-1, recording.dim), axis=0) for f in (np.min, np.max))
    extent = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(low, high, strict=True))
    motion = step_motion(recording)
    out = [
        Finding("positions, by axis", f"{extent} m", ""),
        Finding("speed, median and largest", f"{np.median(speed):.3g}, {speed.max():.3g} m/s", ""),
        Finding("way of a step, typical", f"{motion:.2g} m", "" if motion > 0 else "nothing moves"),
    ]
    if recording.n_trajectories < ENOUGH:
        count = f"{recording.n_trajectories} of up to {int(recording.length.max())} samples"
        advice = "several starts tell more; `carom learn` cuts these into pieces (in Python: recording.cut(samples))"
        out.append(Finding("trajectories", count, advice))
    noise = position_noise(recording)
    if noise is not None and motion > 0:
        share = noise / motion
        text = f"at most {noise:.1g} m, {share:.1g} of a step's way"
        advice = "start states will be estimated too (docs/noise.md)" if share > 0.1 else ""
        out.append(Finding("noise of positions", text, advice))
    rates = compare_rates(recording)
    return out if rates is None else [*out, *_velocity_findings(rates, recording.dt)]


def _velocity_findings(rates: Rates, dt: float) -> list[Finding]:
    found = f"{rates.slope:.4g} times the differences of positions"
    advice = ""
    if rates.slope <= 0 or abs(np.log(rates.slope)) > np.log(1.02):
        advice = f"they must be the same: are units right, and is the time step {dt:.4g} s?"
    elif rates.scatter > 0.1:
        advice = f"they differ by {rates.scatter:.0%} of the speed: estimate velocities anew (leave them out of a CSV)"
    out = [Finding("velocities", found, advice)]
    if rates.lag is not None:
        late = rates.lag / dt
        advice = "they are differences of the past: give central ones" if late > 0.25 else ""
        advice = "they are of later times: give central differences" if late < -0.25 else advice
        out.append(Finding("velocities are late by", f"{late:.2f} of a step", advice))
    return out


def step_motion(recording: Recording) -> float:
    """Root mean square of what a point moves in a step (m)."""
    return float(np.sqrt(np.mean(np.sum(recording.v[recording.valid] ** 2, axis=-1)))) * recording.dt


def position_noise(recording: Recording) -> float | None:
    """At most this standard deviation (m) have errors of positions, from third differences; None of short trajectories.

    Of independent errors of variance s^2 a third difference has 20 s^2; smooth motion adds `dt^3 x'''`, which is why
    this is a bound. The median leaves impacts out.
    """
    return _third_differences(recording.x, recording.valid)


def state_noise(recording: Recording) -> float:
    """At most this share of a typical state, positions and velocities together (m, m/s), is noise; as `position_noise`.

    0 of short trajectories.
    """
    parts = (recording.x, recording.v)
    sizes = [_third_differences(part, recording.valid) or 0.0 for part in parts]
    square = sum(np.sum(part[recording.valid] ** 2, axis=(1, 2)) for part in parts)
    numbers = recording.n_points * recording.dim
    return float(np.sqrt(numbers * np.sum(np.square(sizes))) / max(np.sqrt(np.median(square)), 1e-300))


def _third_differences(part: Float[np.ndarray, "N T n d"], valid: Bool[np.ndarray, "N T"]) -> float | None:
    ends = valid[:, 3:]
    if ends.shape[1] == 0 or not ends.any():
        return None
    third = np.diff(part, n=3, axis=1)[ends]
    return float(np.median(np.abs(third)) / 0.6745 / np.sqrt(20))


def compare_rates(recording: Recording) -> Rates | None:
    """Recorded velocities against central differences of positions; None of short or motionless trajectories."""
    inside = recording.valid[:, 2:]
    if inside.shape[1] == 0 or not inside.any():
        return None
    x, dt = recording.x, recording.dt
    central = ((x[:, 2:] - x[:, :-2]) / (2 * dt))[inside]
    bend = ((x[:, 2:] - 2 * x[:, 1:-1] + x[:, :-2]) / dt**2)[inside]
    v = recording.v[:, 1:-1][inside]
    typical = float(np.sqrt(np.mean(np.sum(central**2, axis=-1))))
    if typical == 0:
        return None
    size = np.linalg.norm(bend, axis=-1)
    smooth: Bool[np.ndarray, "S n"] = size <= 3 * np.median(size)
    scatter = float(np.median(np.linalg.norm(v - central, axis=-1)) / typical)
    return Rates(*_slope_and_lag(v[smooth], central[smooth], bend[smooth], typical * 1e-3 / dt), scatter)


def _slope_and_lag(
    v: Float[np.ndarray, "S d"], central: Float[np.ndarray, "S d"], bend: Float[np.ndarray, "S d"], least: float
) -> tuple[float, float | None]:
    """`v = slope (x' - lag x'')` by least squares, over samples without an impact; `least`: x'' that tells a lag."""
    if np.sqrt(np.mean(np.sum(bend**2, axis=-1))) < least:
        return float(np.sum(v * central) / np.sum(central**2)), None
    columns = np.stack([central.reshape(-1), -bend.reshape(-1)], axis=1)
    slope, late = np.linalg.lstsq(columns, v.reshape(-1))[0]
    return float(slope), float(late / slope) if slope else None
