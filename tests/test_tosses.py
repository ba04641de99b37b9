"""Learning from recorded tosses, and the protocols that predictions of them are measured by."""

import csv
import dataclasses
import io
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from systems import ball_on_floor, refused

import carom
from carom.cli.main import main
from carom.cli.systems import Chosen
from carom.cli.tosses import explains, nominal_width, touching_height
from carom.cli.view import View
from carom.learning.estimation.protocols import body_points, box_points, paired_difference, protocol_starts, toss_errors
from carom.learning.estimation.toss_config import STEPS, TossConfig, search_steps, tossed_names
from carom.learning.estimation.tosses import choose_segments, learn_tosses, predict_tosses
from carom.learning.run import RunFolder
from carom.learning.unknowns.quantities import Learned
from carom.mechanics.bodies import embed_pose, embed_velocity, recover_velocity
from carom.recordings.poses import poses_of

DT, WIDTH = 1 / 148, 0.1024
HEIGHT = np.sqrt(3) / 2 * WIDTH
"""Half of the diagonal."""
NAMES = ("inertia:0", "friction:0", "restitution:0")
CENTER = tuple(f"center_of_mass:0:{axis}" for axis in "xyz")
CONFIG = TossConfig(horizons=(8,), segments=200, toss_rounds=4, evaluations=0, toss_samples=50)


def changed(system, values):
    """The system with other values of quantities, by their names."""
    for name, value in values.items():
        (quantity,) = Learned.chosen(system, [name]).quantities
        system = quantity.put(system, jnp.asarray(value))
    return system


def values_of(system, names):
    """Values by name."""
    learned = Learned.chosen(system, names)
    return dict(zip(learned.names, np.asarray(learned.physical(learned.free())).tolist(), strict=True))


@pytest.fixture(scope="module")
def cube():
    return carom.task("cube")


@pytest.fixture(scope="module")
def tosses(cube_tosses):
    """60 simulated tosses with errors of 0.05 mm, 2 mm/s and 0.02 rad/s; four sessions."""
    x, v = (part.copy() for part in cube_tosses[:2])
    rng = np.random.default_rng(0)
    x += 5e-5 * rng.normal(size=x[:, :, :1].shape)
    v += 2e-3 * rng.normal(size=v[:, :, :1].shape)
    spin = 0.02 * rng.normal(size=(*x.shape[:2], 1, 3))
    v[:, :, 1:] += np.cross(np.broadcast_to(spin, x[:, :, 1:].shape), x[:, :, 1:] - x[:, :, :1])
    return carom.Recording.of(x, v, dt=DT, group=np.arange(60) // 15, task="cube")


@pytest.fixture(scope="module")
def moved(cube):
    return changed(cube, dict(zip(NAMES, (7e-4, 0.25, 0.25), strict=True)))


@pytest.mark.slow
def test_segments_recover_what_noisy_tosses_were_made_with(cube, tosses, moved):
    system, report = learn_tosses(moved, tosses, NAMES, CONFIG, progress=False)
    for name, true in values_of(cube, NAMES).items():
        found = report.estimates[name]
        assert found.standard_error is not None
        assert 0 < found.standard_error < 0.1 * max(abs(true), 0.1)
        assert abs(found.value - true) < 5 * found.standard_error  # four sessions alone
        assert abs(found.value - true) < 0.05 * true
    assert values_of(system, NAMES) == pytest.approx({name: one.value for name, one in report.estimates.items()})
    assert report.tosses == 60
    start_position, start_rotation = errors_of(moved, tosses)
    assert report.position < 0.3 * start_position
    assert report.rotation < 0.5 * start_rotation


def errors_of(system, recording):
    errors = toss_errors(system, recording, predict_tosses(system, recording), WIDTH)
    return errors.position.mean() / 100, np.radians(errors.rotation.mean())


@pytest.mark.slow
def test_a_search_that_was_stopped_goes_on_without_computing_again(tosses, moved, tmp_path):
    config = dataclasses.replace(CONFIG, horizons=(), evaluations=9)
    whole = RunFolder.create(tmp_path / "whole", {})
    _, expected = learn_tosses(moved, tosses, NAMES, config, run=whole, progress=False)

    class StoppedError(Exception):
        pass

    class Stopping(RunFolder):
        def log(self, metrics):
            super().log(metrics)
            if len(self.metrics()) == 4:
                raise StoppedError

    with pytest.raises(StoppedError):
        learn_tosses(moved, tosses, NAMES, config, run=Stopping.create(tmp_path / "part", {}), progress=False)
    again = RunFolder.open(tmp_path / "part")
    _, report = learn_tosses(moved, tosses, NAMES, config, run=again, progress=False)
    assert [row["loss"] for row in again.metrics()] == [row["loss"] for row in whole.metrics()]
    assert report.estimates == expected.estimates
    assert report.evaluations == 9
    losses = [row["loss"] for row in whole.metrics()]
    assert min(losses) < losses[0]
    assert np.isclose(report.position + report.rotation, min(losses), rtol=1e-9)


def test_segments_start_in_flight_before_an_impact(cube, tosses):
    steps = choose_segments(tosses, cube, 8, 100, 0)
    assert len(steps) == 100
    gaps = np.asarray(jax.vmap(jax.vmap(cube.gaps))(jnp.asarray(tosses.x)))
    closed = (gaps < 1e-3).any(axis=-1)
    assert not any(closed[k, max(0, s - 3) : s + 2].any() for k, s in steps)
    assert all(closed[k, s + 2 : s + 6].any() for k, s in steps)


def test_what_is_learned_of_a_toss_if_nothing_is_said(cube):
    """Losses belong to Coulomb's law; a step of the search is one in the unit of each quantity."""
    names = ("half_width", "corner_radius", "inertia", "center_of_mass", "friction:0", "restitution:0")
    assert tossed_names(cube) == names
    system = cube.with_contact_model("coulomb")
    assert tossed_names(system) == (*names, "friction_loss", "restitution_loss")
    learned = Learned.chosen(system, tossed_names(system))
    theta = learned.free()
    for k, (quantity, step) in enumerate(zip(learned.quantities, search_steps(learned), strict=True)):
        there = learned.physical(theta.at[k].add(1e-3 * step))[k] - learned.physical(theta)[k]
        assert float(there) == pytest.approx(1e-3 * STEPS[quantity.label.kind], rel=1e-3)


def box_on_two_planes() -> carom.System:
    """A box of unequal edges above a table and a wall, which have properties of their own."""
    return carom.System(
        bodies=[carom.RigidBody(0.4, (1e-4, 2e-4, 3e-4))],
        contacts=[
            carom.CornerPlane([0], (0.06, 0.03, 0.015), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), property=1),
            carom.CornerPlane([0], (0.06, 0.03, 0.015), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), property=0),
        ],
        potential=carom.Gravity((0.0, 0.0, -9.81)),
        friction=(0.5, 0.2),
        restitution=(0.9, 0.1),
    )


