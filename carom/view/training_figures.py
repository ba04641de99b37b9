"""Figures of a training, as PNG files: losses, and what was learned, over epochs."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, LogFormatterMathtext, LogLocator, MaxNLocator

from carom.errors import CaromError
from carom.view.style import (
    BLUE,
    DASHES,
    GREEN,
    INK,
    MUTED,
    PALETTE,
    VERMILLION,
    draw_line,
    draw_log_line,
    figure_style,
    log_axis,
    new_figure,
    power,
    save_png,
    say_empty,
)

MOST_NAMED = len(PALETTE)
"""More properties than this are drawn in one color."""

SMALLEST_SPAN = 0.1
"""What the axis of a property spans at least: smaller changes are for the panel of errors."""


KEPT: dict[str, Any] = {"marker": "D", "markersize": 5, "markeredgecolor": "white", "markeredgewidth": 0.8}
"""How the values of the system that was kept are marked."""


def learning_curves(metrics: Sequence[Mapping[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Training and validation loss and learning rate over epochs; returns the PNG's path.

    Over Gauss-Newton steps, where a training ended with the refinement before its first epoch.

    **Arguments:** `metrics`, one mapping an epoch with `epoch`, `loss`, `val_loss`,
    `learning_rate`, each of which may be missing, None or NaN. Where an epoch was logged twice,
    after a resume, the later entry counts. Steps before the first epoch have `refinement`, their number.

    **Raises:** `CaromError` for values that are not numbers, or a path that cannot be written.
    """
    epochs, rows, unit = _by_epoch(metrics)
    loss, validation = _series(rows, "loss"), _series(rows, "val_loss")
    rate = _series(rows, "learning_rate")
    with figure_style():
        figure = new_figure(6.4, 4.2)
        bottom = None
        if unit == "epoch":
            top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=[4, 1])
        else:
            top = figure.subplots()
        drawn = draw_log_line(top, epochs, loss, color=BLUE, label="training")
        drawn |= draw_log_line(top, epochs, validation, color=VERMILLION, label="validation")
        lost = np.array([row.get("loss", 0.0) for row in rows], dtype=object)
        broken = epochs[[value is None or not np.isfinite(_number("loss", value)) for value in lost]]
        if broken.size:
            top.plot(
                broken,
                np.full(broken.size, 0.02),
                "x",
                transform=top.get_xaxis_transform(),
                color=INK,
                markersize=4,
                label="loss not finite",
            )
        _mark_best(top, epochs, validation, unit)
        top.set_ylabel("loss")
        if drawn or broken.size:
            top.legend(loc="upper right", ncols=2)
        if not drawn:
            say_empty(top, "no loss was recorded")
        if bottom is not None:
            if draw_line(bottom, epochs, rate, np.isfinite(rate), color=MUTED, linewidth=1.2):
                bottom.set_ylim(bottom=0)
                bottom.yaxis.set_major_locator(MaxNLocator(nbins=2, min_n_ticks=2))
                bottom.ticklabel_format(axis="y", scilimits=(-2, 2), useMathText=True)
            else:
                say_empty(bottom, "no learning rate was recorded")
            bottom.set_ylabel("learning\nrate")
        _epoch_axis(top if bottom is None else bottom, epochs, unit)
        figure.align_ylabels()
        return save_png(figure, path)


class _Quantity(NamedTuple):
    """A row of the figure of contact properties; `learned` (epochs, P), `truth` and `kept` (P,) or None."""

    label: str
    member: str
    color: str
    learned: np.ndarray
    truth: np.ndarray | None
    kept: np.ndarray | None
    relative: bool


def contact_properties(
    metrics: Sequence[Mapping[str, Any]],
    truth: Mapping[str, Any] | None,
    path: str | os.PathLike[str],
    *,
    kept: Mapping[str, Any] | None = None,
) -> Path:
    """Friction, restitution, mass ratios and their errors over epochs; returns the PNG's path.

    **Arguments:** `metrics`, one mapping an epoch with `epoch` and the lists `friction`,
    `restitution` (P,) and `mass_ratio` (bodies,), each of which, and each value in it, may be
    missing, None or NaN; `truth`, the true lists by the same names, or None: then no errors are
    shown; `kept`, the lists of the system that was kept, which need not be the last epoch's.
    Mass ratios are left out where there is one body.

    **Raises:** `CaromError` for values that are not numbers, a truth of another length than what
    was learned, or a path that cannot be written.
    """
    epochs, rows, unit = _by_epoch(metrics)
    quantities = [
        quantity
        for quantity in (
            _quantity(rows, truth, kept, "friction", "friction  μ", "contact", BLUE),
            _quantity(rows, truth, kept, "restitution", "restitution  e", "contact", VERMILLION),
            _quantity(rows, truth, kept, "mass_ratio", "mass ratio  $m_k / m_0$", "body", GREEN),
        )
        if quantity.member == "contact" or quantity.learned.shape[1] > 1
    ]
    columns = 1 if truth is None else 2
    with figure_style():
        figure = new_figure(5.4 if columns == 1 else 9.0, 0.7 + 2.1 * len(quantities))
        grid = figure.subplots(len(quantities), columns, sharex=True, squeeze=False)
        for axes, quantity in zip(grid, quantities, strict=True):
            _values_panel(axes[0], epochs, quantity)
            if truth is not None:
                _error_panel(axes[1], epochs, quantity)
            _name_lines(axes[-1], quantity)
        for axes in grid[-1]:
            _epoch_axis(axes, epochs, unit)
        figure.align_ylabels(grid[:, 0])
        if truth is not None:
            handles = [
                Line2D([], [], color=MUTED, label="learned"),
                Line2D([], [], color=MUTED, linestyle=DASHES, linewidth=1.1, label="true"),
            ]
            if any(q.kept is not None for q in quantities):
                handles.append(Line2D([], [], color=MUTED, linestyle="", **KEPT, label="kept"))
            if any(_is_crowded(q) for q in quantities):
                handles.append(Line2D([], [], color=INK, linewidth=2, label="mean error"))
            figure.legend(handles=handles, loc="outside upper left", ncols=4)
        return save_png(figure, path)


