"""The named systems: that each can be built and sampled, and numbers of the paper."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import carom
from carom.tasks import TASKS, find_task
from carom.tasks.gyroscopes import euler_motion

SMALL = sorted(set(TASKS) - {"rope-50", "rope-100", "rope-200"})


@pytest.mark.parametrize("name", SMALL)
def test_samples_are_free_of_contact_and_obey_the_constraints(name):
    system = carom.task(name)
    x, v = carom.sample(system, jax.random.key(0), 6)
    assert x.shape == v.shape == (6, system.n_points, system.dim)
    assert np.isfinite(x).all()
    assert np.isfinite(v).all()
    gaps = np.asarray(system.gaps(x))
    assert (gaps >= (-1e-15 if name == "billiards" else 0)).all()  # billiards: balls of the rack touch
    if system.links:
        assert np.abs(system.constraints(x)).max() < 1e-12
        rates = jax.vmap(lambda x, v: jax.jvp(system.constraints, (x,), (v,))[1])(x, v)
        assert np.abs(rates).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "candidates", "points"),
    [("bp5", 30, 5), ("bd5", 30, 15), ("gyro", 1, 4), ("rope", 19, 10), ("rope-200", 399, 200), ("billiards", 55, 11)],
)
def test_sizes(name, candidates, points):
    system = carom.task(name)
    assert (system.n_candidates, system.n_points) == (candidates, points)


def test_bd5_properties_belong_to_their_pairs():
    system = carom.task("bd5")
    names = [n for contact in system.contacts for n in contact.names()]
    friction = dict(zip(names[:10], system.friction[:10].tolist(), strict=True))
    restitution = dict(zip(names[:10], system.restitution[:10].tolist(), strict=True))
    assert (friction["0-1"], friction["1-2"], friction["2-4"], friction["3-4"]) == (0.3, 1.4, 0.2, 0.6)
    assert (restitution["0-1"], restitution["1-4"], restitution["3-4"]) == (0.2, 1.0, 0.0)
    assert set(system.friction[10:].tolist()) == {0.1}


def test_euler_angles_give_rotation_and_its_rate():
    rng = np.random.default_rng(2)
    angles, rates = jnp.asarray(rng.uniform(-2, 2, (4, 3))), jnp.asarray(rng.normal(size=(4, 3)))
    rotation, omega = euler_motion(angles, rates)
    _, change = jax.jvp(lambda a: euler_motion(a, rates)[0], (angles,), (rates,))
    spin = jax.vmap(lambda R, w: jnp.stack([jnp.cross(w, R[:, i]) for i in range(3)], axis=1))(rotation, omega)
    np.testing.assert_allclose(change, spin, atol=1e-12)
    np.testing.assert_allclose(rotation @ rotation.mT, np.broadcast_to(np.eye(3), (4, 3, 3)), atol=1e-12)


def test_the_gyroscope_precesses_as_a_fast_top():
    """`Omega = m g l / (I_3 spin)`, to first order in its smallness, for a fast top let go with that rate."""
    task = find_task("gyro")
    m, arm = task.mass, task.arm
    inertia = m * (task.moments_per_mass[0] + task.moments_per_mass[1])
    spin = 400.0
    rate = m * 9.81 * arm / (inertia * spin)
    rotation, omega = euler_motion(jnp.array([0.0, 1.0, 0.0]), jnp.array([rate, 0.0, spin]))
    from carom.mechanics.bodies import embed_pose, embed_velocity

    center = arm * rotation[:, 2]
    x0, v0 = embed_pose(center, rotation), embed_velocity(rotation, jnp.cross(omega, center), omega)
    system = carom.task("gyro")
    free = carom.System(system.bodies, system.links[:1], (), system.potential)
    out = carom.simulate(free, x0, v0, dt=2e-4, steps=500)
    heading = np.unwrap(np.arctan2(out.x[:, 0, 1], out.x[:, 0, 0]))
    measured = (heading[-1] - heading[0]) / 0.1
    # The formula leaves out terms of the relative size (I_1 / I_3) Omega cos(theta) / spin, here 1e-4.
    assert measured == pytest.approx(rate, rel=1e-3)


def test_a_disk_rolls_down_an_incline():
    """Rolling without slipping: `a = 2/3 g sin(alpha)` for a uniform disk."""
    alpha, radius = 0.3, 0.1
    disk = carom.RigidBody(1.0, (radius**2 / 4,) * 2, radius)
    system = carom.System(
        bodies=[disk],
        contacts=[carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0))],
        potential=carom.Gravity((9.81 * np.sin(alpha), -9.81 * np.cos(alpha))),
        friction=0.6,
    )
    x0 = jnp.array([[0.0, radius], [1.0, radius], [0.0, 1 + radius]])
    out = carom.simulate(system, x0, jnp.zeros((3, 2)), dt=1e-3, steps=500)
    expected = 9.81 * np.sin(alpha) / 3 * 0.5**2
    # The step rule lets contact act once a step of 1e-3 s in 0.5 s; and the rest is rolling.
    assert float(out.x[-1, 0, 0]) == pytest.approx(expected, rel=5e-3)
    velocity, spin = out.v[-1, 0, 0], (out.v[-1, 1] - out.v[-1, 0]) @ jnp.array([0.0, 1.0])
    turned = out.x[-1, 1] - out.x[-1, 0]
    omega = float(spin / turned[0])
    # The disk rests up to 1e-4 m deep in the plane, 1e-3 of its radius, and contact also undoes that: measured 1e-4.
    assert float(velocity) == pytest.approx(-omega * radius, rel=1e-3)
