"""Run folders: metrics, checkpoints, and what is refused."""

import jax.numpy as jnp
import numpy as np
import pytest

import carom
from carom.atomic import replacing, write_whole
from carom.learning.run import CONFIG, METRICS, RunFolder


@pytest.fixture
def run(tmp_path):
    folder = RunFolder.create(tmp_path / "run", {"task": "cp3"})
    yield folder
    folder.close()


def test_metrics_round_trip_without_values_that_are_not_json(run):
    run.log({"epoch": 1, "loss": float("nan"), "friction": [0.5, float("inf")]})
    run.log({"epoch": 2, "loss": np.float64(0.25), "friction": np.array([0.5, 1.0])})
    assert run.metrics() == [
        {"epoch": 1, "loss": None, "friction": [0.5, None]},
        {"epoch": 2, "loss": 0.25, "friction": [0.5, 1.0]},
    ]
    run.rewind_metrics(1)
    assert [m["epoch"] for m in run.metrics()] == [1]


def test_a_line_cut_off_by_a_kill_is_left_out_and_a_damaged_one_is_named(run):
    run.log({"epoch": 1})
    path = run.path / METRICS
    path.write_text(path.read_text() + '{"epoch": 2, "lo')
    assert run.metrics() == [{"epoch": 1}]
    path.write_text('{"epoch": 1\n{"epoch": 2}\n')
    with pytest.raises(carom.CaromError, match="line 1"):
        run.metrics()


def test_checkpoints_come_back_as_they_were(run):
    state = {"a": jnp.arange(3.0), "b": jnp.asarray(7), "c": "not an array"}
    assert run.restore_checkpoint(state) is None
    run.save_checkpoint(1, state)
    run.save_checkpoint(2, {**state, "b": jnp.asarray(8)})
    run.close()
    again = RunFolder.open(run.path).restore_checkpoint({**state, "a": jnp.zeros(3)})
    assert again["a"].tolist() == [0, 1, 2]
    assert int(again["b"]) == 8
    assert again["c"] == "not an array"


def test_a_damaged_checkpoint_is_refused_with_advice(run):
    state = {"a": jnp.arange(3.0)}
    run.save_checkpoint(1, state)
    run.close()
    for file in (run.path / "checkpoints" / "1").rglob("*"):
        if file.is_file():
            file.write_bytes(b"x")
    with pytest.raises(carom.CaromError, match="cannot be restored"):
        RunFolder.open(run.path).restore_checkpoint(state)


def test_folders_that_cannot_be_used_are_refused(tmp_path, run):
    with pytest.raises(carom.CaromError, match="already holds a run"):
        RunFolder.create(run.path, {})
    with pytest.raises(carom.CaromError, match="not a run folder"):
        RunFolder.open(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(carom.CaromError, match="cannot make the run folder"):
        RunFolder.create(tmp_path / "file" / "run", {})
    (run.path / CONFIG).write_text("{")
    with pytest.raises(carom.CaromError, match="not valid JSON"):
        run.read_json(CONFIG)


def test_writing_leaves_the_old_file_or_the_new_one(tmp_path):
    path = tmp_path / "file"
    write_whole(path, b"old")

    def fail():
        with replacing(path) as temporary:
            temporary.write_bytes(b"ne")
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail()
    assert path.read_bytes() == b"old"
    write_whole(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
    with pytest.raises(carom.CaromError, match="cannot be written"):
        write_whole(tmp_path / "missing" / "file", b"")
