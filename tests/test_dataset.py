"""Chunks and datasets: what may be learned from, and in which proportion."""

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console
from systems import refused

import carom
from carom.cli.learn import Learn
from carom.cli.systems import Chosen
from carom.learning.dataset import Chunks, Dataset, closing, contact_flags, recording_of, trajectory_of


def recording(n=4, times=12, contact=None, dt=0.01, points=1):
    x = np.random.default_rng(0).normal(size=(n, times, points, 2))
    return carom.Recording.of(x, np.zeros_like(x), dt=dt, contact=contact)


def test_chunks_never_start_in_contact_and_are_sorted_by_contact():
    flags = np.zeros((1, 8), bool)
    flags[0, [3, 4]] = True
    chunks = Chunks.of(flags, np.array([8]), length=3)
    # Possible starts are 0 to 5; 3 and 4 are in contact; 1 and 2 reach index 3.
    assert chunks.smooth[0].tolist() == [0, 5]
    assert chunks.impact[0].tolist() == [1, 2]
    assert chunks.count() == (2, 2)


def test_chunks_stay_within_each_trajectory():
    chunks = Chunks.of(np.zeros((3, 8), bool), np.array([8, 4, 2]), length=3)
    assert [s.tolist() for s in chunks.smooth] == [[0, 1, 2, 3, 4, 5], [0, 1], []]


def test_draw_is_even_over_trajectories_and_keeps_the_share_of_contact():
    flags = np.zeros((50, 40), bool)
    flags[:25, 20] = True
    chunks = Chunks.of(flags, np.full(50, 40), length=5)
    trajectory, start = chunks.draw(np.random.default_rng(0), 1000, 0.5)
    assert np.bincount(trajectory).tolist() == [20] * 50
    with_contact = np.array([s in chunks.impact[t] for t, s in zip(trajectory, start, strict=True)])
    assert not with_contact[trajectory >= 25].any()
    # 500 fair coins: five standard deviations are 56.
    assert abs(with_contact.sum() - 250) < 56


def test_flags_are_recorded_or_found_from_gaps():
    floor = carom.System(bodies=[carom.PointMass(1.0, 0.1)], contacts=[carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0))])
    x = np.full((2, 3, 1, 2), 0.5)
    x[1, 2, 0, 1] = 0.05
    data = carom.Recording.of(x, np.zeros_like(x), dt=0.1)
    assert np.argwhere(contact_flags(data, floor)).tolist() == [[1, 2]]
    assert closing(data, floor).tolist() == [1]
    flagged = carom.Recording.of(x, np.zeros_like(x), dt=0.1, contact=np.ones((2, 3), bool))
    assert contact_flags(flagged, floor).all()


def test_split_keeps_every_trajectory_once():
    data = recording(n=10)
    parts = Dataset.split(data, val=0.3, seed=1)
    assert (parts.train.n_trajectories, parts.val.n_trajectories) == (7, 3)
    both = np.concatenate([parts.train.x, parts.val.x])
    assert np.array_equal(np.sort(both[:, 0, 0, 0]), np.sort(data.x[:, 0, 0, 0]))


def test_sessions_are_not_shared_by_training_validation_and_test(tmp_path):
    """What `carom learn` holds out is whole sessions, so that no test trajectory is like one that was learned from."""
    x = np.random.default_rng(0).normal(size=(24, 5, 1, 2))
    x[:, :, 0, 0] += np.repeat(100.0 * np.arange(8), 3)[:, None]  # the session can be read from the positions
    data = carom.Recording.of(x, np.zeros_like(x), dt=0.01, group=np.repeat(np.arange(8), 3))
    carom.save_recording(tmp_path / "data.h5", data)
    system = carom.System(bodies=[carom.PointMass(1.0, 0.1)], dim=2)
    chosen = Chosen("mine.py", system, b"")
    parts, test = Learn("mine.py", data=tmp_path / "data.h5").data_sets(chosen, Console())
    sessions = [set(np.round(part.x[:, 0, 0, 0] / 100).astype(int)) for part in (parts.train, parts.val, test)]
    assert sorted(session for part in sessions for session in part) == list(range(8))
    counts = [part.n_trajectories for part in (parts.train, parts.val, test)]
    assert counts == [18, 3, 3]
    two = carom.Recording.of(x, np.zeros_like(x), dt=0.01, group=np.repeat([4, 9], 12))
    carom.save_recording(tmp_path / "two.h5", two)
    with refused("data must hold at least 3 sessions (group), to train, validate and test; it held 2."):
        Learn("mine.py", data=tmp_path / "two.h5").data_sets(chosen, Console())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Dataset(recording(), recording(points=2)), "of one system"),
        (lambda: Dataset(recording(), recording(dt=0.02)), "one time step"),
        (lambda: Dataset.split(recording(n=1)), "at least 2 trajectories"),
        (lambda: Dataset.split(recording(), val=1.0), "val must be a share"),
    ],
    ids=["points", "dt", "one", "share"],
)
def test_datasets_that_do_not_fit_are_refused(make, message):
    with pytest.raises(carom.CaromError, match=message):
        make()


def test_a_trajectory_goes_through_a_recording_unchanged():
    data = recording(contact=np.eye(4, 12, dtype=bool))
    one = trajectory_of(data, 2)
    assert np.array_equal(one.x, data.x[2])
    assert np.array_equal(one.contact, data.contact[2])
    batch = carom.Trajectory(
        x=jnp.asarray(data.x),
        v=jnp.asarray(data.v),
        contact=jnp.asarray(data.contact),
        time=jnp.asarray(data.time),
        overflow=jnp.zeros((4, 12), int),
        residual=jnp.zeros((4, 12)),
    )
    again = recording_of(batch, task="t", source="s")
    assert np.array_equal(again.x, data.x)
    assert again.dt == pytest.approx(data.dt, rel=1e-12)  # time is summed in steps
