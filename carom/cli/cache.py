"""A cache of compiled programs on disk, for one kind of processor."""

import hashlib
import importlib
import importlib.util
import os
import time
import zlib
from pathlib import Path

import jax

ZSTD = b"\x28\xb5\x2f\xfd"
"""What data begin with that zstd has compressed."""


def use_compilation_cache(folder: str | os.PathLike[str]) -> Path | None:
    """Let JAX keep compiled programs in a folder for this processor within `folder`; None if there is none to tell it.

    A program that was compiled for another processor may stop the process with an illegal instruction.
    """
    name = processor()
    if not name:
        return None
    path = Path(folder) / name
    remove_damaged(path)
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return path


def remove_damaged(cache: Path) -> None:
    """Remove programs that a kill left half-written: JAX would warn of them in every run, and never replace them.

    Each is looked at once, in the run after the one that wrote it. To remove one that another process is just writing
    does no harm: it is compiled again.
    """
    mark, now = cache / "checked", time.time()
    try:
        since = mark.stat().st_mtime if mark.exists() else 0.0
        for entry in cache.glob("*-cache"):
            if entry.stat().st_mtime >= since and not _is_whole(entry.read_bytes()):
                entry.unlink(missing_ok=True)
        if cache.is_dir():
            mark.touch()
            os.utime(mark, (now, now))
    except OSError:
        return  # a cache that cannot be read or written only takes longer


def _is_whole(data: bytes) -> bool:
    """Whether compressed data can be read to their end. They are zlib's, or zstd's from Python 3.14 on."""
    if data.startswith(ZSTD) and importlib.util.find_spec("compression") is None:
        return True  # nothing here to read it with
    try:
        (importlib.import_module("compression.zstd") if data.startswith(ZSTD) else zlib).decompress(data)
    except Exception:  # zlib.error or ZstdError
        return False
    return True


def processor() -> str:
    """A name for this kind of processor: programs compiled on one must not run on another. Empty if unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(flags.encode()).hexdigest()[:16] if flags else ""