# --- reading the metrics -------------------------------------------------------------------------


def _number(key: str, value: Any) -> float:
    """`value` as a float, None as NaN."""
    try:
        return np.nan if value is None else float(value)
    except (TypeError, ValueError):
        raise CaromError(f"metrics: {key!r} must be a number or None; one was {value!r}.") from None


def _by_epoch(metrics) -> tuple[np.ndarray, list[Mapping[str, Any]], str]:
    """Epochs in order with their entries, the last one of each, and what they are.

    Steps before the first epoch, where there is no other.
    """
    unit, key = "epoch", "epoch"
    if metrics and all("refinement" in row for row in metrics):
        unit, key = "Gauss-Newton step", "refinement"
    rows = {_number(key, row.get(key, k)): row for k, row in enumerate(metrics)}
    epochs = sorted(epoch for epoch in rows if np.isfinite(epoch))
    return np.array(epochs, dtype=float), [rows[epoch] for epoch in epochs], unit


def _series(rows, key: str) -> np.ndarray:
    """(epochs,) values of `key`, NaN where there is none."""
    return np.array([_number(key, row.get(key)) for row in rows], dtype=float)


def _list(key: str, value: Any) -> list[float]:
    if value is None:
        return []
    values = value if isinstance(value, Sequence | np.ndarray | Array) else [value]
    if isinstance(values, str):
        raise CaromError(f"{key!r} must be a list of numbers; it was {values!r}.")
    return [_number(key, v) for v in np.asarray(values, dtype=object).reshape(-1)]


def _quantity(rows, truth, kept, key: str, label: str, member: str, color: str) -> _Quantity:
    lists = [_list(key, row.get(key)) for row in rows]
    found = np.array(_list(key, None if kept is None else kept.get(key)))
    width = max(map(len, lists), default=0)
    learned = np.array([values + [np.nan] * (width - len(values)) for values in lists])
    true = np.array(_list(key, None if truth is None else truth.get(key)))
    if width and true.size not in (0, width):
        raise CaromError(f"truth[{key!r}] must have {width} values, as many as were learned; it had {true.size}.")
    if width and found.size not in (0, width):
        raise CaromError(f"kept[{key!r}] must have {width} values, as many as were learned; it had {found.size}.")
    learned = learned.reshape(len(rows), width)
    true, found = (values if np.isfinite(values).any() else None for values in (true, found))
    return _Quantity(label, member, color, learned, true, found, key == "mass_ratio")


# --- drawing -------------------------------------------------------------------------------------


def _epoch_axis(axes: Axes, epochs: np.ndarray, unit: str) -> None:
    axes.set_xlabel(unit)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=7))
    if epochs.size == 1:
        axes.set_xlim(epochs[0] - 1, epochs[0] + 1)


def _mark_best(axes: Axes, epochs: np.ndarray, validation: np.ndarray, unit: str) -> None:
    good = np.isfinite(validation) & (validation > 0)
    if not good.any():
        return
    best = np.flatnonzero(good)[np.argmin(validation[good])]
    axes.plot(
        epochs[best],
        validation[best],
        "o",
        color=VERMILLION,
        markersize=6,
        markeredgecolor="white",
        markeredgewidth=1.2,
        zorder=4,
        label=f"best: {power(float(validation[best]))}, {unit} {epochs[best]:.0f}",
    )


