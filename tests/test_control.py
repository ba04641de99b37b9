"""Optimal control through contacts: known answers, the true system as judge, and going on after a stop."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.learning.run import RunFolder
from carom.tasks import control as control_module
from carom.tasks.control import ControlConfig, optimize, perform
from carom.tasks.problems import find_control


def solved(name: str, **settings):
    problem = find_control(name)
    system = carom.task(problem.task)
    return problem, system, optimize(problem, system, ControlConfig(**settings), progress=False)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_bounce_once_by_hand():
    """Elastic, no gravity: it ends at `x_0 + T v_x`, `2 r - y_0 - T v_y` after the bounce, with r = 0.1 and T = 1."""
    _, _, report = solved("bounce-once")
    assert np.allclose(report.choice["velocity"], [1.0, -1.4], atol=1e-5)
    assert report.miss < 1e-5
    assert report.losses[0] > 1e5 * report.losses[-1]


@pytest.mark.slow
def test_the_spin_that_sends_a_disk_straight_up_by_hand():
    """The disk sticks: a third of the speed at which it touches, `v_x + r w`, is taken off v_x. So `r w = 2 v_x`."""
    problem, _, report = solved("throw-vertical")
    assert np.allclose(report.choice["spin"], 2 * problem.velocity[0] / problem.radius, rtol=1e-5)
    assert report.miss < 1e-3


@pytest.mark.slow
def test_throw_hit_in_finer_steps():
    """Where the disk lands for the second time does not hang on the time step, nor on how it is measured."""
    problem, system, report = solved("throw-hit")
    assert report.miss < 1e-3
    fine = dataclasses.replace(problem, dt=problem.dt / 8, steps=8 * problem.steps)
    motion = perform(fine, system, report.choice)
    centers = np.asarray(motion.x[:, 0])
    low = np.flatnonzero(np.asarray(motion.contact[1:]) & (centers[1:, 1] < 0.12))
    assert np.allclose(centers[low[1]], problem.aim, atol=0.01)
    assert float(fine.miss(motion)) < 1e-3


@pytest.mark.slow
def test_ground_then_wall():
    _, _, report = solved("ground-wall")
    assert report.miss < 1e-3
    met = np.flatnonzero(report.after.contact)
    assert len(met) == 2
    ground, wall = np.asarray(report.after.x[met, 0])
    assert ground[1] < 0.12
    assert wall[0] > 1.63


@pytest.mark.slow
def test_two_balls_reach_the_analytic_optimum():
    _, _, report = solved("two-balls")
    assert abs(report.loss - 1.396542) < 2e-4
    force = np.asarray(report.choice["force"])
    assert np.allclose(force[:, 0], force[:, 1], atol=1e-3)
    assert np.abs(force[-1]).max() < 1e-2  # after the impact, force is wasted


@pytest.mark.slow
def test_billiards():
    problem, system, report = solved("billiards")
    assert report.miss < 1e-3
    assert len(report.losses) <= 201
    assert np.asarray(system.gaps(report.before.x[0])).min() > -1e-12
    again = perform(problem, system, report.choice)
    assert float(jnp.linalg.norm(again.x[-1, -1] - jnp.array([0.9, 0.75]))) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("problem", ["throw-hit", "throw-vertical"])
def test_with_learned_properties_on_the_true_system(problem):
    """Learned from 100 trajectories of the disk: friction, restitution and the potential."""
    chosen, truth = find_control(problem), carom.task("throw")
    data = carom.make_recording(truth, jax.random.key(3), 100)
    learned, _ = carom.learn(truth, carom.Dataset.split(data), carom.LearnConfig(epochs=40), progress=False)
    report = optimize(chosen, learned, progress=False)
    assert report.miss < 1e-3
    assert float(chosen.miss(perform(chosen, truth, report.choice))) < 1e-2


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["adam", "lbfgs"])
def test_a_run_that_was_stopped_goes_on_to_the_same_end(tmp_path, monkeypatch, optimizer):
    monkeypatch.setattr(control_module, "CHECKPOINT_EVERY", 2)
    problem, system = find_control("bounce-once"), carom.task("bounce-once")
    config = ControlConfig(iterations=7, optimizer=optimizer, enough=0.0)
    whole = optimize(problem, system, config, progress=False)

    class Dying(RunFolder):
        def log(self, metrics):
            super().log(metrics)
            if metrics["epoch"] == 5:
                raise KeyboardInterrupt

    run = Dying.create(tmp_path / "run", {})
    with pytest.raises(KeyboardInterrupt):
        optimize(problem, system, config, run=run, progress=False)
    run.close()
    run = RunFolder.open(tmp_path / "run")
    resumed = optimize(problem, system, config, run=run, progress=False)
    run.close()
    assert resumed.losses == whole.losses
    assert np.array_equal(resumed.choice["velocity"], whole.choice["velocity"])
    assert [row["epoch"] for row in run.metrics()] == list(range(len(whole.losses)))


def test_what_cannot_be_is_refused():
    problem, system = find_control("bounce-once"), carom.task("bounce-once")
    with refused("problem must be one of billiards, bounce-once, ground-wall, throw-hit, throw-vertical, two-balls"):
        find_control("bounce-twice")
    for setting, text in (
        ({"iterations": 0}, "iterations must be at least 1; it was 0"),
        ({"learning_rate": -1.0}, "learning_rate must be a positive number; it was -1.0"),
        ({"optimizer": "sgd"}, "optimizer must be one of ['adam', 'lbfgs']; it was 'sgd'"),
        ({"enough": -1.0}, "enough must not be negative"),
    ):
        with refused(text):
            optimize(problem, system, ControlConfig(**setting), progress=False)
    with refused("x0 starts in an impossible place"):
        optimize(dataclasses.replace(problem, place=(0.0, -1.0)), system, progress=False)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_the_command_writes_what_it_found(tmp_path, monkeypatch, capsys):
    from carom.cli.main import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    main(["control", "bounce-once"])
    text = capsys.readouterr().out
    assert "miss (m)" in text
    folder = tmp_path / "runs" / "control-bounce-once"
    found = json.loads((folder / "report.json").read_text())
    assert np.allclose(found["choice"]["velocity"], [1.0, -1.4], atol=1e-5)
    assert found["on_true_system"] is None
    for name in ("config.json", "metrics.jsonl", "control.png", "before_after.gif"):
        assert (folder / name).stat().st_size > 0
    with pytest.raises(SystemExit):
        main(["control", "bounce-once", "--out", str(folder)])
    assert "already holds a run" in capsys.readouterr().err
