"""A sweep as a picture: what was to be small, against each option that was varied."""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from carom.checks import require
from carom.view.style import BLUE, TINT_EDGE, VERMILLION, figure_style, log_axis, new_figure, save_png


def draw_sweep(
    options: Mapping[str, Sequence[Any]], values: Sequence[float], path: Path, *, label: str, log: Collection[str] = ()
) -> Path:
    """A panel an option, a point a trial, the best one marked; returns the PNG's path.

    **Arguments:** `options`, by name what each trial had; `values`, what shall be small, by trial, drawn where finite;
    `label`, its name; `log`, the options with a logarithmic axis. Options that are no numbers are named on the axis.

    **Raises:** `CaromError` without trials, or for a path that cannot be written.
    """
    require(len(values) > 0, "values must hold a number for each trial; there was none.")
    height = np.array(values, float)
    best = int(np.argmin(np.where(np.isfinite(height), height, np.inf)))
    with figure_style():
        figure = new_figure(0.6 + 2.5 * len(options), 2.6)
        panels = figure.subplots(1, len(options), sharey=True, squeeze=False)[0]
        for axes, (name, chosen) in zip(panels, options.items(), strict=True):
            scaled = _are_numbers(chosen) and (name in log or len(set(chosen)) > 4)
            place = np.array(chosen, float) if scaled else _side_by_side(axes, chosen)
            if scaled and name in log:
                _logarithmic(axes, place)
            axes.plot(place, height, "o", color=BLUE, markeredgecolor=TINT_EDGE, ms=4.5, alpha=0.75)
            axes.plot(place[best], height[best], "o", color=VERMILLION, ms=7, label="best")
            axes.margins(x=0.08, y=0.1)
            axes.set_xlabel(name.replace("_", " "))
        finite = height[np.isfinite(height)]
        if len(finite) and finite.max() > 3 * finite.min() > 0:
            log_axis(panels[0])
        panels[0].set_ylabel(label.replace("_", " "))
        panels[-1].legend(loc="best")
        return save_png(figure, path)


def _are_numbers(chosen: Sequence[Any]) -> bool:
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in chosen)


def _logarithmic(axes: Any, place: np.ndarray) -> None:
    """A logarithmic axis that says where values begin, end, and have their middle."""
    axes.set_xscale("log")
    marks = np.geomspace(place.min(), place.max(), 3)
    axes.set_xticks(marks, [f"{mark:.1e}" for mark in marks])
    axes.set_xticks([], minor=True)


def _side_by_side(axes: Any, chosen: Sequence[Any]) -> np.ndarray:
    """A place for each value that there is, numbers in their order, with its name below."""
    kinds = sorted(set(chosen)) if _are_numbers(chosen) else sorted(set(chosen), key=str)
    axes.set_xticks(range(len(kinds)), [str(kind) for kind in kinds])
    axes.set_xlim(-0.6, len(kinds) - 0.4)
    return np.array([kinds.index(value) for value in chosen], float)
