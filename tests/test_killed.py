"""Kills at any time: every file that is left loads, and what was interrupted comes to the same end.

Three ways: a process is killed between any two changes that it makes to its folder (simulated, and so exhaustive),
while it saves one checkpoint after another, and, at random times, the real commands are.
"""

import dataclasses
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

import carom
from carom.learning.checkpoints import Checkpoints
from carom.learning.dataset import Dataset
from carom.learning.model_file import load_model_into, save_model
from carom.learning.run import CONFIG, METRICS, MODEL, REPORT, RunFolder
from carom.learning.training.start import fresh_state
from carom.learning.training.train import learn

TASK = "ground-wall"
TINY = carom.LearnConfig(
    epochs=4, chunks_per_epoch=32, batch_size=16, chunk_length=3, width=8, depth=1, checkpoint_every=2, refine=False
)
REPOSITORY = Path(carom.__file__).parents[1]
TEMPORARY = re.compile(r"\.carom-[0-9a-f]{16}\.tmp(\.\w+)?")


def load_all(folder: Path, like=None) -> int | None:
    """Load every file of a run folder; returns the epoch of its last checkpoint. Nothing may be damaged (or warn)."""
    epoch, truth = None, carom.task(TASK)
    for path in folder.iterdir() if folder.exists() else ():
        if TEMPORARY.fullmatch(path.name):
            continue
        if path.suffix == ".json":
            assert json.loads(path.read_text())
        elif path.name == METRICS:
            metrics = RunFolder(folder).metrics()
            numbers = [m["epoch"] for m in metrics]
            assert numbers == list(range(1, len(numbers) + 1))
        elif path.suffix == ".h5":
            carom.load_recording(path, task=TASK)
        elif path.name == MODEL:
            load_model_into(path, truth)
        elif path.suffix in (".png", ".gif"):
            with Image.open(path) as image:
                image.load()
        else:
            assert path.name == "checkpoints"
            checkpoints = Checkpoints(path)
            found = None if like is None else checkpoints.restore(like)
            assert (found is None) == (like is None or not checkpoints.epochs)
            epoch = None if found is None else int(found.epoch)
            checkpoints.close()
    return epoch


def results(folder: Path) -> tuple[list, dict, list[np.ndarray]]:
    """What a training came to, without the time that it took."""

    def timeless(content):
        return {k: timeless(v) if isinstance(v, dict) else v for k, v in content.items() if k != "seconds"}

    run = RunFolder.open(folder)
    model = load_model_into(folder / MODEL, carom.task(TASK))
    arrays = [np.asarray(leaf) for leaf in jax.tree.leaves(model) if isinstance(leaf, jax.Array)]
    return [timeless(m) for m in run.metrics()], timeless(run.read_json(REPORT)), arrays


def assert_same(folder: Path, expected: Path) -> None:
    """Equal to the last bit: the same programs on the same numbers."""
    (metrics, report, model), (metrics2, report2, model2) = results(folder), results(expected)
    assert metrics == metrics2
    assert report == report2
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(model, model2, strict=True))


# ------------------------------------------------------------------------- between any two changes


class KilledError(BaseException):
    """Nothing catches it, and nothing is changed once it was raised."""


CHANGES = ("replace", "rename", "unlink", "remove", "mkdir", "rmdir", "truncate", "fsync")


class Killer:
    """Ends everything at the `at`-th change of a folder; counts the changes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, at: float):
        self.count = 0
        for name in CHANGES:
            monkeypatch.setattr(os, name, self._guarded(getattr(os, name), str(folder), at))

    def _guarded(self, change, folder: str, at: float):
        def guarded(path, *args, **kwargs):
            # A number is an open file; a tree is removed by names within an open folder.
            if isinstance(path, int) or kwargs.get("dir_fd") is not None or folder in os.fspath(path):
                self.count += 1
                if self.count >= at:
                    raise KilledError
            return change(path, *args, **kwargs)

        return guarded


@pytest.fixture(scope="module")
def data():
    return Dataset.split(carom.make_recording(carom.task(TASK), jax.random.key(0), 12), val=0.25)


def train(folder: Path, data: Dataset) -> None:
    """What `carom learn` does, but for pictures and tables."""
    truth = carom.task(TASK)
    run = RunFolder.open(folder) if (folder / CONFIG).exists() else RunFolder.create(folder, dataclasses.asdict(TINY))
    carom.save_recording(folder / "test.h5", data.val)
    system, report = learn(truth, data, TINY, run=run, progress=False)
    run.close()
    save_model(folder / MODEL, system)
    run.write_json(REPORT, dataclasses.asdict(report))


@pytest.fixture(scope="module")
def whole(data, tmp_path_factory):
    """A run that nothing has interrupted, and how many changes it makes."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    with pytest.MonkeyPatch.context() as patch:
        killer = Killer(patch, folder, np.inf)
        train(folder, data)
    return folder, killer.count


