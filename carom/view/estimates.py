"""What data tell of contact properties and masses, as a picture: estimates with their 95 % intervals, and bounds."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from carom.checks import require
from carom.learning.estimation.identify import Estimate, Identification
from carom.view.style import BLUE, GREEN, INK, MUTED, VERMILLION, figure_style, new_figure, save_png

QUANTITIES = {
    "friction": ("friction  μ", BLUE),
    "restitution": ("restitution  e", VERMILLION),
    "mass_ratio": ("mass ratio  $m_k / m_0$", GREEN),
}


def draw_estimates(
    found: Identification,
    names: Sequence[str],
    path: str | os.PathLike[str],
    *,
    truth: Mapping[str, Any] | None = None,
) -> Path:
    """Each friction, restitution and mass ratio with its 95 % interval; returns the PNG's path.

    What is identified is filled; a bound is an arrow from it to where the value may be; what the data do not tell is
    grey, with its interval as far as the axis goes.

    **Arguments:** `found`, of `identify`; `names` of the contact properties (P,); `path` of the PNG; `truth`, true
    values as in `truth.json`: `friction`, `restitution` (P,), `mass_ratio` (bodies,), drawn as short upright lines.

    **Raises:** `CaromError` if there is no estimate, or the path cannot be written.
    """
    parts = {name: getattr(found, name) for name in QUANTITIES if getattr(found, name)}
    require(len(parts) > 0, "found has no estimate: nothing was taken as unknown.")
    most = max(len(estimates) for estimates in parts.values())
    with figure_style():
        figure = new_figure(2.9 * len(parts) + 0.6, 1.1 + 0.24 * most)
        panels = figure.subplots(1, len(parts), squeeze=False)[0]
        for axes, (name, estimates) in zip(panels, parts.items(), strict=True):
            label, color = QUANTITIES[name]
            first = 1 if name == "mass_ratio" else 0
            true = None if truth is None or truth.get(name) is None else list(truth[name])[first:]
            labels = [f"{k} to 0" for k in range(1, len(estimates) + 1)] if first else list(names)
            _panel(axes, estimates, labels, true, color)
            axes.set_xlabel(label)
        handles = [
            Line2D([], [], color=MUTED, marker="o", ms=4, label="identified, 95 %"),
            Line2D([], [], color=MUTED, marker=">", ms=4, label="bound"),
            Line2D([], [], color=MUTED, marker="o", ms=4, mfc="none", alpha=0.6, label="not told"),
        ]
        if truth is not None:
            handles.append(Line2D([], [], color=INK, marker="|", linestyle="none", ms=10, mew=1.2, label="true"))
        figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
        return save_png(figure, path)


def _panel(axes: Axes, estimates: Sequence[Estimate], labels: Sequence[str], true: list | None, color: str) -> None:
    """One quantity: a line for each estimate, the first at the top."""
    low, high = _limits(estimates, true)
    for k, estimate in enumerate(estimates):
        y = len(estimates) - 1 - k
        lower, upper = np.clip([estimate.lower, min(estimate.upper, 1e300)], low, high)
        told = estimate.verdict == "identified"
        if estimate.bound is not None and not told:
            end = high if estimate.verdict == "bounded below" else low
            axes.plot([estimate.bound, end], [y, y], color=color, lw=1.4)
            axes.plot([end], [y], ">" if end == high else "<", color=color, ms=5, clip_on=False)
            axes.plot([estimate.bound], [y], "|", color=color, ms=8)
        else:
            shade = color if told else MUTED
            axes.plot([lower, upper], [y, y], color=shade, lw=2.2 if told else 1.2, alpha=1 if told else 0.6)
            axes.plot([np.clip(estimate.value, low, high)], [y], "o", color=shade, ms=5, mfc=shade if told else "none")
        if true is not None:
            axes.plot([true[k]], [y], "|", color=INK, ms=13, mew=1.2)
    axes.set_xlim(low, high)
    axes.set_ylim(-0.7, len(estimates) - 0.3)
    axes.set_yticks(range(len(estimates)), list(labels)[::-1])
    axes.grid(axis="y", visible=False)


def _limits(estimates: Sequence[Estimate], true: list | None) -> tuple[float, float]:
    """An axis that holds what is identified, bounds and the truth with some room; other intervals may leave it."""
    told = [estimate for estimate in estimates if estimate.verdict == "identified"]
    numbers = [edge for estimate in told for edge in (estimate.lower, estimate.upper)]
    numbers += [estimate.value for estimate in estimates] + list(true or [])
    numbers += [estimate.bound for estimate in estimates if estimate.bound is not None]
    numbers = [float(number) for number in numbers if np.isfinite(number)]
    low, high = min(0.0, *numbers), max(numbers)
    room = 0.08 * max(high - low, 1e-3)
    return low - room, high + room
