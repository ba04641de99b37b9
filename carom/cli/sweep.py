"""`carom sweep TASK`: many trainings with different options, several at a time; which are best?"""

import csv
import dataclasses
import fcntl
import io
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from carom.atomic import write_whole
from carom.checks import optional_package, require
from carom.cli.arguments import FilePath, FolderPath, SystemName
from carom.cli.learn import Learn
from carom.cli.search_space import Space, grid, parse_space, words_of
from carom.cli.systems import Chosen, choose
from carom.errors import CaromError
from carom.learning.config import LearnConfig
from carom.learning.run import CONFIG, REPORT, RunFolder, check_same_settings
from carom.recordings.files import save_recording

Objective = Literal["bounded_error", "trajectory_error", "trajectory_error_median", "trajectory_error_geometric"]
DATABASE, SETTINGS, LOCK = "sweep.db", "sweep.json", "lock"
DATA = {"data": "train.h5", "val": "val.h5", "test": "test.h5"}
"""The sweep's own files of data: of these a trial gets the first two, and the third is for the winner."""
TRAIN = (sys.executable, "-m", "carom.cli.main", "learn")
"""Starts a training."""
PATIENCE = 0.5
"""Seconds between looks at the trainings that run."""


@dataclasses.dataclass(frozen=True)
class Sweep:
    """Train with many different options, several trainings at a time, and find the best.

    --over says what to vary: `width=64,128,256`, `learning_rate=1e-4:1e-2:log`, `seed=0,1,2`. All other options of
    `carom learn` are the same for all. Every trial is a run folder, measured on the validation data; the test data are
    left for the winner. The same command goes on with a sweep that was stopped.
    """

    task: SystemName
    """Name of the task, or a Python file that sets `system`."""
    over: tuple[str, ...]
    """What to vary: NAME=A,B,C or NAME=LOW:HIGH or NAME=LOW:HIGH:log, any number of them."""
    trials: int = 20
    """How many trainings (a grid has as many as it has combinations)."""
    workers: int = 1
    """Trainings at the same time, each a process."""
    method: Literal["tpe", "random", "grid"] = "tpe"
    """How options are chosen: by what was found (tree of Parzen estimators), at random, or all combinations."""
    objective: Objective = "bounded_error"
    """What shall be small, of predictions of the validation trajectories (see `carom evaluate`)."""
    out: FolderPath = None
    """Folder of the sweep; by default sweeps/TASK."""
    data: FilePath = None
    """Trajectory file to learn from; without it, data are simulated."""
    val: FilePath = None
    """Trajectory file to validate on; without it, a tenth of the data."""
    test: FilePath = None
    """Trajectory file to test on; without it, a tenth of the data."""
    trajectories: int = 800
    """Training trajectories to simulate (and an eighth as many each to validate and to test)."""
    config: LearnConfig = dataclasses.field(default_factory=LearnConfig)

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "Finished trials are kept, and stopped ones go on from their checkpoints: give the same command again."

    def run(self) -> None:
        """Do it."""
        optuna = optional_package("optuna", "carom sweep", "sweep")
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        for name in ("trials", "workers"):
            require(getattr(self, name) >= 1, f"--{name} must be at least 1; it was {getattr(self, name)}.")
        space, chosen, console = parse_space(self.over), choose(self.task), Console()
        combinations = grid(space) if self.method == "grid" else []
        folder = Path("sweeps") / chosen.stem if self.out is None else self.out
        self.config.check()
        with _alone(folder) as lock:
            self._prepare(folder, chosen, console)
            study = _study(folder, self.method, self.config.seed)
            _requeue(study)
            _enqueue(study, combinations)
            trials = len(combinations) or self.trials
            try:
                _Trials(self, study, space, folder, trials, console, lock).run()
            finally:
                if _finished(study):
                    _write(folder, study, space, self.objective)
            console.print(_best_table(study, space, self.objective))
            best = _name(study.best_trial)
            console.print(
                f"The best: {folder / best}. Its error on the test data: carom evaluate {folder / best} --data "
                f"{folder / DATA['test']}. The same training again: carom learn --from {folder / best}. All trials: "
                f"{folder / 'trials.csv'}, {folder / 'sweep.png'}",
                soft_wrap=True,
                highlight=False,
            )

    def _prepare(self, folder: Path, chosen: Chosen, console: Console) -> None:
        """A new sweep's settings and data; or that these are the settings of the one that is there."""
        settings = json.loads(json.dumps(self._settings(chosen)))
        path = folder / SETTINGS
        if path.exists():
            try:
                before = json.loads(path.read_text())
            except ValueError as error:
                raise CaromError(f"{path} is not valid JSON ({error}): restore it, or take another --out.") from error
            check_same_settings(f"the sweep in {folder}", before, settings)
            return
        learn = Learn(
            self.task,
            data=self.data,
            val=self.val,
            test=self.test,
            trajectories=self.trajectories,
            config=self.config,
        )
        dataset, test = learn.data_sets(chosen, console)
        for part, name in zip((dataset.train, dataset.val, test), DATA.values(), strict=True):
            save_recording(folder / name, part)
        if chosen.source is not None:
            write_whole(folder / Path(self.task).name, chosen.source)
        write_whole(path, (json.dumps(settings, indent=1) + "\n").encode())

    def _settings(self, chosen: Chosen) -> dict[str, Any]:
        """All that must stay the same for trials to be comparable."""
        kept = ("over", "method", "objective", "trajectories")
        files: dict[str, Path | None] = {name: getattr(self, name) for name in DATA}
        return {
            "task": Path(self.task).name,
            "system_sha256": chosen.digest,
            **{name: getattr(self, name) for name in kept},
            **{name: path and str(path.absolute()) for name, path in files.items()},
            "config": dataclasses.asdict(self.config),
        }