def killed_between_changes(data, whole, folder: Path, points: list[int]) -> None:
    like = fresh_state(carom.task(TASK), TINY, data.train)
    for point in points:
        run = folder / str(point)
        with pytest.MonkeyPatch.context() as patch:
            Killer(patch, run, point)
            with pytest.raises(KilledError):
                train(run, data)
        load_all(run, like)
        train(run, data)
        load_all(run, like)
        assert_same(run, whole[0])


@pytest.mark.slow
@pytest.mark.ci_budget
def test_killed_between_some_changes(data, whole, tmp_path):
    assert whole[1] > 20
    points = np.random.default_rng(0).choice(np.arange(1, whole[1] + 1), 10, replace=False)
    killed_between_changes(data, whole, tmp_path, points.tolist())


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_killed_between_any_two_changes(data, whole, tmp_path):
    killed_between_changes(data, whole, tmp_path, list(range(1, whole[1] + 1)))


# --------------------------------------------------------------------------- while checkpoints are saved

SAVER = """
import os, random, signal, sys, time
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint
from pathlib import Path
from carom.learning.checkpoints import Checkpoints

def state(k):
    return {"a": np.full(3000, k), "b": np.full((30, 30), k), "c": np.asarray(k)}

def save_forever(folder):
    checkpoints = Checkpoints(folder)
    found = checkpoints.restore(state(0))
    k = 0 if found is None else int(found["c"])
    assert found is None or all((np.asarray(found[name]) == k).all() for name in found)
    assert k == max(checkpoints.epochs, default=0)
    print(k, flush=True)
    for k in range(k + 1, 10**9):
        checkpoints.save(k, state(k))

rng = random.Random(0)
folder = Path(sys.argv[1])
for _ in range(int(sys.argv[2])):
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.dup2(write, 1)
        try:
            save_forever(folder)
        finally:
            os._exit(1)
    started = os.read(read, 100)
    time.sleep(rng.uniform(0.2, 0.6))
    os.kill(child, signal.SIGKILL)
    print(int(started), os.waitpid(child, 0)[1], flush=True)
"""


@pytest.mark.slow
def test_killed_while_it_saves_checkpoints(tmp_path):
    """The last checkpoint that was finished is always there, and every kill comes after more of them."""
    kills = 12
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", SAVER, str(tmp_path / "checkpoints"), str(kills)],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        check=True,
    )
    starts, ends = np.array([line.split() for line in done.stdout.splitlines()], int).T
    assert ends.tolist() == [signal.SIGKILL] * kills
    assert (np.diff(starts) >= 0).all()
    assert starts[-1] > kills
    assert len(list((tmp_path / "checkpoints").iterdir())) <= 4  # two, one half-removed, one half-written


# ------------------------------------------------------------------------------ the commands, at random times

EPOCHS, EVERY = 240, 5
LEARN = [
    *("--data", "data.h5", "--val", "data.h5", "--test", "data.h5", "--no-refine", "--epochs", str(EPOCHS)),
    *("--chunks-per-epoch", "32", "--batch-size", "16", "--chunk-length", "3", "--width", "8", "--depth", "1"),
    *("--checkpoint-every", str(EVERY)),
]


