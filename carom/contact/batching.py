"""How work on many small problems meets batches: block by block, only where there is something to do."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

SMALL = 2
"""Contacts up to which a problem of a larger batch is solved in a small form of its own."""

FEW, FEW_CONTACTS = 4, 8
"""Batches of so few problems are not worth code of their own; with room for so few contacts they have one form."""


def contacts_used(A: Array, contacts: int) -> Int[Array, " B"]:
    """How many contacts of each problem `A` (B, K d, K d) to look at: behind them all is padding.

    Padding has a normal entry of zero. NaN counts as a contact, so that it is reported.
    """
    normal = jnp.diagonal(A, axis1=1, axis2=2)[:, :: A.shape[1] // contacts]
    return jnp.max(jnp.where(~(normal <= 0), jnp.arange(contacts) + 1, 0), axis=1)


def by_size(used: Int[Array, " B"], contacts: int) -> list[tuple[int, Bool[Array, " B"]]]:
    """The forms in which problems with room for `contacts` are compiled: a number of contacts, and whose form it is.

    A few problems gain less by a form of their own than compiling it costs.
    """
    several = contacts > 2 * SMALL and (used.shape[0] > FEW or contacts > FEW_CONTACTS)
    sizes = (SMALL, contacts) if several else (contacts,)
    return [(size, (used > smaller) & (used <= size)) for smaller, size in zip((0, *sizes[:-1]), sizes, strict=True)]


def of_each(flags: Bool[Array, " B"], like: Array) -> Bool[Array, "B ..."]:
    """Flags of problems, batch first, as they are met with an array `like` (B, ...)."""
    return flags.reshape(-1, *(1,) * (like.ndim - 1))


def solve_chosen(
    solve_block: Callable[..., Any], arrays: tuple[Array, ...], chosen: Bool[Array, " B"], block: int, out: Any
) -> Any:
    """`out` with the results of the `chosen` problems put in, that `solve_block` solves `block` at a time.

    **Arguments:** `solve_block`, from arrays to a tree of arrays, both batch first, to which zeros are a problem too;
    `arrays` (B, ...), all problems; `out`, a tree like its results for all problems, whose arrays may be larger:
    results are put in at the front of each axis.
    """
    batch = chosen.shape[0]
    if batch <= block:
        return jax.lax.cond(jnp.any(chosen), lambda: _solve_all(solve_block, arrays, chosen, out), lambda: out)
    order = jnp.nonzero(chosen, size=-(-batch // block) * block, fill_value=batch)[0]

    def body(i, out):
        lanes = jax.lax.dynamic_slice(order, (i * block,), (block,))
        solved = solve_block(*(x.at[lanes].get(mode="fill", fill_value=0) for x in arrays))

        def put(whole, part):
            return whole.at[(lanes, *(slice(0, s) for s in part.shape[1:]))].set(part, mode="drop")

        return jax.tree.map(put, out, solved)

    blocks = (jnp.sum(chosen) + block - 1) // block
    return jax.lax.fori_loop(0, blocks, body, out)


def _solve_all(solve_block: Callable[..., Any], arrays: tuple[Array, ...], chosen: Bool[Array, " B"], out: Any) -> Any:
    """`solve_chosen` in one block."""

    def put(whole: Array, part: Array) -> Array:
        front = tuple(slice(0, size) for size in part.shape)
        return whole.at[front].set(jnp.where(of_each(chosen, part), part, whole[front]))

    return jax.tree.map(put, out, solve_block(*(jnp.where(of_each(chosen, x), x, jnp.zeros_like(x)) for x in arrays)))


def as_one_batch(solve: Callable[..., Any], name: str) -> Callable[..., Any]:
    """`solve` of batch-first arrays, such that its batching under vmap is one larger batch.

    It is what a derivative rule calls, and has no derivative of its own: asking for one says that `name` has none.
    """

    solve = jax.jit(solve)  # traced once for each shape, however often it is met

    @jax.custom_batching.custom_vmap
    def batched(*arrays):
        return solve(*arrays)

    @batched.def_vmap
    def _(size, is_batched, *arrays):
        flat = []
        for x, mapped in zip(arrays, is_batched, strict=True):
            x = x if mapped else jnp.broadcast_to(x, (size, *x.shape))
            flat.append(x.reshape(-1, *x.shape[2:]))
        out = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), batched(*flat))
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def undifferentiated(*arrays):
        return batched(*arrays)

    @undifferentiated.defjvp
    def _(primals, tangents):
        raise NotImplementedError(
            f"carom's {name} has first derivatives only: its derivative cannot be differentiated again. "
            "Use a Gauss-Newton approximation, or differences of gradients, in place of second derivatives."
        )

    return undifferentiated


def anywhere(flag: Bool[Array, ""]) -> Bool[Array, ""]:
    """`flag`, or, under vmap, whether any of the batch has it: one flag for all, so that a `cond` on it stays one."""

    @jax.custom_batching.custom_vmap
    def shared(flag):
        return flag

    @shared.def_vmap
    def _(size, is_batched, flags):
        return shared(jnp.any(flags)), False

    return shared(flag)
