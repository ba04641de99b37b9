"""`carom simulate TASK`: make a trajectory file with the true or a learned system."""

import dataclasses
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
from rich.console import Console

from carom.atomic import check_writable
from carom.checks import require
from carom.cli.arguments import CompensationSteps, ContactModelName, FilePath, FolderPath, SystemName
from carom.cli.systems import choose, learned_system
from carom.learning.dataset import recording_of
from carom.learning.run import MODEL
from carom.recordings.files import load_recording, save_recording
from carom.simulation.impact import COMPENSATION_STEPS, ImpactRule
from carom.simulation.rollout import simulate
from carom.tasks import find_task, sample

OF_ROBOTS = 2.0
"""Seconds that a robot file's motion is simulated for by default."""


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Simulate a task, or a system of your own, and write its trajectories to a file."""

    task: SystemName
    """Name of the task, or a Python file that sets `system`; such a one also needs --initial."""
    out: FilePath = None
    """File to write (.h5, .hdf5, .npz or .csv); by default TASK.h5."""
    run_folder: FolderPath = None
    """Use the model learned in this run folder in place of the true system."""
    initial: FilePath = None
    """Start from the first states of the trajectories in this file; by default from the task's own distribution."""
    trajectories: int = 10
    """How many."""
    steps: int | None = None
    """Time steps of each; by default the task's, or of a system of your own those of --initial."""
    dt: float | None = None
    """Time step in seconds; by default the task's, or of a system of your own that of --initial."""
    seed: int = 0
    """Seed of the initial states."""
    project: bool = True
    """Bring each step's end back onto the constraints."""
    impact: ImpactRule | Literal["auto"] = "auto"
    """Contacts act at the end of the step in which they close (step), or at the time at which they close (event); auto:
    as the learned model was learned, or step."""
    contact_model: ContactModelName | None = None
    """Contact model; by default that of the learned model, or cm."""
    compensation_steps: CompensationSteps = "auto"
    """Time steps over which a penetration is undone, or None to leave it; auto: those of the learned model, or 8."""

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "No file was written."

    def run(self) -> None:
        """Do it."""
        chosen = choose(self.task)
        system, formulation, source = chosen.system, "lagrangian", "carom simulate"
        compensation, impact = COMPENSATION_STEPS, "step"
        if self.run_folder is not None:
            system, header = learned_system(self.run_folder, self.task)
            formulation, compensation = header["formulation"], header["compensation_steps"]
            impact = header["impact"]
            source = f"carom simulate, model {self.run_folder / MODEL}"
        if self.contact_model is not None:
            system, source = (
                system.with_contact_model(self.contact_model),
                f"{source}, contact model {self.contact_model}",
            )
        require(self.trajectories >= 1, f"--trajectories must be at least 1; it was {self.trajectories}.")
        out = Path(f"{chosen.stem}.h5") if self.out is None else self.out
        check_writable(out)
        require(
            self.initial is not None or not chosen.own or chosen.start is not None,
            f"initial is needed for {self.task}: give a file to start from its first states, --initial FILE.",
        )
        first = None if self.initial is None else load_recording(self.initial, task=chosen.task)
        start = chosen.start
        if first is None and start is not None:
            x0, v0 = start.x[None], start.v[None]
        elif first is not None:
            x0, v0 = jnp.asarray(first.x[:, 0]), jnp.asarray(first.v[:, 0])
        else:
            x0, v0 = sample(system, jax.random.key(self.seed), self.trajectories)
        if first is not None and chosen.own:
            dt, steps = first.dt, int(first.length.max()) - 1
        elif start is not None:
            dt, steps = start.dt, max(1, round(OF_ROBOTS / (start.dt if self.dt is None else self.dt)))
        else:
            known = find_task(self.task)
            dt, steps = known.dt, known.steps
        trajectory = simulate(
            system,
            x0,
            v0,
            dt=dt if self.dt is None else self.dt,
            steps=steps if self.steps is None else self.steps,
            impact=impact if self.impact == "auto" else self.impact,
            project=self.project,
            formulation=formulation,
            compensation_steps=compensation if self.compensation_steps == "auto" else self.compensation_steps,
        )
        save_recording(out, recording_of(trajectory, task=chosen.task or "", source=source))
        n, states = trajectory.x.shape[:2]
        share = float(trajectory.contact.mean())
        text = f"Wrote {n} trajectories of {states} states to {out}; {share:.0%} of the states follow a contact."
        Console().print(text, soft_wrap=True, highlight=False)