def test_a_box_keeps_its_proportions_and_a_wall_its_properties():
    box = box_on_two_planes()
    assert tossed_names(box)[:6] == (
        "half_width",
        "corner_radius",
        "inertia",
        "center_of_mass",
        "friction:1",
        "restitution:1",
    )
    names = ("half_width:0", "inertia:0", "friction:1", "restitution:1")
    values = values_of(box, names)
    assert list(values.values()) == pytest.approx([4e-4, 0.2, 0.1, 0.035])  # in the order of the registry
    other = changed(box, {"half_width:0": 0.07, "inertia:0": 8e-4, "friction:1": 0.3, "restitution:1": 0.4})
    for contact in other.contacts:  # one box, whatever it meets
        assert np.allclose(contact.half_widths, (0.12, 0.06, 0.03))
    assert np.allclose(other.bodies[0].moments, (2e-4, 4e-4, 6e-4))
    assert np.allclose(other.friction, (0.5, 0.3))
    assert np.allclose(other.restitution, (0.9, 0.4))


def test_a_box_is_measured_from_where_its_corners_can_touch():
    """sqrt(6^2 + 3^2 + 1.5^2) cm; errors are in % of its least width."""
    chosen = Chosen("box.py", box_on_two_planes(), b"")
    assert touching_height(chosen) == pytest.approx(0.01 * np.sqrt(36 + 9 + 2.25))
    assert nominal_width(chosen) == pytest.approx(0.03)
    cube = Chosen("cube", carom.task("cube"))
    assert touching_height(cube) == pytest.approx(np.sqrt(3) / 2 * 0.1048)
    assert nominal_width(cube) == 0.1048


