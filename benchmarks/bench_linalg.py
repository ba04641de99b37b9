"""Cholesky factorisation and solve of small batched systems: written out over the batch beside LAPACK."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from carom.contact.linalg import Cholesky

BATCH = 128


@pytest.mark.parametrize("way", ["unrolled", "lapack"])
@pytest.mark.parametrize("n", [2, 6, 12, 24])
def test_cholesky(benchmark, n, way):
    A = np.random.default_rng(0).normal(size=(BATCH, n, n))
    A = A @ A.transpose(0, 2, 1) + np.eye(n)
    b = np.random.default_rng(1).normal(size=(BATCH, n))
    if way == "unrolled":
        solve = jax.jit(lambda A, b: Cholesky(A).solve(b))
        inputs = (jnp.asarray(A.transpose(1, 2, 0)), jnp.asarray(b.T))
    else:
        solve = jax.jit(lambda A, b: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(A), True), b[..., None]))
        inputs = (jnp.asarray(A), jnp.asarray(b))
    benchmark.group = f"Cholesky, {n} rows, batch {BATCH}"
    benchmark.pedantic(lambda: jax.block_until_ready(solve(*inputs)), rounds=200, warmup_rounds=5)
