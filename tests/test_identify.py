"""What data can tell: bodies whose impacts are known, linear problems with a known answer, coverage by Monte Carlo."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.learning.estimation.identify import identify
from carom.learning.estimation.refine import Fit, choose_steps, polish
from carom.learning.estimation.robust import Blocks, solve
from carom.learning.unknowns.models import NeuralPotential
from carom.learning.unknowns.parameters import unknowns_of
from carom.simulation.impact import Stepper

CONTACT = ("friction", "restitution")


def ball(friction=0.3, restitution=0.6):
    """A ball between a floor (property 0), which it hits, and a ceiling (1), which it never does."""
    return carom.System(
        bodies=[carom.PointMass(1.0, 0.1)],
        contacts=[
            carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0), property=0),
            carom.DiskPlane([0], (0.0, 9.0), (0.0, -1.0), property=1),
        ],
        potential=carom.Gravity((0.0, -9.81)),
        friction=np.array([friction, 0.7]),
        restitution=np.array([restitution, 0.4]),
    )


def throws(system, n, *, along, noise=1e-3, seed=0):
    """`n` throws at the floor of about 1.5 m/s downward and `along` m/s sideways, recorded for 0.12 s."""
    rng = np.random.default_rng(seed)
    x0 = np.stack([rng.uniform(-1, 1, n), rng.uniform(0.12, 0.2, n)], axis=-1)[:, None]
    v0 = np.stack([along * rng.uniform(0.8, 1.2, n), -rng.uniform(1, 2, n)], axis=-1)[:, None]
    motion = carom.simulate(system, jnp.asarray(x0), jnp.asarray(v0), dt=0.01, steps=12)
    x, v = (np.asarray(part) + noise * rng.normal(size=part.shape) for part in (motion.x, motion.v))
    return carom.Recording.of(x, v, dt=0.01)


def started_off(system, by=0.05):
    """The system as a trainer might leave it."""
    return eqx.tree_at(lambda s: (s.friction, s.restitution), system, (system.friction + by, system.restitution - by))


@pytest.mark.slow
def test_sliding_impacts_identify_and_a_contact_never_touched_is_not():
    truth = ball()
    found = identify(started_off(truth), throws(truth, 40, along=4.0), learned=CONTACT)
    assert found.impacts[1] == found.used[1] == 0
    assert found.impacts[0] >= found.used[0] == found.sliding[0] >= 20
    for name in CONTACT:
        told, untold = getattr(found, name)
        true = float(getattr(truth, name)[0])
        assert told.verdict == "identified"
        assert told.lower < true < told.upper
        assert told.standard_error < 3e-3  # 20 impacts of 1.5 m/s, whose velocities err by 1e-3
        assert untold.verdict == "not identified"
        assert untold.standard_error == np.inf
        assert np.isfinite(untold.value)
    assert found.mass_ratio == []


def test_a_contact_that_sticks_bounds_its_friction_from_below():
    truth = ball(friction=0.9)
    found = identify(truth, throws(truth, 40, along=0.3), learned=CONTACT)
    estimate = found.friction[0]
    assert found.sliding[0] == 0
    assert found.sticking[0] >= 20
    assert estimate.verdict == "bounded below"
    # A ball of 1 to 2 m/s downward and at most 0.36 m/s sideways is stopped by a ratio of at most 0.36.
    assert estimate.bound is not None
    assert 0.15 < estimate.bound == estimate.lower < 0.36
    assert estimate.upper == np.inf
    assert found.restitution[0].verdict == "identified"


@pytest.mark.slow
def test_no_rebound_bounds_restitution_from_above():
    """At e = 0, what the velocity after an impact tells is that it is no more than undoes the penetration."""
    truth = ball(restitution=0.0)
    estimate = identify(truth, throws(truth, 60, along=4.0, noise=1e-4), learned=CONTACT).restitution[0]
    assert estimate.value < 1e-4
    assert estimate.lower == 0
    assert estimate.bound is not None
    assert 0 < estimate.bound < 0.05
    assert estimate.verdict == "bounded above"  # however tight: no impact tells the restitution itself
    assert estimate.impacts == 0


def bounced(n, friction=0.3, restitution=0.6):
    """Throws as `throws` makes them, but in closed form: the ball meets the floor at its own time, between samples."""
    rng, time, g = np.random.default_rng(0), 0.01 * np.arange(13), 9.81
    y, down, along = rng.uniform(0.12, 0.2, (n, 1)), rng.uniform(1, 2, (n, 1)), rng.uniform(3.2, 4.8, (n, 1))
    hit = (-down + np.sqrt(down**2 + 2 * g * (y - 0.1))) / g
    speed = down + g * hit  # of the impact, which slides: 0.3 (1 + e) of it is less than the ball moves along
    left, after = along - friction * (1 + restitution) * speed, time - hit
    before = np.stack([along * time, y - down * time - g * time**2 / 2], axis=-1)
    then = np.stack([along * hit + left * after, 0.1 + restitution * speed * after - g * after**2 / 2], axis=-1)
    v_before = np.stack([along + 0 * time, -down - g * time], axis=-1)
    v_then = np.stack([left + 0 * time, restitution * speed - g * after], axis=-1)
    later = (after > 0)[..., None]
    x, v = np.where(later, then, before), np.where(later, v_then, v_before)
    return carom.Recording.of(x[:, :, None], v[:, :, None], dt=0.01)


def test_impacts_that_no_sample_shows_tell_nothing(monkeypatch):
    data, truth = bounced(40), ball()
    with refused("impacts happen between the samples"):
        identify(truth, data, learned=CONTACT)
    # Even if that were not found out: the model predicts impacts, but the data have none.
    monkeypatch.setattr("carom.learning.estimation.identify.check_meetings", lambda recording, system: None)
    found = identify(truth, data, learned=CONTACT)
    assert found.impacts == found.used == [0, 0]
    assert {e.verdict for name in CONTACT for e in getattr(found, name)} == {"not identified"}
    assert {e.impacts for name in CONTACT for e in getattr(found, name)} == {0}


@pytest.mark.slow
def test_fewer_than_ten_impacts_identify_nothing():
    truth = ball()
    data = throws(truth, 40, along=4.0)
    few = data.select([k for k in range(40) if (data.x[k, 1:, 0, 1] < 0.1).any()][:9])
    found = identify(truth, few, learned=CONTACT)
    assert 0 < (found.friction[0].impacts or 0) <= 9
    assert found.friction[0].verdict == found.restitution[0].verdict == "not identified"
    assert found.friction[0].standard_error < 0.05  # it is their number


@pytest.mark.slow
def test_nothing_to_tell_of_the_mass_of_one_body():
    """Its mass is the unit of all others: alone, no parameter is left."""
    truth = ball()
    found = identify(truth, throws(truth, 40, along=4.0), learned=("mass",))
    assert found.mass_ratio == found.friction == found.restitution == []
    assert found.used[0] >= 20


def test_a_recording_that_is_never_free_of_contact_is_refused():
    """Every state overlaps the floor, so that no step may be looked at."""
    network = NeuralPotential(1, 2, width=8, depth=2, key=jax.random.key(0))
    system = eqx.tree_at(lambda s: s.potential, ball(), network, is_leaf=lambda part: part is None)
    x = np.full((3, 5, 1, 2), 0.09)
    with refused("the recording has no step that starts without contact"):
        identify(system, carom.Recording.of(x, np.zeros_like(x), dt=0.01))
    flagged = carom.Recording.of(x, np.zeros_like(x), dt=0.01, contact=np.zeros((3, 5), bool))
    unknowns = unknowns_of(system, ("potential",))
    fit = polish(unknowns, system, Stepper(dt=jnp.asarray(0.01)), flagged, lambda unknowns: Fit(0.0, 0.0), 1.0)[1]
    assert fit == Fit(np.inf, np.inf)


def test_values_at_their_bounds_have_cut_off_intervals():
    truth = ball(friction=0.0, restitution=1.0)
    found = identify(truth, throws(truth, 40, along=4.0), learned=CONTACT)
    friction, restitution = found.friction[0], found.restitution[0]
    assert friction.verdict == restitution.verdict == "identified"
    assert friction.lower == 0 <= friction.value < friction.upper < 0.01
    assert 0.99 < restitution.lower < restitution.value <= restitution.upper == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "noise", "ratio"), [(160, 1e-4, 0.5), (40, 3e-4, 3.0)], ids=["4 times the data", "3 times the noise"]
)
def test_standard_errors_scale_with_data_and_noise(n, noise, ratio):
    truth = ball()
    base, other = (
        identify(truth, throws(truth, count, along=4.0, noise=sd), learned=CONTACT)
        for count, sd in ((40, 1e-4), (n, noise))
    )
    for name in CONTACT:
        a, b = (getattr(found, name)[0].standard_error for found in (base, other))
        assert b / a == pytest.approx(ratio, rel=0.3)  # from 30 impacts, a standard error is known to 13 %


def test_exact_data_give_exact_values():
    truth = ball()
    found = identify(started_off(truth), throws(truth, 40, along=4.0, noise=0.0), learned=CONTACT)
    assert found.friction[0].value == pytest.approx(0.3, abs=1e-6)
    assert found.restitution[0].value == pytest.approx(0.6, abs=1e-6)
    assert found.friction[0].standard_error == 1e-6


@pytest.mark.slow
def test_intervals_cover_the_truth():
    truth, start = ball(), started_off(ball())
    found = [identify(start, throws(truth, 25, along=4.0, seed=seed), learned=CONTACT) for seed in range(60)]
    estimates = [(getattr(f, name)[0], float(getattr(truth, name)[0])) for f in found for name in CONTACT]
    told = [(e.lower <= true <= e.upper) for e, true in estimates if e.verdict == "identified"]
    assert len(told) > 100
    assert np.mean(told) > 0.88  # 95 % of 120 intervals less 3.5 standard deviations
    z = [(e.value - true) / e.standard_error for e, true in estimates if e.verdict == "identified"]
    assert 0.6 < np.std(z) < 1.2


@pytest.mark.slow
def test_masses_are_told_by_impacts_between_bodies_and_a_network_is_profiled_out():
    truth = carom.System(
        bodies=[carom.PointMass(1.0, 0.2), carom.PointMass(2.0, 0.2)],
        contacts=[carom.DiskDisk([(0, 1)])],
        friction=0.2,
        restitution=0.8,
    )
    rng = np.random.default_rng(0)
    x0 = np.tile([[0.0, 0.0], [0.5, 0.1]], (40, 1, 1)) + rng.uniform(-0.04, 0.04, (40, 2, 2))
    v0 = np.tile([[2.0, 0.0], [-1.0, 0.0]], (40, 1, 1)) + 0.3 * rng.normal(size=(40, 2, 2))
    motion = carom.simulate(truth, jnp.asarray(x0), jnp.asarray(v0), dt=0.01, steps=10)
    x, v = (np.asarray(part) + 1e-3 * rng.normal(size=part.shape) for part in (motion.x, motion.v))
    network = NeuralPotential(2, 2, width=8, depth=2, key=jax.random.key(0))
    start = eqx.tree_at(lambda s: (s.bodies[1].mass, s.potential), truth, (truth.bodies[1].mass * 1.1, network))
    found = identify(start, carom.Recording.of(x, v, dt=0.01), learned=("mass", *CONTACT, "potential"))
    (mass,) = found.mass_ratio
    assert mass.verdict == "identified"
    assert mass.lower < 2 < mass.upper
    assert mass.standard_error < 0.05
    assert found.friction[0].lower < 0.2 < found.friction[0].upper


def test_bodies_that_never_meet_tell_nothing():
    free = carom.System(bodies=[carom.PointMass(1.0, 0.1), carom.PointMass(1.0, 0.1)], dim=2)
    v = np.broadcast_to(np.random.default_rng(0).normal(size=(5, 1, 2, 2)), (5, 9, 2, 2))
    data = carom.Recording.of(0.1 * np.arange(9)[:, None, None] * v, v, dt=0.1)
    found = identify(free, data, learned=("mass",))
    assert found.mass_ratio[0].verdict == "not identified"
    assert found.mass_ratio[0].standard_error >= 0.9
    assert found.friction == found.restitution == []  # what was not learned is not reported


def test_steps_do_not_start_in_contact_and_are_shared_out():
    truth = ball()
    data = throws(truth, 40, along=4.0)
    config = carom.IdentifyConfig(impacts=12, smooth_steps=7)
    steps, most = choose_steps(data, truth, config)
    assert steps.shape == (19, 2)
    assert most == 1
    assert (truth.gaps(jnp.asarray(data.x[steps[:, 0], steps[:, 1]])) >= 0).all()
    assert np.array_equal(choose_steps(data, truth, config)[0], steps)
    assert not np.array_equal(choose_steps(data, truth, dataclasses.replace(config, seed=1))[0], steps)


def test_a_recording_of_another_system_is_refused():
    with refused("1 points in 2D"):
        identify(carom.task("bp5"), carom.Recording.of(*np.zeros((2, 2, 9, 1, 2)), dt=0.01))


def test_a_system_too_large_is_refused():
    with refused("identify is for systems of up to 64 points; this one has 100."):
        identify(carom.task("rope-100"), carom.Recording.of(*np.zeros((2, 2, 9, 100, 2)), dt=0.01))


def test_robust_least_squares_ignores_outliers_and_knows_its_error():
    """A linear problem with 8 % of one-sided outliers, 200 times."""
    rng = np.random.default_rng(0)
    true = np.array([0.5, -1.0, 0.0])
    unbounded, n, q = np.full(3, np.inf), 150, 4
    blocks, z = None, []
    for _ in range(200):
        J = rng.normal(size=(n, q, 3))
        J[..., 2] = 0  # a column without information
        u = -J @ true + rng.normal(size=(n, q))
        u[: n // 12] += 30
        blocks = Blocks(u, J, np.arange(n) // 3, np.zeros(n, int))
        out = solve(blocks, np.eye(3), np.zeros(3), -unbounded, unbounded, redescend=True)
        z.append((out.change - true)[:2] / out.standard_error[:2])
        assert out.standard_error[2] >= 0.999
        assert (out.weight[: n // 12] < 0.01).all()
    z = np.array(z)
    assert abs(z.mean()) < 0.2  # 400 values: 4 standard deviations
    assert 0.9 < np.mean(np.abs(z) < 1.96) <= 0.99
    assert blocks is not None
    held = solve(blocks, np.eye(3), np.zeros(3), np.array([-1, -0.2, -1.0]), np.ones(3), redescend=True)
    assert held.change[1] == -0.2


def test_least_squares_without_a_parameter_change_nothing():
    blocks = Blocks(np.ones((7, 2)), np.zeros((7, 2, 0)), np.arange(7), np.zeros(7, int))
    none = np.zeros(0)
    out = solve(blocks, np.zeros((0, 0)), none, none, none, redescend=True)
    assert out.change.shape == out.standard_error.shape == (0,)
    assert out.weight.shape == (7,)


def test_what_nearly_exact_data_do_not_tell_is_left_to_the_prior():
    """Only the sum of the last two parameters has an effect, with errors so small that rounding hides the prior."""
    rng = np.random.default_rng(1)
    J = rng.normal(size=(300, 4, 3))
    J[..., 2] = J[..., 1]
    true, errors = np.array([0.3, 0.2, 0.0]), 1e-9
    u = (-J @ true) / errors + rng.normal(size=(300, 4))
    blocks = Blocks(u, J / errors, np.arange(300), np.zeros(300, int))
    out = solve(blocks, np.eye(3), np.zeros(3), np.full(3, -9.0), np.full(3, 9.0), redescend=True)
    assert np.isclose(out.change[0], 0.3, atol=1e-9)
    assert np.isclose(out.change[1] + out.change[2], 0.2, atol=1e-7)
    assert out.standard_error[0] < 1e-9
    assert np.allclose(out.standard_error[1:], 0.5**0.5, rtol=0.01)
