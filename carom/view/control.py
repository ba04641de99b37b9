"""The figure of an optimal control: how the loss fell, how the system moved before and after, and the forces chosen."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.tasks.control import Control, ControlReport
from carom.view.scene import (
    FAR,
    camera_of,
    draw_planes,
    draw_walls,
    framed,
    lines_of,
    planes_near,
    positions_of,
    view_box,
    walls_of,
)
from carom.view.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    TINT,
    VERMILLION,
    figure_style,
    log_axis,
    new_figure,
    power,
    save_png,
)

_STILL = 1e-6
"""A body that moves less than this (m) has no path to draw."""


def control_figure(control: Control, system: System, report: ControlReport, path: str | os.PathLike[str]) -> Path:
    """Loss and miss by iteration, the motion before and after, and forces over time, if these were chosen.

    Returns the PNG's path.

    **Raises:** `CaromError` for a path that cannot be written.
    """
    force = report.choice.get("force")
    with figure_style():
        figure = new_figure(9.0, 3.8 if force is None else 5.2)
        grid = figure.add_gridspec(2 if force is not None else 1, 2, width_ratios=[1, 1.25])
        _losses(figure.add_subplot(grid[0, 0]), control, report)
        _motion(figure.add_subplot(grid[:, 1]), control, system, report)
        if force is not None:
            _forces(figure.add_subplot(grid[1, 0]), np.asarray(report.before.time), np.asarray(force))
        return save_png(figure, path)


def _losses(axes: Axes, control: Control, report: ControlReport) -> None:
    """Loss by iteration, in decades if it fell by one; a circle on the choice that was kept."""
    losses = np.array(report.losses)
    axes.plot(losses, color=BLUE)
    best = int(np.argmin(losses))
    axes.plot(best, losses[best], "o", color=BLUE, clip_on=False)
    if losses[best] > 0 and losses.max() > 10 * losses[best]:
        log_axis(axes)
    before, after = (f"{miss:.2g}" if miss >= 0.01 else power(miss) for miss in (report.misses[0], report.miss))
    axes.set(xlabel="iteration", ylabel="loss", title=f"miss: {before} {control.unit} before, {after} after")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


def _motion(axes: Axes, control: Control, system: System, report: ControlReport) -> None:
    """Paths of the bodies' centres over the walls, the bodies where they end, and the place that is aimed at."""
    camera, lines, walls = camera_of(system.dim), lines_of(system), walls_of(system)
    box = view_box(system, report.after, report.before, lines.anchors, walls)
    aim = control.target()
    if aim is not None:
        box = np.array([np.minimum(box[0], aim), np.maximum(box[1], aim)])
    squares = [square @ camera for square in planes_near(walls, box)] if system.dim == 3 else []
    corners = np.array(np.meshgrid(*box.T)).reshape(system.dim, -1).T @ camera
    low, high = framed(np.concatenate([corners, *squares]))
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xlabel="x (m)", ylabel="y (m)")
    axes.grid(False)
    if system.dim == 2:
        draw_walls(axes, walls)
    else:
        draw_planes(axes, squares)
    _paths(axes, system, report.before, camera, MUTED, (0, (3, 2)), "none", order=3)
    _paths(axes, system, report.after, camera, BLUE, "-", TINT, order=4)
    handles = [
        Line2D([], [], color=MUTED, linestyle=(0, (3, 2)), label="before"),
        Line2D([], [], color=BLUE, label="after"),
    ]
    if aim is not None:
        place = aim @ camera
        axes.plot(*place, "x", color=INK, markersize=9, markeredgewidth=2, zorder=7)
        handles.append(Line2D([], [], color=INK, marker="x", linestyle="none", label="aim"))
    axes.legend(handles=handles, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)


def _paths(axes: Axes, system: System, motion: Trajectory, camera, color: str, style, face: str, order: int) -> None:
    centers = positions_of(motion, FAR)[:, list(system.table.center)] @ camera
    for path in centers.swapaxes(0, 1):
        if np.ptp(path, axis=0).max() > _STILL:
            axes.plot(*path.T, color=color, linestyle=style, linewidth=1.3, zorder=order)
    sizes = 2 * np.asarray(system.radii, float)
    for places, edge, width in ((centers[0], color, 0.8), (centers[-1], color, 1.6)):
        axes.add_collection(
            EllipseCollection(
                sizes,
                sizes,
                np.zeros_like(sizes),
                units="x",
                offsets=places,
                offset_transform=axes.transData,
                facecolors=face if width > 1 else "none",
                edgecolors=[edge] * 2,
                linewidths=width,
                zorder=order + 0.5,
            ),
            autolim=False,
        )


def _forces(axes: Axes, time: np.ndarray, force: np.ndarray) -> None:
    for k, (name, color) in enumerate(zip("xyz", (BLUE, VERMILLION, GREEN), strict=True)):
        if k < force.shape[1]:
            style = (0, (4, 2)) if k else "-"
            axes.stairs(force[:, k], time, baseline=None, color=color, linestyle=style, label=name, linewidth=1.6)
    axes.set(xlabel="time (s)", ylabel="force (N)", title="force chosen")
    axes.legend(ncols=3, loc="best")
