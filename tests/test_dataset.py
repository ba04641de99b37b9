"""Chunks and datasets: what may be learned from, and in which proportion."""

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from rich.console import Console
from systems import refused

import carom
from carom.cli.learn import Learn
from carom.cli.systems import Chosen
from carom.learning.dataset import Chunks, Dataset, closing, contact_flags, in_pieces, recording_of, trajectory_of


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


def motion(*batch, states=5):
    """A free point in the plane, simulated."""
    point = carom.System(bodies=[carom.PointMass(1.0)])
    x0 = jnp.arange(2.0 * int(np.prod(batch))).reshape(*batch, 1, 2)
    return carom.simulate(point, x0, jnp.ones_like(x0), dt=0.1, steps=states - 1)


def test_a_single_motion_becomes_a_recording():
    one, several = motion(), motion(3)
    recorded = carom.recording_of(one, source="mine")
    assert recorded.x.shape == (1, 5, 1, 2)
    np.testing.assert_array_equal(recorded.x[0], one.x)
    np.testing.assert_array_equal(recorded.v[0], one.v)
    assert recorded.contact is not None
    assert recorded.contact.shape == (1, 5)
    assert recorded.source == "mine"
    np.testing.assert_array_equal(carom.recording_of(several).x, several.x)


def test_what_is_no_recording_is_refused_with_what_to_do(tmp_path):
    one = motion()
    jaxtyping.config.update("jaxtyping_disable", True)  # the run-time checks would speak first
    try:
        with pytest.raises(carom.CaromError, match=r"it was Trajectory; .* give carom.recording_of"):
            carom.save_recording(tmp_path / "a.h5", one)  # pyright: ignore[reportArgumentType]
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    with pytest.raises(carom.CaromError, match=r"for one trajectory give x\[None\]"):
        carom.Recording.of(one.x, one.v, dt=0.1)


def test_a_recording_is_cut():
    flags = np.arange(24).reshape(2, 12) % 5 == 0
    data = recording(n=2, contact=flags)
    data = carom.Recording.of(data.x, data.v, dt=0.01, contact=flags, length=[12, 7], group=[3, 5])
    pieces = data.cut(5)
    np.testing.assert_array_equal(pieces.x, [data.x[0, :5], data.x[0, 5:10], data.x[1, :5]])
    np.testing.assert_array_equal(pieces.contact, [flags[0, :5], flags[0, 5:10], flags[1, :5]])
    assert pieces.group is not None
    assert (pieces.length.tolist(), pieces.group.tolist()) == ([5, 5, 5], [3, 3, 5])
    np.testing.assert_allclose(pieces.time, 0.01 * np.arange(5))
    with pytest.raises(carom.CaromError, match="samples must be from 2 to 12, the longest; it was 13"):
        data.cut(13)


def test_one_recording_is_cut_into_pieces():
    data = recording(n=1, times=103)
    pieces, word = in_pieces(data, 3, 5)
    np.testing.assert_array_equal(pieces.x.reshape(100, 1, 2), data.x[0, :100])
    assert "1 trajectory of up to 103 samples: cut into 10 pieces of 10" in word
    assert in_pieces(data, 1, 5) == (data, "")
    one_session = carom.Recording.of(data.x, data.v, dt=0.01, group=[7])
    assert Dataset.split(in_pieces(one_session, 3, 5)[0]).val.n_trajectories == 1
    with pytest.raises(
        carom.CaromError, match="it held 1 of up to 12 samples, which is too little to cut into pieces of 5"
    ):
        in_pieces(recording(n=1), 3, 5)


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
        (lambda: Dataset.split(recording(n=1)), r"at least 2 trajectories .* recording.cut\(samples\), with up to 6"),
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
