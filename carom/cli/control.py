"""`carom control PROBLEM`: find what makes a system do what is wanted, by gradients through contacts."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import carom
from carom.cli.arguments import FolderPath
from carom.cli.systems import learned_system
from carom.learning.run import REPORT, RunFolder
from carom.tasks import task
from carom.tasks.control import AS_GIVEN, Control, ControlConfig, ControlReport, Physics, optimize, perform
from carom.tasks.problems import find_control

MOST_SHOWN = 4
"""A choice of more numbers than this is not shown in the table."""

ProblemName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PROBLEM")]


@dataclasses.dataclass(frozen=True)
class ControlCommand:
    """Find the initial state, or the forces, that bring a system where it should go, by gradients through contacts.

    PROBLEM is billiards, throw-hit, throw-vertical, bounce-once, ground-wall or two-balls. Writes a folder: what was
    chosen, a figure of the loss and the motion, and an animation before and after.
    """

    problem: ProblemName
    """Name of the problem."""
    run_folder: Annotated[FolderPath, tyro.conf.arg(name="run")] = None
    """Optimise with the model learned in this run folder of `carom learn`; what is chosen is then scored on the true
    system too."""
    out: FolderPath = None
    """Folder to write; by default runs/control-PROBLEM, with a number if that is taken."""
    resume: bool = False
    """Go on in the folder --out from its last checkpoint."""
    config: ControlConfig = dataclasses.field(default_factory=ControlConfig)

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "The last checkpoint is kept: go on with --out FOLDER --resume."

    def run(self) -> None:
        """Do it."""
        control, console = find_control(self.problem), Console()
        self.config.check()
        truth, physics = task(control.task), AS_GIVEN
        system = truth
        if self.run_folder is not None:
            system, header = learned_system(self.run_folder, control.task)
            physics = Physics(header["formulation"], header["compensation_steps"])
        folder = RunFolder.choose(self.out, f"control-{control.name}", resume=self.resume)
        if self.resume:
            run = RunFolder.open(folder)
            run.check_same(self._description())
        else:
            run = RunFolder.create(folder, self._description())
        where = "the true system" if self.run_folder is None else f"the system learned in {self.run_folder}"
        console.print(f"Optimising {control.name} with {where}, into {run.path}", soft_wrap=True, highlight=False)
        try:
            report = optimize(control, system, self.config, physics=physics, run=run)
        finally:
            run.close()
        scored = None if self.run_folder is None else score(control, truth, report, self.config)
        run.write_json(REPORT, as_json(report, scored))
        console.print(result_table(control, report, scored))
        _pictures(run.path, control, system, report)
        console.print(
            f"Done ({report.seconds:.0f} s for {len(report.losses) - 1} iterations). Everything is in {run.path}",
            soft_wrap=True,
            highlight=False,
        )

    def _description(self) -> dict[str, Any]:
        return {
            "problem": self.problem,
            "run": str(self.run_folder) if self.run_folder else None,
            **dataclasses.asdict(self.config),
            "carom_version": carom.__version__,
            "jax_version": jax.__version__,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        }


def score(control: Control, truth, report: ControlReport, config: ControlConfig) -> dict[str, float]:
    """Loss and miss of what was chosen, on the true system."""
    motion = perform(control, truth, report.choice, config)
    return {"loss": float(control.loss(report.choice, motion)), "miss": float(control.miss(motion))}


def as_json(report: ControlReport, scored: dict[str, float] | None) -> dict[str, Any]:
    """What was found, for a file."""
    return {
        "choice": {name: np.asarray(value).tolist() for name, value in report.choice.items()},
        "loss": report.loss,
        "miss": report.miss,
        "on_true_system": scored,
        "losses": report.losses,
        "misses": report.misses,
        "seconds": report.seconds,
    }


def result_table(control: Control, report: ControlReport, scored: dict[str, float] | None) -> Table:
    """What was chosen, and what that does, before and after."""
    table = Table(title=control.name)
    table.add_column("")
    for name in ("before", "after", *(["on the true system"] if scored else [])):
        table.add_column(name, justify="right")
    for name, first in control.start().items():
        found = np.asarray(report.choice[name])
        if found.size > MOST_SHOWN:
            table.add_row(name, "", f"{' x '.join(map(str, found.shape))} values")
        else:
            table.add_row(name, *(", ".join(f"{v:.5g}" for v in np.ravel(part)) for part in (first, found)))
    for name, unit in (("loss", ""), ("miss", f" ({control.unit})")):
        first, found = getattr(report, f"{name}es")[0], getattr(report, name)
        table.add_row(name + unit, f"{first:.6g}", f"{found:.6g}", *([f"{scored[name]:.6g}"] if scored else []))
    return table


def _pictures(folder: Path, control: Control, system, report: ControlReport) -> None:
    """The figure and the animation."""
    from carom.view import animate  # matplotlib is slow to import
    from carom.view.control import control_figure

    control_figure(control, system, report, folder / "control.png")
    path, names = folder / "before_after.gif", ("before", "after")
    animate.animate(system, report.before, report.after, path, names=names, show_error=False)
