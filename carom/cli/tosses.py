"""Tossed bodies on the command line: learn from recorded poses, and measure by the protocols."""

import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

from carom.atomic import write_whole
from carom.checks import require
from carom.cli.outcome import percent, say_unexplained
from carom.cli.systems import Chosen, chosen_by
from carom.learning.dataset import trajectory_of
from carom.learning.estimation.protocols import (
    Protocol,
    TossErrors,
    body_points,
    box_of,
    moments_of,
    paired_difference,
    pose_errors,
    protocol_starts,
    toss_errors,
)
from carom.learning.estimation.toss_config import TossConfig
from carom.learning.estimation.tosses import COMPENSATION, IMPACT, TossReport, learn_tosses, predict_tosses
from carom.learning.estimation.verdict import Estimate
from carom.learning.evaluate import FAR_OFF
from carom.learning.model_file import load_model_into, save_model
from carom.learning.run import CONFIG, MODEL, REPORT, RunFolder
from carom.recordings.recording import Recording
from carom.system import System

PUBLISHED = {
    "friction:0": 0.18,
    "restitution:0": 0.125,
    "inertia:0": 8.1e-4,
    **{f"center_of_mass:0:{axis}": 0.0 for axis in "xyz"},
}
"""Of the acrylic cube (Pfrommer, Halm, Posa, CoRL 2020), with its mass in the middle."""

WIDTH_95 = 1.96
"""Half of a 95 % interval, in standard errors."""

NOMINAL = 0.1048
"""Width of that cube (m)."""


@dataclasses.dataclass(frozen=True)
class LearnedToss:
    """A tossed body as a run has learned it, with the `substeps` that it was learned, and is predicted, with."""

    name: str
    system: System
    substeps: int

    @classmethod
    def of_run(cls, folder: Path) -> "LearnedToss":
        """That of a run folder.

        **Raises:** `CaromError` if the folder is none of a run that has learned from recorded tosses.
        """
        run = RunFolder.open(folder)
        tosses = run.read_json(CONFIG).get("tosses")
        require(tosses is not None, f"{folder} must be a run that learned from recorded tosses; it is another.")
        return cls(folder.name, load_model_into(run.path / MODEL, chosen_by(run).system), tosses["substeps"])

    def predict(self, recording: Recording):
        """Points of all tosses from their first recorded states."""
        return predict_tosses(self.system, recording, substeps=self.substeps)


def learn_and_measure(
    console: Console,
    run: RunFolder,
    chosen: Chosen,
    train: Recording,
    test: Recording,
    learn: Sequence[str],
    config: TossConfig,
    seed: int,
) -> None:
    """Learn from `train`, measure on `test` by protocol A, and write all that into the run folder."""
    system, report = learn_tosses(chosen.system, train, learn, config, seed=seed, run=run)
    save_model(run.path / MODEL, system, compensation_steps=COMPENSATION, impact=IMPACT)
    console.print(estimate_table(report, chosen.name))
    console.print("Mass is not learned: forces are in proportion to it, so that it drops out of the motion.")
    learned = LearnedToss(run.path.name, system, config.substeps)
    measures = measure(console, run, learned, test, "A", chosen)
    told = {**estimates_and_fit(report, explained=measures.pop("explained")), "evaluation": measures}
    run.write_json(REPORT, {**told, "learned": dataclasses.asdict(report)})
    console.print(f"Done ({report.seconds:.0f} s). Everything is in {run.path}", soft_wrap=True, highlight=False)


def estimates_and_fit(report: TossReport, *, explained: bool) -> dict[str, Any]:
    """What was found as the estimator reports it: `estimates` by the names of quantities, and the `fit`.

    What is fitted is predictions, not errors of recorded numbers (`chi2` is None): where these are far off, or where
    segments of tosses do not tell a quantity, it is not told.
    """
    estimates = []
    for name, one in report.estimates.items():
        error = np.nan if one.standard_error is None else one.standard_error
        verdict = "misfit" if not explained else "identified" if one.told else "not identified"
        half = float(WIDTH_95 * error)
        ends = one.value - half, one.value + half
        estimates.append(Estimate(name, one.of, one.value, float(error), *ends, one.unit, verdict, None))
    fit = {"explained": explained, "chi2": None, "by_channel": {}, "impact_rule": IMPACT}
    return {"estimates": [dataclasses.asdict(one) for one in estimates], "fit": fit}


def nominal_width(chosen: Chosen) -> float:
    """The width that errors are given in: the cube's nominal one, whatever its recordings say."""
    return NOMINAL if chosen.name == "cube" else 2 * float(np.min(box_of(chosen.system).half_widths))


