"""Small dense factorisations, thousands at once, with the batch on the last axis.

A batch of small symmetric systems is solved fastest when the batch is the contiguous axis and the
elimination is written out over the rows: each step is then one long vector operation. At 2 to 24 rows this
beats LAPACK, which is called once a matrix, four to twenty times on a CPU (`benchmarks/bench_linalg.py`), and
makes no library calls that could block one another. Larger systems go to LAPACK.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

UNROLL_LIMIT = 24
"""Most rows that are eliminated in unrolled form; compile time grows with their square."""

UNROLL_SOLVE_LIMIT = 6
"""Most rows whose triangular solves are unrolled too; above, they are loops over the rows, which compile at once."""


class Cholesky:
    """Cholesky factor `H = L L^T` of a batch of SPD matrices `(n, n, B)`, with the batch last.

    With `rhs` (n, m, B), `solution` is that of `H x = rhs`: elimination of the right-hand sides along with the matrix
    costs much less than `solve` does afterwards. `unrolled`: write the elimination out over the batch, as above, if the
    matrix is not too large; without it LAPACK is called, which compiles at once. A matrix that is not positive definite
    gives NaN in its own lane and no other.
    """

    def __init__(
        self, matrix: Float[Array, "n n B"], rhs: Float[Array, "n m B"] | None = None, *, unrolled: bool = True
    ):
        self.size, self.unrolled = matrix.shape[0], unrolled and matrix.shape[0] <= UNROLL_LIMIT
        if self.unrolled:
            extended = _factor_unrolled(matrix if rhs is None else jnp.concatenate([matrix, rhs.swapaxes(0, 1)]))
            self.columns = [column[: self.size - j] for j, column in enumerate(extended)]
            if rhs is not None:
                self.solution = _back_substitute(
                    self.columns, [column[self.size - j :] for j, column in enumerate(extended)]
                )
        else:
            self.lower = jnp.linalg.cholesky(jnp.moveaxis(matrix, -1, 0))
            if rhs is not None:
                self.solution = self.solve(rhs)

    @property
    def parts(self) -> tuple[Array, ...]:
        """`L` as it is at hand; see `triangle_of`."""
        return tuple(self.columns) if self.unrolled else (self.lower,)

    def solve(self, rhs: Float[Array, "n *m B"]) -> Float[Array, "n *m B"]:
        """Solve `H x = rhs` for one or several right-hand sides."""
        if self.unrolled and self.size <= UNROLL_SOLVE_LIMIT:
            return _solve_unrolled(self.columns, rhs)
        if self.unrolled:
            return _solve_by_rows(_rows(self.columns), rhs)
        flat = jnp.moveaxis(rhs.reshape(self.size, -1, rhs.shape[-1]), -1, 0)
        x = jax.scipy.linalg.cho_solve((self.lower, True), flat)
        return jnp.moveaxis(x, 0, -1).reshape(rhs.shape)


def triangle_of(parts: tuple[Array, ...]) -> Float[Array, "B n n"]:
    """`L`, with the batch first, of a `Cholesky`'s `parts`: its columns from the diagonal down, or `L` itself."""
    return parts[0] if parts[0].ndim == 3 else jnp.moveaxis(_rows(parts), -1, 0)


def _rows(columns: Sequence[Float[Array, "_ B"]]) -> Float[Array, "n n B"]:
    return jnp.stack([jnp.pad(c, ((j, 0), (0, 0))) for j, c in enumerate(columns)], axis=1)


def _factor_unrolled(matrix: Float[Array, "all_rows n B"]) -> list[Float[Array, "_ B"]]:
    # The columns of L. Rows of `matrix` below the n-th are transposed right-hand sides, which become `L^-1 rhs`.
    # Left-looking: column j of L from column j of H and the columns before it. The division (rather than a
    # product with a reciprocal) also keeps XLA from fusing a column's computation into each of its readers.
    columns = []
    for j in range(matrix.shape[1]):
        column = matrix[j:, j]
        for k, previous in enumerate(columns):
            column = column - previous[j - k :] * previous[j - k]
        columns.append(column / jnp.sqrt(column[0]))
    return columns


def _back_substitute(columns: list[Float[Array, "_ B"]], rhs: list[Float[Array, "m B"]]) -> Float[Array, "n m B"]:
    """Solve `L^T x = rhs`."""
    x = list(rhs)
    for j in reversed(range(len(columns))):
        for k in range(j + 1, len(columns)):
            x[j] = x[j] - columns[j][k - j] * x[k]
        x[j] = x[j] / columns[j][0]
    return jnp.stack(x)


def _solve_unrolled(columns: list[Float[Array, "_ B"]], rhs: Float[Array, "n *m B"]):
    n = len(columns)
    x = [rhs[i] for i in range(n)]
    for j in range(n):
        for k in range(j):
            x[j] = x[j] - columns[k][j - k] * x[k]
        x[j] = x[j] / columns[j][0]
    for j in reversed(range(n)):
        for k in range(j + 1, n):
            x[j] = x[j] - columns[j][k - j] * x[k]
        x[j] = x[j] / columns[j][0]
    return jnp.stack(x)


def _solve_by_rows(lower: Float[Array, "n n B"], rhs: Float[Array, "n *m B"]):
    n = lower.shape[0]
    wide = lower.reshape(n, n, *(1,) * (rhs.ndim - 2), lower.shape[-1])

    def forward(j, x: Array) -> Array:  # entries from j on are still those of the right-hand side
        known = jnp.sum(jnp.where(_before(n, j, x.ndim), wide[j] * x, 0), axis=0)
        return x.at[j].set((x[j] - known) / wide[j, j])

    def backward(i, x: Array) -> Array:
        j = n - 1 - i
        known = jnp.sum(jnp.where(_before(n, j + 1, x.ndim), 0, wide[:, j] * x), axis=0)
        return x.at[j].set((x[j] - known) / wide[j, j])

    return jax.lax.fori_loop(0, n, backward, jax.lax.fori_loop(0, n, forward, rhs))


def _before(n: int, j, ndim: int) -> Array:
    return (jnp.arange(n) < j).reshape(n, *(1,) * (ndim - 1))
