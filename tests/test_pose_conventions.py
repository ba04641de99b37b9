"""In which order and direction quaternions are written: what motion tells of it, and what it does not."""

import equinox as eqx
import numpy as np
import pytest
import scipy.integrate
from scipy.spatial.transform import Rotation
from test_cli import command, refused

import carom
from carom.recordings.pose_conventions import READINGS, Reading, check_convention
from carom.recordings.poses import PoseRecording, load_poses, poses_of

RATE = 120
RIGHT, LAST, BACK, BOTH = READINGS


@pytest.fixture(autouse=True)
def _apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def flights(moments, count=6, samples=40) -> PoseRecording:
    """Free flight of a body with these moments of inertia (Euler's equations, by SciPy), thrown in several ways."""
    rng, inertia = np.random.default_rng(0), np.array(moments, float)
    time, quaternion = np.arange(samples) / RATE, []

    def rate(_, state):
        q, w = state[:4], state[4:]
        turn = np.concatenate([[-q[1:] @ w], q[0] * w + np.cross(q[1:], w)]) / 2
        return np.concatenate([turn, -np.cross(w, inertia * w) / inertia])

    omega = []
    for _ in range(count):
        start = rng.normal(size=4)
        state = np.concatenate([start / np.linalg.norm(start), rng.normal(0, 5, 3)])
        found = scipy.integrate.solve_ivp(rate, (0, time[-1]), state, t_eval=time, rtol=1e-9, atol=1e-9).y.T
        quaternion.append(found[:, :4])
        omega.append(found[:, 4:])
    height = 1.5 + time - 4.905 * time**2
    position = np.stack([0.3 * time, 0 * time, height], axis=1)
    return PoseRecording.of(np.tile(position, (count, 1, 1)), quaternion, dt=1 / RATE, omega=np.array(omega))


def misread(poses: PoseRecording, written: Reading, *, omega: bool = False) -> PoseRecording:
    """As it is if the file has quaternions in one way, and they are read as w first, body to world."""
    out = eqx.tree_at(lambda p: p.quaternion, poses, written.written(poses.quaternion))
    return out if omega else eqx.tree_at(lambda p: p.omega, out, None, is_leaf=lambda part: part is None)


def test_orders_and_directions_are_those_of_scipy():
    turns = Rotation.random(5, rng=np.random.default_rng(0))
    first, last = turns.as_quat(scalar_first=True), turns.as_quat()
    np.testing.assert_array_equal(LAST.read(last), first)
    back = turns.inv().as_quat()
    np.testing.assert_allclose(Rotation.from_quat(BOTH.read(back), scalar_first=True).as_matrix(), turns.as_matrix())
    for reading in READINGS:
        np.testing.assert_array_equal(reading.read(reading.written(first)), first)


@pytest.mark.parametrize("moments", [(1, 1.3, 1.6), (1, 1, 0.4), (1, 1, 1.8)])
def test_free_flight_tells_one_of_two_pairs(moments):
    poses = flights(moments)
    right = check_convention(misread(poses, RIGHT), 0.1)
    assert (right.possible, right.wrong) == ((RIGHT, BOTH), "")
    assert "fits x, y, z, w, world to body too" in right.finding.found
    for written in (LAST, BACK):
        found = check_convention(misread(poses, written), 0.1)
        assert "of angular momentum would come and go" in found.wrong
        assert found.possible == (LAST, BACK)


def test_a_body_with_equal_moments_tells_nothing_and_that_is_said():
    poses = flights((1, 1, 1))
    for written in READINGS:
        found = check_convention(misread(poses, written), 0.1)
        assert (len(found.possible), found.wrong) == (4, "")
        assert found.finding.found == "the motion fits any order and direction"
        assert "--quaternion-order xyzw" in found.finding.advice


@pytest.mark.parametrize("written", READINGS, ids=str)
def test_recorded_rates_tell_all(written):
    found = check_convention(misread(flights((1, 1, 1)), written, omega=True), 0.1)
    assert found.possible == (written,)
    assert bool(found.wrong) == (written != RIGHT)


def test_noise_is_not_taken_for_another_reading():
    poses, rng = flights((1, 1.3, 1.6)), np.random.default_rng(0)
    for degrees in (0.1, 1.0):
        noise = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=(6 * 40, 3)))
        turns = Rotation.from_quat(poses.quaternion.reshape(-1, 4), scalar_first=True) * noise
        noisy = turns.as_quat(scalar_first=True).reshape(poses.quaternion.shape)
        assert not check_convention(misread(eqx.tree_at(lambda p: p.quaternion, poses, noisy), RIGHT), 0.1).wrong


@pytest.mark.slow
@pytest.mark.parametrize("written", READINGS, ids=str)
def test_a_cube_tells_by_the_table(cube_tosses, written):
    position, quaternion = poses_of(cube_tosses[0])
    poses = PoseRecording.of(position, quaternion, dt=1 / 148)
    found = check_convention(misread(poses, written), 0.1048)
    assert found.possible == (written,)
    assert bool(found.wrong) == (written != RIGHT)


@pytest.mark.parametrize("omega", [True, False])
@pytest.mark.parametrize("written", READINGS, ids=str)
def test_the_recorded_cube_tells(reference_dir, omega, written):
    poses, _ = load_poses(reference_dir / "cube_tosses_val.npz")
    found = check_convention(misread(poses, written, omega=omega), 0.1048)
    assert found.possible == (written,)
    assert bool(found.wrong) == (written != RIGHT)


def test_import_refuses_and_takes_the_option(tmp_path, capsys):
    poses = flights((1, 1.3, 1.6))
    np.savez("a.npz", position=poses.position, quaternion=LAST.written(poses.quaternion), dt=poses.dt)
    words = ("import", "poses", "a.npz", "--size", "0.1", "--out", "a.h5")
    text = refused(capsys, *words)
    assert "a.npz: quaternion does not seem to be w, x, y, z, body to world: in free flight" in text
    assert "Give --quaternion-order xyzw (likelier), or --quaternion-direction world-to-body." in text
    assert not (tmp_path / "a.h5").exists()
    command(*words, "--quaternion-order", "xyzw")
    x = carom.load_recording("a.h5").x
    turns = Rotation.from_quat(poses.quaternion.reshape(-1, 4), scalar_first=True).as_matrix()
    axes = (x[:, :, 1:] - x[:, :, :1]).reshape(-1, 3, 3)
    np.testing.assert_allclose(axes, turns.transpose(0, 2, 1), atol=1e-12)
    capsys.readouterr()
    # Who gives both options has the last word.
    command(*words, "--quaternion-order", "wxyz", "--quaternion-direction", "body-to-world")
    assert "may be" in " ".join(capsys.readouterr().out.split())


def test_import_names_its_options(capsys, tmp_path):
    np.savez("a.npz", x=np.zeros(3))
    assert "--size must be the body's width" in refused(capsys, "import", "poses", "a.npz")
