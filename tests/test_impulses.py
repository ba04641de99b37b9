"""Compression and restitution: recorded problems, Poisson's hypothesis, target velocities, bad input."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.contact.impulses import consistent_velocity, target_velocity
from carom.contact.phases import two_phases


@pytest.mark.parametrize("task", ["bp5-e", "cp3", "gyro-e", "rope"])
def test_recorded_impulses(task, reference_dir):
    with np.load(reference_dir / "reference" / f"{task}_impulses.npz") as file:
        data = {name: file[name] for name in file.files}
    names = ("A", "v", "friction", "restitution", "v_star")
    found = carom.contact_impulse(*(jnp.asarray(data[n]) for n in names))
    worst = 0.5 if task == "rope" else 1.0  # rope: the reference is good in the median only
    for own, name in zip(found, ("compression", "restitution_impulse"), strict=True):
        change = np.einsum("bij,bj->bi", data["A"], (np.asarray(own) - data[name]).reshape(len(own), -1))
        assert np.quantile(np.abs(change).max(1), worst) < 1e-5


def test_restitution_is_the_ratio_of_the_impulses():
    """Poisson: what comes back along the normal is e times what was compressed, here with all contacts apart."""
    A, v = jnp.eye(6), jnp.array([[-1.0, 0.3], [-2.0, 0.0], [1.0, 0.0]])
    e = jnp.array([0.25, 1.0, 0.5])
    fc, fr = carom.contact_impulse(A, v, jnp.full(3, 0.4), e, jnp.zeros((3, 2)))
    assert np.allclose(fc[:, 0], [1, 2, 0], atol=1e-9)
    assert np.allclose(fr[:, 0], e * fc[:, 0], atol=1e-9)
    assert np.allclose(fc[0, 1], -0.3, atol=1e-9)  # sticks: mu f_n = 0.4


def test_target_velocity_undoes_the_depth_where_nothing_hinders():
    rows = jnp.zeros((2, 2, 3, 2)).at[0, :, 0].set(jnp.eye(2)).at[1, :, 2].set(jnp.eye(2))
    free = target_velocity(rows, jnp.array([0.02, 0.04]), jnp.zeros((0, 3, 2)), time=0.08)
    assert np.allclose(free, [[0.25, 0], [0.5, 0]], atol=1e-8)
    held = jnp.zeros((1, 3, 2)).at[0, 0, 0].set(1.0)  # point 0 cannot move along its normal
    assert np.allclose(target_velocity(rows, jnp.array([0.02, 0.04]), held, time=0.08), [[0, 0], [0.5, 0]], atol=1e-8)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_drift_off_the_joints_does_not_choose_the_impulse():
    """A contact in 3D of a body on a ball joint: two free velocities for three rows, and velocities with some drift."""
    rng = np.random.default_rng(0)
    J = jnp.asarray(np.linalg.qr(rng.normal(size=(16, 3, 3)))[0][:, :, :2])
    u = jnp.asarray(rng.normal(size=(16, 2)))
    J = J.at[:, 0].multiply(-jnp.sign(J[:, :1] @ u[..., None])[..., 0])  # all approach
    friction, restitution, target = jnp.full((16, 1), 0.3), jnp.full((16, 1), 0.8), jnp.zeros((16, 1, 3))
    drift = jnp.asarray(rng.normal(size=(16, 1, 3)))

    @jax.jit
    def rebound(u, size, taken):
        A = jnp.einsum("bri,bsi->brs", J, J)
        off = size * drift
        v = jnp.einsum("bri,bi->br", J, u)[:, None] + off
        v = jnp.where(taken, jax.vmap(consistent_velocity)(v, off, A, friction), v)
        compression, restored = two_phases(A, v, friction, restitution, target)
        return jnp.stack([compression.impulse, restored.impulse])

    exact = rebound(u, 0.0, False)
    assert np.abs(rebound(u, 1e-5, False) - exact).max() > 0.1  # it would choose another
    assert np.abs(rebound(u, 1e-5, True) - exact).max() < 1e-3
    step, towards = 1e-5, jnp.asarray(rng.normal(size=(16, 2)))
    slope = jax.jvp(lambda u: rebound(u, 1e-6, True), (u,), (towards,))[1]
    difference = (rebound(u + step * towards, 0.0, False) - rebound(u - step * towards, 0.0, False)) / (2 * step)
    assert np.abs(slope - difference).max() < 1e-3 * np.abs(difference).max()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("friction", -0.1, "friction must be at least 0; it was"),
        ("restitution", 1.5, "restitution must be between 0 and 1; it was"),
        ("v", np.nan, "v must be finite; it was"),
        ("A", np.inf, "A must be finite; it was"),
    ],
)
def test_bad_values_are_refused_by_name(name, value, message):
    data = {
        "A": np.eye(4),
        "v": -np.ones((2, 2)),
        "friction": np.ones(2),
        "restitution": np.ones(2),
        "v_star": np.zeros((2, 2)),
    }
    data[name] = np.full_like(data[name], value)
    with refused(message):
        carom.contact_impulse(**{k: jnp.asarray(x) for k, x in data.items()})


def test_shapes_that_do_not_fit_are_refused():
    with refused("A must have the shape (4, 4) to go with v (2, 2)"):
        carom.solve_impulse(jnp.eye(6), -jnp.ones((2, 2)), jnp.ones(2), jnp.zeros(2))
    with refused("v must have the shape (..., contacts, d)"):
        carom.solve_impulse(jnp.eye(4), -jnp.ones((1, 4)), jnp.ones(1), jnp.zeros(1))


def test_a_problem_without_a_solution_is_an_error():
    """Two walls that approach a body which cannot yield: no impulse stops them."""
    A = jnp.array([[1.0, -1.0], [-1.0, 1.0]]).repeat(2, 0).repeat(2, 1) * jnp.tile(
        jnp.diag(jnp.array([1.0, 0.0])), (2, 2)
    )
    with refused("the impulse was not found"):
        carom.solve_impulse(A, jnp.array([[-1.0, 0.0], [-1.0, 0.0]]), jnp.zeros(2), jnp.zeros(2))