def test_other_systems_and_wrong_settings_are_refused(cube, tosses):
    with refused("one rigid body with a CornerPlane"):
        learn_tosses(ball_on_floor(), tosses, NAMES, CONFIG, progress=False)
    with refused("learn must name something, such as half_width"):
        learn_tosses(cube, tosses, (), CONFIG, progress=False)
    with refused("'mass' is nothing that can be learned of this system"):
        learn_tosses(cube, tosses, ("mass",), CONFIG, progress=False)
    with refused("'friction_loss' is nothing that can be learned of this system (it belongs to the contact model coul"):
        learn_tosses(cube, tosses, ("friction_loss",), CONFIG, progress=False)
    with refused("too few for 3 quantities"):
        short = carom.Recording.of(tosses.x[:1, :12], tosses.v[:1, :12], dt=DT)
        learn_tosses(cube, short, NAMES, CONFIG, progress=False)


# --- protocols ----------------------------------------------------------------------------------------------------


def test_errors_are_what_was_done_to_the_truth(cube, tosses):
    system = cube.with_max_active(4)
    x = tosses.x.copy()
    errors = toss_errors(system, tosses, x, WIDTH)
    assert errors.position.max() == 0
    assert errors.rotation.max() < 1e-5
    x += np.array([1e-3, 0, 0])
    assert np.allclose(toss_errors(system, tosses, x, WIDTH).position, 0.1 / WIDTH)
    turned = Rotation.from_euler("z", 5, degrees=True).apply((x[:, :, 1:] - x[:, :, :1]).reshape(-1, 3))
    x[:, :, 1:] = x[:, :, :1] + turned.reshape(*x.shape[:2], 3, 3)
    assert np.allclose(toss_errors(system, tosses, x, WIDTH).rotation, 5)
    x[..., 2] -= 1.0  # all of it a metre below the table: half of the diagonal and more
    sunk = toss_errors(system, tosses, x, WIDTH)
    assert np.all(sunk.penetration > 100 * 0.6 / WIDTH)
    assert set(sunk.summary()["rotation"]) == {"mean", "sd", "median"}


def test_recordings_are_of_the_centre_of_the_box(cube):
    center = np.array([1e-3, -2e-3, 5e-3])
    system = changed(cube, dict(zip(CENTER, -center, strict=True)))
    rotation = jnp.asarray(Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix())
    mass, spin = jnp.array([0.1, 0.2, 0.3]), jnp.array([1.0, -2.0, 3.0])
    x, v = embed_pose(mass, rotation), embed_velocity(rotation, jnp.array([0.5, 0.0, -1.0]), spin)
    recorded, moving = box_points(system, x), box_points(system, v)
    assert np.allclose(recorded[0], mass + rotation @ center)
    assert np.allclose(moving[0], np.array([0.5, 0.0, -1.0]) + np.cross(spin, rotation @ center))
    assert np.allclose(recorded[1:] - recorded[:1], x[1:] - x[:1])
    assert np.allclose(body_points(system, recorded), x)
    assert np.allclose(body_points(system, moving), v)


def test_predictions_of_tosses_that_are_far_off_are_called_so(tosses):
    """Off by less or more than a tenth of the mean distance from the start."""
    way = np.linalg.norm(tosses.x[:, :, 0] - tosses.x[:, :1, 0], axis=-1).mean(axis=1)
    for share, expected in ((0.09, False), (0.11, True)):
        text = io.StringIO()
        assert explains(Console(file=text), tosses, share * way) != expected
        assert ("does not explain the data" in text.getvalue()) == expected


def test_a_toss_counts_to_its_own_end(cube, tosses):
    short = carom.Recording.of(tosses.x, tosses.v, dt=DT, length=np.full(60, 10))
    x = tosses.x.copy()
    x[:, 10:] += 1.0
    assert toss_errors(cube, short, x, WIDTH).position.max() == 0


def test_protocol_b_starts_where_a_corner_can_touch(tosses):
    assert protocol_starts(tosses, "A", HEIGHT) is tosses
    data = protocol_starts(tosses, "B", HEIGHT)
    started = tosses.length - data.length
    late = started > 0  # the others begin so low
    assert late.sum() > 50
    assert np.all(data.x[late, 1, 0, 2] < HEIGHT)
    assert np.all(data.x[late, 0, 0, 2] >= HEIGHT)
    assert np.array_equal(data.x[0, 0], tosses.x[0, started[0]])
    # A long flight gives better velocities than one recorded sample.
    k = int(np.argmax(started))
    fallen = tosses.v[k, 0, 0] - np.array([0, 0, 9.61 * DT * started[k]])
    assert np.abs(data.v[k, 0, 0] - fallen).max() < 0.02
    assert np.array_equal(data.group, tosses.group)


