"""`carom learn TASK`: make or read data, train, and write a run folder with tables and pictures."""

import dataclasses
import hashlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro
from rich.console import Console

import carom
from carom.atomic import write_whole
from carom.checks import require
from carom.cli.arguments import ContactModelName, FilePath, FolderPath, SystemName
from carom.cli.estimation import is_for_estimator, learn_by_estimator, names_to_learn
from carom.cli.outcome import TEST_DATA, estimates_and_fit, pictures, warn_if_far_off, what_is_told
from carom.cli.systems import Chosen, choose, copy_of, is_file
from carom.cli.tables import evaluation_table, property_table, told_table
from carom.cli.tosses import learn_and_measure
from carom.contact.impulses import contact_model_of
from carom.errors import CaromError
from carom.learning.config import FORMULATIONS, LearnConfig
from carom.learning.dataset import Dataset, hold_out, in_pieces, sessions_of
from carom.learning.estimation.toss_config import TossConfig, tossed_names
from carom.learning.estimation.tosses import can_learn_tosses
from carom.learning.evaluate import evaluate
from carom.learning.model_file import save_model
from carom.learning.run import CONFIG, MODEL, REPORT, TRUTH, RunFolder
from carom.learning.training.devices import is_first, start_processes
from carom.learning.training.train import LearnReport, learn, quantities
from carom.learning.unknowns.quantities import Learned
from carom.recordings.files import load_recording, save_recording
from carom.recordings.recording import Recording
from carom.tasks import make_data_sets, noisy

QUICK = {"trajectories": 100, "epochs": 20}
"""What `--quick` makes smaller, where it is not set by hand."""


COMMON = ("model", "epochs", "contact_model", "seed")
"""Options of `LearnConfig` that most users want."""


