"""The run folder of a training: configuration, metrics, checkpoints and results, each whole or absent."""

import json
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from carom.atomic import write_whole
from carom.checks import require
from carom.errors import CaromError

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
        self._manager: Any = None

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
            f"{run.path} is not a run folder: it has no {CONFIG}. Give a folder that `carom learn` has made.",
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
        before = self.read_json(CONFIG)
        free = {"carom_version", "jax_version", "started"}
        for name in now:
            new = list(now[name]) if isinstance(now[name], tuple) else now[name]
            require(
                name in free or before.get(name) == new,
                f"the run in {self.path} was started with {name} = {before.get(name)!r}, not {new!r}. Use the same "
                "options to go on with it, or another --out.",
            )

    def read_json(self, name: str) -> Any:
        """The content of a JSON file of the run."""
        path = self.path / name
        try:
            return json.loads(path.read_text())
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
        with (self.path / METRICS).open("a") as file:
            file.write(json.dumps(_finite(metrics)) + "\n")

    def metrics(self) -> list[dict[str, Any]]:
        """All lines of `metrics.jsonl`; a last line cut off by a kill is left out."""
        path = self.path / METRICS
        if not path.exists():
            return []
        lines = path.read_text().splitlines()
        out = []
        for number, line in enumerate(lines):
            try:
                out.append(json.loads(line))
            except ValueError as error:
                if number == len(lines) - 1:
                    break
                raise CaromError(f"line {number + 1} of {path} is not valid JSON: remove or restore it.") from error
        return out

    def rewind_metrics(self, epoch: int) -> None:
        """Drop the lines after `epoch`: they will be made again."""
        kept = [m for m in self.metrics() if m["epoch"] <= epoch]
        write_whole(self.path / METRICS, "".join(json.dumps(m) + "\n" for m in kept).encode())

    # --- checkpoints -----------------------------------------------------------------------------------------

    @property
    def _checkpoints(self):
        if self._manager is None:
            import orbax.checkpoint as ocp  # slow to import, and only a training needs it

            # Of several processes the first alone writes, and waits for no other.
            alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
            options = ocp.CheckpointManagerOptions(
                max_to_keep=2, enable_async_checkpointing=False, multiprocessing_options=alone, create=False
            )
            folder = (self.path / "checkpoints").absolute()
            folder.mkdir(exist_ok=True)
            self._manager = ocp.CheckpointManager(folder, options=options)
        return self._manager

    def save_checkpoint(self, epoch: int, state: Any) -> None:
        """Save the arrays of `state`. A kill at any time leaves the one before."""
        import orbax.checkpoint as ocp

        self._checkpoints.save(epoch, args=ocp.args.StandardSave(_leaves(state)))

    def restore_checkpoint(self, like: Any) -> Any:
        """The latest checkpoint in the form of `like`, or `None` if there is none.

        **Raises:** `CaromError` if it does not fit, or cannot be read.
        """
        import orbax.checkpoint as ocp

        epoch = self._checkpoints.latest_step()
        if epoch is None:
            return None
        leaves = _leaves(like)
        try:
            restored = self._checkpoints.restore(epoch, args=ocp.args.StandardRestore(leaves))
        except Exception as error:  # orbax raises many types for a damaged or foreign checkpoint
            raise CaromError(
                f"the checkpoint of epoch {epoch} in {self.path} cannot be restored "
                f"({str(error).splitlines()[0] if str(error) else type(error).__name__}). Delete the folder "
                f"{self.path / 'checkpoints' / str(epoch)} to go on from an earlier one, or start a new run."
            ) from error
        arrays, rest = eqx.partition(like, eqx.is_array)
        flat, structure = jax.tree.flatten(arrays)
        # Without orbax's placement on a device, so that the programs compiled for fresh arrays take them.
        values = [jnp.asarray(np.asarray(restored.get(f"{k:04d}", leaf))) for k, leaf in enumerate(flat)]
        return eqx.combine(jax.tree.unflatten(structure, values), rest)

    def close(self) -> None:
        """Finish what is being written."""
        if self._manager is not None:
            self._manager.close()
            self._manager = None


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    """The arrays of a tree by their number. Those without elements, which orbax refuses, are left out.

    NumPy's: of several processes the first alone writes, which orbax refuses to do with arrays of JAX.
    """
    leaves = enumerate(jax.tree.leaves(eqx.filter(tree, eqx.is_array)))
    return {f"{k:04d}": np.asarray(leaf) for k, leaf in leaves if leaf.size}


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
