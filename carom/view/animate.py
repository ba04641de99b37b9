"""Animations of a trajectory, true against predicted, as GIF or MP4.

The background is drawn once; each frame redraws only what moves. A system in 3D is seen from one
direction without perspective, so that spheres are disks of their own radius and everything is drawn
as in 2D.
"""

import importlib.util
import os
import warnings
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import imageio.v2
import jax
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from PIL import Image

from carom.checks import require
from carom.contact.candidates import DiskDisk, DiskPlane
from carom.mechanics.bodies import RigidBody
from carom.mechanics.constraints import Distance, Joint, Tether
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.view.style import (
    BLUE,
    HATCH,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    SOLID,
    TINT,
    TINT_EDGE,
    VERMILLION,
    checked_path,
    figure_style,
    new_figure,
    power,
    replacing,
)

DPI = 100
SHORTEST, LONGEST, HOLD = 4.0, 10.0, 0.8
"""Playing time (s) between which the speed is chosen; how long the last frame stays."""
MOST_FRAMES = 500
FAR = 1e6
"""What is farther away (m) is lost."""
RING_FRAMES = 10
"""For how many frames a new contact flashes."""
AZIMUTH, ELEVATION = np.radians(-60), np.radians(20)
"""From where a system in 3D is seen; the third axis is up."""
MARGIN, HEADER, PANEL = 14, 58, 104
"""Parts of the picture (pixels)."""


