"""The cache of compiled programs: what a kill has left of one is removed."""

import os
import zlib

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache

from carom.cli.cache import remove_damaged


def test_half_written_programs_are_removed(tmp_path):
    program = zlib.compress(bytes(range(256)) * 20)
    contents = {"whole": program, "cut": program[:-1], "empty": b"", "changed": program[:50] + b"?" + program[51:]}
    for name, content in contents.items():
        (tmp_path / f"{name}-cache").write_bytes(content)
    remove_damaged(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"whole-cache", "checked"}
    # Each is looked at once, right after it was written.
    for name in ("before", "after"):
        (tmp_path / f"{name}-cache").write_bytes(program[:-1])
    os.utime(tmp_path / "before-cache", (0, 0))
    remove_damaged(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"whole-cache", "before-cache", "checked"}
    remove_damaged(tmp_path / "missing")


def test_programs_that_jax_writes_are_whole(tmp_path):
    """Should JAX compress them in another way, this tells."""
    before = jax.config.jax_compilation_cache_dir, jax.config.jax_persistent_cache_min_compile_time_secs
    try:
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", str(tmp_path))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.jit(lambda x: x * 1.2345 + 6)(jnp.ones(3))
    finally:
        compilation_cache.reset_cache()
        jax.config.update("jax_compilation_cache_dir", before[0])
        jax.config.update("jax_persistent_cache_min_compile_time_secs", before[1])
    programs = list(tmp_path.glob("*-cache"))
    assert programs
    remove_damaged(tmp_path)
    assert all(path.exists() for path in programs)
    for path in programs:
        path.write_bytes(path.read_bytes()[:-1])
    remove_damaged(tmp_path)
    assert not any(path.exists() for path in programs)
