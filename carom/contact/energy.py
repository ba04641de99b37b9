"""What an impact does to the energy, and that it never adds any; which contacts belong together."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.contact.impulses import ContactState, Jump

_ROUNDING = 1e-12
"""A gain below this share of the energies that are exchanged is rounding."""


def islands(delassus: Float[Array, "r r"], d: int) -> Bool[Array, "K K"]:
    """Which contacts belong together: they act on each other, or on others that do."""
    k = delassus.shape[0] // d
    reach = jnp.any(delassus.reshape(k, d, k, d) != 0, axis=(1, 3)) | jnp.eye(k, dtype=bool)
    for _ in range(int(np.ceil(np.log2(max(k, 2))))):
        reach = (reach.astype(delassus.dtype) @ reach.astype(delassus.dtype)) > 0
    return reach


def work(contacts: ContactState, impulse: Float[Array, "K d"], velocity: Float[Array, "K d"]) -> Float[Array, " K"]:
    """Work (J) of each contact's impulse, that meets the contacts' `velocity` (m/s): `f (v + A f / 2)`."""
    change = (contacts.delassus @ impulse.reshape(-1)).reshape(impulse.shape)
    return jnp.sum(impulse * (velocity + change / 2), axis=1)


def dissipative(contacts: ContactState, jump: Jump) -> Jump:
    """The same jump, or one whose rebound is less, so that no island of contacts has more energy than before.

    Poisson's hypothesis gives back a share of each contact's impulse. For one contact that is a share of the energy.
    Contacts that act on each other with unlike shares, or that slide, may get more energy back than compression took.
    Of the way from the velocities after compression, which have less, to those after the rebound, it then goes the part
    that keeps the energy: velocities of two states between which no contact closes, impulses in their cones.

    A jump of one phase (Newton's restitution) stays as it is; a gain is in its residual, relative to the energy that
    its impulses exchange.
    """
    if jump.impulse is None:
        return jump
    together = islands(contacts.delassus, contacts.velocity.shape[1]).astype(contacts.delassus.dtype)
    first = work(contacts, jump.impulse[0], contacts.velocity)
    if jump.impulse.shape[0] == 1:
        exchanged = jnp.sum(jnp.abs(jump.impulse[0] * contacts.velocity), axis=1)
        gain, most = together @ first, together @ exchanged
        gained = jnp.max(jnp.where(gain > 1e-9 * most, gain / jnp.where(most > 0, most, 1), 0), initial=0)
        return jump._replace(residual=jnp.maximum(jump.residual, gained))
    compression, rebound = jump.impulse
    after = contacts.velocity + (contacts.delassus @ compression.reshape(-1)).reshape(compression.shape)
    linear = together @ jnp.sum(rebound * after, axis=1)
    square = together @ work(contacts, rebound, jnp.zeros_like(after))
    lost = jnp.maximum(-(together @ first), 0)
    gains = linear + square > lost * (1 + _ROUNDING) + _ROUNDING * square
    root = jnp.sqrt(jnp.where(gains, linear**2 + 4 * square * lost, 1))
    # The positive root of square s^2 + linear s = lost, without cancellation.
    above = jnp.where(linear > 0, 2 * lost, root - linear)
    below = jnp.where(linear > 0, linear + root, 2 * square)
    part = above / jnp.where(gains, below, 1)
    share = jnp.where(gains, jnp.clip(part, 0, 1), 1)
    rebound = share[:, None] * rebound
    velocity = jnp.einsum("rid,r->id", contacts.response, (compression + rebound).reshape(-1))
    return jump._replace(velocity=velocity, impulse=jnp.stack([compression, rebound]))
