"""In which order and direction recorded quaternions are written, as the recorded motion tells it.

Quaternions may have w first or last, and turn the body's axes into the world's or back. Read in another way they are
still rotations, and smooth. What tells is

* recorded rates: `omega` must be the rate of the recorded rotations;
* free flight: angular momentum `R I omega`, with the `omega` of the rotations R, is constant in the world's axes, with
  one inertia I (unknown, found by least squares) for all flights. To have w at the other end and to go the other way
  differ by turns of the axes alone, q -> a conj(q) b with unit quaternions a and b, so that flights cannot tell these
  two apart; and nothing of a body with three equal moments of inertia, whose rotation is uniform in any reading;
* the table: a box comes to rest on a face, and has no corner far below.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
import scipy.linalg
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from carom.recordings.pose_checks import at_rest, lowest_corners
from carom.recordings.poses import PoseRecording, free_flight, impacts
from carom.recordings.recording_checks import Finding

Order = Literal["wxyz", "xyzw"]
Direction = Literal["body-to-world", "world-to-body"]
HALF = 2
"""Samples on each side that a rate is taken from."""
FEWEST = 3
"""Flights, or tosses that come to rest, which tell."""
CLEARLY = 3.0
"""How many times worse than the best a reading must be to be wrong."""
FEWEST_RATES = 10
SLOW = 0.5
"""Rates (rad/s) that tell nothing."""
INERTIAS = np.array([np.eye(3)[[i]].T @ np.eye(3)[[j]] for i in range(3) for j in range(i, 3)])
INERTIAS = (INERTIAS + INERTIAS.transpose(0, 2, 1)) / 2


class Reading(NamedTuple):
    """How the four numbers of a quaternion are read."""

    order: Order = "wxyz"
    direction: Direction = "body-to-world"

    def __str__(self) -> str:
        return f"{', '.join(self.order)}, {self.direction.replace('-', ' ')}"

    def read(self, quaternion: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
        """w first and body to world, of what is written in this way."""
        first = quaternion if self.order == "wxyz" else np.roll(quaternion, 1, axis=-1)
        return first if self.direction == "body-to-world" else first * CONJUGATE

    def written(self, quaternion: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 4"]:
        """In this way, of w first and body to world."""
        first = quaternion if self.direction == "body-to-world" else quaternion * CONJUGATE
        return first if self.order == "wxyz" else np.roll(first, -1, axis=-1)


CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
READINGS = tuple(
    Reading(order, direction) for direction in ("body-to-world", "world-to-body") for order in ("wxyz", "xyzw")
)
"""The likelier first."""


class Evidence(NamedTuple):
    """How far each of `READINGS` is off by one measure: `good` of a right reading, at least `bad` of a wrong one.

    `wrong`: what to say of one that is, with its number.
    """

    off: dict[Reading, float]
    good: float
    bad: float
    wrong: str

    def contradicts(self, reading: Reading) -> bool:
        """Whether a reading is clearly wrong, and another is not."""
        best = min(self.off.values())
        return best < self.good and self.off[reading] > max(self.bad, CLEARLY * best)


class Convention(NamedTuple):
    """What a recording tells of how its quaternions are written.

    `possible`: readings that nothing contradicts, the likelier first; `wrong`: what contradicts the one that was used,
    "" if nothing does; `finding`: both in words.
    """

    possible: tuple[Reading, ...]
    wrong: str
    finding: Finding


def check_convention(poses: PoseRecording, width: float, used: Reading = READINGS[0]) -> Convention:
    """Whether the motion of a box of this `width` (m) fits the reading of quaternions that `poses` were made by."""
    others = {reading: _reread(poses, used, reading) for reading in READINGS}
    found = [_rates(others), _flights(poses, others), _rest(others), _corners(others, width)]
    evidence = [part for part in found if part is not None]
    possible = tuple(r for r in READINGS if not any(part.contradicts(r) for part in evidence))
    wrong = next((part.wrong.format(part.off[used]) for part in evidence if part.contradicts(used)), "")
    return Convention(possible, wrong, _finding(used, possible, wrong))


def _finding(used: Reading, possible: tuple[Reading, ...], wrong: str) -> Finding:
    others = [reading for reading in possible if reading != used]
    told, advice = "the motion fits no other way to read them", ""
    if wrong:
        told = wrong
        advice = f"may be {' or '.join(map(str, others))}" if others else "they fit in no way: check the file"
    elif others:
        told = "the motion fits " + (
            "any order and direction" if len(others) == 3 else f"{' and '.join(map(str, others))} too"
        )
        advice = f"nothing tells here: make sure, else give {options(used, others[0])}"
    return Finding(f"quaternions, read as {used}", told, advice)


def options(used: Reading, other: Reading) -> str:
    """The options of the command line that another reading needs."""
    names = [f"--quaternion-order {other.order}"] if other.order != used.order else []
    return " ".join(
        [*names, *([f"--quaternion-direction {other.direction}"] if other.direction != used.direction else [])]
    )


def _reread(poses: PoseRecording, used: Reading, reading: Reading) -> PoseRecording:
    if reading == used:
        return poses
    return eqx.tree_at(lambda p: p.quaternion, poses, reading.read(used.written(poses.quaternion)))


def _turning(poses: PoseRecording) -> tuple[Float[np.ndarray, "N t 3 3"], Float[np.ndarray, "N t 3"]]:
    """Rotations (body to world) and their rates (rad/s, body), but for the first and the last samples."""
    shape = (*poses.quaternion.shape[:2], 3)
    turns = poses.rotation
    before, after = turns[:, : -2 * HALF], turns[:, 2 * HALF :]
    between = np.einsum("ntji,ntjk->ntik", before, after).reshape(-1, 3, 3)
    rate = Rotation.from_matrix(between).as_rotvec() / (2 * HALF * poses.dt)
    return turns[:, HALF:-HALF], rate.reshape(shape[0], -1, 3)


def _rates(others: dict[Reading, PoseRecording]) -> Evidence | None:
    """Recorded rates against those of the rotations, away from impacts and padding."""
    first = next(iter(others.values()))
    if first.omega is None or first.omega.shape[1] <= 2 * HALF:
        return None
    bends = impacts(first)
    near = np.any([np.roll(bends, k, axis=1) for k in range(-HALF - 1, HALF + 2)], axis=0)
    inside = (~near)[:, HALF:-HALF] & first.valid[:, 2 * HALF :]
    rates = first.omega[:, HALF:-HALF]
    inside &= np.linalg.norm(rates, axis=2) > SLOW
    if inside.sum() < FEWEST_RATES:
        return None
    omega = rates[inside]
    typical = float(np.median(np.linalg.norm(omega, axis=1)))
    off = {
        reading: float(np.median(np.linalg.norm(_turning(poses)[1][inside] - omega, axis=1))) / typical
        for reading, poses in others.items()
    }
    return Evidence(off, 0.3, 0.6, "recorded omega is not the rate of its rotations, but {:.0%} off")


def _flights(poses: PoseRecording, others: dict[Reading, PoseRecording]) -> Evidence | None:
    """How much of angular momentum is not constant in free flight, with the inertia that is best for it."""
    if poses.quaternion.shape[1] <= 2 * HALF:
        return None
    flight = free_flight(poses)[:, 2 * HALF :]  # up to the last sample that a rate is taken from
    flight &= (flight.sum(axis=1) > 2 * HALF)[:, None]
    turning = {reading: _turning(other) for reading, other in others.items()}
    speed = np.linalg.norm(next(iter(turning.values()))[1], axis=2)
    if flight.any(axis=1).sum() < FEWEST or np.median(speed[flight]) < SLOW:
        return None
    found = {reading: _momentum_change(*parts, flight) for reading, parts in turning.items()}
    if not found[min(found, key=lambda r: found[r][0])][1]:
        return None
    off = {reading: share for reading, (share, _) in found.items()}
    return Evidence(off, 0.1, 0.02, "in free flight {:.1%} of angular momentum would come and go")


def _momentum_change(rotation, rate, flight) -> tuple[float, bool]:
    """Root mean square change of angular momentum as a share of it, and whether a body can have such an inertia."""
    momentum = np.einsum("ntij,bjk,ntk->ntbi", rotation, INERTIAS, rate)
    weight = flight[:, :, None, None] / np.maximum(flight.sum(axis=1), 1)[:, None, None, None]
    change = (momentum - np.sum(momentum * weight, axis=1, keepdims=True))[flight]
    changes, whole = (np.einsum("sbi,sci->bc", part, part) for part in (change, momentum[flight]))
    shares, ways = scipy.linalg.eigh(changes, whole + 1e-12 * np.trace(whole) * np.eye(6))
    moments = np.linalg.eigvalsh(np.einsum("b,bij->ij", ways[:, 0], INERTIAS))
    moments = moments * np.sign(moments.sum())
    # No moment of inertia is larger than the sum of the others; noise may make it so by a little.
    physical = bool(moments.min() > 0 and 2 * moments.max() < 1.05 * moments.sum())
    return float(np.sqrt(max(shares[0], 0.0))), physical


def _rest(others: dict[Reading, PoseRecording]) -> Evidence | None:
    """Share of tosses that come to rest on no face."""
    first = next(iter(others.values()))
    resting, last = np.flatnonzero(at_rest(first)), first.length - 1
    if len(resting) < FEWEST:
        return None
    flat = np.cos(np.radians(5.0))
    up = {reading: poses.rotation[resting, last[resting], 2] for reading, poses in others.items()}
    off = {reading: float(np.mean(np.abs(part).max(axis=1) < flat)) for reading, part in up.items()}
    return Evidence(off, 0.2, 0.5, "{:.0%} of the tosses would come to rest on no face")


def _corners(others: dict[Reading, PoseRecording], width: float) -> Evidence:
    """Depth of the deepest corners as a share of the width."""
    off = {
        reading: max(-float(np.quantile(lowest_corners(poses, width)[poses.valid], 0.01)) / width, 0.0)
        for reading, poses in others.items()
    }
    return Evidence(off, 0.06, 0.12, "corners would be {:.0%} of the width below the table")
