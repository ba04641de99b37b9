"""The platform: what carom excludes in pyproject.toml must not be installed."""

import subprocess
import sys


def test_batched_solves_of_one_program_do_not_block_one_another():
    """Versions of JAX in which this never returns are excluded in pyproject.toml."""
    program = (
        "import jax, jax.numpy as jnp; jax.config.update('jax_enable_x64', True); "
        "A = jnp.eye(6) + jnp.zeros((1000, 6, 6)); b = jnp.ones((1000, 6, 1)); "
        "jax.block_until_ready(jax.jit(lambda A, b: [jnp.linalg.solve(A + k, b) for k in range(3)])(A, b))"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)
