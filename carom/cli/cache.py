"""A cache of compiled programs on disk, for one kind of processor."""

import hashlib
import os
from pathlib import Path

import jax


def use_compilation_cache(folder: str | os.PathLike[str]) -> Path | None:
    """Let JAX keep compiled programs in a folder for this processor within `folder`; None if there is none to tell it.

    A program that was compiled for another processor may stop the process with an illegal instruction.
    """
    name = processor()
    if not name:
        return None
    path = Path(folder) / name
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    return path


def processor() -> str:
    """A name for this kind of processor: programs compiled on one must not run on another. Empty if unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    flags = next((line for line in lines if line.startswith(("flags", "Features"))), "")
    return hashlib.sha256(flags.encode()).hexdigest()[:16] if flags else ""
