"""What an instrument makes of a motion: a bias, a scale and a lag, which may be unknown.

A channel that is late by `lag` shows at time t what was there at t - lag. From the state at t that is, to second order,
`x - v lag + a lag^2 / 2`: exact for motion under constant forces, where interpolating between samples is not. Across an
impact it does not hold: samples that are less than a lag after one are to be left out.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.checks import require


class Channel(eqx.Module):
    """`recorded = scale * motion(t - lag) + bias`; by default what is recorded is the motion.

    `bias` (d,) in m (or m/s, of velocities), `lag` in s, late if positive, `scale` without unit.
    """

    bias: Float[Array, " d"]
    lag: Float[Array, ""]
    scale: Float[Array, ""]

    @classmethod
    def perfect(cls, dim: int) -> "Channel":
        """Without bias, lag or scale."""
        return cls(jnp.zeros(dim), jnp.zeros(()), jnp.ones(()))


def observe(
    channel: Channel,
    motion: Float[Array, "*t n d"],
    rate: Float[Array, "*t n d"],
    bend: Float[Array, "*t n d"] | None = None,
) -> Float[Array, "*t n d"]:
    """What a channel shows of a motion; derivatives with respect to all are right.

    **Arguments:** `motion`, what it records (positions, say), `rate`, its derivative by time (velocities), and `bend`,
    the derivative of that, none by default: all at the times of the samples.
    """
    late = motion - rate * channel.lag
    if bend is not None:
        late = late + bend * channel.lag**2 / 2
    return channel.scale * late + channel.bias


def fit_channel(
    recorded: Float[np.ndarray, "*t n d"],
    motion: Float[np.ndarray, "*t n d"],
    rate: Float[np.ndarray, "*t n d"],
    kept: Bool[np.ndarray, "*t n"] | None = None,
) -> tuple[Channel, Channel, float]:
    """The channel that fits best a motion that is known otherwise, its standard errors, and the noise that is left.

    By least squares: the parameters enter linearly, as scale, scale times lag, and bias.

    **Arguments:** `recorded`, NaN where nothing was; `motion` and `rate` as of `observe`; `kept`, what to look at.

    **Raises:** `CaromError` if the motion tells no scale and lag: it must change, and not as one with its rate.
    """
    good = np.isfinite(recorded).all(axis=-1) & np.isfinite(motion).all(axis=-1) & np.isfinite(rate).all(axis=-1)
    good = good if kept is None else good & kept
    dim = recorded.shape[-1]
    y, x, v = (part[good] for part in (recorded, motion, rate))
    require(len(y) >= 3, f"at least 3 samples must be there to fit a channel; there were {len(y)}.")
    columns = np.concatenate([x[..., None], -v[..., None], np.broadcast_to(np.eye(dim), (len(x), dim, dim))], axis=2)
    columns = columns.reshape(-1, 2 + dim)
    size = np.linalg.norm(columns, axis=0)
    size = np.where(size > 0, size, 1.0)
    solution, _, rank, _ = np.linalg.lstsq(columns / size, y.reshape(-1), rcond=1e-10)
    require(rank == 2 + dim, "the motion must change in position and rate to tell scale and lag; it did not.")
    scale, product, *bias = solution / size
    left = y.reshape(-1) - (columns / size) @ solution
    noise = float(np.sqrt(np.sum(left**2) / max(len(left) - 2 - dim, 1)))
    spread = noise**2 * np.linalg.inv((columns / size).T @ (columns / size)) / np.outer(size, size)
    turn = np.array([-product / scale**2, 1 / scale])  # of lag = product / scale
    lag_error = np.sqrt(turn @ spread[:2, :2] @ turn)
    error = np.sqrt(np.diag(spread))
    return (
        Channel(jnp.asarray(np.array(bias)), jnp.asarray(product / scale), jnp.asarray(scale)),
        Channel(jnp.asarray(error[2:]), jnp.asarray(lag_error), jnp.asarray(error[0])),
        noise,
    )
