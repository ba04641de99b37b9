"""Limits of chains as contacts: how far neighbouring segments may bend, and how long each may be (paper, appendix H).

For a limit, the normal row of the contact Jacobian is the gradient of its gap and the tangent row the same with every
2-vector turned by 90 degrees, so that friction on limits is a property that can be learned.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from carom.checks import as_floats, positive, require, require_values, whole_numbers
from carom.contact.candidates import Candidates, Contact, property_indices
from carom.contact.geometry import bend_gap, stretch_gap


class Chain(eqx.Module):
    """Point masses in a row, in 2D, perhaps hung from a fixed `anchor`.

    `bodies` are indices of bodies, in order; with an anchor the chain starts there.
    """

    bodies: tuple[int, ...] = eqx.field(static=True)
    anchor: Float[Array, " 2"] | None

    def __init__(self, bodies: Sequence[int], anchor=None):
        self.bodies = whole_numbers("chain bodies", bodies)
        require(
            all(a != b for a, b in pairwise(self.bodies)),
            f"a chain joins different bodies; neighbours of {self.bodies} were the same.",
        )
        self.anchor = None if anchor is None else as_floats(anchor)
        require(
            self.anchor is None or self.anchor.shape == (2,),
            "anchor must be a point of 2 numbers, or None; it was of another shape.",
        )
        if anchor is not None:
            require_values("anchor", anchor, np.isfinite, "finite coordinates in m")

    def windows(self, length: int) -> Int[np.ndarray, "c length"]:
        """All runs of `length` neighbours; -1 is the anchor."""
        row = np.array(self.bodies if self.anchor is None else (-1, *self.bodies))
        require(
            len(row) >= length,
            f"the chain must have at least {length} points, its anchor included; it had {len(row)}.",
        )
        return np.lib.stride_tricks.sliding_window_view(row, length)

    def bodies_of(self, length: int) -> tuple[tuple[int, ...], ...]:
        """The bodies of each run of `length` neighbours."""
        return tuple(tuple(int(b) for b in run if b >= 0) for run in self.windows(length))

    def candidates(self, x: Float[Array, "n 2"], table, length: int, gap: Callable) -> Candidates:
        """Gaps of all runs of `length` neighbours, and their rows by automatic differentiation of `gap`."""
        runs = self.windows(length)
        fixed = runs < 0
        stencil = np.array(table.center)[np.where(fixed, self.bodies[0], runs)]
        places = x[stencil]
        if self.anchor is not None:
            places = jnp.where(fixed[..., None], self.anchor.astype(x.dtype), places)
        value, gradient = jax.vmap(jax.value_and_grad(gap))(places)
        normal = jnp.asarray(jnp.where(fixed[..., None], 0, gradient))
        tangent = jnp.stack([-normal[..., 1], normal[..., 0]], axis=-1)
        return Candidates(value, stencil, jnp.stack([normal, tangent], axis=1))


class BendLimit(Contact):
    """Neighbouring segments of a chain may differ in angle by at most `limit`; gaps in rad, velocities in rad/s.

    **Arguments:** `bodies`, the chain of point masses; `limit` (rad), in (0, pi]; `anchor` (2,), a fixed point that
    the chain hangs from (m), or `None`; `property`, index into the system's `friction` and `restitution`: one for all,
    or one for each bend.
    """

    chain: Chain
    limit: Float[Array, ""]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, bodies: Sequence[int], limit, anchor=None, property: int | Sequence[int] = 0):
        self.chain, self.limit = Chain(bodies, anchor), as_floats(limit)
        require_values("limit", limit, lambda a: (a > 0) & (a <= np.pi), "an angle in (0, pi] rad")
        self.property_index = property_indices("BendLimit", property, len(self.chain.windows(3)))

    def candidates(self, x, radii, table):
        return self.chain.candidates(x, table, 3, lambda places: bend_gap(places, self.limit.astype(x.dtype)))

    def reach(self, radii):
        return jnp.full(len(self.property_index), jnp.inf, radii.dtype)

    def travel(self, radii):
        return jnp.full(len(self.property_index), 0.5, radii.dtype)  # rad

    def bodies_of(self):
        return self.chain.bodies_of(3)

    def names(self):
        return tuple(f"bend at {run[1]}" for run in self.chain.windows(3))

    def dimension(self):
        return 2


class StretchLimit(Contact):
    """The segments of a chain stay between two lengths; gaps in m.

    **Arguments:** `bodies`, the chain of point masses; `shortest`, `longest` (m), 0 < shortest < longest; `anchor`
    (2,), a fixed point that the chain hangs from (m), or `None`; `property`, index into the system's `friction` and
    `restitution`: one for all, or one for each segment.
    """

    chain: Chain
    shortest: Float[Array, ""]
    longest: Float[Array, ""]
    property_index: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, bodies: Sequence[int], shortest, longest, anchor=None, property: int | Sequence[int] = 0):
        self.chain, self.shortest, self.longest = Chain(bodies, anchor), as_floats(shortest), as_floats(longest)
        require_values("shortest", shortest, positive, "a positive number of metres")
        require_values("longest", longest, lambda most, least: most > least, "longer than shortest", shortest)
        self.property_index = property_indices("StretchLimit", property, len(self.chain.windows(2)))

    def candidates(self, x, radii, table):
        limits = self.shortest.astype(x.dtype), self.longest.astype(x.dtype)
        return self.chain.candidates(x, table, 2, lambda places: stretch_gap(places, *limits))

    def reach(self, radii):
        return jnp.full(len(self.property_index), jnp.inf, radii.dtype)

    def travel(self, radii):
        half = ((self.longest - self.shortest) / 2).astype(radii.dtype)
        return jnp.broadcast_to(half, (len(self.property_index),))

    def bodies_of(self):
        return self.chain.bodies_of(2)

    def names(self):
        return tuple(f"stretch to {run[1]}" for run in self.chain.windows(2))

    def dimension(self):
        return 2
