"""What comes out of a training: what the data tell, and pictures of it, for `learn` and `evaluate`."""

import dataclasses
from typing import Any

import jax
import numpy as np
from rich.console import Console

from carom.cli.tables import property_names
from carom.errors import CaromError
from carom.learning.config import FORMULATIONS
from carom.learning.dataset import trajectory_of
from carom.learning.estimation.identify import MOST_POINTS, Identification, identify
from carom.learning.estimation.verdict import Estimate
from carom.learning.evaluate import far_off, state_errors
from carom.learning.run import TRUTH, RunFolder
from carom.learning.training.train import quantities
from carom.learning.unknowns.baselines import BASELINES
from carom.learning.unknowns.quantities import describe
from carom.recordings.recording import Recording
from carom.simulation.rollout import Trajectory
from carom.system import System

TEST_DATA = "test.h5"
"""The run folder's file of test data."""


def what_is_told(
    system: System, recording: Recording, config: dict[str, Any], console: Console
) -> Identification | None:
    """What the recording tells of the properties of a system learned with `config`.

    None for a baseline, which has no properties, for a system that is too large, and where it cannot be found.
    """
    if config["model"] in BASELINES:
        return None
    if system.n_points > MOST_POINTS:
        console.print(f"What the data can tell is found for systems of up to {MOST_POINTS} points.", highlight=False)
        return None
    console.print("Finding what the data can tell ...", highlight=False)
    try:
        return identify(
            system,
            recording,
            learned=config["learn"],
            formulation=FORMULATIONS[config["model"]],
            compensation_steps=config["compensation_steps"],
            project=config["project"],
        )
    except CaromError as error:  # what was learned is to be kept and measured all the same
        console.print(f"It cannot be found: {error}", highlight=False)
        return None


def estimates_and_fit(system: System, found: Identification | None, measures: dict[str, Any]) -> dict[str, Any]:
    """What was found as the estimator reports it: `estimates` by the names of quantities, and the `fit`.

    What was trained on recorded states is not measured in units of their noise (`chi2` is None), but by predictions:
    where these are far off, no quantity is told.
    """
    explained = not far_off(measures)
    fit = {"explained": explained, "chi2": None, "by_channel": {}, "impact_rule": "step"}
    if found is None:
        return {"estimates": [], "fit": fit}
    of = {name: (what, unit) for name, what, _, unit in describe(system)}
    parts = {f"mass:{k}": one for k, one in enumerate(found.mass_ratio, 1)}
    for kind in ("friction", "restitution"):
        parts |= {f"{kind}:{k}": one for k, one in enumerate(getattr(found, kind))}
    estimates = [
        Estimate(
            name,
            of[name][0],
            one.value,
            one.standard_error,
            one.lower,
            one.upper,
            of[name][1],
            one.verdict if explained else "misfit",
            one.impacts,
        )
        for name, one in parts.items()
        if name in of  # a property that no contact has is no quantity
    ]
    return {"estimates": [dataclasses.asdict(one) for one in estimates], "fit": fit}


def warn_if_far_off(console: Console, measures: dict[str, Any]) -> None:
    """Say before all else where predictions do not explain the data (`far_off`)."""
    if far_off(measures):
        say_unexplained(
            console,
            f"predictions are off by {percent(measures['trajectory_error_median'])} in the median and "
            f"{percent(measures['trajectory_error'])} in the mean, above {percent(measures['error_allowed'])}",
        )


def percent(share: float) -> str:
    """A share in words that stay short, whatever became of it."""
    return "not a number" if np.isnan(share) else f"{share:.0%}" if share < 10 else "more than 1000%"


def say_unexplained(console: Console, why: str) -> None:
    """The warning, in its colour."""
    console.print(
        f"The learned system does not explain the data: {why} (docs/identifiability.md).",
        style="bold yellow",
        soft_wrap=True,
        highlight=False,
    )


def pictures(
    run: RunFolder, system: System, test: Recording, predicted: Trajectory, found: Identification | None = None
) -> None:
    """Draw learning curves, contact properties, what data tell (`found`), error over time, and a test trajectory."""
    from carom.view import animate, figures, training_figures  # matplotlib is slow to import

    metrics = run.metrics()
    if metrics:
        training_figures.learning_curves(metrics, run.path / "learning_curves.png")
    if metrics and metrics[-1]["friction"]:
        where, kept = run.path / "contact_properties.png", quantities(system)
        training_figures.contact_properties(metrics, run.read_json(TRUTH), where, kept=kept)
    if found is not None and (found.friction or found.restitution or found.mass_ratio):
        from carom.view.estimates import draw_estimates

        draw_estimates(found, property_names(system), run.path / "estimates.png", truth=run.read_json(TRUTH))
    relative, _ = state_errors(test, predicted)
    figures.trajectory_error(test.time, {"learned": relative}, run.path / "trajectory_error.png")
    k = most_eventful(test)
    shown = trajectory_of(test, k)
    animate.animate(system, shown, one_of(predicted, k, len(shown.time)), run.path / "prediction.gif")


def one_of(batch: Trajectory, k: int, length: int) -> Trajectory:
    """Trajectory number `k` of a batch, up to `length`."""
    return jax.tree.map(lambda a: a[:length] if a is batch.time else a[k, :length], batch)


def most_eventful(test: Recording) -> int:
    """The test trajectory with the most contact, the first of equals."""
    return 0 if test.contact is None else int(np.argmax((test.contact & test.valid).sum(axis=1)))