def animate(
    system: System,
    true: Trajectory | None,
    predicted: Trajectory,
    path: str | os.PathLike[str],
    *,
    fps: float | int = 25,
    speed: float | int | None = None,
    trail: float | int | None = None,
    width: int = 500,
) -> Path:
    """Draw `predicted` as outlines over `true` as filled disks; returns the path.

    Contacts of the prediction flash where they happen. Below runs the relative error `|z - z^| /
    |z|` over positions and velocities together, with the times at which the prediction had contact.

    **Arguments:**

    - `system`: gives radii, links and walls.
    - `true`, `predicted`: one trajectory each, `x` (time, n, d), at the same times; `true` may be
      None. Where one goes on after the other's end, that part is left out.
    - `path`: ends in .gif, or in .mp4, which needs the package imageio-ffmpeg.
    - `fps`: frames a second at most; samples in between are left out.
    - `speed`: 1 is real time. By default real time, but so that it takes from 4 to 10 s.
    - `trail`: how much of the past (s) trails behind the bodies; by default a quarter of the whole.
    - `width`: of the picture (pixels).

    **Raises:** `CaromError` for trajectories that do not fit the system, arguments
    out of range, or a path that cannot be written.
    """
    path = checked_path(path, (".gif", ".mp4"))
    movie = path.suffix.lower() == ".mp4"
    require(
        not movie or importlib.util.find_spec("imageio_ffmpeg") is not None,
        "path asks for an MP4, which needs the package imageio-ffmpeg. Install it (pip install "
        "imageio-ffmpeg), or choose a path that ends in .gif.",
    )
    require(fps > 0, f"fps must be positive; it was {fps}.")
    require(speed is None or speed > 0, f"speed must be positive; it was {speed}.")
    require(trail is None or trail >= 0, f"trail must not be negative; it was {trail}.")
    require(width >= 300, f"width must be at least 300 pixels; it was {width}.")
    _check("predicted", predicted, system)
    if true is not None:
        _check("true", true, system)
        count = min(true.x.shape[0], predicted.x.shape[0])
        true, predicted = _first(true, count), _first(predicted, count)
    time = np.asarray(predicted.time, float)
    frames, speed, delay = _schedule(time, fps, speed)
    share = 0.25 if trail is None else min(trail / max(float(np.ptp(time)), 1e-12), 1.0)
    with figure_style(), replacing(path) as temporary:
        picture = _Picture(system, true, predicted, frames, speed, round(share * time.size), width // 2 * 2)
        if movie:
            _write_mp4(temporary, picture, delay)
        else:
            _write_gif(temporary, picture, delay)
    return path


def _check(name: str, trajectory: Trajectory, system: System) -> None:
    shape = (system.n_points, system.dim)
    require(
        trajectory.x.ndim == 3 and trajectory.x.shape[1:] == shape and trajectory.x.shape[0] > 0,
        f"{name} must be one trajectory of this system, x with the shape (time, {shape[0]}, "
        f"{shape[1]}); it was {trajectory.x.shape}. Choose one out of a batch.",
    )
    require(
        bool(np.isfinite(np.asarray(trajectory.x)).any()),
        f"{name} must have positions to draw; none was finite.",
    )


def _first(trajectory: Trajectory, count: int) -> Trajectory:
    return jax.tree.map(lambda a: a[:count], trajectory)


def _schedule(time: np.ndarray, fps: float | int, speed: float | int | None) -> tuple[np.ndarray, float, float]:
    """Samples to show, the speed (1 is real time), and for how long (s) each is shown."""
    duration = float(np.ptp(time))
    if duration <= 0:
        return np.array([0]), 1.0, 1 / fps
    playing = float(np.clip(duration, SHORTEST, LONGEST)) if speed is None else duration / speed
    count = min(time.size, max(2, round(playing * fps)), MOST_FRAMES)
    frames = np.unique(np.linspace(0, time.size - 1, count).round().astype(int))
    return frames, duration / playing, playing / len(frames)


# --- what there is to draw -----------------------------------------------------------------------


def _camera(dim: int) -> np.ndarray:
    """(d, 2), columns are the picture's axes."""
    if dim == 2:
        return np.eye(2)
    (sa, ca), (se, ce) = ((np.sin(a), np.cos(a)) for a in (AZIMUTH, ELEVATION))
    return np.array([[-sa, -se * ca], [ca, -se * sa], [0, ce]])


def _positions(trajectory: Trajectory, far: float) -> np.ndarray:
    """Points (time, n, d), NaN where they are farther than `far` (m) from the origin."""
    x = np.asarray(trajectory.x, float)
    return np.where(np.abs(x) < far, x, np.nan)


class _Lines(NamedTuple):
    """Lines between points that move with the system: their ends are `weights @ x + offset`."""

    weights: np.ndarray  # (lines, 2, n)
    offset: np.ndarray  # (lines, 2, d)
    anchors: np.ndarray  # (anchors, d)


def _lines_of(system: System) -> _Lines:
    """Rods, and a line from the center of each rigid body along its axes to its rim."""
    n, dim = system.n_points, system.dim
    unit, zero = np.eye(n), np.zeros(dim)
    weights, offset, anchors = [], [], []
    for link in system.links:
        if isinstance(link, Distance):
            weights.append([unit[link.i], unit[link.j]])
            offset.append([zero, zero])
        elif isinstance(link, Tether | Joint):
            weights.append([unit[link.i if isinstance(link, Tether) else link.first], 0 * unit[0]])
            anchors.append(np.asarray(link.anchor, float))
            offset.append([zero, anchors[-1]])
    for body, center in zip(system.bodies, system.table.center, strict=True):
        if isinstance(body, RigidBody):
            # A turning disk shows one spoke, a body in 3D its three axes.
            for axis in range(1 if dim == 2 else 3):
                reach = float(body.radius) or 0.1
                rim = (1 - reach) * unit[center] + reach * unit[center + 1 + axis]
                weights.append([unit[center], rim])
                offset.append([zero, zero])
    return _Lines(
        np.reshape(weights, (-1, 2, n)),
        np.reshape(offset, (-1, 2, dim)),
        np.reshape(anchors, (-1, dim)),
    )


def _touching(system: System, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Where bodies can touch (time, C, d), and whether they did (time, C)."""
    x = _positions(trajectory, FAR)[:, list(system.table.center)]
    radii = np.asarray(system.radii, float)
    places, gaps = [np.zeros((len(x), 0, system.dim))], [np.zeros((len(x), 0))]
    for contact in system.contacts:
        if isinstance(contact, DiskPlane):
            body, normal = list(contact.bodies), np.asarray(contact.normal, float)
            gaps.append((x[:, body] - np.asarray(contact.point, float)) @ normal - radii[body])
            places.append(x[:, body] - radii[body, None] * normal)
        elif isinstance(contact, DiskDisk) and contact.pairs:
            a, b = np.array(contact.pairs).T
            between = x[:, b] - x[:, a]
            distance = np.linalg.norm(between, axis=-1)
            gaps.append(distance - radii[a] - radii[b])
            toward = between / np.maximum(distance, 1e-12)[..., None]
            places.append(x[:, a] + radii[a, None] * toward)
    # Recordings in single precision may be that far from closed.
    closed = np.concatenate(gaps, axis=1) < 1e-6
    return np.concatenate(places, axis=1), closed & np.asarray(trajectory.contact)[:, None]


def _relative_error(true: Trajectory, predicted: Trajectory) -> np.ndarray:
    """`|z - z^| / |z|` (time,), NaN where the prediction is not finite."""
    z, guess = (
        np.concatenate([np.asarray(t.x, float), np.asarray(t.v, float)], axis=1).reshape(len(t.x), -1)
        for t in (true, predicted)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(z - guess, axis=1) / np.maximum(np.linalg.norm(z, axis=1), 1e-12)
    return np.where(np.isfinite(error), error, np.nan)


class _Wall(NamedTuple):
    point: np.ndarray
    normal: np.ndarray

    def gap(self, x: np.ndarray) -> float:
        return float((x - self.point) @ self.normal)


def _walls_of(system: System) -> list[_Wall]:
    """Each plane once."""
    found: dict[tuple, _Wall] = {}
    for contact in system.contacts:
        if isinstance(contact, DiskPlane):
            wall = _Wall(np.asarray(contact.point, float), np.asarray(contact.normal, float))
            key = (*wall.normal.round(9), round(float(wall.point @ wall.normal), 9))
            found.setdefault(key, wall)
    return list(found.values())


def _box(system: System, trajectory: Trajectory, anchors: np.ndarray) -> np.ndarray:
    """Lower and upper corner (2, d) of all that the trajectory reaches."""
    x = _positions(trajectory, FAR)[:, list(system.table.center)]
    radii = np.asarray(system.radii, float)[:, None]
    reached = np.concatenate([(x - radii).reshape(-1, system.dim), (x + radii).reshape(-1, system.dim), anchors])
    reached = reached[np.isfinite(reached).all(axis=1)]
    return np.array([reached.min(axis=0), reached.max(axis=0)])


def _extent(box: np.ndarray) -> float:
    return max(float(np.max(box[1] - box[0])), 1e-6)


def _view_box(system, true, predicted, anchors, walls) -> np.ndarray:
    """Corners (2, d) of what is shown: the motion, and the walls that are near."""
    box = _box(system, predicted if true is None else true, anchors)
    if true is not None:
        # A prediction that goes astray may leave the picture.
        room = 0.2 * _extent(box)
        other = np.clip(_box(system, predicted, anchors), box[0] - room, box[1] + room)
        box = np.array([np.minimum(box[0], other[0]), np.maximum(box[1], other[1])])
    extent = _extent(box)
    for wall in walls:
        nearest = np.where(wall.normal > 0, box[0], box[1])
        gap = wall.gap(nearest)
        if 0 < gap <= extent:
            foot = nearest - gap * wall.normal
            box = np.array([np.minimum(box[0], foot), np.maximum(box[1], foot)])
    return box


# --- drawing -------------------------------------------------------------------------------------


class _Picture:
    """The figure and all that moves in it; `draw(k)` gives the pixels of frame k."""

    def __init__(self, system, true, predicted, frames, speed, past, width):
        self.frames, self.speed, self.time = frames, speed, np.asarray(predicted.time, float)
        camera, lines, walls = _camera(system.dim), _lines_of(system), _walls_of(system)
        box = _view_box(system, true, predicted, lines.anchors, walls)
        squares = [square @ camera for square in _planes(walls, box)] if system.dim == 3 else []
        corners = np.array(np.meshgrid(*box.T)).reshape(system.dim, -1).T @ camera
        low, high = _framed(np.concatenate([corners, *squares]))
        inner = width - 2 * MARGIN
        scale = inner / (high[0] - low[0])
        scene = round(scale * (high[1] - low[1]))
        panel = PANEL if true is not None else 0
        height = (HEADER + scene + MARGIN + panel + 1) // 2 * 2
        self.figure = new_figure(width / DPI, height / DPI, dpi=DPI, constrained=False)
        axes = self.figure.add_axes((MARGIN / width, (panel + MARGIN) / height, inner / width, scene / height))
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_axis_off()
        if system.dim == 2:
            _draw_walls(axes, walls)
        else:
            _draw_planes(axes, squares)
            _draw_triad(axes, camera)
        anchors = lines.anchors @ camera
        (self.pivots,) = axes.plot(*anchors.T, "o", color=INK, markersize=5, zorder=5)

        self.parts: list[_Bodies | _Contacts | _ErrorPanel] = []
        if true is None:
            self.parts.append(_Bodies(axes, system, predicted, lines, camera, past, ALONE_LOOK))
        else:
            self.parts.append(_Bodies(axes, system, true, lines, camera, past, TRUE_LOOK))
            self.parts.append(_Bodies(axes, system, predicted, lines, camera, past, PREDICTED_LOOK))
        self.parts.append(_Contacts(axes, system, predicted, camera, frames))
        self._header(system.name, scale, height, width, known=true is not None)
        if true is not None:
            rect = ((MARGIN + 40) / width, 38 / height, (inner - 40) / width, 48 / height)
            panel_axes = self.figure.add_axes(rect)
            self.parts.append(_ErrorPanel(panel_axes, self.time, true, predicted))

        self.canvas: Any = FigureCanvasAgg(self.figure)
        moving = [artist for part in self.parts for artist in part.artists]
        self.moving = sorted([*moving, self.pivots, self.clock], key=lambda a: a.get_zorder())
        for artist in self.moving:
            artist.set_animated(True)
        self.canvas.draw()
        self.background = self.canvas.copy_from_bbox(self.figure.bbox)

    def _header(self, name: str, scale: float, height: int, width: int, *, known: bool) -> None:
        """Name, time, legend and scale."""
        left, right = MARGIN / width, 1 - MARGIN / width
        top, second = 1 - 18 / height, 1 - 42 / height
        style = {"va": "center_baseline", "fontsize": 10}
        self.figure.text(left, top, name, weight="bold", **style)
        self.clock = self.figure.text(right, top, "", ha="right", **style)
        disk = {"marker": "o", "linestyle": "none", "markersize": 8}
        handles = []
        if known:
            handles.append(Line2D([], [], mfc=TINT, mec=TINT_EDGE, label="true", **disk))
        face, edge = ("none", VERMILLION) if known else (TINT, BLUE)
        handles.append(Line2D([], [], mfc=face, mec=edge, mew=1.5, label="predicted", **disk))
        disk["markersize"] = 5
        handles.append(Line2D([], [], mfc=ORANGE, mec=INK, mew=0.6, label="contact", **disk))
        self.figure.legend(
            handles=handles,
            loc="center left",
            bbox_to_anchor=(left, second),
            ncols=3,
            handlelength=1.0,
            handletextpad=0.4,
            columnspacing=1.2,
            borderpad=0,
            borderaxespad=0,
            fontsize=8.5,
        )
        length = _round_length(0.25 * width / scale)
        start = right - length * scale / width
        self.figure.add_artist(Line2D([start, right], [second, second], color=MUTED, linewidth=1.5, marker="|"))
        self.figure.text(start - 8 / width, second, f"{length:g} m", ha="right", va="center", fontsize=8.5)

    def draw(self, frame: int) -> np.ndarray:
        """Pixels (height, width, 3) of this frame."""
        sample = int(self.frames[frame])
        decimals = 2 if self.time[-1] >= 0.5 else 3
        pace = "" if abs(self.speed - 1) < 0.01 else f"   ({self.speed:.2g}× speed)"
        self.clock.set_text(f"t = {self.time[sample]:.{decimals}f} s{pace}")
        self.canvas.restore_region(self.background)
        for part in self.parts:
            part.update(frame, sample)
        for artist in self.moving:
            self.figure.draw_artist(artist)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()


class _Look(NamedTuple):
    """Colors and line widths (points) of a trajectory; a higher `order` is drawn later."""

    face: str
    edge: str
    trail: tuple[str, float]
    disk_width: float
    link_width: float
    trail_width: float
    order: int


TRUE_LOOK = _Look(TINT, TINT_EDGE, (BLUE, 0.5), 1.0, 4.5, 3.0, order=1)
PREDICTED_LOOK = _Look("none", VERMILLION, (VERMILLION, 0.9), 1.7, 1.5, 1.1, order=4)
ALONE_LOOK = _Look(TINT, BLUE, (BLUE, 0.7), 1.5, 2.0, 2.0, order=1)


class _Bodies:
    """Disks, links and trails of one trajectory."""

    def __init__(self, axes, system, trajectory, lines, camera, past, look: _Look):
        x = _positions(trajectory, 1e3 * float(np.diff(axes.get_xlim())[0]))
        self.centers = x[:, list(system.table.center)] @ camera
        # A point that is not finite takes only its own lines along: 0 * NaN is not 0.
        known = np.nan_to_num(x)
        ends = np.einsum("lsn,tnd->tlsd", lines.weights, known) + lines.offset
        gone = np.einsum("lsn,tn->tls", np.abs(lines.weights), np.isnan(x).any(-1).astype(float))
        self.ends = np.where(gone[..., None] > 0, np.nan, ends) @ camera
        smallest = 0.012 * float(np.diff(axes.get_xlim())[0])
        sizes = 2 * np.maximum(np.asarray(system.radii, float), smallest)
        self.disks = EllipseCollection(
            sizes,
            sizes,
            np.zeros_like(sizes),
            units="x",
            offsets=self.centers[0],
            offset_transform=axes.transData,
            facecolors=look.face,
            # Twice, as a single style would be drawn as a marker: on whole pixels, by jerks.
            edgecolors=[look.edge] * 2,
            linewidths=look.disk_width,
            zorder=look.order + 0.1,
        )
        self.links = LineCollection(
            [], colors=look.edge, linewidths=look.link_width, capstyle="butt", zorder=look.order
        )
        self.past, self.steps = past, max(1, min(30, past))
        color, strongest = look.trail
        fade = np.linspace(0, strongest, self.steps + 1)[1:]
        colors = np.tile([(*to_rgb(color), alpha) for alpha in fade], (len(sizes), 1))
        self.trail = LineCollection(
            [],
            colors=colors,
            linewidths=look.trail_width,
            capstyle="butt",
            zorder=2 + look.order / 10,
        )
        self.artists: list[Artist] = [self.trail, self.links, self.disks]
        for artist in (self.trail, self.links, self.disks):
            axes.add_collection(artist, autolim=False)

    def update(self, frame: int, sample: int) -> None:
        self.disks.set_offsets(self.centers[sample])
        self.links.set_segments(list(self.ends[sample]))
        samples = np.linspace(sample - self.past, sample, self.steps + 1).round()
        points = self.centers[np.maximum(samples.astype(int), 0)].swapaxes(0, 1)
        pieces = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        self.trail.set_segments(list(pieces.reshape(-1, 2, 2)))


class _Contacts:
    """A dot where bodies touch, and a ring that spreads from where they begin to."""

    def __init__(self, axes, system, predicted, camera, frames):
        places, closed = _touching(system, predicted)
        self.places = places @ camera
        edges = np.concatenate([[-1], frames])
        self.shown = [closed[a + 1 : b + 1].any(axis=0) for a, b in pairwise(edges)]
        # Contacts that only flicker, as those of a body at rest may, begin once.
        recent = np.zeros_like(closed)
        for lag in range(1, 6):
            recent[lag:] |= closed[:-lag]
        begins = np.argwhere(closed & ~recent)
        self.begin_frame = np.searchsorted(frames, begins[:, 0])
        self.begin_place = self.places[begins[:, 0], begins[:, 1]]
        self.extent = float(np.diff(axes.get_xlim())[0])
        size = np.array([0.02 * self.extent])
        common: dict[str, Any] = {"units": "x", "offset_transform": axes.transData}
        self.dots = EllipseCollection(
            size, size, [0], facecolors=ORANGE, edgecolors=INK, linewidths=0.6, zorder=6, **common
        )
        self.rings = EllipseCollection(size, size, [0], facecolors="none", linewidths=2.0, zorder=5, **common)
        self.artists: list[Artist] = [self.rings, self.dots]
        axes.add_collection(self.dots, autolim=False)
        axes.add_collection(self.rings, autolim=False)

    def update(self, frame: int, sample: int) -> None:
        self.dots.set_offsets(self.places[sample][self.shown[frame]])
        age = (frame - self.begin_frame) / RING_FRAMES
        fresh = (age >= 0) & (age < 1)
        size = self.extent * (0.03 + 0.09 * np.sqrt(age[fresh]))
        self.rings.set_offsets(self.begin_place[fresh])
        self.rings.set(widths=size, heights=size, angles=np.zeros_like(size))
        self.rings.set_edgecolor([to_rgba(ORANGE, 1 - a) for a in age[fresh]])


class _ErrorPanel:
    """The error over time, drawn as time goes on."""

    def __init__(self, axes: Axes, time: np.ndarray, true: Trajectory, predicted: Trajectory):
        self.time, self.error = time, _relative_error(true, predicted)
        positive = self.error[self.error > 0]
        low, high = (positive.min(), positive.max()) if positive.size else (1e-9, 1e-9)
        high = 10 ** np.ceil(np.log10(np.clip(high, 1e-12, 1e3)))
        low = 10 ** np.floor(np.log10(np.clip(low, high * 1e-8, high / 10)))
        self.drawn = np.clip(self.error, low, high)
        axes.set_yscale("log")
        axes.set(xlim=(time[0], max(time[-1], time[0] + 1e-9)), ylim=(low, high))
        axes.set_xlabel("time (s)", fontsize=8, labelpad=1)
        axes.xaxis.set_major_locator(MaxNLocator(nbins=5))
        axes.yaxis.set_major_locator(LogLocator(numticks=3))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.tick_params(labelsize=7.5)
        axes.plot(time, self.drawn, color="#C9CED6", linewidth=1.2)
        touched = time[np.asarray(predicted.contact, bool)]
        axes.vlines(touched, 0, 0.1, color=ORANGE, transform=axes.get_xaxis_transform(), zorder=1)
        axes.set_title("relative error", fontsize=8.5, pad=4)
        style: dict[str, Any] = {"color": VERMILLION, "clip_on": False, "zorder": 3}
        (self.line,) = axes.plot([], [], linewidth=1.6, **style)
        (self.dot,) = axes.plot([], [], "o", markersize=5, **style)
        self.text = axes.set_title("", fontsize=8.5, pad=4, loc="right")
        self.artists: list[Artist] = [self.line, self.dot, self.text]

    def update(self, frame: int, sample: int) -> None:
        value = self.error[sample]
        self.line.set_data(self.time[: sample + 1], self.drawn[: sample + 1])
        self.dot.set_data(self.time[[sample]], self.drawn[[sample]])
        self.text.set_text("not finite" if np.isnan(value) else power(float(value)))


def _framed(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right of a frame around corners (k, 2), neither very flat nor high."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(high - low, 1e-6)
    size = size + 0.14 * size.max()
    wanted = np.maximum(size, [size[1] / 1.1, size[0] * 0.5])
    middle = (low + high) / 2
    return middle - wanted / 2, middle + wanted / 2


def _round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten up to `most`."""
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(k * decade for k in (1, 2, 5) if k * decade <= most))


def _clip(polygon: np.ndarray, wall: _Wall) -> np.ndarray:
    """The part of a convex polygon (k, 2) in front of a wall (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        gap_a, gap_b = wall.gap(a), wall.gap(b)
        if gap_a >= 0:
            kept.append(a)
        if gap_a * gap_b < 0:
            kept.append(a + (b - a) * gap_a / (gap_a - gap_b))
    return np.reshape(kept, (-1, 2))


def _draw_walls(axes: Axes, walls: list[_Wall]) -> None:
    """Hatch what no body can enter, and draw a line around what is free."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    frame = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    free = frame
    for wall in walls:
        free = _clip(free, wall)
    if not walls or len(free) < 3:
        return
    axes.add_patch(Polygon(frame, facecolor=SOLID, hatch="/////", edgecolor=HATCH, linewidth=0))
    axes.add_patch(Polygon(free, facecolor=PAPER, edgecolor="none"))
    near = 1e-9 * (right - left)
    for a, b in zip(free, np.roll(free, -1, axis=0), strict=True):
        if any(abs(wall.gap(a)) < near and abs(wall.gap(b)) < near for wall in walls):
            axes.plot(*np.array([a, b]).T, color=MUTED, linewidth=1.6, solid_capstyle="projecting")


def _planes(walls: list[_Wall], box: np.ndarray) -> list[np.ndarray]:
    """Squares (4, 3) on the planes that are near."""
    reach, middle = 0.55 * _extent(box), box.mean(axis=0)
    squares = []
    for wall in walls:
        gap = wall.gap(middle)
        if abs(gap) < 3 * reach:
            tangents = np.linalg.svd(wall.normal[None])[2][1:]
            turns = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach
            squares.append(middle - gap * wall.normal + turns @ tangents)
    return squares


def _draw_planes(axes: Axes, squares: list[np.ndarray]) -> None:
    """Each square (4, 2) with a grid on it."""
    for a, b, c, d in squares:
        axes.add_patch(Polygon([a, b, c, d], facecolor=SOLID, edgecolor=MUTED, linewidth=0.8))
        for k in np.linspace(0, 1, 9)[1:-1]:
            for start, end in (((a, b), (d, c)), ((a, d), (b, c))):
                line = [p + k * (q - p) for p, q in (start, end)]
                axes.plot(*np.transpose(line), color=HATCH, linewidth=0.7, zorder=1)


def _draw_triad(axes: Axes, camera: np.ndarray) -> None:
    """The directions of the three axes, in the lower left corner."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    length = 0.07 * (right - left)
    origin = np.array([left, bottom]) + length * np.array([0.8, 0.9])
    for name, direction in zip("xyz", camera, strict=True):
        tip = origin + length * direction
        axes.plot(*np.array([origin, tip]).T, color=MUTED, linewidth=1.2)
        x, y = origin + 1.35 * length * direction
        axes.text(x, y, name, ha="center", va="center", color=MUTED)


# --- files ---------------------------------------------------------------------------------------


def _palette(samples: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Palette (256, 3) for all frames, so that colors do not flicker, and its table (32768,).

    The table maps the upper five bits of red, green and blue to the nearest color; the colors of
    large areas are exact.
    """
    tiled = Image.fromarray(np.concatenate(list(samples), axis=1))
    palette = np.reshape(tiled.quantize(248).getpalette() or [], (-1, 3)).astype(float)
    exact = np.array([to_rgb(c) for c in (PAPER, SOLID, INK, MUTED, TINT, BLUE, VERMILLION, ORANGE)])
    palette = np.concatenate([(exact * 255).round(), palette])
    bins = 8 * np.stack(np.meshgrid(*[np.arange(32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 4
    # Of |b - p|^2 the part that depends on p.
    table = np.argmin(np.sum(palette**2, axis=1) - 2 * bins @ palette.T, axis=1)
    table[_bin(palette[: len(exact)].astype(np.uint8))] = np.arange(len(exact))
    return palette.astype(np.uint8), table.astype(np.uint8)


def _bin(colors: np.ndarray) -> np.ndarray:
    red, green, blue = np.moveaxis(colors.astype(np.int32) >> 3, -1, 0)
    return red << 10 | green << 5 | blue


def _write_gif(path: Path, picture: _Picture, delay: float) -> None:
    count = len(picture.frames)
    spread = np.unique(np.linspace(0, count - 1, min(count, 8)).astype(int)).tolist()
    palette, table = _palette(picture.draw(k) for k in spread)

    def indexed(k: int) -> Image.Image:
        image = Image.fromarray(table[_bin(picture.draw(k))])
        image.putpalette(palette.tobytes())
        return image

    # GIF counts in 10 ms, and viewers slow down what is under 20 ms.
    shown = max(20, round(delay * 100) * 10)
    durations = [shown] * (count - 1) + [shown + round(HOLD * 1000)]
    rest = (indexed(k) for k in range(1, count))
    indexed(0).save(path, save_all=True, append_images=rest, duration=durations, loop=0)


def _write_mp4(path: Path, picture: _Picture, delay: float) -> None:
    count = len(picture.frames)
    options: dict[str, Any] = {"fps": 1 / delay, "quality": 8, "macro_block_size": 2}
    with warnings.catch_warnings():
        # JAX and Python warn of a fork; this one runs ffmpeg at once, which is safe.
        warnings.filterwarnings("ignore", r".*fork\(\)")
        writer: Any = imageio.v2.get_writer(path, format="FFMPEG", **options)  # pyright: ignore
        with writer:
            for k in range(count + round(HOLD / delay)):
                writer.append_data(picture.draw(min(k, count - 1)))
