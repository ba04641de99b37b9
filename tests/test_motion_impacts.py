"""Impacts that motion shows: which bodies met; and what `carom check` and `carom import` do with positions alone."""

import numpy as np
import pytest
from systems import refused

import carom
from carom.cli.main import main
from carom.learning.estimation.inspection import inspect_observations, inspect_recording
from carom.recordings.motion_impacts import body_points, impact_counts, motion_impacts
from carom.recordings.observations import Observations, load_observations

WALLS = """import carom
system = carom.System(
    bodies=[carom.PointMass(1.0, 0.1), carom.PointMass(1.0, 0.1)],
    contacts=[carom.DiskPlane([0, 1], (0.0, 0.0), (1.0, 0.0)), carom.DiskPlane([0, 1], (1.0, 0.0), (-1.0, 0.0)),
              carom.DiskDisk([(0, 1)])])
"""
TIME = 0.01 * np.arange(60)


def system() -> carom.System:
    names: dict = {}
    exec(WALLS, names)
    return names["system"]


def met(noise: float = 0.0) -> Observations:
    """Two disks of 0.1 m between walls at 0 and 1 m, of equal mass: one hits the other, which hits the right wall."""
    rng = np.random.default_rng(0)
    speed = np.linspace(1.6, 2.0, 5)[:, None]
    first = (0.5 - 0.3) / speed  # when the gap of 0.2 m is closed
    second = first + (0.9 - 0.7) / speed
    one = 0.3 + speed * np.minimum(TIME, first)
    two = 0.7 + speed * np.clip(TIME - first, 0, second - first) - speed * np.maximum(TIME - second, 0)
    x = np.stack([np.stack([one, 0.02 * TIME + 0 * one], -1), np.stack([two, 0 * two], -1)], axis=2)
    # What follows, when the second comes back, is left out.
    return Observations.checked(x + noise * rng.normal(size=x.shape), TIME, length=np.full(5, 30))


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_geometry_tells_which_bodies_met(noise):
    found = motion_impacts(met(noise), system())
    assert impact_counts(found, system()) == {"1-wall": 5, "0-1": 5}
    pair = [impact for impact in found if len(impact.bodies) == 2]
    assert [impact.trajectory for impact in pair] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(
        [i.time for i in pair], 0.2 / np.linspace(1.6, 2.0, 5), atol=1e-9 if noise == 0 else 1e-3
    )


def test_the_points_of_bodies():
    assert body_points(system()) == [(0,), (1,)]
    assert body_points(carom.task("cube")) == [(0, 1, 2, 3)]


def test_what_positions_alone_show_of_a_system():
    found = {finding.check: finding for finding in inspect_observations(met(1e-4), system())}
    assert found["impacts seen in the motion"].found == "10 (1-wall 5, 0-1 5)"
    assert found["points not seen"].found == "none"
    assert found["time between samples"].found == "0.01 s, always"
    # Two impacts in 30 samples are in a third of the differences of fourth order: their median is half as much more.
    assert found["noise of positions"].found.startswith("at most 0.0001")
    with refused("the system 4 in 3D"):
        inspect_observations(met(), carom.task("cube"))
    seen = met(1e-4)
    recording = carom.Recording.of(seen.x[:, :30], np.gradient(seen.x[:, :30], 0.01, axis=1), dt=0.01)
    shown = {finding.check: finding for finding in inspect_recording(recording, system()).findings}
    assert shown["impacts seen in the motion"].found == "10 (1-wall 5, 0-1 5)"


def test_commands_keep_what_was_recorded(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    (tmp_path / "walls.py").write_text(WALLS)
    seen = met(1e-4)
    for name, rows in (("one", [0, 1]), ("two", [2, 3, 4])):
        lines = ["trajectory,time,x0,y0,x1,y1"]
        for k in rows:
            for s in range(30):
                cells = ["" if s == 7 else repr(float(number)) for number in seen.x[k, s].ravel()]
                lines += [] if s == 9 else [",".join([str(k), f"{TIME[s]:.3f}", *cells])]
        (tmp_path / f"{name}.csv").write_text("\n".join(lines) + "\n")
    main(["import", "points", "one.csv", "two.csv", "--out", "both.h5"])
    assert "5 trajectories of up to 29 samples, 2 points in 2D, no velocities, 3.4% not seen" in capsys.readouterr().out
    found = load_observations("both.h5")
    assert found.group == ("one.csv",) * 2 + ("two.csv",) * 3
    np.testing.assert_array_equal(found.x[:, 8:10], seen.x[:, [8, 10]])
    np.testing.assert_allclose(found.time[0], np.delete(TIME[:30], 9), atol=1e-15)
    main(["check", "both.h5", "--task", "walls.py", "--no-tell"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "10 (1-wall 5, 0-1 5)" in said
    assert "3.4%" in said
    main(["check", "one.csv"])
    assert "0.01 s in the median, from 0.01 to 0.02 s" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    with pytest.raises(SystemExit):
        main(["import", "poses", "both.h5", "--positions-only"])
    assert "it holds points, not poses" in capsys.readouterr().err


def test_recorded_velocities_are_kept_or_left_out(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    x = np.random.default_rng(0).normal(size=(2, 6, 1, 2))
    carom.save_recording("own.npz", carom.Recording.of(x, 2 * x, dt=0.1))
    main(["import", "points", "own.npz", "--scale", "0.001", "--out", "with.h5"])
    np.testing.assert_allclose(carom.load_recording("with.h5").v, 0.002 * x)  # whole, so a recording too
    main(["import", "points", "own.npz", "--positions-only", "--out", "without.h5"])
    assert load_observations("without.h5").v is None
    zero = np.zeros((2, 8))
    poses = {"pos": np.zeros((2, 8, 3)), "quat": np.stack([zero + 1, zero, zero, zero], -1), "dt": 0.1}
    poses["pos"][0, 3] = np.nan
    np.savez("poses.npz", **poses)
    main(["import", "poses", "poses.npz", "--positions-only", "--out", "poses.h5"])
    assert load_observations("poses.h5", carom.task("cube")).seen.sum() == 15 * 4
    capsys.readouterr()
