"""Undoing penetration by moving positions: how far each contact pushes. Arrays only."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SWEEPS = 32


def pushes(normal: Float[Array, "K K"], wanted: Float[Array, " K"]) -> Float[Array, " K"]:
    """Pushes `p >= 0` (kg m) along the normals, by which gaps grow by at least `wanted` (m), as far as they were found.

    `0 <= p` perpendicular to `A_nn p - wanted >= 0`: of all displacements that open the gaps so far, the least in the
    metric of the mass, with the normal rows of the Delassus matrix `A_nn` (1/kg). Each contact is scaled by its own
    mobility, so that no unit enters (gaps of bends are in rad, and pushes in kg m^2). Jacobi sweeps, by the sums of
    rows, know no order of the contacts and leave what is not found yet to the next step; contacts that do not act on
    each other do not meet.
    """
    own = jnp.diagonal(normal)
    size = jnp.where(own > 0, jax.lax.rsqrt(jnp.asarray(jnp.where(own > 0, own, 1))), 0)
    scaled = size[:, None] * normal * size
    stiff = jnp.maximum(jnp.sum(jnp.abs(scaled), axis=1), 1)

    def sweep(p, _):
        return jnp.maximum(p + (size * wanted - scaled @ p) / stiff, 0), None

    return size * jax.lax.scan(sweep, jnp.zeros_like(wanted), length=_SWEEPS)[0]
