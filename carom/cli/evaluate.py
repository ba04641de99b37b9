"""`carom evaluate RUN`: measure a learned model on test data."""

import dataclasses
from typing import Literal

from rich.console import Console

from carom.checks import require
from carom.cli.arguments import FilePath, FolderPath, RunPath
from carom.cli.outcome import TEST_DATA, pictures, warn_if_far_off, what_is_told
from carom.cli.systems import Chosen, chosen_by
from carom.cli.tables import evaluation_table, property_table, told_table
from carom.cli.tosses import LearnedToss, measure
from carom.learning.evaluate import evaluate
from carom.learning.model_file import load_model_into, read_model_header
from carom.learning.run import CONFIG, MODEL, RunFolder
from carom.recordings.files import load_recording
from carom.recordings.recording import check_system


@dataclasses.dataclass(frozen=True)
class Evaluate:
    """Measure a learned model: contact properties, mass ratios, trajectory error, energy, constraints.

    What the data can tell of each property is of the test data here, in `carom learn` of the training data.

    Writes evaluation.json and pictures into the run folder.
    """

    run_folder: RunPath
    """Run folder that `carom learn` has made."""
    data: FilePath = None
    """Trajectory file to test on; by default the run's own test data."""
    protocol: Literal["A", "B"] = "A"
    """For recorded tosses: A predicts from the first sample, B from the last before a corner can touch."""
    against: FolderPath = None
    """For recorded tosses: another run, to compare with toss by toss."""

    dark: bool = False
    """Draw the figures for a dark background."""

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "Nothing was changed."

    def run(self) -> None:
        """Do it."""
        from carom.view.style import theme  # matplotlib is slow to import

        run = RunFolder.open(self.run_folder)
        config = run.read_json(CONFIG)
        chosen = chosen_by(run)
        truth = chosen.system
        if config.get("tosses") is not None:
            self._evaluate_tosses(run, chosen)
            return
        require(self.against is None, "--against compares runs that learned from recorded tosses; this one did not.")
        header = read_model_header(run.path / MODEL)
        system = load_model_into(run.path / MODEL, truth)
        test = load_recording(self.data or run.path / TEST_DATA, task=chosen.task)
        measures, predicted = evaluate(
            system,
            test,
            truth=chosen.truth,
            formulation=header["formulation"],
            compensation_steps=header["compensation_steps"],
            impact=header["impact"],
        )
        console = Console()
        # What was estimated from positions is told in the run's own report.
        found = None if config.get("estimated") else what_is_told(system, test, config, console)
        told = found and dataclasses.asdict(found)
        run.write_json("evaluation.json", {"data": str(self.data or TEST_DATA), **measures, "identification": told})
        with theme("dark" if self.dark else "light"):
            pictures(run, system, test, predicted, found)
        warn_if_far_off(console, measures)
        console.print(property_table(system, truth, config["task"] if chosen.own else ""))
        if found is not None:
            console.print(told_table(system, found))
        console.print(evaluation_table(measures))
        console.print(f"Written to {run.path / 'evaluation.json'}", soft_wrap=True, highlight=False)

    def _evaluate_tosses(self, run: RunFolder, chosen: Chosen) -> None:
        console, learned = Console(), LearnedToss.of_run(run.path)
        other = None if self.against is None else LearnedToss.of_run(self.against)
        test = load_recording(self.data or run.path / TEST_DATA, task=chosen.task)
        check_system(test, chosen.system, str(self.data or TEST_DATA))
        measures = measure(console, run, learned, test, self.protocol, chosen, other)
        run.write_json("evaluation.json", {"data": str(self.data or TEST_DATA), **measures})
        console.print(f"Written to {run.path / 'evaluation.json'}", soft_wrap=True, highlight=False)