def _values_panel(axes: Axes, epochs: np.ndarray, quantity: _Quantity) -> None:
    """What was learned as solid lines, the truth as dashed ones."""
    axes.set_ylabel(quantity.label)
    crowded = _is_crowded(quantity)
    drawn = False
    for k, values in enumerate(quantity.learned.T):
        style: dict[str, Any] = {"linewidth": 0.7, "alpha": 0.6} if crowded else {}
        drawn |= draw_line(axes, epochs, values, np.isfinite(values), color=_color(quantity, k), **style)
    if not drawn:
        say_empty(axes, "none was recorded")
        return
    if quantity.truth is not None:
        style = {"alpha": 0.35, "linewidth": 0.7} if crowded else {"alpha": 0.8, "linewidth": 1.1}
        for value in np.unique(quantity.truth[np.isfinite(quantity.truth)]):
            axes.axhline(value, color=INK, linestyle=DASHES, zorder=3, **style)
    if quantity.kept is not None:
        for k, value in enumerate(quantity.kept):
            axes.plot(epochs[-1], value, color=_color(quantity, k), zorder=4, clip_on=False, **KEPT)
    low, high = axes.get_ylim()
    if high - low < SMALLEST_SPAN:
        middle = (low + high) / 2
        axes.set_ylim(middle - SMALLEST_SPAN / 2, middle + SMALLEST_SPAN / 2)


def _error_panel(axes: Axes, epochs: np.ndarray, quantity: _Quantity) -> None:
    """Distance from the truth on a logarithmic axis, whose bottom line stands for exact hits."""
    kind = "relative error" if quantity.relative else "absolute error"
    axes.set_ylabel(kind)
    if quantity.truth is None:
        say_empty(axes, "the truth is not known")
        return
    error = _error(quantity.learned, quantity.truth, relative=quantity.relative)
    known = np.isfinite(error)
    if not known.any():
        say_empty(axes, "none was recorded")
        return
    mean = np.where(known, error, 0).sum(axis=1) / np.where(known.any(axis=1), known.sum(axis=1), np.nan)
    kept = None if quantity.kept is None else _error(quantity.kept[None], quantity.truth, relative=quantity.relative)[0]
    seen = error[known] if kept is None else np.concatenate([error[known], kept[np.isfinite(kept)]])
    positive = seen[seen > 0]
    floor = 10 ** (np.floor(np.log10(positive.min())) - 0.5) if positive.size else 1e-10
    crowded = _is_crowded(quantity)
    for k, values in enumerate(error.T):
        style: dict[str, Any] = {"color": _color(quantity, k + quantity.relative)}
        style |= {"linewidth": 0.7, "alpha": 0.4} if crowded else {"linewidth": 1.2}
        draw_line(axes, epochs, np.maximum(values, floor), np.isfinite(values), clip_on=False, **style)
    if crowded:
        draw_line(axes, epochs, np.maximum(mean, floor), np.isfinite(mean), color=INK, linewidth=2)
    for k, value in enumerate(() if kept is None else kept):
        color = _color(quantity, k + quantity.relative)
        axes.plot(epochs[-1], max(value, floor), color=color, zorder=4, clip_on=False, **KEPT)
    log_axis(axes)
    if (seen == 0).any():
        _show_zero(axes, floor)
    last = mean[np.isfinite(mean)][-1] if kept is None else np.nanmean(kept)
    which = f"{'final' if kept is None else 'kept'}{': mean' if error.shape[1] > 1 else ':'}"
    axes.set_title(f"{which} {power(float(last))}", fontsize=8, color=MUTED, loc="right")


def _error(values: np.ndarray, truth: np.ndarray, *, relative: bool) -> np.ndarray:
    """Distance (rows, values) from the truth, relative for mass ratios."""
    error = np.abs(values - truth)
    # The first mass is the unit: it has no error of its own.
    return error[:, 1:] / np.abs(truth[1:]) if relative else error


def _name_lines(axes: Axes, quantity: _Quantity) -> None:
    """Say beside the row which color is which, where there are a few."""
    count = quantity.learned.shape[1]
    if 1 < count <= MOST_NAMED:
        handles = [Line2D([], [], color=_color(quantity, k), label=f"{quantity.member} {k}") for k in range(count)]
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.03), handlelength=1.2)


def _show_zero(axes: Axes, floor: float) -> None:
    """End the axis at `floor` and call it 0: values that are exact have a place."""
    axes.set_ylim(bottom=floor)
    low, high = axes.get_ylim()
    ticks = [tick for tick in LogLocator(numticks=5).tick_values(low, high) if low * 2 < tick <= high]
    formatter = LogFormatterMathtext()
    formatter.axis = axes.yaxis  # pyright: ignore
    axes.yaxis.set_major_locator(FixedLocator([floor, *ticks]))
    axes.yaxis.set_major_formatter(lambda value, _: "0" if value == floor else formatter(value))


def _color(quantity: _Quantity, k: int) -> str:
    """One color for one or for many values, a color each for a few."""
    count = quantity.learned.shape[1]
    return PALETTE[k] if 1 < count <= MOST_NAMED else quantity.color


def _is_crowded(quantity: _Quantity) -> bool:
    return quantity.learned.shape[1] > MOST_NAMED
