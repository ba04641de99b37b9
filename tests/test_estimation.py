"""The estimator against motions that carom did not make: flights in closed form, impacts at their own time."""

import json
from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import carom
from benchmarks.worlds import Pucks, Seen, observe
from carom.cli.estimation import estimates_table, is_for_estimator, names_to_learn, report_of, verdict_first
from carom.cli.main import main
from carom.cli.systems import Chosen
from carom.errors import CaromError
from carom.learning.config import LearnConfig
from carom.learning.estimation.estimate import estimate
from carom.learning.estimation.survey import survey
from carom.learning.estimation.windows import windows_of
from carom.learning.model_file import load_model_into
from carom.learning.run import RunFolder
from carom.recordings.observations import Observations

TRUE = Pucks(friction=(0.17, 0.08), restitution=(0.82, 0.65), field=(0.1, -0.3))
LEARN = ("friction", "restitution", "mass", "gravity", "radius:1", "plane:1")


class Frame(NamedTuple):
    """Where and in which units something is told: `unit turn @ x + shift`, masses times `heavy`."""

    turn: np.ndarray = np.eye(2)
    shift: np.ndarray = np.zeros(2)
    unit: float = 1.0
    heavy: float = 1.0

    def of(self, x):
        return self.unit * np.asarray(x) @ self.turn.T + self.shift


HERE = Frame()


