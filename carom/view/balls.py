"""Balls that are fixed anywhere in bodies: the lines that show them, and where they touch."""

from itertools import combinations, pairwise

import numpy as np

from carom.contact.balls import BallBall, BallPlane
from carom.system import System

RING = {2: 24, 3: 8}
"""Lines around a ball, by dimension; in 3D there are three rings."""


def balls_of(system: System) -> dict[int | None, list[tuple[np.ndarray, float]]]:
    """Centers, along the axes of their bodies, and radii, by body (`None`: in space); each once.

    Without the balls that are drawn anyway: of the body's own radius, at its center of mass.
    """
    found: dict[int | None, dict[tuple, tuple[np.ndarray, float]]] = {}
    for contact in system.contacts:
        if isinstance(contact, BallPlane):
            each = zip(contact.bodies, np.asarray(contact.centers), np.asarray(contact.radii), strict=True)
        elif isinstance(contact, BallBall):
            bodies = [body for pair in contact.pairs for body in pair]
            centers = np.asarray(contact.centers).reshape(-1, system.dim)
            each = zip(bodies, centers, np.asarray(contact.radii).ravel(), strict=True)
        else:
            continue
        for body, center, radius in each:
            own = body is not None and not center.any() and np.isclose(radius, float(system.bodies[body].radius))
            if not own:
                key = (*np.round(center, 9), round(float(radius), 9))
                found.setdefault(body, {})[key] = np.asarray(center, float), float(radius)
    return {body: list(balls.values()) for body, balls in found.items()}


def ball_lines(system: System) -> tuple[list[list[np.ndarray]], list[list[np.ndarray]]]:
    """Rings around balls, and spokes to them from the centers of their bodies: ends as `weights @ x + offset`."""
    n, dim = system.n_points, system.dim
    unit, zero = np.eye(n), np.zeros(dim)
    weights, offset = [], []
    for body, balls in balls_of(system).items():
        points = None if body is None else [system.table.center[body], *system.table.axes[body]]
        for center, radius in balls:
            strokes = _rings(center, radius, dim) if radius > 0 else []
            if points is not None and center.any():
                strokes.append((zero, center))
            for stroke in strokes:
                if points is None:
                    weights.append([0 * unit[0]] * 2)
                    offset.append(list(stroke))
                else:
                    weights.append([unit[points[0]] * (1 - np.sum(end)) + end @ unit[points[1:]] for end in stroke])
                    offset.append([zero, zero])
    return weights, offset


def _rings(center: np.ndarray, radius: float, dim: int) -> list[tuple[np.ndarray, np.ndarray]]:
    turn = np.linspace(0, 2 * np.pi, RING[dim] + 1)
    strokes = []
    for first, second in combinations(radius * np.eye(dim), 2):
        ring = center + np.outer(np.cos(turn), first) + np.outer(np.sin(turn), second)
        strokes += list(pairwise(ring))
    return strokes


def ball_reach(system: System) -> dict[int, float]:
    """How far (m) the balls of a body reach from its center."""
    return {
        body: max(float(np.linalg.norm(center)) + radius for center, radius in balls)
        for body, balls in balls_of(system).items()
        if body is not None
    }


def ball_touches(system: System, contact: BallPlane | BallBall, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the balls of a contact touch (time, c, d), and their gaps (time, c), for points `x` (time, n, d)."""

    def places(bodies, centers):
        out = []
        for body, center in zip(bodies, np.asarray(centers, float), strict=True):
            if body is None:
                out.append(np.broadcast_to(center, (len(x), system.dim)))
            else:
                origin = x[:, system.table.center[body]]
                axes = x[:, list(system.table.axes[body])] - origin[:, None]
                out.append(origin + np.einsum("a,tad->td", center, axes))
        return np.stack(out, axis=1)

    radii = np.asarray(contact.radii, float)
    if isinstance(contact, BallPlane):
        center, normal = places(contact.bodies, contact.centers), np.asarray(contact.normal, float)
        gap = (center - np.asarray(contact.point, float)) @ normal - radii
        return center - radii[:, None] * normal, gap
    first, second = zip(*contact.pairs, strict=True)
    a, b = places(first, contact.centers[:, 0]), places(second, contact.centers[:, 1])
    distance = np.linalg.norm(b - a, axis=-1)
    toward = (b - a) / np.maximum(distance, 1e-12)[..., None]
    return a + radii[:, 0, None] * toward, distance - radii.sum(axis=1)
