"""Figures of predictions, as PNG files: their errors and energies over time."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float, Real
from matplotlib.axes import Axes

from carom.errors import CaromError
from carom.view.style import (
    DASHES,
    INK,
    PALETTE,
    draw_log_line,
    figure_style,
    new_figure,
    save_png,
    say_empty,
)

NOT_FINITE = 1e300
"""Stands in for infinite values where quantiles are taken."""

LARGEST_ERROR = 1e3
"""A relative error beyond this says no more than this does."""
ROUNDED = 1e-6
"""A first error that is less than this share of the next is rounding: predictions begin with what was seen."""


def trajectory_error(
    time: Real[Array | np.ndarray, " time"],
    errors: Mapping[str, Float[Array | np.ndarray, "..."]],
    path: str | os.PathLike[str],
) -> Path:
    """Relative error over time, median and interquartile band; returns the PNG's path.

    **Arguments:** `time` (T,) in s; `errors`, by the model's name, (N, T): the relative error of N
    trajectories. NaN stands for times at which there is none, and is left out. An infinite error
    counts as larger than all others, and the legend says how many trajectories have one.

    **Raises:** `CaromError` for shapes that do not fit, or a path that cannot be written.
    """
    seconds, curves = _curves(time, errors, "errors")
    with figure_style():
        figure = new_figure(6.4, 4.0)
        axes = figure.subplots()
        drawn = False
        for color, dashes, (name, values) in _styled(curves):
            lower, median, upper = _quartiles(values)
            # On a logarithmic axis an exact start has no place: curves begin at the first error.
            if len(median) > 1 and median[0] < ROUNDED * median[1]:
                median[0] = 0
            shown = median > 0
            lost = int(np.sum(np.isinf(values).any(axis=1)))
            label = f"{name} ({lost} of {len(values)} not finite)" if lost else name
            if not draw_log_line(axes, seconds, median, color=color, linestyle=dashes, label=label):
                axes.plot([], [], color=color, linestyle=dashes, label=label)
                continue
            drawn = True
            if len(values) > 1:
                bottom = np.where(lower > 0, lower, np.nanmin(median[shown]) / 10)
                _band(axes, seconds, bottom, np.minimum(upper, 1e6), color, shown)
        if drawn:
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(low, min(high, LARGEST_ERROR))
            _legend_above(axes)
        else:
            say_empty(axes, "no error above zero")
        spread = any(len(values) > 1 for values in curves.values())
        axes.set(xlabel="time (s)", ylabel=f"relative error{' (median, quartiles)' if spread else ''}")
        return save_png(figure, path)


def energy(
    time: Real[Array | np.ndarray, " time"],
    curves: Mapping[str, Float[Array | np.ndarray, "..."]],
    path: str | os.PathLike[str],
) -> Path:
    """Total energy over time; returns the PNG's path.

    **Arguments:** `time` (T,) in s; `curves`, by name, in J: (T,), or (N, T) for median and
    interquartile band. One called "true" is drawn dashed in black, over the others.

    **Raises:** `CaromError` for shapes that do not fit, or a path that cannot be written.
    """
    seconds, values = _curves(time, curves, "curves")
    with figure_style():
        figure = new_figure(6.4, 3.4)
        axes = figure.subplots()
        drawn = False
        for color, dashes, (name, rows) in _styled(values):
            lower, median, upper = _quartiles(rows)
            finite = np.isfinite(median)
            drawn |= bool(finite.any())
            axes.plot(
                seconds[finite],
                median[finite],
                color=color,
                linestyle=dashes,
                label=name,
                zorder=3 if color == INK else 2,
            )
            if len(rows) > 1:
                _band(axes, seconds, lower, upper, color, finite & np.isfinite(lower + upper))
        if drawn:
            _legend_above(axes)
        else:
            say_empty(axes, "no finite energy")
        axes.set(xlabel="time (s)", ylabel="energy (J)")
        return save_png(figure, path)


def _curves(time, curves, name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """`time` and each curve as (N, T) arrays of floats."""
    seconds = np.asarray(time, dtype=float)
    checked = {}
    for key, values in curves.items():
        array = np.asarray(values, dtype=float)
        if seconds.ndim != 1 or array.ndim not in (1, 2) or array.shape[-1] != seconds.size:
            raise CaromError(
                f"{name}[{key!r}] must have the shape (N, {seconds.size}), a value for each time; "
                f"it was {array.shape}, and time {seconds.shape}."
            )
        checked[key] = np.atleast_2d(array)
    if not checked or any(array.size == 0 for array in checked.values()):
        raise CaromError(f"{name} must hold at least one curve of at least one trajectory.")
    return seconds, checked


def _quartiles(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quartiles over the first axis of what is not NaN.

    Infinite values count as the largest: a median of them is NaN, an upper quartile infinite.
    """
    quartiles = np.full((3, values.shape[1]), np.nan)
    measured = ~np.isnan(values).all(axis=0)
    filled = np.where(np.isinf(values), NOT_FINITE, values)[:, measured]
    quartiles[:, measured] = np.nanquantile(filled, [0.25, 0.5, 0.75], axis=0)
    # Halfway to the stand-in is still far beyond anything that was measured.
    lost = quartiles > NOT_FINITE * 1e-6
    lower, median, upper = np.where(lost, [[np.nan], [np.nan], [np.inf]], quartiles)
    return lower, median, upper


def _styled(curves: Mapping[str, np.ndarray]):
    """Color and dashes of each curve: dashed ink for "true", dotted lines beyond the palette."""
    others = [name for name in curves if name != "true"]
    for item in curves.items():
        if item[0] == "true":
            yield INK, DASHES, item
        else:
            turn, k = divmod(others.index(item[0]), len(PALETTE))
            yield PALETTE[k], ("-", (0, (1, 1.5)), (0, (5, 1.5)))[turn % 3], item


def _band(axes: Axes, x, lower, upper, color, where) -> None:
    axes.fill_between(x, lower, upper, where=where, color=color, alpha=0.16, linewidth=0)


def _legend_above(axes: Axes) -> None:
    """Name the curves above the panel, where they do not run."""
    names = [str(label) for label in axes.get_legend_handles_labels()[1]]
    columns = 2 if max(map(len, names)) > 20 or len(names) == 4 else 3
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.01), ncols=columns, columnspacing=1.6)
