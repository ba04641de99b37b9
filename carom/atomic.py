"""Files that are there whole, or as they were before: whatever fails or is killed meanwhile."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from carom.errors import CaromError


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

    A process that is killed meanwhile may leave a file `.carom-*` there, which can be deleted.

    **Raises:** `CaromError` if the folder is missing, full, or not writable.
    """
    target = Path(os.path.realpath(path))  # a link stays a link
    temporary = target.parent / f".carom-{secrets.token_hex(8)}.tmp{target.suffix}"
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


def write_whole(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Write `data` as the new content of a file.

    **Raises:** `CaromError` if the folder is missing, full, or not writable.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)
