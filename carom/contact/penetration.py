"""Undoing penetration by moving positions: how far each contact pushes. Arrays only."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_SWEEPS = 32


def pushes(normal: Float[Array, "K K"], wanted: Float[Array, " K"]) -> Float[Array, " K"]:
    """Pushes `p >= 0` (kg m) along the normals, by which gaps grow by at least `wanted` (m), as far as they were found.

    `0 <= p` perpendicular to `A_nn p - wanted >= 0`: of all displacements that open the gaps so far, the least in the
    metric of the mass, with the normal rows of the Delassus matrix `A_nn` (1/kg). Jacobi sweeps, scaled by the sums of
    rows, which know no order of the contacts and leave what is not found yet to the next step; contacts that do not act
    on each other do not meet, and no unit enters.
    """
    total = jnp.sum(jnp.abs(normal), axis=1)
    stiff = jnp.where(total > 0, total, 1)
    wanted = jnp.where(total > 0, wanted, 0)

    def sweep(p, _):
        return jnp.maximum(p + (wanted - normal @ p) / stiff, 0), None

    return jax.lax.scan(sweep, jnp.zeros_like(wanted), length=_SWEEPS)[0]