@contextmanager
def _alone(folder: Path) -> Iterator[int]:
    """The folder of a sweep, for one process at a time and the trainings that it starts; yields the lock's file."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK).open("w")
    except OSError as error:
        raise CaromError(f"cannot make the folder {folder}: {error.strerror}. Choose another with --out.") from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise CaromError(
                f"another `carom sweep`, or a training that a killed one has left, works in {folder}: wait for it, or "
                "choose another folder with --out. For more trainings at a time give --workers."
            ) from error
        yield file.fileno()


def _study(folder: Path, method: str, seed: int) -> Any:
    """The study in the folder's database, a new one if there is none."""
    import optuna

    path = folder / DATABASE
    try:
        study = optuna.create_study(storage=f"sqlite:///{path}", study_name="carom", load_if_exists=True)
        # A sampler begins anew in each process: from the seed alone, it would draw what the first one has drawn.
        drawn = len(study.get_trials(deepcopy=False))
        kind = optuna.samplers.TPESampler if method == "tpe" else optuna.samplers.RandomSampler
        study.sampler = kind(seed=int(np.random.SeedSequence((seed, drawn)).generate_state(1)[0]))
        return study
    except Exception as error:  # sqlalchemy has many for a damaged file
        first = (str(error).splitlines() or [""])[0]
        raise CaromError(f"cannot use {path} ({first}). Restore it, or choose another folder with --out.") from error


def _requeue(study: Any) -> None:
    """Put trials that were running when a sweep was killed into the queue again, each with its run folder."""
    import optuna

    for trial in study.get_trials(states=(optuna.trial.TrialState.RUNNING,)):
        _again(study, trial)


def _enqueue(study: Any, combinations: list[dict[str, Any]]) -> None:
    """Put the combinations into the queue that are neither there nor finished; one that failed, with its folder."""
    import optuna

    trials = study.get_trials()
    for combination in combinations:
        same = [t for t in trials if t.system_attrs.get("fixed_params", t.params) == combination]
        if all(trial.state == optuna.trial.TrialState.FAIL for trial in same):
            kept = {"folder": _name(same[-1])} if same else None
            study.enqueue_trial(combination, user_attrs=kept)


def _again(study: Any, trial: Any) -> None:
    import optuna

    study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
    study.enqueue_trial(trial.params, user_attrs={"folder": _name(trial)})


def _name(trial: Any) -> str:
    """The run folder of a trial: that of the one which it goes on with, if it does."""
    return trial.user_attrs.get("folder", f"trial-{trial.number:04d}")


def _finished(study: Any) -> list[Any]:
    import optuna

    return study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))