@dataclasses.dataclass(frozen=True)
class Learn:
    """Learn masses, potential, friction and restitution of a task, or of a system of your own, from trajectories.

    Writes a run folder: configuration, metrics, checkpoints, the learned model, a report, and pictures.
    """

    task: SystemName
    """Name of the task, or a Python file that sets `system`: its geometry is known, all else is learned."""
    from_run: Annotated[FolderPath, tyro.conf.arg(name="from")] = None
    """Run folder to take all options from, the task too; those given here change them."""
    data: FilePath = None
    """Trajectory file (.h5, .hdf5, .npz or .csv) to learn from; without it, data are simulated."""
    val: FilePath = None
    """Trajectory file to validate on; without it, a tenth of the data (of its sessions, if it has `group`)."""
    test: FilePath = None
    """Trajectory file to test on; without it, a tenth of the data (of its sessions, if it has `group`)."""
    out: FolderPath = None
    """Run folder; by default runs/TASK-MODEL, with a number if that is taken."""
    resume: bool = False
    """Go on with the training in the folder --out from its last checkpoint."""
    trajectories: int = 800
    """Training trajectories to simulate (and an eighth as many each to validate and to test)."""
    data_contact_model: ContactModelName = "cm"
    """Contact model of the simulated data; `--contact-model` is the one to learn with."""
    data_noise: float = 0.0
    """Standard deviation of errors on simulated data to learn from (rad and rad/s for pendulums, else m and m/s)."""
    quick: bool = False
    """A small training of one minute or so after compilation, to try things out: few trajectories and epochs."""
    coordinator: str = ""
    """HOST:PORT of process 0, to train in several processes: each is started with the same options and its number."""
    process_count: int = 1
    """Number of processes that train together."""
    process_id: int = 0
    """Number of this process, from 0."""
    config: LearnConfig = dataclasses.field(default_factory=LearnConfig)
    tosses: TossConfig = dataclasses.field(default_factory=TossConfig)

    @classmethod
    def defaults(cls, words: Sequence[str]) -> "Learn | None":
        """The options of the run folder after `--from`, if the words of the command line have it.

        **Raises:** `CaromError` if it is not a run folder, or of other options than this version has.
        """
        for k, word in enumerate(words):
            if word == "--from" or word.startswith("--from="):
                folder = word.removeprefix("--from").removeprefix("=") or "".join(words[k + 1 : k + 2])
                require(bool(folder), "--from must be a run folder; nothing came after it.")
                return cls._of_run(RunFolder.open(folder))
        return None

    @classmethod
    def _of_run(cls, run: RunFolder) -> "Learn":
        kept = run.read_json(CONFIG)
        try:
            config = LearnConfig(**_tuples({f.name: kept[f.name] for f in dataclasses.fields(LearnConfig)}))
            tosses = TossConfig(**_tuples(kept["tosses"])) if kept.get("tosses") else TossConfig()
            files = {name: kept[name] and Path(kept[name]) for name in ("data", "val", "test")}
            others = {name: kept[name] for name in ("trajectories", "data_contact_model", "data_noise")}
        except (KeyError, TypeError) as error:
            raise CaromError(
                f"the run in {run.path} was not started by this version's `carom learn` ({error}): give its options "
                "by hand."
            ) from error
        task = str(copy_of(run, kept["task"])) if is_file(kept["task"]) else kept["task"]
        return cls(task, run.path, **files, **others, config=config, tosses=tosses)

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "The last checkpoint is kept: go on with `carom learn --from RUN --out RUN --resume`."

    def run(self) -> None:
        """Do it."""
        command = self._quickened() if self.quick else self
        if self.coordinator or self.process_count > 1:
            start_processes(self.coordinator, self.process_count, self.process_id)
        command._run(Console(quiet=not is_first()))

    def _quickened(self) -> "Learn":
        trajectories = QUICK["trajectories"] if self.trajectories == Learn.trajectories else self.trajectories
        epochs = QUICK["epochs"] if self.config.epochs == LearnConfig.epochs else self.config.epochs
        return dataclasses.replace(
            self, trajectories=trajectories, config=dataclasses.replace(self.config, epochs=epochs)
        )

    def _run(self, console: Console) -> None:
        chosen = self._chosen()
        truth = chosen.system
        if self._is_for_estimator(chosen):
            self._run_estimator(console, chosen)
            return
        tosses = self.data is not None and can_learn_tosses(truth)
        # Names of what is learned of tosses are those of the registry.
        config = dataclasses.replace(self.config, learn=LearnConfig.learn) if tosses else self.config
        config.check()
        if not tosses:
            config.prepare(truth)
        require(
            self.data is not None or not chosen.own,
            f"data is needed for {chosen.name}: give a trajectory file to learn from, --data FILE.",
        )
        contact_model_of(self.data_contact_model, argument="data_contact_model")
        require(
            0 <= self.data_noise < np.inf,
            f"--data-noise must be a finite number of at least 0; it was {self.data_noise}.",
        )
        require(
            self.data is None or not self.data_noise,
            f"--data-noise is for simulated data; it was {self.data_noise}, and --data {str(self.data)!r}.",
        )
        require(self.trajectories >= 8, f"--trajectories must be at least 8; it was {self.trajectories}.")
        if tosses:
            self._run_tosses(console, chosen)
            return
        if not is_first():
            learn(truth, self.data_sets(chosen, console)[0], self.config, progress=False)
            return
        folder = RunFolder.choose(self.out, f"{chosen.stem}-{self.config.model}", resume=self.resume)
        if not self.resume:
            RunFolder.check_new(folder)
            dataset, test = self.data_sets(chosen, console)
            run = RunFolder.create(folder, self._description(chosen))
        else:
            run = RunFolder.open(folder)
            run.check_same(self._description(chosen))
            dataset, test = self.data_sets(chosen, console)
        # Resumed too: a kill may have come before them.
        if chosen.source is not None:
            write_whole(copy_of(run, chosen.name), chosen.source)
        save_recording(run.path / TEST_DATA, test)
        run.write_json(TRUTH, None if chosen.truth is None else quantities(truth))
        console.print(
            f"Learning {chosen.name} ({self.config.model}) from {dataset.train.n_trajectories} trajectories of "
            f"{int(dataset.train.length.max())} states into {run.path}",
            soft_wrap=True,
            highlight=False,
        )
        try:
            system, report = learn(truth, dataset, self.config, run=run)
        finally:
            run.close()
        self._finish(console, run, system, report, chosen, dataset, test)

    def _run_tosses(self, console: Console, chosen: Chosen) -> None:
        """Recordings of a tossed body are noisy poses: they have a fit of their own."""
        self.tosses.check()
        require(self.process_count == 1, f"--process-count must be 1 for recorded tosses; it was {self.process_count}.")
        # Coulomb's law by default, which knows what fast impacts lose.
        config = dataclasses.replace(self.config, contact_model=self.config.contact_model or "coulomb")
        chosen = dataclasses.replace(chosen, system=config.prepare(chosen.system))
        names = tossed_names(chosen.system) if config.learn == LearnConfig.learn else config.learn
        Learned.chosen(chosen.system, names)  # names of nothing are refused before a folder is made
        folder = RunFolder.choose(self.out, f"{chosen.stem}-tosses", resume=self.resume)
        if not self.resume:
            RunFolder.check_new(folder)
        train, test = self._toss_data(console, chosen)
        settings = {**self._description(chosen), "tosses": dataclasses.asdict(self.tosses)}
        if self.resume:
            run = RunFolder.open(folder)
            run.check_same(settings)
        else:
            run = RunFolder.create(folder, settings)
        # Resumed too: a kill may have come before them.
        if chosen.source is not None:
            write_whole(copy_of(run, chosen.name), chosen.source)
        save_recording(run.path / TEST_DATA, test)
        console.print(
            f"Learning {chosen.name} from {train.n_trajectories} recorded tosses into {run.path}",
            soft_wrap=True,
            highlight=False,
        )
        learn_and_measure(console, run, chosen, train, test, names, self.tosses, self.config.seed)

    def _is_for_estimator(self, chosen: Chosen) -> bool:
        if can_learn_tosses(chosen.system) or self.config.model not in ("clnn", "chnn"):
            return False
        return is_for_estimator(self.data, self.config.learn, LearnConfig.learn, chosen)

    def _run_estimator(self, console: Console, chosen: Chosen) -> None:
        """Positions alone: start states, and the time of each impact, are estimated too."""
        assert self.data is not None
        require(not self.resume, "--resume goes on with a training; this takes minutes, and is begun again without it.")
        learn = names_to_learn(self.config.learn, LearnConfig.learn, chosen)
        folder = RunFolder.choose(self.out, f"{chosen.stem}-estimated", resume=False)
        RunFolder.check_new(folder)
        run = RunFolder.create(folder, {**self._description(chosen), "learn": learn, "estimated": True})
        learn_by_estimator(console, run, chosen, self.data, self.test, learn, self.config.seed)

    def _toss_data(self, console: Console, chosen: Chosen) -> tuple[Recording, Recording]:
        """Tosses to learn from and to measure on: the fit needs none to validate on, so that either file will do."""
        assert self.data is not None
        data = load_recording(self.data, task=chosen.task)
        held = self.test or self.val
        if self.test is not None and self.val is not None:
            console.print(f"Recorded tosses are learned without validation: {self.val} is not used.", highlight=False)
        if held is None:
            count = data.n_trajectories
            require(count >= 2, f"--data must hold at least 2 tosses, or --val others; it held {count}.")
            parts = Dataset.split(data, seed=self.config.seed)
            return parts.train, parts.val
        return data, load_recording(held, task=chosen.task)

    def _chosen(self) -> Chosen:
        """The system to learn, under the name that it was first given."""
        chosen = choose(self.task)
        first = None if self.from_run is None else RunFolder.open(self.from_run)
        if first is not None and is_file(self.task) and self.task == str(copy_of(first, self.task)):
            return dataclasses.replace(chosen, name=first.read_json(CONFIG)["task"])
        return chosen

    def _description(self, chosen: Chosen) -> dict[str, Any]:
        files = {name: getattr(self, name) for name in ("data", "val", "test")}
        return {
            "task": chosen.name,
            "system_sha256": chosen.digest,
            **{name: path and str(path.absolute()) for name, path in files.items()},
            **{f"{name}_sha256": path and _digest(path) for name, path in files.items()},
            "data_noise": self.data_noise,
            "trajectories": self.trajectories,
            "data_contact_model": self.data_contact_model,
            **dataclasses.asdict(self.config),
            "carom_version": carom.__version__,
            "jax_version": jax.__version__,
            "started": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        }

    def data_sets(self, chosen: Chosen, console: Console) -> tuple[Dataset, Recording]:
        """Training, validation and test data: read, or simulated from seeds of their own."""
        truth = chosen.system
        if self.data is None:
            for name in ("val", "test"):
                require(getattr(self, name) is None, f"--{name} needs --data: give the file to train on too.")
            console.print(f"Simulating {self.task} ...", highlight=False)
            held = max(self.trajectories // 8, 2)
            counts = (self.trajectories, held, held)
            train, val, test = make_data_sets(
                truth,
                *((jax.random.fold_in(jax.random.key(self.config.seed), k), count) for k, count in enumerate(counts)),
                contact_model=self.data_contact_model,
                compensation_steps=self.config.compensation_steps,
            )
            if self.data_noise:
                rng = np.random.default_rng((self.config.seed, 17))
                train, val = (noisy(self.task, part, self.data_noise, rng) for part in (train, val))
            return Dataset(train, val), test
        data = load_recording(self.data, task=chosen.task)
        test = load_recording(self.test, task=chosen.task) if self.test else None
        least = 1 + (self.test is None) + (self.val is None)
        data, word = in_pieces(data, least, self.config.states)
        if word:
            console.print(word, soft_wrap=True, highlight=False)
        if test is None:
            data, test = _hold_out(data, self.config.seed)
        if self.val is not None:
            return Dataset(data, load_recording(self.val, task=chosen.task)), test
        return Dataset.split(data, val=1 / 9, seed=self.config.seed), test

    def _finish(self, console, run, system, report: LearnReport, chosen: Chosen, dataset, test) -> None:
        formulation, compensation = FORMULATIONS[self.config.model], self.config.compensation_steps
        save_model(run.path / MODEL, system, formulation=formulation, compensation_steps=compensation)
        measures, predicted = evaluate(
            system, test, truth=chosen.truth, formulation=formulation, compensation_steps=compensation
        )
        found = what_is_told(system, dataset.train, dataclasses.asdict(self.config), console)
        run.write_json(
            REPORT,
            {
                **estimates_and_fit(system, found, measures),
                "learned": dataclasses.asdict(report),
                "evaluation": measures,
                "identification": found and dataclasses.asdict(found),
            },
        )
        warn_if_far_off(console, measures)
        console.print(property_table(system, chosen.system, chosen.name if chosen.own else ""))
        if found is not None:
            console.print(told_table(system, found))
        console.print(evaluation_table(measures))
        if report.starts_estimated:
            console.print(
                "The data are noisier than a tenth of what a step moves: start states were estimated too "
                "(docs/noise.md).",
                highlight=False,
            )
        if report.skipped_steps or report.overflowed_contacts:
            console.print(
                f"Note: {report.skipped_steps} steps were left out because a gradient was not finite; "
                f"{report.overflowed_contacts} predicted contacts found no place in the solver.",
                highlight=False,
            )
        pictures(run, system, test, predicted, found)
        seconds = f"{report.seconds:.0f} s for {report.epochs} epochs" + (
            ", stopped early" if report.stopped_early else ""
        )
        if not report.epochs:
            seconds = f"{report.seconds:.0f} s; Gauss-Newton steps were enough, no epoch was needed"
        console.print(f"Done ({seconds}). Everything is in {run.path}", soft_wrap=True, highlight=False)


Learn.RARE = {  # pyright: ignore[reportAttributeAccessIssue]
    Learn: ("data_contact_model", "data_noise", "coordinator", "process_count", "process_id"),
    LearnConfig: tuple(f.name for f in dataclasses.fields(LearnConfig) if f.name not in COMMON),
    TossConfig: tuple(f.name for f in dataclasses.fields(TossConfig)),
}


def _tuples(options: dict[str, Any]) -> dict[str, Any]:
    """Options as they were before JSON made lists of tuples."""
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}


def _hold_out(data: Recording, seed: int) -> tuple[Recording, Recording]:
    """Keep a tenth of the trajectories for the test, or of the sessions where there are some."""
    n = len(np.unique(sessions_of(data)))
    what, more = ("trajectories", "") if data.group is None else ("sessions (group)", " Or give --val and --test.")
    require(n >= 3, f"data must hold at least 3 {what}, to train, validate and test; it held {n}.{more}")
    held = hold_out(data, 0.1, np.random.default_rng((seed, 2)))
    return data.select(~held), data.select(held)


def _digest(path: Path) -> str | None:
    """SHA-256 of a file; None of one that is not there, which is said where it is read."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None
