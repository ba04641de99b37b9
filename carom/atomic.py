"""Files that are there whole, or as they were before: whatever fails or is killed meanwhile."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from carom.errors import CaromError


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
        raise CaromError(
            f"the file {target.name} cannot be written in {target.parent} ({error.strerror or error}); choose a folder "
            "that exists, has room and can be written to."
        ) from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def write_whole(path: str | os.PathLike[str], data: bytes | memoryview) -> None:
    """Write `data` as the new content of a file.

    **Raises:** `CaromError` if the folder is missing, full, or not writable.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)
