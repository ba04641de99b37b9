"""Bias, scale and lag of an instrument: what it shows of a motion in closed form, and found again."""

import jax
import jax.numpy as jnp
import numpy as np
from systems import refused

from carom.recordings.channels import Channel, fit_channel, observe

TIME = np.linspace(0, 2, 200)


def fallen(time) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A point that is thrown up: (T, 1, 2) positions, velocities, accelerations."""
    time = np.asarray(time, float)
    one = np.ones_like(time)
    parts = ([2 * time, 3 * time - 5 * time**2], [2 * one, 3 - 10 * time], [0 * one, -10 * one])
    x, v, a = (np.stack(part, axis=-1)[:, None] for part in parts)
    return x, v, a


def test_what_is_late_is_what_was_there_before():
    x, v, a = (jnp.asarray(part) for part in fallen(TIME))
    channel = Channel(jnp.array([0.1, -0.2]), jnp.asarray(0.02), jnp.asarray(1.05))
    # Exact under a constant force.
    before = 1.05 * fallen(TIME - 0.02)[0] + [0.1, -0.2]
    np.testing.assert_allclose(observe(channel, x, v, a), before, atol=1e-14)
    np.testing.assert_allclose(observe(channel, v, a), 1.05 * fallen(TIME - 0.02)[1] + [0.1, -0.2], atol=1e-14)
    np.testing.assert_array_equal(observe(Channel.perfect(2), x, v), x)
    slope = jax.grad(lambda lag: jnp.sum(observe(Channel(channel.bias, lag, channel.scale), x, v, a)))(channel.lag)
    np.testing.assert_allclose(slope, -1.05 * fallen(TIME - 0.02)[1].sum(), rtol=1e-12)


def swing(time) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Velocities and accelerations along two axes, at 4 and 5 rad/s."""
    return [np.cos(4 * time), np.sin(5 * time)], [-4 * np.sin(4 * time), 5 * np.cos(5 * time)]


def test_a_channel_is_found_again_within_its_errors():
    rng = np.random.default_rng(0)
    # A pendulum's velocity and acceleration; under a constant force alone a lag looks like a bias.
    v, a = (np.stack(part, axis=-1)[:, None] for part in swing(TIME))
    late = np.stack(swing(TIME - 0.004)[0], axis=-1)[:, None]
    off = []
    for _ in range(100):
        recorded = 0.97 * late + [0.05, 0.0] + 0.02 * rng.normal(size=v.shape)
        recorded[::7] = np.nan
        found, error, noise = fit_channel(recorded, v, a)
        bias = (found.bias - jnp.array([0.05, 0])) / error.bias
        off.append([(found.lag - 0.004) / error.lag, (found.scale - 0.97) / error.scale, *bias])
        assert 0.015 < noise < 0.025
    # 100 values each: standard deviations within 4 of their own standard errors, 0.07.
    assert np.all(np.abs(np.std(off, axis=0) - 1) < 0.28)
    assert np.all(np.abs(np.mean(off, axis=0)) < 0.4)


def test_what_does_not_change_tells_no_channel():
    x = np.zeros((5, 1, 2))
    with refused("the motion must change"):
        fit_channel(x, x, x)
    with refused("the motion must change"):
        fit_channel(*fallen(TIME)[1:2], *fallen(TIME)[1:])
    with refused("at least 3 samples"):
        fit_channel(x[:2], x[:2], x[:2])
