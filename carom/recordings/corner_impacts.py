"""What impacts at one corner of a recorded box tell, without any contact model: where its mass is, and how it bounces.

Between the flights before and after an impact at one corner, whatever force acted there changed momentum and angular
momentum together: about the centre of mass c, with the body's velocity v of the middle, rates w, and the corner at r,

    I dw = (r - c) x (dv + dw x c)        (per mass; friction, restitution and the force's course do not enter)

so that c and the moment of inertia follow from recorded velocities alone. In flight it is the centre of mass that moves
along a parabola; so velocities are taken again from the flights of the point that was found.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from carom.recordings.poses import PoseRecording, flight_acceleration

FLIGHT = 3
"""Samples on each side that velocities are taken from."""
LONGEST = 3
"""Samples that an impact may take."""
JOLT = 5.0
"""Upward acceleration (m/s^2) above free fall that tells an impact."""
CLEAR = 0.04
"""Share of the width by which the next corner must be higher than the one that hits."""
FEWEST = 20
ROUNDS = 3


class CornerImpacts(NamedTuple):
    """Impacts at one corner: velocities (m/s, rad/s) of a point of a body before and after, the corner from it (m)."""

    velocity: Float[np.ndarray, "2 K 3"]
    omega: Float[np.ndarray, "2 K 3"]
    arm: Float[np.ndarray, "K 3"]
    rotation: Float[np.ndarray, "K 3 3"]


class MassBalance(NamedTuple):
    """Centre of mass from the middle of the box (m, along its axes) and inertia over mass (m^2), and what they explain.

    `unexplained`: median share of the change of angular momentum that is left, about the middle and about `center`.
    """

    impacts: int
    center: Float[np.ndarray, " 3"]
    inertia: float
    unexplained: tuple[float, float]


def corner_impacts(poses: PoseRecording, width: float, center: Float[np.ndarray, " 3"]) -> CornerImpacts:
    """Impacts of a box of this `width` (m) at one corner, between flights of three samples of its point at `center`."""
    fall = np.array([0.0, 0.0, flight_acceleration(poses)])
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * width - center
    kept: list[tuple[np.ndarray, ...]] = []
    for k, length in enumerate(poses.length):
        rotation = Rotation.from_matrix(poses.rotation[k, :length])
        x = poses.position[k, :length] + rotation.apply(center)
        jolt = np.pad(np.diff(x[:, 2], 2) / poses.dt**2 - fall[2], 1)
        for first, last in _runs(jolt > JOLT):
            before = np.arange(first - FLIGHT, first)
            after = np.arange(last + 1, last + 1 + FLIGHT)
            if last - first >= LONGEST or before[0] < 1 or after[-1] >= length - 1:
                continue
            if np.abs(jolt[np.concatenate([before[:-1], after[1:]])]).max() > JOLT:
                continue
            middle = (first + last) / 2
            states = [_flight(x, rotation, rows, (rows - middle) * poses.dt, fall) for rows in (before, after)]
            (x0, v0, w0, r0), (x1, v1, w1, _) = states
            jump = v1 - v0
            time = -np.dot(x1 - x0, jump) / np.dot(jump, jump)
            turned = (Rotation.from_rotvec(w0 * time) * r0).as_matrix()
            arms = corners @ turned.T
            order = np.argsort(arms[:, 2])
            gap, approach = np.diff(arms[order[:2], 2])[0], (v0 + fall * time + np.cross(w0, arms[order[0]]))[2]
            height = (x0 + v0 * time + fall * time**2 / 2 + arms[order[0]])[2]
            if abs(time) < 2 * poses.dt and gap > CLEAR * width and approach < -0.3 and abs(height) < 0.08 * width:
                kept.append((v0 + fall * time, v1 + fall * time, w0, w1, arms[order[0]], turned))
    if not kept:
        none = np.zeros((0, 3))
        return CornerImpacts(np.stack([none, none]), np.stack([none, none]), none, np.zeros((0, 3, 3)))
    v0, v1, w0, w1, arm, turned = (np.array(part) for part in zip(*kept, strict=True))
    return CornerImpacts(np.stack([v0, v1]), np.stack([w0, w1]), arm, turned)


def _runs(mask: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of each run of true values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2)]


def _flight(x, rotation: Rotation, rows, time, fall):
    """Position, velocity, rates and rotation at time 0 of a flight through these samples."""
    slope, place = np.polyfit(time, x[rows] - fall * time[:, None] ** 2 / 2, 1)
    reference = rotation[int(rows[len(rows) // 2])]
    rate, offset = np.polyfit(time, (rotation[rows] * reference.inv()).as_rotvec(), 1)
    return place, slope, rate, Rotation.from_rotvec(offset) * reference


def mass_balance(poses: PoseRecording, width: float) -> MassBalance | None:
    """Centre of mass and inertia that explain the impacts at one corner best; None if there are fewer than twenty."""
    center, unexplained, count, inertia = np.zeros(3), [], 0, 0.0
    for _ in range(ROUNDS):
        impacts = corner_impacts(poses, width, center)
        count = len(impacts.arm)
        if count < FEWEST:
            return None
        inertia, step, before, after = _balance(impacts)
        unexplained += [before, after]
        center = center + step
    return MassBalance(count, center, inertia, (unexplained[0], unexplained[-1]))


def _balance(impacts: CornerImpacts) -> tuple[float, Float[np.ndarray, " 3"], float, float]:
    """Inertia over mass, centre of mass from the point, and what is unexplained about the point and about that."""
    dv, dw = np.diff(impacts.velocity, axis=0)[0], np.diff(impacts.omega, axis=0)[0]
    size = np.median(np.linalg.norm(np.cross(impacts.arm, dv), axis=1))

    def left(p):
        center = impacts.rotation @ p[1:]
        return (np.cross(impacts.arm - center, dv + np.cross(dw, center)) - p[0] * dw) / size

    def fit(free: int):
        start = np.array([np.sum(np.cross(impacts.arm, dv) * dw) / np.sum(dw**2), 0.0, 0.0, 0.0])
        found = scipy.optimize.least_squares(
            lambda q: left(np.concatenate([q, start[free:]])).ravel(), start[:free], loss="soft_l1", f_scale=0.05
        )
        p = np.concatenate([found.x, start[free:]])
        return p, float(np.median(np.linalg.norm(left(p), axis=1)))

    (_, before), (p, after) = fit(1), fit(4)
    return float(p[0]), p[1:], before, after
