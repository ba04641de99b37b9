"""`carom check DATA`: what recorded data show of a system, and what they can tell, before anything is learned."""

import dataclasses
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from carom.cli.estimation import estimated, names_to_learn, print_told, recording_in, shows_impacts
from carom.cli.systems import Chosen, observed_and_system
from carom.cli.tables import findings_table, quantities_table, told_table
from carom.errors import CaromError
from carom.learning.estimation.identify import MOST_POINTS, identify
from carom.learning.estimation.inspection import inspect_observations, inspect_recording
from carom.recordings.observation_checks import check_observations
from carom.recordings.observations import Observations
from carom.recordings.recording import Recording
from carom.recordings.recording_checks import Finding, check_recording
from carom.system import System

ENOUGH = 40
"""Trajectories of which what they tell is found within a minute."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Say what recorded data show of a system, and what they can tell, before anything is learned.

    Units, time step, velocities, noise, rods and joints, contacts, chunks to learn from; then the standard error that
    friction, restitution and mass ratios would have. What looks wrong has an advice. Files without velocities, with
    missing samples or uneven times are looked at as they are: impacts are then seen in how the motion bends.
    """

    data: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")]
    """Trajectory file (.h5, .hdf5, .npz or .csv), or pose file."""
    task: str = ""
    """Name of the task, or a Python file that sets `system`; by default the task that the file names, if any."""
    no_tell: bool = False
    """Leave out what the data can tell, which takes most of the time."""
    quantities: bool = False
    """List everything that can be learned of the system, by the names that it is chosen by."""
    learn: tuple[str, ...] = ()
    """Of which quantities to say what the data can tell; by default those that `carom learn` learns by itself."""

    def run(self) -> None:
        """Do it."""
        console = Console()
        observed, chosen, word = observed_and_system(self.data, self.task)
        recording = recording_in(self.data)
        findings = _findings(observed, recording, None if chosen is None else chosen.system)
        ends = np.nanmax(observed.time, axis=1) - observed.time[:, 0]
        step = float(np.nanmedian(np.diff(observed.time, axis=1)))
        title = (
            f"{self.data.name}: {observed.n_trajectories} trajectories of up to {ends.max():.3g} s, a sample every "
            f"{step:.4g} s, {observed.n_points} points in {observed.dim}D"
        )
        console.print(findings_table(title, findings))
        if word:
            console.print(word, soft_wrap=True, highlight=False)
        if self.quantities and chosen is not None:
            console.print(quantities_table(chosen.system))
        if chosen is None:
            console.print("That shows what they say of the system, too.", highlight=False)
        elif not self.no_tell:
            self._tell(observed, recording, chosen, console)
        advised = sum(bool(finding.advice) for finding in findings)
        console.print(f"{advised} of {len(findings)} checks have an advice." if advised else "Nothing looks wrong.")

    def _tell(self, observed: Observations, recording: Recording | None, chosen: Chosen, console: Console) -> None:
        """What the estimator makes of some trajectories; of recorded states with impacts at samples, `identify`."""
        system = chosen.system
        if not self.learn and system.n_points > MOST_POINTS:
            console.print(f"What data can tell is found for up to {MOST_POINTS} points.", highlight=False)
            return
        if not self.learn and recording is not None and shows_impacts(observed, recording, system):
            self._tell_of_states(recording, system, console)
            return
        names = self.learn or names_to_learn((), (), chosen)
        rows = np.unique(np.linspace(0, observed.n_trajectories - 1, ENOUGH).round().astype(int))
        told = estimated(console, system, observed.take(rows), names)
        print_told(console, told)
        if len(rows) < observed.n_trajectories:
            rest = f"That is of {len(rows)} of {observed.n_trajectories} trajectories; all of them tell more."
            console.print(rest, highlight=False)

    def _tell_of_states(self, recording: Recording, system: System, console: Console) -> None:
        """Standard errors of the estimator of `identify`, from the values that the system has."""
        if not system.contacts:
            console.print("What data can tell is found with contacts.", highlight=False)
            return
        console.print("Finding what the data can tell, with the potential as it is given ...", highlight=False)
        try:
            found = identify(system, recording, learned=("mass", "friction", "restitution"))
        except CaromError as error:
            console.print(f"It cannot be found: {error}", highlight=False)
            return
        console.print(told_table(system, found))


def _findings(observed: Observations, recording: Recording | None, system: System | None) -> list[Finding]:
    """Of a recording what it shows; of what is none, or had no velocities, what its positions do."""
    if recording is None or observed.v is None:
        return check_observations(observed) if system is None else inspect_observations(observed, system)
    return check_recording(recording) if system is None else inspect_recording(recording, system).findings
