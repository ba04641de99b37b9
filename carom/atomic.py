"""Files that are there whole, or as they were before: whatever fails or is killed meanwhile."""

import os
import re
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from carom.errors import CaromError

LEFTOVER_AGE = 3600.0
"""Seconds without a write after which a temporary file is taken for one that a kill has left."""


def check_writable(path: str | os.PathLike[str]) -> None:
    """Raise at once what writing the file `path` would raise at the end of long work.

    **Raises:** `CaromError` if its folder is missing or not writable.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise _cannot_write(target, "there is no such folder")
    if target.is_dir() or not os.access(target.parent, os.W_OK | os.X_OK):
        raise _cannot_write(target, "a folder has that name" if target.is_dir() else "permission denied")


def _cannot_write(target: Path, why: object) -> CaromError:
    return CaromError(
        f"the file {target.name} cannot be written in {target.parent} ({why}); choose a folder that exists, has room "
        "and can be written to."
    )


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary file next to `path`, which takes its place when the block ends without an error.

    A process that is killed meanwhile may leave a file `.carom-*` there. It can be deleted, and is when another file is
    written there an hour later.

    **Raises:** `CaromError` if the folder is missing, full, or not writable.
    """
    target = Path(os.path.realpath(path))  # a link stays a link
    temporary = target.parent / f".carom-{secrets.token_hex(8)}.tmp{target.suffix}"
    _remove_leftovers(target.parent)
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        os.replace(temporary, target)
    except OSError as error:
        raise _cannot_write(target, error.strerror or error) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _remove_leftovers(folder: Path) -> None:
    """Remove temporary files that nobody has written to for an hour: their process was killed."""
    with suppress(OSError):
        for entry in folder.glob(".carom-*.tmp*"):
            ours = re.fullmatch(r"\.carom-[0-9a-f]{16}\.tmp(\.\w+)?", entry.name)
            if ours and time.time() - entry.stat().st_mtime > LEFTOVER_AGE:
                entry.unlink(missing_ok=True)


def write_whole(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Write `data` as the new content of a file.

    **Raises:** `CaromError` if the folder is missing, full, or not writable.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)
