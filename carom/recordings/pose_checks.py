"""What looks wrong with a recording of poses: scale, gravity, penetration, bias, copies, late velocities."""

from collections.abc import Iterable
from itertools import product

import numpy as np
from jaxtyping import Float

from carom.recordings.corner_impacts import mass_balance
from carom.recordings.poses import PoseRecording, flight_acceleration, free_flight, velocity_lag
from carom.recordings.recording_checks import Finding

STANDARD_GRAVITY = 9.81


LATE = 0.25
"""Velocities that are older than this share of a sample are differences of the past."""


def check_poses(poses: PoseRecording, width: float) -> list[Finding]:
    """What a tossed cube of this nominal `width` (m) shows; everything is measured on the recording."""
    out = [_gravity(poses), _rest_height(poses, width), _lowest(poses, width), _tilt(poses), _mass(poses, width)]
    if poses.velocity is not None:
        lag = velocity_lag(poses) / poses.dt
        late = abs(lag) > LATE
        out.append(
            Finding(
                "velocities are late by",
                f"{lag:.2f} of a sample",
                "they are differences of the past: brought to their samples by free fall" if late else "",
            )
        )
    copies = find_copies(poses)
    out.append(
        Finding(
            "copies",
            f"{len(copies)} of {len(poses.length)}" + (f", e.g. {copies[0][1]} of {copies[0][0]}" if copies else ""),
            "turned about the vertical: leave them out of validation" if copies else "",
        )
    )
    return out


def _gravity(poses: PoseRecording) -> Finding:
    fall = -flight_acceleration(poses)
    share = fall / STANDARD_GRAVITY - 1
    advice = f"lengths may be {abs(share):.1%} too {'short' if share < 0 else 'long'}: learn gravity, or --scale"
    return Finding("gravity in free flight", f"{fall:.3f} m/s^2", advice if abs(share) > 0.005 else "")


def at_rest(poses: PoseRecording) -> np.ndarray:
    """Samples at which the body has stopped: it moves by less than 1 mm in the last 5 of each toss."""
    last = poses.length - 1
    rows = np.arange(len(last))
    moved = np.linalg.norm(poses.position[rows, last] - poses.position[rows, np.maximum(last - 5, 0)], axis=1)
    return moved < 1e-3


def _rest_height(poses: PoseRecording, width: float) -> Finding:
    resting, last = at_rest(poses), poses.length - 1
    if not resting.any():
        return Finding("height at rest", "no toss comes to rest", "record until the body rests")
    height = float(np.median(poses.position[np.flatnonzero(resting), last[resting], 2]))
    share = height / (width / 2) - 1
    advice = f"half of the width is {width / 2 * 1e3:.2f} mm: {abs(share):.1%} off; learn half_width"
    return Finding("height at rest", f"{height * 1e3:.2f} mm", advice if abs(share) > 0.005 else "")


def lowest_corners(poses: PoseRecording, width: float) -> Float[np.ndarray, "N T"]:
    """Heights of the lowest corner of a cube of this width (m)."""
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * width
    return poses.position[..., 2] + (poses.rotation[..., 2, :] @ corners.T).min(axis=-1)


def _lowest(poses: PoseRecording, width: float) -> Finding:
    depth = -float(np.quantile(lowest_corners(poses, width)[poses.valid], 0.01))
    advice = "a cube of this width sinks into the table: its width, the table's height or the scale is wrong"
    return Finding("deepest corner (1 % quantile)", f"{depth * 1e3:.2f} mm", advice if depth > 0.005 * width else "")


def _tilt(poses: PoseRecording) -> Finding:
    resting, last = at_rest(poses), poses.length - 1
    if not resting.any():
        return Finding("tilt at rest", "no toss comes to rest", "")
    up = np.abs(poses.rotation[np.flatnonzero(resting), last[resting], 2]).max(axis=1)
    tilt = float(np.degrees(np.median(np.arccos(np.minimum(up, 1)))))
    advice = "poses have a bias that each toss keeps: expect no better predictions of rotation"
    return Finding("tilt at rest, median", f"{tilt:.2f} degrees", advice if tilt > 0.2 else "")


def _mass(poses: PoseRecording, width: float) -> Finding:
    found = mass_balance(poses, width)
    if found is None:
        return Finding("centre of mass", "too few impacts at one corner to tell", "")
    x, y, z = 1e3 * found.center
    middle, best = found.unexplained
    advice = (
        f"not in the middle, about which {middle:.0%} of the change of angular momentum are left over; about this "
        f"point {best:.0%} are: learn it"
    )
    off = np.linalg.norm(found.center) > 0.01 * width and best < 0.7 * middle
    return Finding(
        f"centre of mass, by {found.impacts} impacts at one corner",
        f"({x:.1f}, {y:.1f}, {z:.1f}) mm",
        advice if off else "",
    )


def find_copies(poses: PoseRecording) -> list[tuple[int, int]]:
    """Pairs of trajectories with the same heights at all samples (to 1e-7 m): one is the other, turned or moved."""
    heights = (poses.position[k, :length, 2] for k, length in enumerate(poses.length))
    return [(first, k) for k, first in enumerate(earlier_equal(heights, 7)) if first >= 0]


def earlier_equal(heights: Iterable[np.ndarray], digits: int) -> list[int]:
    """For each array the index of the first one before it that is the same to so many digits, or -1."""
    seen: dict[bytes, int] = {}
    firsts = [seen.setdefault(np.round(each, digits).tobytes(), k) for k, each in enumerate(heights)]
    return [first if first != k else -1 for k, first in enumerate(firsts)]


def flight_noise(poses: PoseRecording) -> float:
    """Standard deviation (m) of recorded heights about parabolas in free flight."""
    flight, left = free_flight(poses), []
    for k in np.flatnonzero(flight.sum(axis=1) >= 8):
        time = np.flatnonzero(flight[k]) * poses.dt
        height = poses.position[k, flight[k], 2]
        left.append(height - np.polyval(np.polyfit(time, height, 2), time))
    return float(np.std(np.concatenate(left))) if left else float("nan")
