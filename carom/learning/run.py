"""The run folder of a training: configuration, metrics, checkpoints and results, each whole or absent."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import jax
import numpy as np

from carom.atomic import write_whole
from carom.checks import require
from carom.errors import CaromError
from carom.learning.checkpoints import Checkpoints

CONFIG, TRUTH, METRICS, REPORT, MODEL, SYSTEM = (
    "config.json",
    "truth.json",
    "metrics.jsonl",
    "report.json",
    "model.carom",
    "system.py",
)


class RunFolder:
    """A folder with `config.json`, `metrics.jsonl`, `checkpoints/`, `model.carom`, `report.json` and figures.

    Of a system of the user's own it has the file too: `system.py`.
    """

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self._checkpoints = Checkpoints(self.path / "checkpoints")

    @staticmethod
    def check_new(path: str | os.PathLike) -> None:
        """Raise at once what `create` would raise after long work.

        **Raises:** `CaromError` if the folder already holds a run, or cannot be made.
        """
        path = Path(path)
        require(
            not (path / CONFIG).exists(),
            f"the folder {path} already holds a run. Choose another with --out, or go on with it with --resume.",
        )
        there = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
        require(
            there.is_dir() and os.access(there, os.W_OK | os.X_OK),
            f"cannot make the run folder {path}: {there} is "
            f"{'not writable' if there.is_dir() else 'not a folder'}. Choose another with --out.",
        )

    @classmethod
    def create(cls, path: str | os.PathLike, config: dict[str, Any]) -> "RunFolder":
        """A new folder with its configuration.

        **Raises:** `CaromError` if it already holds a run, or cannot be written.
        """
        cls.check_new(path)
        run = cls(path)
        try:
            run.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CaromError(
                f"cannot make the run folder {run.path}: {error.strerror}. Choose another with --out."
            ) from error
        run.write_json(CONFIG, config)
        return run

    @classmethod
    def open(cls, path: str | os.PathLike) -> "RunFolder":
        """An existing run.

        **Raises:** `CaromError` if there is none.
        """
        run = cls(path)
        require(
            (run.path / CONFIG).is_file(),
            f"{run.path} is not a run folder: it has no {CONFIG}. Give a folder that `carom learn` has made; a "
            "training that was stopped before it had one is started again without --resume.",
        )
        return run

    @staticmethod
    def choose(path: Path | None, name: str, *, resume: bool) -> Path:
        """`path`, or without one `runs/NAME`, with a number if that is taken.

        **Raises:** `CaromError` if a run is to go on, but it is not said where.
        """
        if path is not None:
            return path
        require(not resume, "resume needs --out: the folder of the run to go on with.")
        base, number = Path("runs") / name, 1
        while (found := base if number == 1 else base.with_name(f"{name}-{number}")).exists():
            number += 1
        return found

    def check_same(self, now: dict[str, Any]) -> None:
        """Raise `CaromError` if a run would go on with other settings than it was started with."""
        rest = {name: value for name, value in now.items() if name not in ("carom_version", "jax_version", "started")}
        check_same_settings(f"the run in {self.path}", self.read_json(CONFIG), rest)

    def read_json(self, name: str) -> Any:
        """The content of a JSON file of the run."""
        path = self.path / name
        try:
            return json.loads(path.read_bytes())
        except OSError as error:
            raise CaromError(f"cannot read {path}: {error.strerror}. Was the run finished?") from error
        except ValueError as error:
            raise CaromError(f"{path} is not valid JSON ({error}). Restore the file, or run again.") from error

    def write_json(self, name: str, content: Any) -> None:
        """Write a JSON file of the run; numbers that are not finite are written as null."""
        write_whole(self.path / name, (json.dumps(_finite(content), indent=2) + "\n").encode())

    # --- metrics ---------------------------------------------------------------------------------------------

    def log(self, metrics: dict[str, Any]) -> None:
        """Append one line to `metrics.jsonl`; numbers that are not finite are written as null."""
        path = self.path / METRICS
        whole, rest = self._lines()
        if rest:  # what a kill has left of a line: another must not begin in it
            os.truncate(path, len(whole))
        with path.open("ab") as file:
            file.write(json.dumps(_finite(metrics)).encode() + b"\n")

    def metrics(self) -> list[dict[str, Any]]:
        """All lines of `metrics.jsonl`; a last line cut off by a kill is left out."""
        out = []
        for number, line in enumerate(self._lines()[0].splitlines()):
            try:
                out.append(json.loads(line))
            except ValueError:
                out.append(None)
            require(
                isinstance(out[-1], dict) and "epoch" in out[-1],
                f"line {number + 1} of {self.path / METRICS} is damaged: restore the file, or remove the line.",
            )
        return out

    def _lines(self) -> tuple[bytes, bytes]:
        """The whole lines of `metrics.jsonl`, and what of a last one was written before a kill."""
        path = self.path / METRICS
        whole, end, rest = (path.read_bytes() if path.exists() else b"").rpartition(b"\n")
        return whole + end, rest

    def rewind_metrics(self, epoch: int) -> None:
        """Drop the lines after `epoch`: they will be made again."""
        kept = [m for m in self.metrics() if m["epoch"] <= epoch]
        write_whole(self.path / METRICS, "".join(json.dumps(m) + "\n" for m in kept).encode())

    # --- checkpoints -----------------------------------------------------------------------------------------

    def save_checkpoint(self, epoch: int, state: Any) -> None:
        """Save the arrays of `state`. A kill at any time leaves the one before."""
        self._checkpoints.save(epoch, state)

    def restore_checkpoint(self, like: Any) -> Any:
        """The latest sound checkpoint in the form of `like`, or `None` if there is none; a damaged one is warned of.

        **Raises:** `CaromError` if it does not fit, or all are damaged.
        """
        return self._checkpoints.restore(like)

    def close(self) -> None:
        """Finish what is being written."""
        self._checkpoints.close()


def check_same_settings(what: str, before: dict[str, Any], now: dict[str, Any]) -> None:
    """Raise `CaromError` if `what` would go on with other settings than it was started with, which JSON has kept."""
    # What JSON makes of settings: lists of tuples, at any depth.
    for name, new in json.loads(json.dumps(_finite(now))).items():
        old = before.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            check_same_settings(what, old, new)
            continue
        require(
            old == new,
            f"{what} was started with {name} = {old!r}, not {new!r}. Use the same options to go on with it, or another "
            "--out.",
        )


def _finite(value: Any) -> Any:
    """`value` for JSON, with None for numbers that are not finite."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        value = np.asarray(value).tolist()
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, str) or value is None or isinstance(value, bool):
        return value
    if isinstance(value, Iterable):
        return [_finite(v) for v in value]
    return value if np.isfinite(value) else None
