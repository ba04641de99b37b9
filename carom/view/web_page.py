"""A page that plays motions in any browser, in one file: no network, no server."""

import html
import json
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from carom.atomic import write_whole
from carom.checks import require
from carom.system import System
from carom.view.motion import Motion
from carom.view.scene import Wall, box_of_points, lines_of, outlined_bodies, walls_of
from carom.view.style import checked_path

MOST_SAMPLES = 2000
"""Longer motions are thinned out; samples with a contact stay."""
PLOTS = (("energy", "energy (J)"), ("gap", "smallest gap (m)"), ("impulses", "impulses (N s)"))


def save_page(
    system: System,
    trajectories: Sequence[tuple[str, Sequence[Motion]]],
    path: str | os.PathLike[str],
    *,
    names: Sequence[str],
    title: str,
) -> Path:
    """Write a page of trajectories: each has a name, and a motion for each of `names` (true, predicted); returns it.

    **Raises:** `CaromError` if there is nothing to show, or for a path that cannot be written or is not .html.
    """
    path = checked_path(path, (".html",))
    require(len(trajectories) > 0, "trajectories must hold at least one; it was empty.")
    content = page_data(system, trajectories, names)
    # A "</script>" within the data would end it.
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    template = Template((resources.files("carom.view") / "player.html").read_text())
    write_whole(path, template.substitute(title=html.escape(title), data=data).encode())
    return path


def page_data(
    system: System, trajectories: Sequence[tuple[str, Sequence[Motion]]], names: Sequence[str]
) -> dict[str, Any]:
    """What the page is told, as plain numbers and texts."""
    motions = [motion for _, group in trajectories for motion in group]
    box = box_of_points(system, np.concatenate([m.center.reshape(-1, system.dim) for m in motions]))
    extent = float(np.max(box[1] - box[0]))
    largest = max((float(np.linalg.norm(m.impulse, axis=-1).max(initial=0)) for m in motions), default=0.0)
    return {
        "dim": system.dim,
        "radii": [_short(r) for r in np.asarray(system.radii, float)],
        "boxed": [body in outlined_bodies(system) for body in range(len(system.bodies))],
        "box": _numbers(box),
        "walls": [_numbers(_corners(wall, box)) for wall in walls_of(system)],
        "anchors": _numbers(lines_of(system).anchors),
        "arrow": 0.25 * extent / largest if largest > 0 else 0.0,
        "cone": 0.08 * extent,
        "names": list(names),
        "plots": [{"name": name, "label": label} for name, label in PLOTS],
        "trajectories": [
            {"name": name, "time": _numbers(group[0].time[kept]), "motions": [_motion(m, kept) for m in group]}
            for name, group in trajectories
            for kept in [_kept(group)]
        ],
    }


def _kept(motions: Sequence[Motion]) -> np.ndarray:
    """The samples that are shown."""
    count = min(len(motion.time) for motion in motions)
    every = -(-count // MOST_SAMPLES)
    touched = np.any([motion.acting[:count].any(axis=1) for motion in motions], axis=0)
    return np.flatnonzero((np.arange(count) % every == 0) | touched)


def _motion(motion: Motion, kept: np.ndarray) -> dict[str, Any]:
    impulses = motion.impulse_size
    contacts = []
    for k in kept:
        contacts.append([_contact(motion, int(k), int(c)) for c in np.flatnonzero(motion.acting[k])])
    return {
        "center": _numbers(motion.center[kept]),
        "lines": _numbers(motion.lines[kept]),
        "contacts": contacts,
        "energy": _numbers(motion.energy[kept]),
        "gap": _numbers(motion.gap[kept]),
        "impulses": _numbers(impulses[kept]),
    }


def _contact(motion: Motion, k: int, c: int) -> dict[str, Any]:
    normal, impulse = motion.normal[k, c], motion.impulse[k, c]
    along = impulse - (impulse @ normal) * normal
    size = np.linalg.norm(along)
    if size < 1e-12:  # any direction of the plane
        along = np.roll(normal, 1) - (np.roll(normal, 1) @ normal) * normal
        along = along if np.linalg.norm(along) > 1e-6 else np.eye(len(normal))[0] - normal[0] * normal
        size = np.linalg.norm(along)
    return {
        "place": _numbers(motion.place[k, c]),
        "normal": _numbers(normal),
        "tangent": _numbers(along / size),
        "impulse": _numbers(impulse),
        "friction": _short(motion.friction[k, c]),
    }


def _corners(wall: Wall, box: np.ndarray) -> np.ndarray:
    """The part of a wall that is near: the ends of a line in 2D, the corners of a square in 3D."""
    middle = box.mean(axis=0)
    foot = middle - wall.gap(middle) * wall.normal
    half = 0.62 * float(np.max(box[1] - box[0]))
    if len(foot) == 2:
        along = np.array([-wall.normal[1], wall.normal[0]])
        return np.array([foot - half * along, foot + half * along])
    first = np.eye(3)[int(np.argmin(np.abs(wall.normal)))]
    first = first - (first @ wall.normal) * wall.normal
    first = first / np.linalg.norm(first)
    second = np.cross(wall.normal, first)
    return np.array([foot + half * (a * first + b * second) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])


def _short(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _numbers(values: np.ndarray) -> Any:
    """Nested lists of numbers with five digits; null for what is not finite."""
    array = np.asarray(values, float)
    if array.ndim == 0:
        return _short(float(array))
    return [_numbers(part) for part in array] if array.ndim > 1 else [_short(v) for v in array]