def flight(turns, velocity) -> carom.Recording:
    """A body that falls past the height of protocol B while it turns (rotations (T, 3, 3)); no recorded velocity."""
    time = DT * np.arange(len(turns))
    center = np.array([0.0, 0.0, 0.4]) + velocity * time[:, None] - [0, 0, 4.905] * time[:, None] ** 2
    x = np.asarray(embed_pose(jnp.asarray(center), jnp.asarray(turns)))[None]
    return carom.Recording.of(x, np.zeros_like(x), dt=DT)


@pytest.mark.parametrize("rate", [3.0, 60.0])
def test_velocities_of_a_flight_with_many_turns(rate):
    """At one rate, in closed form: 60 rad/s are .4 rad from sample to sample, and three turns before the start."""
    axis, velocity = np.array([2.0, -1.0, 2.0]) / 3, np.array([0.3, -0.2, 1.0])
    angles = rate * DT * np.arange(80)
    turns = Rotation.from_rotvec(angles[:, None] * axis) * Rotation.from_euler("xyz", [0.3, -0.5, 1.0])
    recording = flight(turns.as_matrix(), velocity)
    data = protocol_starts(recording, "B", HEIGHT)
    start = int(recording.length[0] - data.length[0])
    assert start > 40
    found = [np.asarray(part[0]) for part in recover_velocity(jnp.asarray(data.x[:, 0]), jnp.asarray(data.v[:, 0]))]
    assert np.allclose(found[0], velocity - [0, 0, 9.81 * DT * start], atol=1e-9)
    assert np.allclose(found[1], rate * axis, atol=1e-9)


def test_velocities_of_a_flight_that_wobbles():
    """Euler's equations of a body with unequal moments, integrated by scipy to 1e-10: it turns at no one rate."""
    moments, start_rate = np.array([1.0, 2.0, 4.0]), np.array([20.0, 3.0, -4.0])
    inertia = moments.sum() - moments

    def change(_, state):
        turn, rate = state[:9].reshape(3, 3), state[9:]
        spin = np.cross(np.broadcast_to(rate, (3, 3)), np.eye(3)).T
        return np.concatenate([(turn @ spin).ravel(), -np.cross(rate, inertia * rate) / inertia])

    time = DT * np.arange(80)
    first = np.concatenate([np.eye(3).ravel(), start_rate])
    motion = solve_ivp(change, (0, time[-1]), first, t_eval=time, rtol=1e-10, atol=1e-10).y.T
    turns, rates = motion[:, :9].reshape(-1, 3, 3), motion[:, 9:]
    recording = flight(turns, np.array([0.0, 0.0, 1.0]))
    data = protocol_starts(recording, "B", HEIGHT, moments)
    start = int(recording.length[0] - data.length[0])
    found = np.asarray(recover_velocity(jnp.asarray(data.x[:, 0]), jnp.asarray(data.v[:, 0]))[1][0])
    true = turns[start] @ rates[start]
    assert np.linalg.norm(true - turns[0] @ rates[0]) > 3
    # Half steps are of second order: a share of (|omega| dt)^2 / 24, with |omega| dt = 0.14.
    assert np.linalg.norm(found - true) < 1e-3 * np.linalg.norm(true)


def test_paired_differences_know_sessions():
    rng = np.random.default_rng(0)
    group = np.repeat(np.arange(20), 5)
    first = rng.normal(size=100)
    shift = np.repeat(rng.normal(size=20), 5)
    found = paired_difference(first + 1 + shift, first, group)
    assert np.isclose(found["mean"], 1 + shift.mean())
    # The sessions' differences vary by 1: the mean of 20 is known to 2 / sqrt(20), however many tosses they have.
    assert 0.5 < (found["upper"] - found["lower"]) / (2 * 1.96 * shift.std() / np.sqrt(20)) < 1.5
    alone = paired_difference(first + 1, first, None)
    assert np.isclose(alone["lower"], 1)
    assert alone["sessions"] == 100


