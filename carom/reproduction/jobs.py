"""One training of a table: its data, its run folder, its measures."""

import dataclasses
import hashlib
import json
import platform
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

import carom
from carom.checks import require
from carom.learning.config import BASELINES, FORMULATIONS, LearnConfig, Model
from carom.learning.dataset import Dataset
from carom.learning.estimation.identify import identify
from carom.learning.estimation.refine import MOST_POINTS
from carom.learning.evaluate import energy_errors, evaluate, mean_and_interval, state_errors
from carom.learning.model_file import save_model
from carom.learning.run import CONFIG, MODEL, REPORT, RunFolder
from carom.learning.training.train import learn
from carom.recordings.recording import Recording
from carom.system import System
from carom.tasks import make_data_sets, noisy, task

TEST_SEED = 1_000_000
"""Test states have a seed of their own, whatever is learned from."""
TEST_TRAJECTORIES = 100


@dataclasses.dataclass(frozen=True)
class Job:
    """What is learned from what. Jobs that are equal are one training, however many tables ask for it.

    What is learned from data of LCP with another contact model is tested on data of CM with CM itself: whether the
    properties are right is then the question, not how the contact models differ.
    """

    task: str
    model: Model = "clnn"
    contact_model: str = "cm"
    data: str = "cm"
    """Contact model that the data are simulated with."""
    noise: float = 0.0
    """Standard deviation of errors on every recorded number (angles and rates for pendulums)."""
    trajectories: int = 800
    epsilon: float | Literal["learn"] | None = None
    width: int = 256
    depth: int = 3
    seed: int = 0

    @property
    def name(self) -> str:
        """A folder's name that says what differs from the defaults."""
        parts = [self.task, self.model, self.contact_model]
        if self.data != "cm":
            parts.append(f"on-{self.data}")
        for field, label in (("noise", "noise"), ("epsilon", "eps"), ("trajectories", "n"), ("width", "w")):
            value = getattr(self, field)
            if value != next(f.default for f in dataclasses.fields(Job) if f.name == field):
                parts.append(f"{label}{value}")
        return "-".join([*parts, f"seed{self.seed}"])

    def config(self) -> LearnConfig:
        """How it is learned: the defaults; a baseline for as long as in `benchmarks.baselines`."""
        return LearnConfig(
            model=self.model,
            contact_model=self.contact_model,
            epsilon=self.epsilon,
            width=self.width,
            depth=self.depth,
            seed=self.seed,
            epochs=250 if self.model in BASELINES else LearnConfig.epochs,
        )

    def settings(self, quick: bool) -> dict[str, Any]:
        """All that decides what comes out."""
        config = dataclasses.asdict(self._quickened() if quick else self.config())
        return {**dataclasses.asdict(self), "quick": quick, "config": config}

    def digest(self, quick: bool = False) -> str:
        """Hash of the settings."""
        return hashlib.sha256(json.dumps(self.settings(quick), sort_keys=True).encode()).hexdigest()[:12]

    def _quickened(self) -> LearnConfig:
        return dataclasses.replace(self.config(), epochs=4)

    def run(self, folder: Path, *, quick: bool = False, say: Callable[[str], None] | None = None) -> dict[str, Any]:
        """Learn and measure, or go on where a training was stopped, or read what was measured.

        **Raises:** `CaromError` if the folder holds a training with other settings.
        """
        settings = self.settings(quick)
        path = folder / self.name
        run = RunFolder.open(path) if (path / CONFIG).exists() else RunFolder.create(path, settings)
        try:
            before, now = run.read_json(CONFIG), json.loads(json.dumps(settings))
            require(before == now, f"{path} was learned with other settings. Choose another folder with --runs.")
            if (path / REPORT).exists():
                return run.read_json(REPORT)
            learned_by, started = commit(), time.monotonic()
            truth = task(self.task)
            dataset, tests = self._data(quick)
            if say is not None:
                say(f"{self.name}: learning from {dataset.train.n_trajectories} trajectories")
            before_learning = time.monotonic()
            system, report = learn(truth, dataset, self._quickened() if quick else self.config(), run=run)
            # Of a training that was stopped, what it had taken by then counts.
            started += time.monotonic() - before_learning - report.seconds
            save_model(path / MODEL, system, formulation=FORMULATIONS[self.model])
            measures, curves = {}, {}
            for name, test in tests.items():
                measures[name], curves[name] = self._measured(system, test, truth, name)
            content = {
                "learned": dataclasses.asdict(report),
                "evaluation": measures,
                "over_time": curves,
                "identification": self._identified(system, dataset),
                "provenance": {
                    "digest": self.digest(quick),
                    "seconds": round(time.monotonic() - started, 1),
                    "commit": learned_by,
                    "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
                    "carom": carom.__version__,
                    "jax": jax.__version__,
                },
            }
            run.write_json(REPORT, content)
            return run.read_json(REPORT)
        finally:
            run.close()

    def _measured(self, system: System, test: Recording, truth: System, data: str):
        """Measures, and errors over time, of predictions; see `Job` for the contact model that they are made with."""
        if self.contact_model != self.data == "lcp" != data:
            system = system.with_contact_model(data)
        measures, predicted = evaluate(system, test, truth=truth, formulation=FORMULATIONS[self.model])
        errors = {"state": state_errors(test, predicted)[0], "energy": energy_errors(test, predicted, truth)}
        return measures, {name: mean_and_interval(error) for name, error in errors.items()}

    def _identified(self, system: System, dataset: Dataset) -> dict[str, Any] | None:
        """What exact data of CM tell, with standard errors; None for other jobs, and for systems too large."""
        wanted = self.model not in BASELINES and self.data == "cm" and not self.noise and self.epsilon is None
        if not wanted or system.n_points > MOST_POINTS:
            return None
        return dataclasses.asdict(identify(system, dataset.train, formulation=FORMULATIONS[self.model]))

    def _data(self, quick: bool) -> tuple[Dataset, dict[str, Recording]]:
        """To learn from, and to test with: by the contact model of the data, and by CM where that is another."""
        truth = task(self.task)
        count = min(self.trajectories, 64) if quick else self.trajectories
        key = jax.random.key(self.seed)
        parts = [(jax.random.fold_in(key, k), n) for k, n in ((0, count), (1, max(count // 8, 2)))]
        test = (jax.random.fold_in(jax.random.key(self.seed), TEST_SEED), 8 if quick else TEST_TRAJECTORIES)
        train, val, own = make_data_sets(truth, parts[0], parts[1], test, contact_model=self.data)
        tests = {self.data: own}
        if self.data != "cm":
            tests["cm"] = make_data_sets(truth, parts[1], parts[1], test, contact_model="cm")[2]
        if self.noise:
            rng = np.random.default_rng((self.seed, 17))
            train, val = (noisy(self.task, part, self.noise, rng) for part in (train, val))
        return Dataset(train, val), tests


def commit() -> str | None:
    """The commit of the checkout that the package is in, if it is in one, and a + where the package was changed."""

    def git(*arguments: str) -> str:
        here = Path(__file__).parents[1]
        command = ["git", "-C", str(here), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=10, check=True).stdout.strip()

    try:
        return git("rev-parse", "--short", "HEAD") + ("+" if git("status", "--porcelain", ".") else "")
    except (OSError, subprocess.SubprocessError):
        return None
