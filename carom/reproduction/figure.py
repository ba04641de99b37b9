"""Pictures of the tables: errors over time of all models (figure 3), and errors of contact properties."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from carom.reproduction.results import QUANTITIES, is_told, mean_over_seeds, quantity_of, task_of
from carom.view.style import PALETTE, PAPER, figure_style, log_axis, new_figure, save_png

LABELS = {"state": "relative error of the state", "energy": "error of the energy / largest kinetic energy"}
FLOOR = 1e-16
"""Errors below rounding, and none, are drawn there."""
LARGEST = 100.0
"""Errors above this, of predictions that are lost, leave the picture."""
NAMES = {"mu": "friction", "e": "restitution"}
DASHED = (0, (4, 1.5))


def draw_over_time(content: dict[str, Any], quantity: str, path: Path) -> Path:
    """A panel a task: mean over test trajectories and 95 % interval by model, over time; returns the PNG's path."""
    curves = content["over_time"]
    tasks = list(dict.fromkeys(curve["column"] for curve in curves))
    models = list(dict.fromkeys(curve["row"] for curve in curves))
    columns = min(4, len(tasks))
    rows = math.ceil(len(tasks) / columns)
    with figure_style():
        figure = new_figure(2.6 * columns, 2.1 * rows + 0.6)
        panels = figure.subplots(rows, columns, squeeze=False).flatten()
        for axes in panels[len(tasks) :]:
            axes.set_visible(False)
        for axes, task in zip(panels, tasks, strict=False):
            axes.set_title(task)
            log_axis(axes)
            for curve in (c for c in curves if c["column"] == task):
                k = models.index(curve["row"])
                found = mean_over_seeds(curve, quantity)
                mean, half = found["mean"][1:], found["ci95"][1:]
                time = curve["dt"] * np.arange(1, len(mean) + 1)
                lost = ~np.isfinite(mean)
                mean = np.where(lost, np.nan, np.maximum(mean, FLOOR))
                # Lagrangian and Hamiltonian often agree: both are to be seen where one lies on the other.
                dashed = k >= len(PALETTE) or "CHNN" in curve["row"]
                color, dashes = PALETTE[k % len(PALETTE)], DASHED if dashed else "-"
                axes.plot(time, mean, color=color, linestyle=dashes, label=curve["row"], lw=1.3)
                half = np.where(np.isfinite(half), half, 0)
                axes.fill_between(time, np.maximum(mean - half, mean / 10), mean + half, color=color, alpha=0.15, lw=0)
        for axes in panels:
            axes.set_ylim(top=min(axes.get_ylim()[1], LARGEST))
        for axes in panels[len(tasks) - columns : len(tasks)]:
            axes.set_xlabel("time (s)")
        figure.supylabel(LABELS[quantity], fontsize=9)
        handles = {h.get_label(): h for axes in panels for h in axes.get_lines()}
        figure.legend([handles[name] for name in models], models, loc="outside upper center", ncols=min(4, len(models)))
        return save_png(figure, path)


def draw_properties(content: dict[str, Any], path: Path) -> Path:
    """Errors of friction and restitution by task and model, a dot a property; returns the PNG's path.

    Hollow dots: properties that the data do not tell of.
    """
    cells = [cell for cell in content["cells"] if cell["error"] is not None]
    tasks = list(dict.fromkeys(map(task_of, cells)))
    models = list(dict.fromkeys(cell["row"] for cell in cells))
    with figure_style():
        figure = new_figure(9.0, 3.4)
        panels = figure.subplots(1, 2, sharey=True)
        for axes, quantity in zip(panels, QUANTITIES, strict=True):
            axes.set_title(f"error of {NAMES[quantity]}")
            log_axis(axes)
            for k, model in enumerate(models):
                mine = [cell for cell in cells if cell["row"] == model and quantity_of(cell) == quantity]
                place = np.array([tasks.index(task_of(cell)) for cell in mine]) + 0.18 * (k - (len(models) - 1) / 2)
                error = np.maximum([cell["error"] for cell in mine], FLOOR)
                fill = [PALETTE[k] if is_told(cell) else PAPER for cell in mine]
                axes.scatter(place, error, s=14, c=fill, edgecolors=PALETTE[k], linewidths=1.0)
            axes.set_xticks(range(len(tasks)), tasks)
            axes.grid(visible=False, axis="x")
            axes.set_ylim(FLOOR / 3, 1.0)
        handles = [
            Line2D([], [], linestyle="", marker="o", markersize=4, color=PALETTE[k], label=model)
            for k, model in enumerate(models)
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=len(models))
        return save_png(figure, path)
