"""What is held and what slides, by the rule of contact that lasts and by the paper's: docs/contact.md.

    python -m docs.figures.lasting [FILE.png]

A block on a slope of 20 degrees, with friction that holds it (mu = .6) or does not (mu = .2), in steps of 10 ms.
"""

from pathlib import Path

import jax.numpy as jnp
import numpy as np

import carom
from carom.view.style import BLUE, INK, MUTED, VERMILLION, figure_style, new_figure, save_png
from docs.figures.command import draw_from_command_line

SLOPE, DT, STEPS, GRAVITY = np.radians(20.0), 0.01, 100, 9.81
NORMAL, DOWN = np.array([-np.sin(SLOPE), np.cos(SLOPE)]), -np.array([np.cos(SLOPE), np.sin(SLOPE)])
RULES = {"contact that lasts (default)": ("mass", "coulomb", BLUE), "paper's rule, CM": ("paper", "cm", VERMILLION)}


def block(friction: float, rule: str) -> carom.Trajectory:
    """One second of a block that starts at rest."""
    compensation, model, _ = RULES[rule]
    system = carom.System(
        bodies=[carom.PointMass(mass=1.0, radius=0.1)],
        contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=NORMAL)],
        potential=carom.Gravity((0.0, -GRAVITY)),
        friction=friction,
        contact_model=model,
        compensation=compensation,
    )
    return carom.simulate(system, jnp.array([0.1 * NORMAL]), jnp.zeros((1, 2)), dt=DT, steps=STEPS)


def draw(path: str | Path) -> Path:
    """Draw the figure; returns the PNG's path."""
    with figure_style():
        figure = new_figure(9.6, 3.2)
        held, slides, gap = figure.subplots(1, 3)
        for rule, (_, _, color) in RULES.items():
            for axes, friction in ((held, 0.6), (slides, 0.2)):
                motion = block(friction, rule)
                moved = np.asarray(motion.x[:, 0]) - 0.1 * NORMAL
                axes.plot(motion.time, 1e3 * moved @ DOWN, color=color, label=rule)
                if friction == 0.2:
                    gap.plot(motion.time, 1e3 * moved @ NORMAL, color=color)
        time = np.arange(STEPS + 1) * DT
        law = GRAVITY * (np.sin(SLOPE) - 0.2 * np.cos(SLOPE)) * time**2 / 2
        slides.plot(time, 1e3 * law, "--", color=INK, linewidth=0.8, label="closed form")
        gap.axhline(0, color=MUTED, linewidth=0.8)
        held.set(title="held, mu = .6", xlabel="time (s)", ylabel="way down the slope (mm)")
        slides.set(title="slides, mu = .2", xlabel="time (s)", ylabel="way down the slope (mm)")
        gap.set(title="slides, mu = .2", xlabel="time (s)", ylabel="gap (mm)")
        slides.legend(fontsize=7, loc="upper left")
        return save_png(figure, path)


if __name__ == "__main__":
    draw_from_command_line(draw, "Draw what is held and what slides.", "docs/images/lasting_contact.png")
