"""Pictures of predicted tosses: how high, with what energy, and how far off, as measured and as predicted."""

import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from carom.learning.estimation.protocols import TossErrors, body_points, lowest_corner
from carom.recordings.recording import Recording
from carom.system import System
from carom.view.style import BLUE, DASHES, INK, VERMILLION, figure_style, new_figure, save_png


def chosen_tosses(errors: TossErrors) -> dict[str, int]:
    """A toss that is predicted well, one of median error, and one that is predicted badly, by rotation."""
    order = np.argsort(errors.rotation)
    count = len(order)
    return {
        "good (10 %)": int(order[count // 10]),
        "median": int(order[count // 2]),
        "bad (90 %)": int(order[-1 - count // 10]),
    }


def toss_figure(
    system: System,
    recording: Recording,
    predicted: Float[np.ndarray, "N T 4 3"],
    errors: TossErrors,
    path: str | os.PathLike[str],
) -> Path:
    """Height of the lowest corner and energy, measured and predicted, of three tosses; returns the PNG's path.

    **Arguments:** `predicted`, points from the first recorded states on; energies are those of `system`, velocities of
    predictions are differences of their positions.
    """
    chosen = chosen_tosses(errors)
    with figure_style():
        figure = new_figure(9.0, 4.6)
        grid = figure.subplots(2, len(chosen), sharex="col", sharey="row", squeeze=False)
        for column, (name, k) in enumerate(chosen.items()):
            count = int(recording.length[k])
            time = recording.time[:count]
            curves = {"measured": recording.x[k, :count], "predicted": predicted[k, :count]}
            for (label, x), (color, style) in zip(curves.items(), ((INK, DASHES), (VERMILLION, "-")), strict=True):
                height = 1e3 * lowest_corner(system, x[None])[0]
                grid[0, column].plot(time, height, color=color, linestyle=style, label=label, linewidth=1.3)
                grid[1, column].plot(
                    time[1:-1], 1e3 * _energy(system, x, recording.dt), color=color, linestyle=style, linewidth=1.3
                )
            grid[0, column].set_title(f"{name}: {errors.position[k]:.1f} % of the width, {errors.rotation[k]:.1f}°")
            grid[1, column].set_xlabel("time (s)")
        grid[0, 0].set_ylabel("lowest corner (mm)")
        grid[1, 0].set_ylabel("energy (mJ)")
        grid[0, 0].legend(loc="upper right")
        figure.align_ylabels(grid[:, 0])
        return save_png(figure, path)


def _energy(system: System, x: Float[np.ndarray, "T 4 3"], dt: float) -> Float[np.ndarray, " inner"]:
    """Energy of recorded points at the inner samples, above that at rest on a face."""
    x = np.asarray(body_points(system, jnp.asarray(x)))
    v = (x[2:] - x[:-2]) / (2 * dt)
    energy = np.asarray(jax.vmap(system.energy)(jnp.asarray(x[1:-1]), jnp.asarray(v)))
    return energy - float(energy[-1])


def error_figure(runs: dict[str, TossErrors], path: str | os.PathLike[str]) -> Path:
    """How many tosses have at most which error, by name of the prediction; returns the PNG's path."""
    with figure_style():
        figure = new_figure(7.2, 3.0)
        left, right = figure.subplots(1, 2, sharey=True)
        for color, (name, errors) in zip((BLUE, VERMILLION, INK), runs.items(), strict=False):
            for axes, part in ((left, errors.position), (right, errors.rotation)):
                share = 100 * (np.arange(len(part)) + 1) / len(part)
                axes.step(np.sort(part), share, where="post", color=color, label=name)
                axes.axvline(float(part.mean()), color=color, linestyle=DASHES, linewidth=0.9)
        left.set_xlabel("position error (% of the width)")
        right.set_xlabel("rotation error (degrees)")
        left.set_ylabel("tosses (%)")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
            axes.set_ylim(0, 100)
        right.legend(loc="lower right", title="dashed: means")
        return save_png(figure, path)
