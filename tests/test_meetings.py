"""Recordings whose impacts happen between the samples: motions in closed form, and of a program that is not carom."""

import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.cli.estimation import is_for_estimator, shows_impacts
from carom.cli.main import main
from carom.cli.systems import Chosen
from carom.learning.config import LearnConfig
from carom.learning.estimation.inspection import inspect_recording
from carom.learning.meetings import Meetings, meetings
from carom.recordings.observations import Observations

WALLS = carom.System(
    bodies=[carom.PointMass(1.0, 0.1)],
    contacts=[
        carom.DiskPlane([0], (0.0, 0.0), (1.0, 0.0)),
        carom.DiskPlane([0], (1.0, 0.0), (-1.0, 0.0)),
    ],
    restitution=1.0,
)


def between_walls(n: int, *, walls: bool, noise: float = 0.0) -> carom.Recording:
    """A ball of 0.1 m between walls at 0 and 1 m, elastic, at 1 to 2 m/s: a triangle wave, sampled at 100 Hz for 2 s.

    Without `walls`, it goes on for ever.
    """
    rng = np.random.default_rng(0)
    time = 0.01 * np.arange(200)
    start, speed = rng.uniform(0.2, 0.8, (n, 1)), rng.choice([-1, 1], (n, 1)) * rng.uniform(1, 2, (n, 1))
    way = start - 0.1 + speed * time  # in a room of width 0.8 for the centre
    along, toward = (0.8 - np.abs(way % 1.6 - 0.8), np.where(way % 1.6 < 0.8, 1, -1)) if walls else (way, 1)
    across = rng.uniform(-0.5, 0.5, (n, 1)) * np.ones_like(time)
    x = np.stack([0.1 + along, across * time], axis=-1)[:, :, None]
    v = np.stack([speed * toward * np.ones_like(time), across], axis=-1)[:, :, None]
    return carom.Recording.of(x + noise * rng.normal(size=x.shape), v, dt=0.01)


@pytest.mark.parametrize("noise", [0.0, 2e-4])
def test_impacts_between_the_samples_are_found(noise):
    data = between_walls(10, walls=True, noise=noise)
    found = meetings(data, WALLS)
    # Ten balls of 1 to 2 m/s cross 0.8 m in 2 s two to five times each; a late one is between two samples and a third.
    assert found.overlapping == 0
    assert 15 < found.between < 100
    assert found.not_seen


@pytest.mark.slow
@pytest.mark.ci_budget
def test_impacts_at_the_samples_are_found():
    """carom's own motion through the same walls overlaps them, but for samples where noise hides it."""
    rng = np.random.default_rng(1)
    x0 = np.stack([rng.uniform(0.3, 0.7, 10), np.zeros(10)], axis=-1)[:, None]
    v0 = np.stack([rng.uniform(1, 2, 10), np.zeros(10)], axis=-1)[:, None]
    motion = carom.simulate(WALLS, jnp.asarray(x0), jnp.asarray(v0), dt=0.01, steps=199)
    data = carom.recording_of(motion)
    found = meetings(data, WALLS)
    assert found.between == 0
    assert found.overlapping > 5
    ragged = carom.Recording.of(data.x, data.v, dt=0.01, length=np.full(10, 5))
    assert meetings(ragged, WALLS) == Meetings(0, 0)  # what comes after a trajectory's end is padding


def test_such_a_recording_is_refused_with_the_reason(tmp_path, monkeypatch, capsys):
    data = between_walls(10, walls=True)
    config = carom.LearnConfig(epochs=1)
    reason = "impacts happen between the samples"
    with refused(f"the recording cannot tell friction and restitution: {reason}. Where bodies meet, 0 of"):
        carom.identify(WALLS, data, learned=("mass", "restitution"))
    with refused(f"the training data cannot tell friction and restitution: {reason}"):
        carom.learn(WALLS, carom.Dataset.split(data), config, progress=False)
    advised = {f.check: f.advice for f in inspect_recording(data, WALLS).findings}
    assert reason in advised["where bodies meet"]
    carom.save_recording(tmp_path / "data.h5", data)
    chosen = Chosen("walls.py", WALLS)
    assert not shows_impacts(Observations.of(data), data, WALLS)
    assert is_for_estimator(tmp_path / "data.h5", LearnConfig.learn, LearnConfig.learn, chosen)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    (tmp_path / "walls.py").write_text(
        "import carom\n"
        "system = carom.System(\n"
        "    bodies=[carom.PointMass(1.0, 0.1)],\n"
        "    contacts=[carom.DiskPlane([0], (0.0, 0.0), (1.0, 0.0)),\n"
        "              carom.DiskPlane([0], (1.0, 0.0), (-1.0, 0.0))])\n"
    )
    with pytest.raises(SystemExit) as stop:
        main(["learn", "walls.py", "--data", "data.h5", "--out", "run", "--learn", "restitution", "potential"])
    assert stop.value.code == 2
    line = capsys.readouterr().err.strip()
    assert reason in line
    assert "\n" not in line


@pytest.mark.slow
def test_bodies_that_never_meet_may_be_learned_from():
    """No impact and no overlap: masses and potential, and nothing is told of friction and restitution."""
    data = between_walls(10, walls=False)
    far = carom.System(bodies=WALLS.bodies, contacts=[carom.DiskPlane([0], (0.0, 9.0), (0.0, -1.0))], friction=0.3)
    assert meetings(data, far) == Meetings(0, 0)
    found = carom.identify(far, data)
    assert {e.verdict for e in (*found.friction, *found.restitution)} == {"not identified"}
    # With both held, a recording whose impacts are between the samples may be looked at too.
    assert carom.identify(WALLS, between_walls(10, walls=True), learned=("mass",)).friction == []


@pytest.mark.parametrize("name", ["pucks_exact", "pucks_noisy"])
def test_recordings_of_a_program_that_meets_impacts_at_their_own_time(reference_dir, name):
    with np.load(reference_dir / "worlds" / f"{name}.npz") as file:
        world = {part: file[part] for part in ("x", "v_true", "time")}
    pucks = carom.System(
        bodies=[carom.PointMass(0.1, 0.1), carom.PointMass(0.169, 0.15)],
        contacts=[
            *(carom.DiskPlane([0, 1], (0.0, 0.0), normal) for normal in ((1.0, 0.0), (0.0, 1.0))),
            *(carom.DiskPlane([0, 1], (1.0, 1.0), normal) for normal in ((-1.0, 0.0), (0.0, -1.0))),
            carom.DiskDisk([(0, 1)]),
        ],
    )
    data = carom.Recording.of(world["x"], world["v_true"], time=world["time"])
    assert meetings(data, pucks).overlapping == 0
    with refused("impacts happen between the samples"):
        carom.identify(pucks, data)