# --- the command line ---------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_from_a_pose_file_to_a_table(tosses, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    position, quaternion = poses_of(tosses.x[:30])
    np.savez("lab.npz", position=position, quaternion=quaternion, dt=DT, group=tosses.group[:30])
    main(["import", "poses", "lab.npz", "--mass", "0.37", "--size", str(WIDTH)])
    assert "gravity in free flight" in capsys.readouterr().out
    options = [
        "--horizons",
        "8",
        "--segments",
        "100",
        "--toss-rounds",
        "1",
        "--evaluations",
        "3",
        "--toss-samples",
        "40",
    ]
    main(["learn", "cube", "--data", "lab-trajectories.h5", "--out", "run", "--learn", "friction", *options])
    out = capsys.readouterr().out
    assert "Protocol A" in out
    report = json.loads((tmp_path / "run" / "report.json").read_text())
    assert set(report["learned"]["estimates"]) == {"friction:0"}
    (estimate,) = report["estimates"]
    assert (estimate["name"], estimate["of"], estimate["unit"]) == ("friction:0", "0-corner --- and 7 more", "")
    assert estimate["lower"] < estimate["value"] < estimate["upper"]
    assert (estimate["verdict"] == "misfit") == (not report["fit"]["explained"])
    assert report["fit"]["impact_rule"] == "event"
    main(["evaluate", "run", "--protocol", "B", "--data", "lab-trajectories.h5", "--against", "run"])
    assert "bootstrap over 2 sessions" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "run" / "toss_errors_B.csv").read_text().splitlines()))
    assert len(rows) == 30
    assert {row["session"] for row in rows} == {"0", "1"}
    for name in ("tosses.png", "toss_errors.png", "prediction.gif", "model.carom", "toss_errors_A.csv"):
        assert (tmp_path / "run" / name).stat().st_size > 100


OWN = """
import carom

system = carom.System(
    bodies=[carom.RigidBody(0.37, (3.9e-4, 3.9e-4, 3.9e-4))],
    contacts=[carom.CornerPlane([0], 0.05, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), center=(1e-3, 0.0, 2e-3))],
    potential=carom.Gravity((0.0, 0.0, -9.61)),
    friction=0.2,
    restitution=0.2,
)
"""


@pytest.mark.slow
def test_tosses_of_an_own_system_are_learned_measured_and_seen_by_one_rule(tosses, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    monkeypatch.setattr("carom.cli.tosses._pictures", lambda *_: None)  # most of the time, three times
    (tmp_path / "mine.py").write_text(OWN)
    for name, part in (("train", tosses.select(slice(8))), ("test", tosses.select(slice(8, 13)))):
        carom.save_recording(f"{name}.h5", dataclasses.replace(part, task=""))
    words = ["learn", "mine.py", "--data", "train.h5", "--test", "test.h5", "--learn", "friction"]
    words += ["--horizons", "--evaluations", "1", "--toss-samples", "40", "--substeps", "2"]
    main(words)
    assert "Learning mine.py from 8 recorded tosses into runs/mine-tosses" in capsys.readouterr().out
    run = tmp_path / "runs" / "mine-tosses"
    assert (run / "system.py").read_text() == OWN
    measured = json.loads((run / "report.json").read_text())["evaluation"]
    assert measured["tosses"] == 5
    main([*words, "--out", str(run), "--resume"])
    assert json.loads((run / "report.json").read_text())["evaluation"] == measured
    kept = {}

    def keep(*_, **options):
        kept.update(options)
        raise KeyboardInterrupt

    monkeypatch.setattr("carom.cli.simulate.simulate", keep)
    with pytest.raises(SystemExit):
        main(["simulate", "mine.py", "--run-folder", str(run), "--initial", "test.h5"])
    assert (kept["impact"], kept["compensation_steps"], kept["dt"]) == ("event", 2.0, pytest.approx(DT))
    (tmp_path / "mine.py").unlink()  # the run has its own
    main(["evaluate", str(run)])
    again = json.loads((run / "evaluation.json").read_text())
    assert {name: again[name] for name in measured} == measured
    # What is shown is what was measured: errors of the shown poses, by the definitions, are those of the table.
    shown = View(run, trajectories=5)._run_folder()
    rows = list(csv.DictReader((run / "toss_errors_A.csv").read_text().splitlines()))
    for k, (true, predicted) in enumerate(shown.pairs):
        assert true is not None
        np.testing.assert_allclose(true.x[0], predicted.x[0], atol=1e-12)
        np.testing.assert_allclose(true.v[0], predicted.v[0], atol=1e-12)
        middles = [np.asarray(box_points(shown.system, part.x))[:, 0] for part in (true, predicted)]
        np.testing.assert_allclose(middles[0], tosses.x[8 + k, :, 0], atol=1e-12)
        error = 100 * np.linalg.norm(middles[0] - middles[1], axis=1).mean() / 0.1
        assert error == pytest.approx(float(rows[k]["position_percent"]), abs=1e-4)
        assert predicted.contact.any()