class Commands:
    """The command line in a folder of its own, which is killed again and again."""

    def __init__(self, folder: Path):
        self.folder, self.random = folder, random.Random(0)
        cache = jax.config.jax_compilation_cache_dir
        self.environment = {
            **os.environ,
            "CAROM_CACHE": str(Path(cache).parent if cache else folder / "cache"),
            "PYTHONPATH": str(REPOSITORY),
        }
        self.environment.pop("JAX_COMPILATION_CACHE_DIR", None)

    def _start(self, *words: object) -> subprocess.Popen[str]:
        command = [sys.executable, "-m", "carom.cli.main", *map(str, words)]
        return subprocess.Popen(
            command,
            cwd=self.folder,
            env=self.environment,
            text=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )

    def whole(self, *words: object) -> float:
        """Run a command to its end; returns how long that took (s)."""
        started = time.monotonic()
        process = self._start(*words)
        _, said = process.communicate()
        assert process.returncode == 0, said
        assert "Warning" not in said
        return time.monotonic() - started

    def killed(self, *words: object, within: float, after=lambda: True) -> None:
        """Kill a command within so many seconds after a condition holds, at random."""
        process = self._start(*words)
        while not after() and process.poll() is None:
            time.sleep(0.02)
        time.sleep(self.random.uniform(0, within))
        process.kill()
        _, said = process.communicate()
        assert process.returncode in (-signal.SIGKILL, 0), said
        assert "Warning" not in said


@pytest.fixture(scope="module")
def commands(tmp_path_factory):
    folder = tmp_path_factory.mktemp("commands")
    made = carom.make_recording(carom.task(TASK), jax.random.key(0), 12)
    carom.save_recording(folder / "data.h5", made)
    return Commands(folder)


@pytest.fixture(scope="module")
def finished(commands):
    """A training that nothing has interrupted."""
    commands.whole("learn", TASK, *LEARN, "--out", "whole")
    return commands.folder / "whole"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_training_killed_at_50_random_times(commands, finished):
    folder = commands.folder / "killed"
    run, data = RunFolder(folder), carom.load_recording(commands.folder / "data.h5")
    config = dataclasses.replace(TINY, epochs=EPOCHS, checkpoint_every=EVERY)
    like = fresh_state(carom.task(TASK), config, data)

    def start() -> list[str]:
        resumed = ["--resume"] if (folder / CONFIG).exists() else []
        return ["learn", TASK, *LEARN, "--out", "killed", *resumed]

    def check() -> None:
        saved = load_all(folder, like) or 0
        logged = max((m["epoch"] for m in run.metrics()), default=0)
        # An epoch is logged right before its checkpoint is written.
        assert logged - EVERY <= saved <= logged

    ends = []
    for kill in range(50):
        entries = len(run.metrics())
        if kill % 5 == 0:  # anywhere, mostly before the first epoch
            commands.killed(*start(), within=20.0)
        elif entries < EPOCHS:  # while it learns: once there are more entries than after it has rewound
            commands.killed(*start(), within=1.5, after=lambda n=entries - entries % EVERY: len(run.metrics()) > n)
        else:  # while the results are written
            commands.killed(*start(), within=8.0, after=(folder / MODEL).exists)
        check()
        ends.append(len(run.metrics()))
    commands.whole(*start())
    check()
    assert_same(folder, finished)
    assert len({end for end in ends if 0 < end < EPOCHS}) >= 10  # kills were spread over the training


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_an_evaluation_killed_at_random_times(commands, finished):
    takes = commands.whole("evaluate", finished)
    expected = json.loads((finished / "evaluation.json").read_text())
    for kill in range(10):
        if kill % 2:
            (finished / "evaluation.json").unlink(missing_ok=True)
        commands.killed("evaluate", finished, within=takes)
        load_all(finished)
        if (finished / "evaluation.json").exists():
            assert json.loads((finished / "evaluation.json").read_text()) == expected
    commands.whole("evaluate", finished)
    assert json.loads((finished / "evaluation.json").read_text()) == expected


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("suffix", ["h5", "npz", "csv"])
def test_a_simulation_killed_at_random_times(commands, suffix):
    out = commands.folder / f"made.{suffix}"
    words = ("simulate", TASK, "--trajectories", 300, "--steps", 200, "--out", out)
    takes = commands.whole(*words)
    expected = carom.load_recording(out)
    for kill in range(6):
        if kill % 2:
            out.unlink(missing_ok=True)
        # Some at any time, the others about when the file is written.
        early = 0.0 if kill < 2 else 0.9 * takes
        begun = time.monotonic()
        commands.killed(*words, within=takes - early, after=lambda t=begun + early: time.monotonic() > t)
        if out.exists():
            assert np.array_equal(carom.load_recording(out).x, expected.x)
    commands.whole(*words)
    assert np.array_equal(carom.load_recording(out).x, expected.x)
    others = {path.name for path in commands.folder.iterdir()} - {"whole", "killed", "data.h5", "cache"}
    assert all(TEMPORARY.fullmatch(name) or name.startswith("made.") for name in others)