def box(pucks: Pucks, frame: Frame = HERE) -> carom.System:
    """What is told of the pucks: radii, walls, the first mass; the second radius and a wall a little wrong."""
    walls = [((0.0, 0.0), (1.0, 0.0)), ((1.002, 0.0), (-1.0, 0.0)), ((0.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (0.0, -1.0))]
    walls = [(frame.of(point), frame.turn @ normal) for point, normal in walls]
    radii = pucks.radii[0], pucks.radii[1] - 1e-3
    return carom.System(
        [carom.PointMass(frame.heavy * pucks.masses[0], frame.unit * radius) for radius in radii],
        contacts=[carom.DiskDisk([(0, 1)])] + [carom.DiskPlane([0, 1], *wall, property=1) for wall in walls],
        friction=[0.3, 0.3],
        restitution=[0.5, 0.5],
        dim=2,
    )


def truth(pucks: Pucks) -> dict[str, float]:
    names = ("friction:0", "friction:1", "restitution:0", "restitution:1", "gravity:x", "gravity:y")
    values = (*pucks.friction, *pucks.restitution, *pucks.field)
    ratio = pucks.masses[1] / pucks.masses[0]
    return {**dict(zip(names, values, strict=True)), "mass:1": ratio, "radius:1": pucks.radii[1], "plane:1": -1.0}


def seen(world: Seen) -> Observations:
    return Observations.checked(world.x, world.time)


# --- what motion shows by itself ----------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1e-4, 1e-3])
def test_noise_is_found_from_the_motion(noise):
    world = observe(TRUE, trajectories=30, samples=80, noise=noise)
    # Some 2000 degrees of freedom for each puck: 1.6 % of its standard deviation, three times that.
    np.testing.assert_allclose(survey(seen(world)).noise, noise, rtol=0.05)


def test_impacts_are_found_where_motion_has_a_kink():
    world = observe(TRUE, trajectories=20, samples=90)
    found = survey(seen(world))
    kinks = sum(len(track.kinks) for track in found.tracks)
    assert abs(kinks - world.impacts) <= 0.06 * world.impacts  # two in one step show one kink
    for track, x in zip(found.tracks, world.x, strict=True):
        gaps = np.concatenate([x.reshape(90, 4), 1 - x.reshape(90, 4)], axis=1) - np.tile([0.1, 0.1, 0.15, 0.15], 2)
        apart = np.linalg.norm(x[:, 0] - x[:, 1], axis=1) - 0.25
        nearest = np.minimum(gaps.min(axis=1), apart)
        # 5 m/s over a step of 1/120 s are as far as a puck can be from what it hits within it.
        assert all(min(nearest[k], nearest[k + 1]) < 5 / 120 for k in track.kinks)


def test_free_flight_has_no_kink():
    time = np.arange(60) / 100
    rng = np.random.default_rng(0)
    x = rng.normal(size=(10, 1, 1, 2)) + rng.normal(size=(10, 1, 1, 2)) * time[:, None, None]
    x = x - 4.9 * time[:, None, None] ** 2 * np.array([0.0, 1.0]) + 1e-4 * rng.normal(size=(10, 60, 1, 2))
    found = survey(Observations.checked(x, time))
    # 1200 samples of which two in a row would have to be missed by six standard errors.
    assert sum(len(track.kinks) for track in found.tracks) == 0


def test_each_sample_is_in_one_window():
    world = observe(TRUE, trajectories=15, samples=90, noise=1e-4, missing=0.2, jitter=1e-3)
    found = survey(seen(world))
    for impacts in (1, 2, None):
        windows = windows_of(found, impacts)
        assert np.isfinite(windows.x).sum() <= np.isfinite(world.x).sum()
        for number in np.unique(windows.trajectory):
            own = windows.x[windows.trajectory == number]
            values = own[np.isfinite(own)]
            assert len(np.unique(values)) == len(values)


def test_steps_of_windows_lead_to_the_times_of_samples():
    world = observe(TRUE, trajectories=3, samples=50, missing=0.4, jitter=2e-3, seed=3)
    windows = windows_of(survey(seen(world)), None)
    for row, number in enumerate(windows.trajectory):
        there = np.isfinite(windows.x[row]).all(axis=1)
        time = np.concatenate([[0.0], np.nancumsum(windows.steps[row])])[there]
        has = np.isfinite(world.x[number]).all(axis=(1, 2))
        np.testing.assert_allclose(np.diff(time), np.diff(world.time[number, has][-len(time) :]), atol=1e-12)


# --- what comes out -------------------------------------------------------------------------------------------------


def test_free_motion_is_estimated_as_by_linear_least_squares():
    rng = np.random.default_rng(1)
    time, noise, count = np.arange(40) / 100, 1e-3, 12
    x = rng.normal(size=(count, 1, 2)) + rng.normal(size=(count, 1, 2)) * time[:, None]
    x = x + np.array([0.4, -9.7]) * time[:, None] ** 2 / 2 + noise * rng.normal(size=x.shape)
    system = carom.System([carom.PointMass(1.0)], potential=carom.Gravity((0.0, -9.0)))
    told = estimate(system, Observations.checked(x[:, :, None], time), ["gravity"])
    held = [np.allclose(x[k, 0], window.x[0, 0]) for k in range(count) for window in told.held]
    kept = ~np.reshape(held, (count, -1)).any(axis=1)
    # By hand: x less its own straight line, against t^2 / 2 less its own.
    line = np.stack([np.ones(40), time], axis=1)
    rest = np.eye(40) - line @ np.linalg.pinv(line)
    curve = rest @ time**2 / 2
    by_hand = np.einsum("t,ntd->d", curve, x[kept]) / (kept.sum() * curve @ curve)
    error = noise / np.sqrt(kept.sum() * curve @ curve)
    found = {one.name: one for one in told.estimates}
    for k, axis in enumerate("xy"):
        one = found[f"gravity:{axis}"]
        # The same minimum, but for samples of more than six standard errors, of which there are none.
        assert abs(one.value - by_hand[k]) < 1e-3 * error
        # The sandwich of ten trajectories is known to a quarter; it is not used where it is less.
        assert 0.9 * error < one.standard_error < 2 * error
        assert one.verdict == "identified"
        assert one.impacts is None
    assert told.fit.explained


@pytest.mark.slow
def test_a_body_that_turns_as_it_falls_tells_gravity():
    """A body of equal moments of inertia turns at one rate about its centre of mass, which falls on a parabola."""
    rng, time, field = np.random.default_rng(4), np.arange(40) / 148, np.array([0.1, 0.0, -9.6])
    x = np.zeros((10, 40, 4, 3))
    for motion in x:
        spin = Rotation.from_rotvec(time[:, None] * rng.normal(size=3) * 8) * Rotation.random(rng=rng)
        motion[:, 0] = rng.normal(size=3) + time[:, None] * rng.normal(size=3) + time[:, None] ** 2 * field / 2
        motion[:, 1:] = motion[:, :1] + np.swapaxes(spin.as_matrix(), 1, 2)
    system = carom.System([carom.RigidBody(0.4, np.full(3, 4e-4))], potential=carom.Gravity((0.0, 0.0, -9.81)))
    told = estimate(system, Observations.checked(x, time), ["gravity"])
    assert told.fit.explained
    found = {one.name: one.value for one in told.estimates}
    np.testing.assert_allclose([found[f"gravity:{axis}"] for axis in "xyz"], field, atol=1e-7)


def test_observations_of_another_system_are_refused():
    world = observe(TRUE, trajectories=2, samples=20)
    with pytest.raises(CaromError, match=r"the observations have 1 points in 2D; the system has 2 in 2D"):
        estimate(box(TRUE), Observations.checked(world.x[:, :, :1], world.time), ["friction"])


@pytest.fixture(scope="module")
def exact():
    """What exact positions tell."""
    return estimate(box(TRUE), seen(observe(TRUE, trajectories=40, samples=80)), LEARN)


@pytest.mark.slow
def test_exact_positions_give_the_truth(exact):
    true = truth(TRUE)
    assert exact.fit.explained
    assert exact.fit.impact_rule == "event"
    for one in exact.estimates:
        # Floats of positions, 1e-16 m, are multiplied by some hundred through each of a few impacts.
        assert abs(one.value - true[one.name]) < 1e-9
        # Of fewer than ten impacts that tell nothing is called told, however sharp.
        told = one.impacts is None or one.impacts >= 10
        assert one.verdict == ("identified" if told else "not identified")
        assert one.lower <= true[one.name] <= one.upper
    assert sum(one.verdict == "identified" for one in exact.estimates) >= len(true) - 1


@pytest.mark.slow
def test_report_is_that_of_the_contract(exact, capsys):
    from rich.console import Console

    report = json.loads(json.dumps(report_of(exact)))
    keys = {"name", "of", "value", "standard_error", "lower", "upper", "unit", "verdict", "impacts"}
    assert all(set(one) == keys for one in report["estimates"])
    assert {"explained", "chi2", "by_channel", "impact_rule"} <= set(report["fit"])
    assert report["evaluation"]["trajectory_error"] < 1e-8
    verdict_first(Console(), exact.fit)
    assert "explains the data" in capsys.readouterr().out
    assert estimates_table(exact.estimates).row_count == len(exact.estimates)


@pytest.mark.slow
def test_noisy_positions_with_gaps_give_intervals_that_hold(exact):
    world = observe(TRUE, trajectories=60, samples=100, noise=2e-4, missing=0.3, jitter=2e-3, decimals=4, seed=2)
    told = estimate(box(TRUE), seen(world), LEARN)
    true = truth(TRUE)
    assert told.fit.explained
    off = [(one.value - true[one.name]) / one.standard_error for one in told.estimates]
    assert np.max(np.abs(off)) < 4  # of nine, in normal errors: one in two thousand
    assert np.sum(np.abs(off) > 2.1) <= 2
    half = {one.name: (one.upper - one.lower) / 2 for one in told.estimates}
    assert max(half[name] for name in ("restitution:0", "restitution:1", "friction:0", "friction:1")) < 0.005


@pytest.mark.slow
def test_what_is_told_hangs_on_no_frame_and_no_unit():
    world = observe(TRUE, trajectories=40, samples=80, noise=2e-4, missing=0.2, seed=5)
    turned = Rotation.from_euler("z", 0.7).as_matrix()[:2, :2] @ np.diag([1.0, -1.0])
    frame = Frame(turned, np.array([300.0, -2000.0]), unit=1e3, heavy=1e-3)
    here = estimate(box(TRUE), seen(world), LEARN)
    there = estimate(box(TRUE, frame), Observations.checked(frame.of(world.x), world.time), LEARN)
    one, other = ({name: getattr(told, name) for name in ("theta", "covariance")} for told in (here, there))
    names = [estimate.name for estimate in here.estimates]
    sizes = np.array([frame.unit if name.startswith(("gravity", "radius", "plane")) else 1.0 for name in names])
    turn = np.eye(len(names))
    field = [names.index("gravity:x"), names.index("gravity:y")]
    turn[np.ix_(field, field)] = turned
    # The wall goes with the frame's origin.
    one["theta"][names.index("plane:1")] += (turned @ [-1.0, 0.0]) @ frame.shift / frame.unit
    error = np.sqrt(np.diag(there.covariance))
    assert here.fit.explained
    assert np.all(np.abs(other["theta"] - sizes * (turn @ one["theta"])) < 1e-3 * error)
    # Errors of the field are the greater of two by each axis, so that they turn only nearly with the frame.
    rest = np.array([not name.startswith("gravity") for name in names])
    expected = (sizes * np.sqrt(np.diag(one["covariance"])))[rest]
    np.testing.assert_allclose(error[rest], expected, rtol=1e-3)
    np.testing.assert_allclose(there.fit.chi2, here.fit.chi2, rtol=1e-6)


@pytest.mark.slow
def test_drag_that_nobody_told_is_a_misfit(exact):
    slowed = Pucks(friction=TRUE.friction, restitution=TRUE.restitution, drag=0.5)
    told = estimate(box(TRUE), seen(observe(slowed, trajectories=40, samples=80, noise=2e-4, seed=4)), LEARN)
    assert not told.fit.explained
    assert {one.verdict for one in told.estimates} == {"misfit"}
    assert told.fit.chi2 > 2


FILE = """
import carom

walls = [((0.0, 0.0), (1.0, 0.0)), ((1.002, 0.0), (-1.0, 0.0)), ((0.0, 0.0), (0.0, 1.0)), ((0.0, 1.0), (0.0, -1.0))]
system = carom.System(
    [carom.PointMass(0.1, 0.1), carom.PointMass(0.1, 0.149)],
    contacts=[carom.DiskDisk([(0, 1)])] + [carom.DiskPlane([0, 1], *wall, property=1) for wall in walls],
    friction=[0.3, 0.3],
    restitution=[0.5, 0.5],
    dim=2,
)
"""


@pytest.mark.slow
def test_command_learns_from_positions_and_says_the_verdict_first(exact, tmp_path, capsys):
    world = observe(TRUE, trajectories=40, samples=80, noise=2e-4, seed=6)
    np.savez(tmp_path / "seen.npz", x=world.x, time=world.time)
    (tmp_path / "box.py").write_text(FILE)
    file, data, run = (str(tmp_path / name) for name in ("box.py", "seen.npz", "run"))
    main(["check", data, "--task", file, "--learn", *LEARN])
    said = capsys.readouterr().out
    assert "impacts seen in the motion" in said
    assert said.index("The learned system explains the data to") < said.index("What the data tell")
    main(["learn", file, "--data", data, "--learn", *LEARN, "--out", run])
    said = capsys.readouterr()
    assert said.out.index("The learned system explains the data to") < said.out.index("What the data tell")
    assert "compiling" in said.out + said.err
    report = RunFolder.open(run).read_json("report.json")
    assert report["fit"]["explained"]
    assert report["fit"]["impact_rule"] == "event"
    learned = {one["name"]: one["value"] for one in report["estimates"]}
    main(["evaluate", run])  # the file of the model has all that was learned: the wall, the radius, the field
    assert "Predictions of" in capsys.readouterr().out
    system = load_model_into(tmp_path / "run" / "model.carom", box(TRUE))
    assert float(system.bodies[1].radius) == pytest.approx(learned["radius:1"], abs=1e-12)
    wall = system.contacts[2]
    assert isinstance(wall, carom.DiskPlane)
    assert float(wall.point[0]) == pytest.approx(-learned["plane:1"], abs=1e-12)


def test_data_with_velocities_and_nothing_said_are_for_the_trainer(tmp_path):
    world = observe(TRUE, trajectories=3, samples=20)
    chosen = Chosen("box.py", box(TRUE), b"")
    default = LearnConfig.learn
    np.savez(tmp_path / "x.npz", x=world.x, time=world.time)
    np.savez(tmp_path / "xv.npz", x=world.x, v=np.zeros_like(world.x), time=world.time)
    assert is_for_estimator(tmp_path / "x.npz", default, default, chosen)
    assert not is_for_estimator(tmp_path / "xv.npz", default, default, chosen)
    assert is_for_estimator(tmp_path / "xv.npz", ("friction", "radius:1"), default, chosen)
    assert not is_for_estimator(tmp_path / "xv.npz", ("mass", "potential"), default, chosen)
    assert not is_for_estimator(None, ("friction",), default, chosen)
    assert names_to_learn(default, default, chosen) == ("friction", "restitution", "mass", "gravity")


# --- bodies on joints -------------------------------------------------------------------------------------------------


def swinging(count: int, *, length: float, gravity: float, restitution: float, wall: float, seed: int):
    """A bob on a rod that hits a smooth wall at an angle `wall` (rad): positions (count, 150, 1, 2) at 100 Hz.

    By SciPy: theta'' = -(g / L) sin(theta), and theta' to -e theta' where theta reaches `wall`.
    """
    rng = np.random.default_rng(seed)
    times = np.arange(150) / 100

    def rate(_, state):
        return [state[1], -gravity / length * np.sin(state[0])]

    def meets(_, state):
        return wall - state[0]

    meets.terminal, meets.direction = True, -1
    angles = np.empty((count, len(times)))
    for k in range(count):
        state, now = np.array([rng.uniform(-1.2, -0.4), rng.uniform(-1.0, 2.0)]), 0.0
        while now < times[-1]:
            found = solve_ivp(rate, (now, times[-1]), state, events=meets, dense_output=True, rtol=1e-12, atol=1e-13)
            its = (times >= now) & (times <= found.t[-1])
            angles[k, its] = found.sol(times[its])[0]
            now, state = found.t[-1], found.y[:, -1] * [1, -restitution]
    place = length * np.stack([np.sin(angles), -np.cos(angles)], axis=-1)
    return np.broadcast_to(times, angles.shape), place[:, :, None]


@pytest.mark.slow
@pytest.mark.ci_budget
def test_a_bob_on_a_rod_tells_gravity_and_restitution():
    length, radius, wall = 0.7, 0.06, 0.25
    time, x = swinging(16, length=length, gravity=9.7, restitution=0.72, wall=wall, seed=4)
    system = carom.System(
        [carom.PointMass(0.3, radius)],
        constraints=[carom.Tether(0, (0.0, 0.0), length)],
        contacts=[carom.DiskPlane([0], (length * np.sin(wall) + radius, 0.0), (-1.0, 0.0))],
        potential=carom.Gravity((0.0, -9.0)),
        friction=0.0,
        restitution=0.5,
    )
    told = estimate(system, Observations.checked(x, time), ("restitution", "gravity:y"))
    assert told.fit.explained
    true = {"restitution:0": 0.72, "gravity:y": -9.7}
    for one in told.estimates:
        # 4e-7 are left of gravity, by which the motion is integrated wrong in steps of 10 ms: the interval holds it.
        assert abs(one.value - true[one.name]) < 1e-6 * abs(true[one.name])
        assert one.lower < true[one.name] < one.upper
    assert {one.verdict for one in told.estimates} == {"identified"}


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_kinks_of_bent_motion_are_those_of_impacts(noise, scale):
    """Points that go round in circles, once thrown back: no parabola, and a kink there alone."""
    time = np.arange(101) * 0.01
    rng = np.random.default_rng(3)
    x = np.zeros((8, len(time), 2, 2))
    hits = []
    for one in x:
        hit, before, after = rng.uniform(0.3, 0.7), rng.uniform(5, 9), -rng.uniform(4, 8)
        angle = np.where(time < hit, before * (time - hit), after * (time - hit)) + rng.uniform(0, 6)
        one[:, 0] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        one[:, 1] = 0.5 * np.stack([np.cos(angle + 1), np.sin(angle + 1)], axis=1)
        hits.append(int(hit / 0.01))
    seen = Observations.checked(scale * (x + noise * rng.normal(size=x.shape)), np.tile(time, (8, 1)))
    found = survey(seen, bent=True)
    assert [track.kinks.tolist() for track in found.tracks] == [[k] for k in hits]
    starts = windows_of(found, 1).start
    first = scale * x[:, 0]
    np.testing.assert_allclose(starts[:, 0], first, atol=scale * (5e-5 + 3 * noise))
    if noise:
        np.testing.assert_allclose(found.noise, scale * noise, rtol=0.3)


def _rounds(samples, rate, phase=0.0, dt=0.01):
    angle = rate * np.arange(samples) * dt + phase
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)[:, None]


def _with_a_seldom_seen_point():
    x = np.array([np.concatenate([_rounds(100, 5), _rounds(100, 4)], axis=1)] * 3)
    x[:, 9:, 1] = np.nan
    x[0, :, 1] = np.nan
    return x, np.arange(100) * 0.01


def _with_a_gap():
    time = np.arange(200) * 0.01 + np.where(np.arange(200) < 100, 0, 10.0)
    return np.stack([np.cos(time), np.sin(time)], axis=1)[None, :, None], time


BENT = {
    "short": (np.array([_rounds(9, 5)] * 2), np.arange(9) * 0.01),
    "very short": (np.array([_rounds(5, 5)] * 2), np.arange(5) * 0.01),
    "seldom seen": _with_a_seldom_seen_point(),
    "a gap": _with_a_gap(),
}


@pytest.mark.parametrize("name", list(BENT))
def test_bent_motion_that_nothing_hits_has_no_kink(name):
    x, time = BENT[name]
    found = survey(Observations.checked(x, np.tile(time, (len(x), 1))), bent=True)
    assert not any(len(track.kinks) for track in found.tracks)
