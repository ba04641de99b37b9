"""`carom learn FILE --data DATA --learn ...` from positions alone: the estimator on the command line."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from carom.atomic import write_whole
from carom.cli.outcome import TEST_DATA, pictures, say_unexplained
from carom.cli.systems import Chosen, copy_of
from carom.errors import CaromError
from carom.learning.estimation.estimate import Told, estimate
from carom.learning.estimation.refine import MOST_POINTS
from carom.learning.estimation.verdict import Estimate, Fit
from carom.learning.meetings import meetings
from carom.learning.model_file import save_model
from carom.learning.progress import LoopProgress
from carom.learning.run import MODEL, REPORT, TRUTH, RunFolder
from carom.learning.unknowns.models import mass_ratios
from carom.learning.unknowns.quantities import describe, matches
from carom.recordings.files import load_recording, save_recording
from carom.recordings.observations import Observations, load_observations
from carom.recordings.recording import Recording
from carom.simulation.rollout import Trajectory
from carom.system import System

BY_ITSELF = ("friction", "restitution", "mass", "gravity")
"""What is learned of positions where nothing is said."""
SHORTEST = 5
"""Windows of fewer samples are not shown."""
TRAINED = {"mass", "friction", "restitution", "potential"}
"""What the trainer can learn of positions and velocities."""


def is_for_estimator(data: Path | None, learn: Sequence[str], default: Sequence[str], chosen: Chosen) -> bool:
    """Whether data are learned from by the estimator.

    That is so for names of other quantities than the trainer's, and where there are no velocities or impacts happen
    between the samples. Else, and if nothing is said, the potential is learned too, which takes the trainer.
    """
    if data is None:
        return False
    if set(learn) - TRAINED or (tuple(learn) != tuple(default) and "potential" not in learn):
        return True
    system = chosen.system
    if tuple(learn) != tuple(default) or (system.links and (not system.contacts or system.n_points > MOST_POINTS)):
        return False
    observed, recording = load_observations(data), recording_in(data)
    if system.links and observed.v is not None and recording is None:
        return False  # states that something is wrong with: what that is, the trainer says
    return observed.v is None or not shows_impacts(observed, recording, system)


def recording_in(path: Path) -> Recording | None:
    """The recording that a file is, with velocities in equal steps, if it is one."""
    try:
        return load_recording(path)
    except CaromError:
        return None


def shows_impacts(observed: Observations, recording: Recording | None, system: System) -> bool:
    """Whether a file is of states at equal steps, with impacts, if there are any, at the samples."""
    return observed.v is not None and recording is not None and not meetings(recording, system).not_seen


def names_to_learn(learn: Sequence[str], default: Sequence[str], chosen: Chosen) -> tuple[str, ...]:
    """What is asked for; by itself, what the system has of `BY_ITSELF`."""
    if tuple(learn) != tuple(default):
        return tuple(learn)
    names = [name for name, *_ in describe(chosen.system)]
    return tuple(kind for kind in BY_ITSELF if any(matches(kind, name) for name in names))


def learn_by_estimator(
    console: Console,
    run: RunFolder,
    chosen: Chosen,
    data: Path,
    test: Path | None,
    learn: Sequence[str],
    seed: int,
) -> None:
    """Estimate, print and write everything."""
    observations = load_observations(data, chosen.system)
    held = None if test is None else load_observations(test, chosen.system)
    told = estimated(console, chosen.system, observations, learn, test=held, seed=seed)
    if chosen.source is not None:
        write_whole(copy_of(run, chosen.name), chosen.source)
    save_model(run.path / MODEL, told.system, impact=told.fit.impact_rule)
    run.write_json(TRUTH, None)
    shown, predicted = shown_motions(told)
    save_recording(run.path / TEST_DATA, shown)
    run.write_json(REPORT, report_of(told))
    print_told(console, told)
    pictures(run, told.system, shown, predicted)
    console.print(f"Done ({told.seconds:.0f} s). Everything is in {run.path}", soft_wrap=True, highlight=False)


def estimated(
    console: Console,
    system: System,
    observations: Observations,
    learn: Sequence[str],
    *,
    test: Observations | None = None,
    seed: int = 0,
) -> Told:
    """What observations tell, with a bar while it is found."""
    with LoopProgress("estimating, %", 100, console=console) as progress:
        progress.say(f"learning {', '.join(learn)} from {observations.n_trajectories} trajectories")
        part = ""

        def say(text: str, share: float) -> None:
            nonlocal part
            progress.update(int(100 * share), text)
            if (now := text.split(":")[0]) != part:
                part = now
                progress.say(text)

        return estimate(system, observations, learn, test=test, seed=seed, say=say)


def print_told(console: Console, told: Told) -> None:
    """How well the data are explained, before all else; the quantities; and which cannot be told apart."""
    verdict_first(console, told.fit)
    console.print(estimates_table(told.estimates))
    for names in told.fit.alike:
        console.print(f"These data do not tell apart: {', '.join(names)}.", highlight=False)


def report_of(told: Told) -> dict[str, Any]:
    """What `report.json` holds."""
    system = told.system
    return {
        "estimates": [dataclasses.asdict(one) for one in told.estimates],
        "fit": dataclasses.asdict(told.fit),
        "evaluation": told.evaluation,
        "learned": {
            "friction": np.asarray(system.friction).tolist(),
            "restitution": np.asarray(system.restitution).tolist(),
            "mass_ratio": mass_ratios(system).tolist(),
            "seconds": told.seconds,
        },
        "identification": None,
    }


def verdict_first(console: Console, fit: Fit) -> None:
    """How well held-out windows are explained, before all else."""
    rule = f"impacts by the rule {fit.impact_rule!r}, {fit.windows} windows that were held out"
    if fit.explained:
        text = f"The learned system explains the data to {np.sqrt(fit.chi2):.3g} of the noise ({rule})."
        console.print(text, style="bold green", soft_wrap=True, highlight=False)
        return
    parts = {
        f"{'before' if when == 'before' else 'after'} impacts, of point {name.removeprefix('x:')}": value
        for name, both in fit.by_channel.items()
        for when, value in both.items()
        if value is not None
    }
    worst = max(parts, key=lambda name: parts[name], default="nowhere")
    why = f"windows are off by {np.sqrt(fit.chi2):.3g} times the noise, mostly {worst}"
    if fit.missed:
        why += f"; {fit.missed:.0%} of them do not fit at all"
    say_unexplained(console, f"{why} ({rule})")


def estimates_table(estimates: Sequence[Estimate]) -> Table:
    """Quantities with their intervals and verdicts."""
    table = Table(title="What the data tell")
    for name in ("quantity", "of", "impacts", "value +- 95 %", "unit", "told"):
        table.add_column(name, justify="right" if name in ("impacts", "value +- 95 %") else "left")
    for one in estimates:
        half = (one.upper - one.lower) / 2
        value = f"{one.value:.{_digits(half)}f} +- {half:.1g}"
        if one.verdict == "bounded below":
            value = f">= {one.lower:.4g}"
        if one.verdict == "bounded above":
            value = f"<= {one.upper:.4g}"
        style = {"identified": None, "misfit": "yellow"}.get(one.verdict, "dim")
        impacts = "" if one.impacts is None else str(one.impacts)
        table.add_row(one.name, one.of, impacts, value, one.unit, one.verdict, style=style)
    return table


def _digits(half: float) -> int:
    return int(np.clip(1 - np.floor(np.log10(half)), 2, 12)) if 0 < half < np.inf else 4


def shown_motions(told: Told) -> tuple[Recording, Trajectory]:
    """Windows that were held out, at equal steps, and their motion by the learned system from the starts that fit.

    Positions are those seen, between samples on straight lines; velocities, but for the first, their differences.
    """
    parts = []
    for window in told.held:
        time = told.step * np.arange(int(np.floor(window.time[-1] / told.step + 1e-6)) + 1)
        if len(time) < SHORTEST:
            continue
        x, explained = (_at_times(time, window.time, part) for part in (window.x, window.explained))
        v, moves = (np.gradient(part, told.step, axis=0, edge_order=2) for part in (x, explained))
        x[0], v[0] = window.start
        parts.append((x, v, explained, moves))
    most = max(len(part[0]) for part in parts)
    x, v, explained, moves = (
        np.stack([np.pad(part[k], ((0, most - len(part[k])), (0, 0), (0, 0)), "edge") for part in parts])
        for k in range(4)
    )
    seen = Recording.of(x, v, dt=told.step, length=np.array([len(part[0]) for part in parts]))
    nothing = np.zeros(x.shape[:2])
    predicted = Trajectory(
        x=jnp.asarray(explained),
        v=jnp.asarray(moves),
        contact=jnp.asarray(nothing > 0),
        time=jnp.asarray(seen.time),
        overflow=jnp.asarray(nothing.astype(int)),
        residual=jnp.asarray(nothing),
    )
    return seen, predicted


def _at_times(
    time: Float[np.ndarray, " S"], there: Float[np.ndarray, " T"], x: Float[np.ndarray, "T n d"]
) -> Float[np.ndarray, "S n d"]:
    columns = x.reshape(len(x), -1).T
    shown = [np.interp(time, there[good], column[good]) for column in columns for good in [np.isfinite(column)]]
    return np.stack(shown, axis=1).reshape(len(time), *x.shape[1:])
