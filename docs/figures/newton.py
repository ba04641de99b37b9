"""Energy after an impact over that before, by Newton's and by Poisson's hypothesis: docs/contact.md.

    python -m docs.figures.newton [FILE.png]

The tip of a double pendulum hits the ground with friction (T. R. Kane, D. A. Levinson, *Dynamics: Theory and
Applications*, 1985): the impulse turns the links, and Newton's restitution asks for a velocity whatever that takes.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import carom
from carom.tasks.pendulums import chain_state
from carom.view.style import BLUE, INK, MUTED, VERMILLION, figure_style, new_figure, save_png
from docs.figures.command import draw_from_command_line

LENGTH, RADIUS, HEIGHT, RESTITUTION = 1.0, 0.05, 1.5, 0.7
RATES = (0.0, 1.0)
"""Rates of the links (rad/s)."""
ANGLES = np.radians(np.linspace(-59.0, 59.0, 237))
MODELS = {"lcp": ("Newton (lcp)", VERMILLION), "coulomb": ("Poisson (coulomb)", BLUE)}


def states() -> tuple[jax.Array, jax.Array]:
    """The tip on the ground, the first link at each of the angles: positions and velocities (N, 2, 2)."""
    second = -np.arccos(HEIGHT / LENGTH - np.cos(ANGLES))
    angles = np.stack([ANGLES, second], axis=1)
    return chain_state(
        jnp.asarray(angles), jnp.broadcast_to(jnp.array(RATES), angles.shape), jnp.array([LENGTH, LENGTH])
    )


def pendulum(friction: float, model: str) -> carom.System:
    """Two equal masses on rods of 1 m, without gravity, the ground 1.5 m below."""
    return carom.System(
        bodies=[carom.PointMass(mass=1.0, radius=RADIUS)] * 2,
        constraints=[carom.Tether(0, (0.0, 0.0), LENGTH), carom.Distance(0, 1, LENGTH)],
        contacts=[carom.DiskPlane([1], (0.0, -HEIGHT - RADIUS + 1e-7), (0.0, 1.0))],
        potential=carom.Gravity((0.0, 0.0)),
        friction=friction,
        restitution=RESTITUTION,
        contact_model=model,
    )


def share(system: carom.System, x: jax.Array, v: jax.Array) -> np.ndarray:
    """Energy after the impact over that before."""
    after = carom.simulate(system, x, v, dt=1e-6, steps=1, throw=False).v[:, -1]
    energy = jax.vmap(system.kinetic_energy)
    return np.asarray(energy(after) / energy(v))


def draw(path: str | Path) -> Path:
    """Draw the figure; returns the PNG's path."""
    with figure_style():
        figure = new_figure(9.6, 3.2)
        picture, *panels = figure.subplots(1, 3, width_ratios=[1, 1.4, 1.4])
        x, v = states()
        hits = np.asarray(v[:, 1, 1] < 0)
        (shown,) = np.flatnonzero(np.isclose(ANGLES, np.radians(-45.5)))[:1]
        links = np.concatenate([np.zeros((1, 2)), np.asarray(x[shown])])
        picture.plot(*links.T, "-o", color=INK, markersize=6)
        picture.axhline(-HEIGHT - RADIUS, color=MUTED)
        picture.annotate(
            "", links[-1] + 0.3 * np.asarray(v[shown, 1]), links[-1], arrowprops={"arrowstyle": "->", "color": INK}
        )
        picture.set(title="the tip hits the ground", aspect="equal", xlim=(-1.7, 0.4), ylim=(-1.8, 0.3))
        picture.axis("off")
        for axes, friction in zip(panels, (0.0, 0.6), strict=True):
            axes.axhline(1, color=MUTED, linewidth=0.8)
            for model, (label, color) in MODELS.items():
                axes.plot(
                    np.degrees(ANGLES[hits]),
                    share(pendulum(friction, model), x[hits], v[hits]),
                    color=color,
                    label=label,
                )
            axes.set(
                title=f"mu = {friction:g}, e = {RESTITUTION:g}",
                xlabel="angle of the first link (deg)",
                ylabel="energy after / before",
            )
        panels[0].legend(fontsize=7)
        return save_png(figure, path)


if __name__ == "__main__":
    draw_from_command_line(draw, "Draw the energy after impacts by two hypotheses.", "docs/images/newton.png")
