"""Checkpoints of a training: arrays in folders that orbax writes, each file with a checksum."""

import hashlib
import json
import shutil
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from carom.atomic import write_whole
from carom.errors import CaromError

CHECKSUMS = "sha256.json"
"""Within a checkpoint: the SHA-256 of every other file in it, by its path."""
KEPT = 2
"""Checkpoints that are kept: the last, and the one before in case that is damaged."""


class DamagedError(CaromError):
    """A checkpoint is not as it was written."""


class Checkpoints:
    """The checkpoints in a folder, by epoch. A kill at any time leaves those that were there before."""

    def __init__(self, folder: Path):
        self.folder = folder.absolute()
        self._manager: Any = None

    @property
    def epochs(self) -> list[int]:
        """Epochs of which there is a checkpoint, in order. What a kill left half-written is none."""
        names = (entry.name for entry in self.folder.iterdir()) if self.folder.is_dir() else ()
        return sorted(int(name) for name in names if name.isdecimal())

    def save(self, epoch: int, state: Any) -> None:
        """Save the arrays of `state`.

        **Raises:** `CaromError` if they cannot be written.
        """
        import orbax.checkpoint as ocp

        try:
            self._opened().save(epoch, args=ocp.args.StandardSave(_leaves(state)))
            # A kill before this leaves a checkpoint without checksums, which orbax has finished all the same.
            where = self.folder / str(epoch)
            content = json.dumps(_checksums(where), indent=1) + "\n"
            write_whole(where / CHECKSUMS, content.encode())
        except OSError as error:
            raise CaromError(
                f"the checkpoint of epoch {epoch} cannot be written in {self.folder} ({error.strerror or error}). Make "
                "room there, and go on with --resume."
            ) from error

    def restore(self, like: Any) -> Any:
        """The latest sound checkpoint in the form of `like`, or `None` if there is none at all.

        Later ones that are damaged are warned of and removed: they will be made again.

        **Raises:** `CaromError` that names the damaged file, if all are damaged, or if the checkpoint does not fit.
        """
        damaged: list[tuple[int, DamagedError]] = []
        for epoch in reversed(self.epochs):
            try:
                found = self._restore(epoch, like)
            except DamagedError as error:
                damaged.append((epoch, error))
                continue
            self._leave_out(damaged, epoch)
            return found
        if damaged:
            raise CaromError(
                f"{damaged[0][1]} There is no other to go on from. Restore it from a copy, or delete the folder "
                f"{self.folder} to start this training again from its beginning with --resume."
            ) from damaged[0][1]
        return None

    def close(self) -> None:
        """Finish what is being written."""
        if self._manager is not None:
            self._manager.close()
            self._manager = None

    def _restore(self, epoch: int, like: Any) -> Any:
        import orbax.checkpoint as ocp

        where = self.folder / str(epoch)
        _check_files(where)  # first, so that orbax never reads a damaged file
        try:
            restored = self._opened().restore(epoch, args=ocp.args.StandardRestore(_leaves(like)))
        except Exception as error:  # orbax raises many types for a checkpoint that is damaged or foreign
            text = str(error).splitlines()[0] if str(error) else type(error).__name__
            if (where / CHECKSUMS).exists():
                raise CaromError(
                    f"the checkpoint {where} cannot be restored ({text}): it is of a training with other settings, or "
                    "of another version of carom. Use those it was made with, or start a new run."
                ) from error
            raise DamagedError(f"the checkpoint {where} cannot be restored ({text}).") from error
        arrays, rest = eqx.partition(like, eqx.is_array)
        flat, structure = jax.tree.flatten(arrays)
        # Without orbax's placement on a device, so that the programs compiled for fresh arrays take them.
        values = [jnp.asarray(np.asarray(restored.get(f"{k:04d}", leaf))) for k, leaf in enumerate(flat)]
        return eqx.combine(jax.tree.unflatten(structure, values), rest)

    def _leave_out(self, damaged: list[tuple[int, DamagedError]], epoch: int) -> None:
        for later, error in damaged:
            warnings.warn(
                f"{error} It is removed, and the training goes on from the checkpoint of epoch {epoch}.", stacklevel=2
            )
            self.close()  # orbax keeps a list of its own
            shutil.rmtree(self.folder / str(later), ignore_errors=True)

    def _opened(self) -> Any:
        if self._manager is None:
            import orbax.checkpoint as ocp  # slow to import, and only a training needs it

            # Of several processes the first alone writes, and waits for no other.
            alone = ocp.options.MultiprocessingOptions(primary_host=0, active_processes={0})
            options = ocp.CheckpointManagerOptions(
                max_to_keep=KEPT,
                enable_async_checkpointing=False,
                multiprocessing_options=alone,
                create=False,
                lightweight_initialize=True,
            )
            self.folder.mkdir(exist_ok=True)
            for entry in self.folder.glob("*.orbax-checkpoint-tmp*"):  # what a kill left half-written
                shutil.rmtree(entry, ignore_errors=True)
            self._manager = ocp.CheckpointManager(self.folder, options=options)
        return self._manager


def _checksums(where: Path) -> dict[str, str]:
    files = sorted(path for path in where.rglob("*") if path.is_file() and path != where / CHECKSUMS)
    return {path.relative_to(where).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _check_files(where: Path) -> None:
    """Raise `DamagedError` unless every file is as it was written; without checksums there is nothing to compare."""
    path = where / CHECKSUMS
    if not path.exists():
        return
    try:
        expected = dict(json.loads(path.read_bytes()))
        found = _checksums(where)
    except (OSError, ValueError, TypeError) as error:
        raise DamagedError(f"the checkpoint {where} is damaged: {path} cannot be read.") from error
    for name, checksum in expected.items():
        if found.get(name) != checksum:
            how = "is not as" if name in found else "is missing that is"
            raise DamagedError(f"the checkpoint {where} is damaged: its file {name} {how} recorded in {CHECKSUMS}.")


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    """The arrays of a tree by their number. Those without elements, which orbax refuses, are left out.

    NumPy's: of several processes the first alone writes, which orbax refuses to do with arrays of JAX.
    """
    leaves = enumerate(jax.tree.leaves(eqx.filter(tree, eqx.is_array)))
    return {f"{k:04d}": np.asarray(leaf) for k, leaf in leaves if leaf.size}
