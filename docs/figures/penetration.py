"""Penetration compensation over 1 or 4 time steps or not at all: the figure S.2 of the paper.

    python -m docs.figures.penetration [FILE.png]

A point mass falls to the ground with e = 0. Contact acts at the end of the step in which the ground was reached, when
the mass is already 2 cm inside it.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle

import carom
from carom.view.style import BLUE, HATCH, INK, MUTED, TINT, TINT_EDGE, figure_style, new_figure, save_png
from docs.figures.command import draw_from_command_line

ROWS = {
    1.0: "N = 1, undone in one time step: it bounces",
    4.0: "N = 4, undone in four: it comes up and stays",
    None: "none: it stays inside and sinks",
}
"""Compensation steps of the rows, and what they show."""

RADIUS, HEIGHT, SPEED, DT, STEPS = 0.1, 0.093, 2.0, 0.01, 22
"""Radius and height over the ground at the start (m), speed of the fall there (m/s), time step (s), number of steps."""


def drop(compensation_steps: float | None) -> carom.Trajectory:
    """The fall onto the ground y = 0, with gravity and without restitution."""
    system = carom.System(
        bodies=[carom.PointMass(mass=1.0, radius=RADIUS)],
        contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
        potential=carom.Gravity((0.0, -9.81)),
        restitution=0.0,
        contact_model="cm",
        compensation="paper",
    )
    x0 = jnp.array([[0.0, RADIUS + HEIGHT]])
    return carom.simulate(
        system, x0, jnp.array([[0.0, -SPEED]]), dt=DT, steps=STEPS, compensation_steps=compensation_steps
    )


def gaps(trajectory: carom.Trajectory) -> np.ndarray:
    """Height (m) of the mass's lowest point over the ground, at each time; negative inside it."""
    return np.asarray(trajectory.x[:, 0, 1]) - RADIUS


def draw(path: str | Path) -> Path:
    """Draw the figure; returns the PNG's path."""
    with figure_style():
        figure = new_figure(9.6, 4.4)
        grid = figure.subplots(len(ROWS), 2, width_ratios=[3.4, 1], sharex="col")
        for (strip, curve), (steps, title) in zip(grid, ROWS.items(), strict=True):
            trajectory = drop(steps)
            _strip(strip, trajectory, title)
            curve.axhline(0, color=INK, linewidth=0.8)
            curve.plot(trajectory.time, 1e3 * gaps(trajectory), "o-", color=BLUE, markersize=2.5, linewidth=1.2)
            curve.set(ylabel="gap (mm)", ylim=(-45, 225))
        grid[-1, 0].set_xlabel("time step (dark: the contact is closed)")
        grid[-1, 1].set_xlabel("time (s)")
        figure.align_ylabels(grid[:, 1])
        return save_png(figure, path)


def _strip(axes: Axes, trajectory: carom.Trajectory, title: str) -> None:
    """The mass at each time step, side by side."""
    apart = 2.2 * RADIUS
    axes.axhspan(-0.08, 0, facecolor="white", edgecolor=HATCH, hatch="////", linewidth=0)
    axes.axhline(0, color=INK, linewidth=1)
    for k, (y, touches) in enumerate(zip(trajectory.x[:, 0, 1], trajectory.contact, strict=True)):
        face, edge = (TINT, TINT_EDGE) if not touches else (TINT_EDGE, BLUE)
        axes.add_patch(Circle((apart * k, float(y)), RADIUS, facecolor=face, edgecolor=edge, linewidth=0.9))
        axes.plot(apart * k, float(y), ".", color=INK, markersize=2)
    axes.set_title(title)
    axes.set(xlim=(-1.2 * RADIUS, apart * STEPS + 1.2 * RADIUS), ylim=(-0.08, 0.42), aspect="equal", yticks=[])
    ticks = range(0, STEPS + 1, 2)
    axes.set_xticks([apart * k for k in ticks], [str(k) for k in ticks])
    axes.spines[["left", "bottom"]].set_visible(False)
    axes.tick_params(length=0, labelcolor=MUTED)
    axes.grid(False)


if __name__ == "__main__":
    draw_from_command_line(draw, "Draw the effect of penetration compensation.", "docs/images/penetration.png")
