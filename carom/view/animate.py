"""Animations of a trajectory, true against predicted, as GIF or MP4.

The background is drawn once; each frame redraws only what moves. A system in 3D is seen from one
direction without perspective, so that spheres are disks of their own radius and everything is drawn
as in 2D.
"""

import os
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import imageio.v2
import jax
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator
from PIL import Image

from carom.checks import require
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.view.extras import check_movies
from carom.view.scene import (
    ALONE_LOOK,
    PREDICTED_LOOK,
    TRUE_LOOK,
    Bodies,
    Contacts,
    camera_of,
    draw_planes,
    draw_triad,
    draw_walls,
    framed,
    lines_of,
    planes_near,
    view_box,
    walls_of,
)
from carom.view.style import (
    BLUE,
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
    names: tuple[str, str] = ("true", "predicted"),
    show_error: bool = True,
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
    - `names`: what `true` and `predicted` are called in the picture, if they are something else.
    - `show_error`: whether to show how far `predicted` is from `true`.

    **Raises:** `CaromError` for trajectories that do not fit the system, arguments
    out of range, or a path that cannot be written.
    """
    path = checked_path(path, (".gif", ".mp4"))
    movie = path.suffix.lower() == ".mp4"
    if movie:
        check_movies("path")
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
        past, size = round(share * time.size), width // 2 * 2
        picture = _Picture(system, true, predicted, frames, speed, past, size, names, show_error)
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


# --- drawing -------------------------------------------------------------------------------------


class _Picture:
    """The figure and all that moves in it; `draw(k)` gives the pixels of frame k."""

    def __init__(self, system, true, predicted, frames, speed, past, width, names, show_error):
        self.frames, self.speed, self.time = frames, speed, np.asarray(predicted.time, float)
        camera, lines, walls = camera_of(system.dim), lines_of(system), walls_of(system)
        box = view_box(system, true, predicted, lines.anchors, walls)
        squares = [square @ camera for square in planes_near(walls, box)] if system.dim == 3 else []
        corners = np.array(np.meshgrid(*box.T)).reshape(system.dim, -1).T @ camera
        low, high = framed(np.concatenate([corners, *squares]))
        inner = width - 2 * MARGIN
        scale = inner / (high[0] - low[0])
        scene = round(scale * (high[1] - low[1]))
        panel = PANEL if true is not None and show_error else 0
        height = (HEADER + scene + MARGIN + panel + 1) // 2 * 2
        self.figure = new_figure(width / DPI, height / DPI, dpi=DPI, constrained=False)
        axes = self.figure.add_axes((MARGIN / width, (panel + MARGIN) / height, inner / width, scene / height))
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        axes.set_axis_off()
        if system.dim == 2:
            draw_walls(axes, walls)
        else:
            draw_planes(axes, squares)
            draw_triad(axes, camera)
        anchors = lines.anchors @ camera
        (self.pivots,) = axes.plot(*anchors.T, "o", color=INK, markersize=5, zorder=5)

        self.parts: list[Bodies | Contacts | _ErrorPanel] = []
        if true is None:
            self.parts.append(Bodies(axes, system, predicted, lines, camera, past, ALONE_LOOK))
        else:
            self.parts.append(Bodies(axes, system, true, lines, camera, past, TRUE_LOOK))
            self.parts.append(Bodies(axes, system, predicted, lines, camera, past, PREDICTED_LOOK))
        self.parts.append(Contacts(axes, system, predicted, camera, frames))
        self._header(system.name, scale, height, width, names, known=true is not None)
        if true is not None and show_error:
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

    def _header(self, name: str, scale: float, height: int, width: int, names, *, known: bool) -> None:
        """Name, time, legend and scale."""
        left, right = MARGIN / width, 1 - MARGIN / width
        top, second = 1 - 18 / height, 1 - 42 / height
        style = {"va": "center_baseline", "fontsize": 10}
        self.figure.text(left, top, name, weight="bold", **style)
        self.clock = self.figure.text(right, top, "", ha="right", **style)
        disk = {"marker": "o", "linestyle": "none", "markersize": 8}
        handles = []
        if known:
            handles.append(Line2D([], [], mfc=TINT, mec=TINT_EDGE, label=names[0], **disk))
        face, edge = ("none", VERMILLION) if known else (TINT, BLUE)
        handles.append(Line2D([], [], mfc=face, mec=edge, mew=1.5, label=names[1], **disk))
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


def _relative_error(true: Trajectory, predicted: Trajectory) -> np.ndarray:
    """`|z - z^| / |z|` (time,), NaN where the prediction is not finite."""
    z, guess = (
        np.concatenate([np.asarray(t.x, float), np.asarray(t.v, float)], axis=1).reshape(len(t.x), -1)
        for t in (true, predicted)
    )
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.linalg.norm(z - guess, axis=1) / np.maximum(np.linalg.norm(z, axis=1), 1e-12)
    return np.where(np.isfinite(error), error, np.nan)


def _round_length(most: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten up to `most`."""
    decade = 10.0 ** np.floor(np.log10(most))
    return float(max(k * decade for k in (1, 2, 5) if k * decade <= most))


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
