"""How the error of a motion with elastic impacts falls with the time step, with the step's rule and with events.

    python -m docs.figures.convergence [FILE.png]

A ball on a linear spring that is anchored on the floor it bounces on goes back on the way it came: `y = h cos(w t)`
between two bounces. Four impacts in 5 s; root mean square over 100 balls dropped from different heights h, as the error
of the step's rule hangs on where in a step an impact falls.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import NullFormatter

import carom
from carom.simulation.impact import ImpactRule
from carom.view.style import BLUE, MUTED, VERMILLION, figure_style, new_figure, save_png
from docs.figures.command import draw_from_command_line

RADIUS, RATE, TIME = 0.1, 2.5, 5.0
"""Radius (m) of the ball, angular frequency of the spring (1/s), and how long it moves (s)."""
HEIGHTS = np.linspace(0.95, 1.05, 100)
"""From which it is dropped (m)."""
STEPS = (60, 85, 120, 170, 240, 340, 480, 680, 960, 1360, 1920)
IMPACTS: tuple[tuple[ImpactRule, int, str], ...] = (("step", 1, VERMILLION), ("event", 4, BLUE))
"""The rules, the orders at which they converge, and their colors."""


def exact() -> tuple[np.ndarray, np.ndarray]:
    """Heights (m) and their rates (m/s) at the end."""
    half = np.arccos(RADIUS / HEIGHTS) / RATE  # from the top to the floor
    phase = RATE * ((TIME + half) % (2 * half) - half)
    return HEIGHTS * np.cos(phase), -RATE * HEIGHTS * np.sin(phase)


def errors(impact: ImpactRule) -> np.ndarray:
    """Of the state at the end (m), for each number of steps."""
    system = carom.System(
        bodies=[carom.PointMass(mass=1.0, radius=RADIUS)],
        contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
        potential=carom.Springs([0], RATE**2 / 2, 0.0, anchor=(0.0, 0.0)),
        friction=0.0,
        restitution=1.0,
    )
    height, rate = exact()
    x0 = jnp.stack([jnp.zeros(len(HEIGHTS)), jnp.asarray(HEIGHTS)], axis=1)[:, None]
    out = []
    for steps in STEPS:
        motion = carom.simulate(
            system,
            x0,
            jnp.zeros_like(x0),
            dt=TIME / steps,
            steps=steps,
            impact=impact,
            compensation_steps=None,
        )
        x, v = motion.x[:, -1, 0, 1], motion.v[:, -1, 0, 1]
        out.append(float(jnp.sqrt(jnp.mean((x - height) ** 2 + ((v - rate) / RATE) ** 2))))
    return np.array(out)


def draw(path: str | Path) -> Path:
    """Draw the figure; returns the PNG's path."""
    dt = TIME / np.array(STEPS)
    with figure_style():
        figure = new_figure(5.4, 3.8)
        axes = figure.subplots()
        for impact, order, color in IMPACTS:
            error = errors(impact)
            axes.loglog(dt, error, "o-", color=color, markersize=4, label=f'impact="{impact}"')
            guide = np.exp(np.mean(np.log(error / dt**order))) * dt**order
            axes.loglog(dt, guide, color=MUTED, linestyle=(0, (2, 2)), linewidth=1.0)
            axes.annotate(f"order {order}", (dt[-3], guide[-3]), (0, -14), textcoords="offset points", color=MUTED)
            found = np.polyfit(np.log(dt), np.log(error), 1)[0]
            print(f"{impact}: order {found:.2f}, error {error[-1]:.1e} at dt = {dt[-1]:.4f} s")
        axes.set(xlabel="time step (s)", ylabel="error after 4 impacts (m)")
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.set_xticks([0.003, 0.01, 0.03, 0.1], ["0.003", "0.01", "0.03", "0.1"])
        axes.legend(loc="lower right")
        return save_png(figure, path)


if __name__ == "__main__":
    draw_from_command_line(draw, "Draw how errors fall with the time step.", "docs/images/convergence.png")
