"""Linear complementarity problems by Lemke's method, many small ones at once, with the batch on the last axis.

For each `M` and `q`: find `z` with `0 <= z`, `0 <= M z + q`, `z^T (M z + q) = 0`. Arrays only.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

# --- The method -------------------------------------------------------------------------------------------------
#
# With w = M z + q + cover z_0 and a large artificial variable z_0 all of w is positive at z = 0. Lemke's pivots keep
# w, z >= 0 and one of each pair w_i, z_i at zero, until z_0 is zero too. The tableau expresses the basic variables by
# the others: basic = T nonbasic + value.
#
# Cycling is excluded by a symbolic perturbation of the constants, values + epsilon ties for an infinitesimal epsilon,
# with ties drawn at random: the tableau carries both columns, and the second decides where the first does not.


class _State(NamedTuple):
    T: Float[Array, "N N+3 B"]  # columns: nonbasic variables, value, tie
    rows: Int[Array, "N B"]  # basic variables: w as 0..N-1, z as N..2N-1, z_0 as 2N
    columns: Int[Array, "N+1 B"]  # nonbasic variables
    entering: Int[Array, " B"]
    done: Bool[Array, " B"]
    iteration: Int[Array, ""]


def lemke(
    M: Float[Array, "N N B"],
    q: Float[Array, "N B"],
    *,
    cover: Float[Array, " N"],
    ties: Float[Array, " N"],
    pivot: float,
    tie: float,
) -> Float[Array, "N B"]:
    """The solutions `z`; or where the search ended without finding one, which the caller has to check for.

    **Arguments:** `M`, `q`, data of order 1; `cover`, the positive column of the artificial variable, which decides the
    path and so which of several solutions is found; `ties`, positive and random, that no two rows may be alike;
    `pivot`, magnitude below which an entry is no pivot; `tie`, values that count as zero in the ratio test.

    **Source:** Cottle, Pang and Stone, *The Linear Complementarity Problem*, 1992, section 4.4.
    """
    size = q.shape[0]

    def keep_going(state: _State):
        # A path visits each basis once; those of contact problems have hardly more steps than rows.
        return jnp.any(~state.done) & (state.iteration < 10 * size)

    start = _start(M, q, cover, ties)
    end = jax.lax.while_loop(keep_going, lambda state: _step(state, pivot, tie), start)
    is_z = end.rows[None] == jnp.arange(size, 2 * size)[:, None, None]
    return jnp.maximum(jnp.sum(jnp.where(is_z, end.T[None, :, -2], 0), axis=1), 0)


def _start(M: Array, q: Array, cover: Array, ties: Array) -> _State:
    """The first pivot: z_0 enters for the row that asks for most of it."""
    size, batch = q.shape
    cover, ties = (jnp.broadcast_to(x[:, None], q.shape) for x in (cover, ties))
    T = jnp.concatenate([M, jnp.stack([cover, q, ties], axis=1)], axis=1)
    rows = jnp.broadcast_to(jnp.arange(size)[:, None], (size, batch))
    columns = jnp.broadcast_to(jnp.arange(size, 2 * size + 1)[:, None], (size + 1, batch))
    ratio = q / cover
    row = _first(ratio == jnp.min(ratio, axis=0), ties / cover)
    leaving = jnp.argmax(row, axis=0)
    done = jnp.min(q, axis=0) >= 0
    row = row & ~done
    column = (columns == 2 * size) & ~done
    T = jnp.where(done, T, _exchange(T, column, row, T[:, size]))
    rows = jnp.where(row, 2 * size, rows)
    columns = jnp.where(column, leaving, columns)
    return _State(T, rows, columns, leaving + size, done, jnp.asarray(0))


def _step(state: _State, pivot: float, tie: float) -> _State:
    """The entering variable grows until a basic one falls to zero, and takes its place; its partner enters next."""
    T, rows, columns, entering, done, iteration = state
    size = rows.shape[0]
    column = columns == entering
    col = jnp.sum(jnp.where(column[None], T[:, : size + 1], 0), axis=1)
    falling = col < -pivot
    slope = jnp.where(falling, -col, 1)
    ratio = jnp.min(jnp.where(falling, jnp.maximum(T[:, -2], 0) / slope, jnp.inf), axis=0)
    # No basic variable falls: a ray, which has no solution at its end.
    ray = ~jnp.any(falling, axis=0)
    tied = falling & (T[:, -2] - jnp.where(ray, 0, ratio) * slope <= tie)
    is_artificial = rows == 2 * size
    key = jnp.where(is_artificial, -jnp.inf, T[:, -1] / slope)  # z_0 leaves whenever it can
    move = ~done & ~ray
    row = _first(tied, key) & move
    leaving = jnp.sum(jnp.where(row, rows, 0), axis=0)
    T = jnp.where(move, _exchange(T, column & move, row, col), T)
    rows = jnp.where(row, entering, rows)
    columns = jnp.where(column & move, leaving, columns)
    done = done | ray | (leaving == 2 * size)
    return _State(T, rows, columns, (leaving + size) % (2 * size), done, iteration + 1)


def _exchange(T: Array, column: Array, row: Array, col: Array) -> Array:
    """The tableau after basic `row` and nonbasic `column` (one-hot, (N, B) and (N + 1, B)) have changed places."""
    column = jnp.concatenate([column, jnp.zeros_like(column[:2])])
    across = jnp.sum(jnp.where(row[:, None], T, 0), axis=0)
    value = jnp.sum(jnp.where(row, col, 0), axis=0)
    across = jnp.where(column, 1, -across) / jnp.where(value == 0, 1, value)
    return jnp.where(row[:, None] | column[None], 0, T) + jnp.where(row, 1, col)[:, None] * across[None]


def _first(choice: Bool[Array, "N B"], key: Float[Array, "N B"]) -> Bool[Array, "N B"]:
    """One-hot of the least key among the chosen."""
    best = jnp.argmin(jnp.where(choice, key, jnp.inf), axis=0)
    return (jnp.arange(key.shape[0])[:, None] == best) & choice