@dataclasses.dataclass
class _Trials:
    """The trainings of a sweep, a few at a time."""

    sweep: Sweep
    study: Any
    space: Space
    folder: Path
    wanted: int
    console: Console
    lock: int
    started: float = dataclasses.field(default_factory=time.monotonic)
    running: dict[Any, tuple[subprocess.Popen[bytes], float]] = dataclasses.field(default_factory=dict)
    done: int = 0
    failed: int = 0

    def run(self) -> None:
        """Until as many as wanted are finished; all fail if the first three do.

        **Raises:** `CaromError` with the reason of the last if no trial can be finished.
        """
        distributions = {name: values.distribution() for name, values in self.space.items()}
        before = len(_finished(self.study))
        left = self.wanted - before
        self.console.print(
            f"{self.wanted} trials, {before} of them finished, into {self.folder}", soft_wrap=True, highlight=False
        )
        try:
            while self.done + self.failed < left:
                while len(self.running) < self.sweep.workers and self.done + self.failed + len(self.running) < left:
                    self._start(self.study.ask(distributions))
                time.sleep(PATIENCE)
                for trial in [t for t, (process, _) in self.running.items() if process.poll() is not None]:
                    self._collect(trial, before)
        finally:
            for trial, (process, _) in self.running.items():
                process.terminate()
                process.wait()
                _again(self.study, trial)

    def _start(self, trial: Any) -> None:
        name = _name(trial)
        trial.set_user_attr("folder", name)
        words = [self._task(), "--out", str(self.folder / name)]
        words += ["--data", str(self.folder / DATA["data"])]
        words += [word for option in ("val", "test") for word in (f"--{option}", str(self.folder / DATA["val"]))]
        words += words_of(dataclasses.replace(self.sweep.config, **trial.params))
        if (self.folder / name / CONFIG).exists():
            words.append("--resume")
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [*TRAIN, *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for the sweep, which stops them
                pass_fds=(self.lock,),  # held as long as any of them works, should the sweep be killed
            )
        self.running[trial] = (process, time.monotonic())

    def _task(self) -> str:
        own = self.folder / Path(self.sweep.task).name
        return str(own) if own.is_file() else self.sweep.task

    def _collect(self, trial: Any, before: int) -> None:
        """Note what came of a training that has ended."""
        import optuna

        process, started = self.running.pop(trial)
        options = " ".join(f"{name}={_shown(value)}" for name, value in trial.params.items())
        if process.returncode == 0:
            report = RunFolder.open(self.folder / _name(trial)).read_json(REPORT)
            value = report["evaluation"][self.sweep.objective]
            self.study.tell(trial, float("inf") if value is None else value)
            self.done += 1
            best = self.study.best_trial
            text = f"{self.sweep.objective} {self.study.trials[trial.number].value:.3g}"
            text += f" (best {best.value:.3g}, {_name(best)})"
        else:
            self.study.tell(trial, state=optuna.trial.TrialState.FAIL)
            self.failed += 1
            text = _last_line(self.folder / f"{_name(trial)}.log")
            if not self.done and not before and self.failed >= min(3, self.wanted):
                raise CaromError(f"no trial can be finished. The last said: {text}")
            text = f"failed: {text}"
        ended = self.done + self.failed
        left = (time.monotonic() - self.started) / ended * (self.wanted - before - ended)
        self.console.print(
            f"{_name(trial)}  {options}  {time.monotonic() - started:.0f} s  {text}"
            + (f"  about {left / 60:.0f} minutes left" if left > 30 else ""),
            soft_wrap=True,
            highlight=False,
        )


def _shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _last_line(path: Path) -> str:
    """What a training said last, without the name of the program."""
    lines = [line for line in path.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1].removeprefix("carom: ") if lines else "it said nothing"


def _best_table(study: Any, space: Space, objective: str) -> Table:
    table = Table(title=f"The best of {len(_finished(study))} trials")
    table.add_column("trial")
    for name in (*space, objective):
        table.add_column(name, justify="right")
    for trial in sorted(_finished(study), key=lambda t: t.value)[:5]:
        table.add_row(_name(trial), *(_shown(trial.params[name]) for name in space), f"{trial.value:.3g}")
    return table


def _write(folder: Path, study: Any, space: Space, objective: str) -> None:
    """`trials.csv`, and the picture."""
    from carom.view.sweeps import draw_sweep  # matplotlib is slow to import

    trials = _finished(study)
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(["trial", *space, objective, "seconds"])
    for trial in trials:
        seconds = trial.duration.total_seconds() if trial.duration else ""
        writer.writerow([_name(trial), *(trial.params[name] for name in space), trial.value, seconds])
    write_whole(folder / "trials.csv", text.getvalue().encode())
    values = {name: [trial.params[name] for trial in trials] for name in space}
    logarithmic = {name for name, values in space.items() if getattr(values, "log", False)}
    draw_sweep(values, [trial.value for trial in trials], folder / "sweep.png", label=objective, log=logarithmic)


Sweep.RARE = {  # pyright: ignore[reportAttributeAccessIssue]
    LearnConfig: tuple(f.name for f in dataclasses.fields(LearnConfig)),
}
