"""Why gradients through impacts need the time of impact: the final height of a ball by its initial height.

    python -m docs.figures.gradients [FILE.png]

The task *bounce once* of Zhong, Han and Brikis (2022): a ball of radius 0.1 m at (-1, 1) m with velocity (2, -2) m/s,
no gravity, elastic, 1 s. A ball that starts higher ends lower: the derivative is -1.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import carom
from carom.simulation.impact import ImpactRule
from carom.view.style import BLUE, INK, VERMILLION, figure_style, new_figure, save_png
from docs.figures.command import draw_from_command_line

RADIUS, SPEED, TIME, STEPS = 0.1, 2.0, 1.0, 20
"""Radius (m), speed downward (m/s), time (s), number of steps: few, so that one can see what each does."""

HEIGHTS = np.linspace(0.75, 1.25, 201)
"""Initial heights (m)."""


def final_heights(impact: ImpactRule) -> tuple[np.ndarray, np.ndarray]:
    """Final heights (m) of all initial heights, and their derivatives."""
    system = carom.System(
        bodies=[carom.PointMass(mass=1.0, radius=RADIUS)],
        contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
        friction=0.0,
        restitution=1.0,
        dim=2,
    )

    def final(height):
        x0, v0 = jnp.array([[-1.0, 0.0]]).at[0, 1].set(height), jnp.array([[2.0, -SPEED]])
        motion = carom.simulate(
            system, x0, v0, dt=TIME / STEPS, steps=STEPS, impact=impact, compensation_steps=None, throw=False
        )
        return motion.x[-1, 0, 1]

    height, slope = jax.jit(jax.vmap(jax.value_and_grad(final)))(jnp.asarray(HEIGHTS))
    return np.asarray(height), np.asarray(slope)


def draw(path: str | Path) -> Path:
    """Draw the figure; returns the PNG's path."""
    with figure_style():
        figure = new_figure(9.0, 3.4)
        left, right = figure.subplots(1, 2, sharex=True)
        exact = SPEED * TIME - HEIGHTS + 2 * RADIUS
        left.plot(HEIGHTS, exact, color=INK, linestyle=(0, (4, 2)), linewidth=1.1, label="exact", zorder=3)
        right.axhline(-1, color=INK, linestyle=(0, (4, 2)), linewidth=1.1, label="exact", zorder=3)
        for impact, color in (("step", VERMILLION), ("event", BLUE)):
            height, slope = final_heights(impact)
            label = f'impact="{impact}"'
            # Where a step more or less is taken, the line is broken.
            jumps = np.flatnonzero(np.abs(np.diff(height)) > 0.02) + 1
            left.plot(np.insert(HEIGHTS, jumps, np.nan), np.insert(height, jumps, np.nan), color=color, label=label)
            right.plot(HEIGHTS, slope, color=color, label=label)
        left.set(xlabel="initial height (m)", ylabel="final height (m)", title="where the ball ends")
        right.set(xlabel="initial height (m)", ylabel="derivative", title="what the gradient says", ylim=(-1.5, 1.5))
        right.legend(loc="center right", bbox_to_anchor=(1.0, 0.6))
        return save_png(figure, path)


if __name__ == "__main__":
    draw_from_command_line(draw, "Draw right and wrong gradients through an impact.", "docs/images/gradients.png")
