"""Bend and stretch limits, and rims: gaps by hand, rows against differences, what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.contact.geometry import deepest_direction, wrap_angle
from carom.tasks.pendulums import chain_state

ROUNDING = 1e-12  # of a few operations on numbers of order 1


def hanging(angles, lengths, **options):
    """A chain of points hung from the origin with both limits, and the points at these angles."""
    n = len(angles)
    system = carom.System(
        bodies=[carom.PointMass(1.0)] * n,
        contacts=[
            carom.BendLimit(range(n), 0.3, anchor=(0.0, 0.0), **options),
            carom.StretchLimit(range(n), 0.8, 1.2, anchor=(0.0, 0.0), **options),
        ],
    )
    x, _ = chain_state(jnp.asarray(angles), jnp.zeros(n), jnp.asarray(lengths))
    return system, x


def test_gaps_by_hand():
    system, x = hanging([0.1, 0.5, -0.2], [1.0, 1.15, 0.7])
    np.testing.assert_allclose(system.gaps(x), [0.3 - 0.4, 0.3 - 0.7, 0.2, 0.05, -0.1], atol=ROUNDING)


def test_bends_do_not_see_where_angles_jump():
    """Two segments on either side of the upward vertical, where the angle changes by a full turn."""
    system, x = hanging([np.pi - 0.1, -np.pi + 0.1], [1.0, 1.0])
    np.testing.assert_allclose(system.gaps(x)[0], 0.3 - 0.2, atol=ROUNDING)
    np.testing.assert_allclose(
        wrap_angle(jnp.array([np.pi, -np.pi, 3 * np.pi, 0.5 - 4 * np.pi])), [np.pi, np.pi, np.pi, 0.5]
    )


def test_rows_are_the_gradient_of_the_gap_and_the_same_turned():
    system, x = hanging([0.3, 0.9, 0.4, 1.1], [0.7, 1.25, 1.0, 1.3])
    active = system.with_max_active(7).active(x)
    gaps = jax.jacrev(system.gaps)(x)
    closed = np.flatnonzero(system.gaps(x) < 0)  # in their order
    np.testing.assert_array_equal(active.candidate[active.active], closed)
    for k, candidate in enumerate(closed.tolist()):
        gradient = gaps[candidate]
        np.testing.assert_allclose(active.jacobian[k, 0], gradient, atol=ROUNDING)
        turned = jnp.stack([-gradient[:, 1], gradient[:, 0]], axis=1)
        np.testing.assert_allclose(active.jacobian[k, 1], turned, atol=ROUNDING)
    assert int(active.active.sum()) == int((system.gaps(x) < 0).sum()) == int(active.closed.sum()) > 3


def test_a_limit_stops_the_motion_that_violates_it():
    """One point on a string of length 1 that flies outward at its longest: it stops, along the string alone."""
    system = carom.System(
        bodies=[carom.PointMass(1.0)], contacts=[carom.StretchLimit([0], 0.8, 1.2, anchor=(0.0, 0.0))]
    )
    out = carom.simulate(
        system, jnp.array([[1.2, 0.0]]), jnp.array([[1.0, 0.5]]), dt=1e-3, steps=1, compensation_steps=None
    )
    x, v = out.x[1, 0], out.v[1, 0]
    assert float(x @ v) == pytest.approx(0, abs=1e-9)
    assert float(v[0] * -x[1] + v[1] * x[0]) == pytest.approx(float(0.5 * x[0] - x[1]), abs=1e-9)  # spin is kept


@pytest.mark.parametrize("tilt", [0.3, 1.2, -2.0])
def test_the_exact_rim_is_the_limit_of_many_points(tilt):
    rotation = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    center = jnp.array([0.1, 0.2, 0.3])
    x = jnp.concatenate([center[None], center + jnp.asarray(rotation.T)])
    body = carom.RigidBody(1.0, (0.1, 0.1, 0.1), 0.25)

    def gap(angles):
        wall = carom.RimPlane([0], (0.0, -0.1, 0.0), (0.0, 2.0, 0.0), angles=angles)
        return carom.System(bodies=[body], contacts=[wall]).gaps(x)[0]

    expected = 0.3 - 0.25 * abs(np.cos(tilt))
    assert float(gap(None)) == pytest.approx(expected, abs=ROUNDING)
    many = tuple(np.linspace(0, 2 * np.pi, 1001).tolist())
    assert float(gap(many)) == pytest.approx(expected, abs=0.25 * (np.pi / 1000) ** 2)


def test_a_rim_parallel_to_the_plane_is_finite():
    axes = jnp.array([[[1.0, 0, 0], [0, 1.0, 0]]])
    assert not deepest_direction(axes, jnp.array([0.0, 0, 1.0])).any()
    slope = jax.jacobian(lambda a: deepest_direction(a, jnp.array([0.0, 0, 1.0])))(axes)
    assert np.isfinite(slope).all()


def test_bad_limits_are_refused():
    with refused("limit must be an angle in (0, pi] rad; it was -1"):
        carom.BendLimit([0, 1, 2], -1)
    with refused("longest must be longer than shortest; it was 0.5"):
        carom.StretchLimit([0, 1], 0.8, 0.5)
    with refused("the chain must have at least 3 points, its anchor included; it had 2"):
        carom.BendLimit([0, 1], 0.3)
    with refused("RimPlane normal must have 3 numbers; it had 2"):
        carom.RimPlane([0], (0.0, 0.0), (0.0, 1.0))
