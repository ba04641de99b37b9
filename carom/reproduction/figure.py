"""Errors over time of all models on the paper's tasks (figure 3), from `results/figure3.json`."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from carom.reproduction.results import mean_over_seeds
from carom.view.style import PALETTE, figure_style, log_axis, new_figure, save_png

LABELS = {"state": "relative error of the state", "energy": "error of the energy / largest kinetic energy"}
FLOOR = 1e-16
"""Errors below rounding are drawn there."""
LARGEST = 100.0
"""Errors above this, of predictions that are lost, leave the picture."""
DASHED = (0, (4, 1.5))


def draw(content: dict[str, Any], quantity: str, path: Path) -> Path:
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
