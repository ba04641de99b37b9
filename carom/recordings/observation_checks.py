"""What observations show without a model of the system: sizes, times, what is missing, noise."""

import numpy as np
from jaxtyping import Float

from carom.recordings.motion_windows import series_of
from carom.recordings.observations import Observations
from carom.recordings.recording_checks import ENOUGH, Finding

UNEVEN = 1e-3
"""Steps that differ by more, relative to the typical one, are no equal steps."""


def check_observations(observations: Observations) -> list[Finding]:
    """What the arrays alone show."""
    seen = observations.x[observations.seen]
    extent = ", ".join(f"{a:.3g} to {b:.3g}" for a, b in zip(seen.min(axis=0), seen.max(axis=0), strict=True))
    steps = np.diff(observations.time, axis=1)
    steps = steps[np.isfinite(steps)]
    ways, speeds = _ways(observations)
    motion = float(np.sqrt(np.mean(ways**2))) if len(ways) else 0.0
    out = [
        Finding("positions, by axis", f"{extent} m", ""),
        _times(steps),
        Finding("way of a step, typical", f"{motion:.2g} m", "" if motion > 0 else "nothing moves"),
    ]
    if motion > 0:
        found = f"{np.median(speeds):.3g}, {speeds.max():.3g} m/s"
        out.insert(2, Finding("speed by differences, median and largest", found, ""))
    lost = 1 - observations.seen.sum() / max(int(observations.valid.sum()) * observations.n_points, 1)
    out.append(Finding("points not seen", f"{lost:.1%}" if lost else "none", ""))
    if observations.n_trajectories < ENOUGH:
        count = f"{observations.n_trajectories} of up to {int(observations.length.max())} samples"
        out.append(Finding("trajectories", count, "several starts tell more"))
    noise = noise_of(observations)
    if noise is not None and motion > 0:
        share = f", {noise / motion:.1g} of a step's way"
        advice = "no motion stands out of it" if noise > motion else ""
        out.append(Finding("noise of positions", f"at most {noise:.2g} m{share}", advice))
    return out


def noise_of(observations: Observations) -> float | None:
    """Standard deviation (m) of errors of positions, the largest of all points and axes; None if too little is seen.

    Of motion with many impacts it is more than that: see `motion_windows.py`.
    """
    found = [series_of(observations, (point,)) for point in range(observations.n_points)]
    units = [series.unit.max() for series in found if series is not None]
    return float(max(units)) if units else None


def _times(steps: Float[np.ndarray, " S"]) -> Finding:
    typical = float(np.median(steps))
    uneven = float(np.mean(np.abs(steps - typical) > UNEVEN * typical))
    if not uneven:
        return Finding("time between samples", f"{typical:.4g} s, always", "")
    found = f"{typical:.4g} s in the median, from {steps.min():.3g} to {steps.max():.3g} s"
    return Finding("time between samples", found, "")


def _ways(observations: Observations) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """How far points move from a sample to the next, where both were seen (m), and how fast (m/s)."""
    ways = np.linalg.norm(np.diff(observations.x, axis=1), axis=-1)
    speeds = ways / np.diff(observations.time, axis=1)[..., None]
    both = np.isfinite(ways)
    return ways[both], speeds[both]
