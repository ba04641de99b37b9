"""Simulation with contact: recorded references, closed forms, conserved quantities, bad input."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor, refused

import carom


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "bounds"),
    [
        # The promises for bp5-e and cp3 are 1e-6 (98 %) and 1e-5 (99.5 %); measured 1e-10 and 4e-10.
        pytest.param("bp5-e", {0.98: 1e-8, 0.995: 1e-7}, marks=pytest.mark.ci_budget),
        pytest.param("cp3", {0.98: 1e-8, 0.995: 1e-7}, marks=pytest.mark.ci_budget),
        ("gyro-e", {0.98: 1e-5, 0.995: 1e-4}),
        ("rope", {0.5: 1e-8, 0.95: 1e-4}),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_one_step_from_every_recorded_state(task, bounds, reference_dir):
    data = carom.load_recording(reference_dir / "reference" / f"{task}_trajectories.npz")
    shape = (-1, *data.x.shape[2:])
    start = (jnp.asarray(a[:, :-1].reshape(shape)) for a in (data.x, data.v))
    out = carom.simulate(carom.task(task), *start, dt=data.dt, steps=1, project=False)
    errors = np.maximum(
        *(np.abs(a[:, 1] - b[:, 1:].reshape(shape)).max((1, 2)) for a, b in ((out.x, data.x), (out.v, data.v)))
    )
    assert np.array_equal(out.contact[:, 1], data.contact[:, 1:].reshape(-1))
    for share, bound in bounds.items():
        assert np.quantile(errors, share) < bound


def test_a_bouncing_ball_rises_to_e_squared_of_its_height():
    """The step rule acts up to one step late, so that heights are off by a multiple of speed times dt."""
    e, dt = 0.8, 2e-4
    out = carom.simulate(
        ball_on_floor(restitution=e),
        jnp.array([[0.0, 1.1]]),
        jnp.zeros((1, 2)),
        dt=dt,
        steps=12000,
        compensation_steps=None,
    )
    height = np.asarray(out.x[:, 0, 1]) - 0.1
    bounces = np.flatnonzero(np.asarray(out.contact))[:3]
    peaks = [height[a:b].max() for a, b in zip(bounces, [*bounces[1:], len(height)], strict=True)]
    # Speed at the floor is 4.4 m/s: up to 1e-3 m late at each bounce.
    assert np.allclose(peaks, [e**2, e**4, e**6], atol=3e-3)


@pytest.mark.parametrize(("slope", "sticks"), [(0.3, True), (3.0, False)])
def test_oblique_impact_of_a_point(slope, sticks):
    """The closed form of S.14 and S.15 for `A = 1`: sticks where `slip <= mu approach`, else slides with

    `f_n = (approach + mu slip) / (1 + mu^2)`, `f_t = -mu f_n` in compression and e times both in restitution (Poisson).
    """
    mu, e = 0.5, 0.6
    system = ball_on_floor(friction=mu, restitution=e, gravity=0.0)
    out = carom.simulate(
        system, jnp.array([[0.0, 0.1]]), jnp.array([[slope, -1.0]]), dt=1e-3, steps=1, compensation_steps=None
    )
    normal = 1.0 if sticks else (1 + mu * slope) / (1 + mu**2)
    tangential = 0.0 if sticks else slope - mu * (1 + e) * normal
    assert np.allclose(out.v[1, 0], [tangential, (1 + e) * normal - 1], atol=1e-8)


def test_two_equal_balls_exchange_velocities_and_momentum_is_kept():
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.1), carom.PointMass(1.0, 0.1)],
        contacts=[carom.DiskDisk([(0, 1)])],
        restitution=1.0,
    )
    x0, v0 = jnp.array([[0.0, 0.0], [0.201, 0.0]]), jnp.array([[1.0, 0.0], [0.0, 0.0]])
    out = carom.simulate(system, x0, v0, dt=0.01, steps=1, compensation_steps=None)
    assert np.allclose(out.v[1], [[0, 0], [1, 0]], atol=1e-9)
    assert np.allclose(out.v[1].sum(0), v0.sum(0), atol=1e-12)


def test_a_block_slides_to_rest():
    """Stopping distance `v^2 / (2 mu g)`.

    In this model a sliding contact separates at `mu` times the slip, so that the block hops; the hops add up to the
    distance of Coulomb's law exactly (docs/contact.md).
    """
    mu, speed = 0.4, 2.0
    out = carom.simulate(
        ball_on_floor(friction=mu), jnp.array([[0.0, 0.1]]), jnp.array([[speed, 0.0]]), dt=1e-3, steps=1000
    )
    expected = speed**2 / (2 * mu * 9.81)
    assert float(out.x[-1, 0, 0]) == pytest.approx(expected, rel=1e-3)  # a hop may end a step of 1e-3 s of 0.5 s late
    assert float(out.v[-1, 0, 0]) == pytest.approx(0, abs=1e-12)
    assert float(out.x[-1, 0, 1]) == pytest.approx(0.1, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("task", ["bp5-e", pytest.param("cp3-e", marks=pytest.mark.ci_budget)])
def test_elastic_impacts_keep_energy(task):
    """Measured at the impacts: the kinetic energy of the state that the step ends in, with and without its contacts."""
    system = carom.task(task)
    x0, v0 = carom.sample(system, jax.random.key(0), 40)
    out = carom.simulate(system, x0, v0, dt=0.01, steps=100, compensation_steps=None)
    before = jax.tree.map(lambda a: a[:, :-1].reshape(-1, *a.shape[2:]), (out.x, out.v))
    free = carom.System(system.bodies, system.links, (), system.potential)
    without = carom.simulate(free, *before, dt=0.01, steps=1)
    kinetic = jax.vmap(system.kinetic_energy)
    old, new = kinetic(without.v[:, 1]), kinetic(out.v[:, 1:].reshape(without.v[:, 1].shape))
    closed = np.sum(np.asarray(system.gaps(without.x[:, 1])) < 0, axis=-1)
    gain = np.asarray(new / old - 1)
    assert (closed == 1).sum() > 20
    assert np.max(np.abs(gain[closed == 1])) < 1e-9
    # Of several contacts at once, one that only the rebound of the others closes is stopped, not reflected: some energy
    # goes. None comes.
    assert np.max(gain) < 1e-9


@pytest.mark.slow
def test_constraints_hold_after_ten_thousand_steps():
    system = carom.task("cp3")
    x0, v0 = carom.sample(system, jax.random.key(2), 1)
    out = carom.simulate(system, x0[0], v0[0], dt=0.01, steps=10_000)
    assert float(jnp.max(jnp.abs(system.constraints(out.x)))) < 1e-8


@pytest.mark.slow
@pytest.mark.ci_budget
def test_lagrangian_and_hamiltonian_move_alike():
    system = carom.task("cp3")
    x0, v0 = carom.sample(system, jax.random.key(4), 4)
    one, two = (
        carom.simulate(system, x0, v0, dt=0.01, steps=20, formulation=name) for name in ("lagrangian", "hamiltonian")
    )
    # They differ off the constraints only, within a step: by the order of the integrator.
    assert np.abs(one.x - two.x).max() < 1e-4
    fine = [
        carom.simulate(system, x0, v0, dt=0.001, steps=20, formulation=name) for name in ("lagrangian", "hamiltonian")
    ]
    assert np.abs(fine[0].x - fine[1].x).max() < 1e-9


def test_a_start_that_cannot_be_is_refused():
    system = carom.task("cp3")
    x0, v0 = carom.sample(system, jax.random.key(0), 2)
    options = {"dt": 0.01, "steps": 2}
    with refused("x0 must have the shape (3, 2)"):
        carom.simulate(system, x0[:, :2], v0[:, :2], **options)
    with refused("v0 must have the shape of x0"):
        carom.simulate(system, x0, v0[0], **options)
    with refused("x0 must be finite"):
        carom.simulate(system, x0.at[1, 0, 0].set(jnp.nan), v0, **options)
    with refused("x0 does not obey the constraints"):
        carom.simulate(system, x0 + 0.2, v0, **options)
    with refused("body 0 is inside a wall"):
        carom.simulate(ball_on_floor(), jnp.array([[0.0, -0.3]]), jnp.zeros((1, 2)), **options)
    with refused("dt must be a positive number of seconds; it was 0"):
        carom.simulate(system, x0, v0, dt=0, steps=2)
    with refused("force must have the shape"):
        carom.simulate(system, x0, v0, force=jnp.zeros((3, 3, 2)), **options)


def test_more_contacts_than_places_are_an_error():
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.1), carom.PointMass(1.0, 0.1)],
        contacts=[carom.DiskPlane([0, 1], (0.0, 0.0), (0.0, 1.0))],
        max_active=1,
    )
    x0, v0 = jnp.array([[0.0, 0.1], [1.0, 0.1]]), -jnp.ones((2, 2))
    with refused("max_active is 1, 2 were needed"):
        carom.simulate(system, x0, v0, dt=0.01, steps=1)
    silent = carom.simulate(system, x0, v0, dt=0.01, steps=1, throw=False)
    assert silent.overflow.tolist() == [0, 1]


@pytest.mark.parametrize("narrow", ["system", "x0", "v0", "force"])
def test_mixed_precision_is_computed_in_the_widest(narrow):
    """As if the narrow part had been given in double precision; all numbers are exact in single."""
    given = {"system": ball_on_floor(radius=0.125, gravity=8.0), "x0": jnp.array([[0.0, 0.5]])}
    given |= {"v0": jnp.array([[1.0, -0.5]]), "force": jnp.ones((2, 1, 2))}
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if eqx.is_array(a) else a, given[narrow])
    out = carom.simulate(**given | {narrow: single}, dt=0.01, steps=2)
    assert out.x.dtype == out.residual.dtype == jnp.float64
    assert np.array_equal(out.x, carom.simulate(**given, dt=0.01, steps=2).x)


@pytest.mark.parametrize(
    "solver", [diffrax.SemiImplicitEuler(), diffrax.Kvaerno3(), diffrax.LeapfrogMidpoint(), diffrax.ReversibleHeun()]
)
def test_other_solvers_than_explicit_runge_kutta_methods_are_refused(solver):
    with refused("solver must be an explicit Runge-Kutta method of diffrax, such as diffrax.Tsit5(), or carom.RK4()"):
        carom.simulate(ball_on_floor(), jnp.ones((1, 2)), jnp.ones((1, 2)), dt=0.01, steps=1, solver=solver)


def test_shapes_of_numbers_are_checked():
    state = jnp.ones((1, 2)), jnp.ones((1, 2))
    with refused("dt must be one number of seconds; its shape was (1,)"):
        carom.simulate(ball_on_floor(), *state, dt=jnp.array([0.01]), steps=1)
    with refused("compensation_steps must be one number; its shape was (2,)"):
        carom.simulate(ball_on_floor(), *state, dt=0.01, steps=1, compensation_steps=jnp.ones(2))


@pytest.mark.parametrize("impact", ["step", "event"])
def test_an_empty_batch_gives_no_trajectory(impact):
    out = carom.simulate(ball_on_floor(), jnp.ones((0, 1, 2)), jnp.ones((0, 1, 2)), dt=0.5, steps=2, impact=impact)
    assert out.x.shape == out.v.shape == (0, 3, 1, 2)
    assert out.residual.shape == out.contact.shape == out.overflow.shape == (0, 3)
    assert np.array_equal(out.time, [0, 0.5, 1])


def test_the_residual_of_what_is_not_finite_is_not_finite():
    """Also under jit, where a start cannot be refused; other members of the batch are what they are."""
    x0 = jnp.array([[[0.0, 0.5]], [[jnp.nan, 0.5]]])
    out = jax.jit(lambda x: carom.simulate(ball_on_floor(), x, jnp.zeros((2, 1, 2)), dt=0.01, steps=2))(x0)
    assert np.array_equal(np.isfinite(out.residual), [[True] * 3, [False] * 3])


def test_a_constant_force_accelerates():
    """`x = F t^2 / (2 m)`; the force is held over each step."""
    system = carom.System(bodies=[carom.PointMass(2.0)], dim=2)
    force = jnp.tile(jnp.array([[[3.0, 0.0]]]), (50, 1, 1))
    out = carom.simulate(system, jnp.zeros((1, 2)), jnp.zeros((1, 2)), dt=0.01, steps=50, force=force)
    assert np.allclose(out.x[-1], [[3.0 / 4 * 0.25, 0]], atol=1e-12)