def touching_height(chosen: Chosen) -> float:
    """Height of the box's middle (m) at which a corner can touch: half of its diagonal."""
    half = np.full(3, NOMINAL / 2) if chosen.name == "cube" else np.asarray(box_of(chosen.system).half_widths)
    return float(np.linalg.norm(half))


def estimate_table(report: TossReport, name: str) -> Table:
    """What was learned, with standard errors, and what was published for the cube."""
    table = Table(title=f"Learned from {report.tosses} tosses")
    for column in ("quantity", "learned", "standard error", "published"):
        table.add_column(column, justify="left" if column == "quantity" else "right")
    for quantity, estimate in report.estimates.items():
        known = PUBLISHED.get(quantity) if name == "cube" else None
        table.add_row(
            f"{quantity} ({estimate.unit})" if estimate.unit else quantity,
            f"{estimate.value:.5g}",
            "" if estimate.standard_error is None else f"{estimate.standard_error:.1g}",
            "" if known is None else f"{known:g}",
        )
    return table


def measure(
    console: Console,
    run: RunFolder,
    learned: LearnedToss,
    recording: Recording,
    protocol: Protocol,
    chosen: Chosen,
    baseline: LearnedToss | None = None,
) -> dict[str, Any]:
    """Predict every toss and print, write and draw how far off that is; against a `baseline` too, toss by toss."""
    system, width = learned.system, nominal_width(chosen)
    data = protocol_starts(recording, protocol, touching_height(chosen), moments_of(system))
    predicted = learned.predict(data)
    errors = toss_errors(system, data, predicted, width)
    explained = explains(console, data, errors.position * width / 100)
    out: dict[str, Any] = {"protocol": protocol, "tosses": len(errors.position), **errors.summary()}
    out["explained"] = explained
    shown = {"learned": errors}
    table = Table(title=f"Protocol {protocol}: {len(errors.position)} tosses")
    for column in ("error", "mean", "sd", "median"):
        table.add_column(column, justify="left" if column == "error" else "right")
    units = {"position": "% of the width", "rotation": "degrees", "penetration": "% of the width"}
    for name, unit in units.items():
        row = out[name]
        table.add_row(f"{name} ({unit})", *(f"{row[part]:.2f}" for part in ("mean", "sd", "median")))
    console.print(table)
    if baseline is not None:
        name = baseline.name
        shown[name] = toss_errors(baseline.system, data, baseline.predict(data), width)
        out["difference"] = {}
        for kind in ("position", "rotation"):
            found = paired_difference(getattr(errors, kind), getattr(shown[name], kind), data.group)
            out["difference"][kind] = found
            console.print(
                f"{kind}: {found['mean']:+.2f} [{found['lower']:+.2f}, {found['upper']:+.2f}] {units[kind]} against "
                f"{name} (95 %, bootstrap over {found['sessions']} sessions)",
                highlight=False,
                soft_wrap=True,
            )
    write_errors(run.path / f"toss_errors_{protocol}.csv", data, errors)
    _pictures(run, system, data, predicted, errors, shown)
    return out


def explains(console: Console, data: Recording, distance: Float[np.ndarray, " N"]) -> bool:
    """Whether predictions whose centres are off by `distance` (m) explain the tosses; says so where they do not."""
    way, _ = pose_errors(np.broadcast_to(data.x[:, :1], data.x.shape), data.x, data.length)
    share = float(np.median(distance / np.maximum(way, 1e-300)))
    if not share <= FAR_OFF:
        why = f"predictions are off by {percent(share)} of the way from the start in the median, above {FAR_OFF:.0%}"
        say_unexplained(console, why)
    return share <= FAR_OFF


def write_errors(path: Path, recording: Recording, errors: TossErrors) -> None:
    """One line a toss."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["toss", "session", "samples", "position_percent", "rotation_degrees", "penetration_percent"])
    for k, length in enumerate(recording.length):
        session = "" if recording.group is None else int(recording.group[k])
        numbers = (errors.position[k], errors.rotation[k], errors.penetration[k])
        writer.writerow([k, session, int(length), *(f"{number:.4f}" for number in numbers)])
    write_whole(path, text.getvalue().encode())


def _pictures(run: RunFolder, system, data: Recording, predicted, errors: TossErrors, shown) -> None:
    from carom.view import animate, tosses  # matplotlib is slow to import

    tosses.toss_figure(system, data, predicted, errors, run.path / "tosses.png")
    tosses.error_figure(shown, run.path / "toss_errors.png")
    k = tosses.chosen_tosses(errors)["median"]
    true = trajectory_of(data, k)
    count = len(true.time)
    shown_as = (body_points(system, points) for points in (true.x, jnp.asarray(predicted[k, :count])))
    true, guess = (dataclasses.replace(true, x=points) for points in shown_as)
    animate.animate(system, true, guess, run.path / "prediction.gif")
