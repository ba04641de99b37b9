"""Run folders: metrics, checkpoints, and what is refused."""

import os
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.atomic import replacing, write_whole
from carom.learning.checkpoints import CHECKSUMS
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
    for rest in (b'{"epoch": 2, "lo', b'{"epoch": 2}', b"\0\0\0"):
        path.write_bytes(path.read_bytes() + rest)
        assert run.metrics() == [{"epoch": 1}]
    run.log({"epoch": 2})  # a line of its own
    assert run.metrics() == [{"epoch": 1}, {"epoch": 2}]
    for line in (b'{"epoch": 1', b"\xff", b"1", b"{}"):
        path.write_bytes(line + b'\n{"epoch": 2}\n')
        with pytest.raises(carom.CaromError, match=r"line 1 of .* is damaged"):
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


STATE = {"a": jnp.arange(300.0), "b": jnp.asarray(0)}


def files_of(run, epoch: int) -> list[Path]:
    return sorted(file for file in (run.path / "checkpoints" / str(epoch)).rglob("*") if file.is_file())


def saved(run, *epochs: int):
    """A run with checkpoints of these epochs, whose number is in them."""
    for epoch in epochs:
        run.save_checkpoint(epoch, {**STATE, "b": jnp.asarray(epoch)})
    run.close()
    return RunFolder.open(run.path)


@pytest.mark.parametrize("kind", ["bit flipped", "cut off", "missing"])
def test_a_damaged_checkpoint_is_refused_with_advice(run, kind):
    again = saved(run, 1)
    rng = np.random.default_rng(0)
    files = [file for file in files_of(run, 1) if file.stat().st_size and (file.name, kind) != (CHECKSUMS, "missing")]
    assert len(files) > 5
    for file in files:
        data = file.read_bytes()
        at = int(rng.integers(len(data)))
        if kind == "missing":
            file.unlink()
        else:
            file.write_bytes(data[:at] + (b"" if kind == "cut off" else bytes([data[at] ^ 1]) + data[at + 1 :]))
        name = re.escape(str(file.relative_to(run.path / "checkpoints" / "1")))
        with pytest.raises(carom.CaromError, match=f"{name}.*delete the folder") as error:
            again.restore_checkpoint(STATE)
        assert "\n" not in str(error.value)
        file.write_bytes(data)
    assert int(again.restore_checkpoint(STATE)["b"]) == 1
    again.close()


@pytest.mark.parametrize("checksums", [True, False])
def test_from_a_damaged_checkpoint_it_goes_back_to_the_one_before(run, checksums):
    again = saved(run, 1, 2, 3)
    for file in files_of(run, 3):
        file.write_bytes(b"x")
    if not checksums:  # as older versions of carom wrote them
        for epoch in (2, 3):
            (run.path / "checkpoints" / str(epoch) / CHECKSUMS).unlink()
    with pytest.warns(UserWarning, match=r"checkpoints/3 .*goes on from the checkpoint of epoch 2"):
        assert int(again.restore_checkpoint(STATE)["b"]) == 2
    again.save_checkpoint(3, {**STATE, "b": jnp.asarray(30)})
    again.close()
    assert int(RunFolder.open(run.path).restore_checkpoint(STATE)["b"]) == 30


def test_a_checkpoint_of_other_settings_is_refused(run):
    again = saved(run, 1)
    with pytest.raises(carom.CaromError, match="of a training with other settings"):
        again.restore_checkpoint({**STATE, "c": jnp.zeros(2)})
    again.close()


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


def test_settings_are_the_same_after_json_has_kept_them(tmp_path):
    settings = {
        "task": "cube",
        "learn": ("mass",),
        "limit": np.inf,
        "tosses": {"horizons": (8, 16), "space": ((0.1, 1.0), None), "rounds": np.int64(3)},
    }
    run = RunFolder.create(tmp_path / "tosses", settings)
    run.check_same({**settings, "started": "later"})
    with refused("was started with horizons = [8, 16], not [8]. Use the same options"):
        run.check_same({**settings, "tosses": {**settings["tosses"], "horizons": (8,)}})
    with refused("was started with learn = ['mass'], not ['friction']"):
        run.check_same({**settings, "learn": ("friction",)})


def test_what_a_kill_left_is_removed_once_it_is_old(tmp_path):
    old, new, other = (
        tmp_path / name for name in (f".carom-{'a' * 16}.tmp.h5", f".carom-{'b' * 16}.tmp", ".carom-mine")
    )
    for path in (old, new, other):
        path.touch()
    for path in (old, other):
        os.utime(path, (0, 0))
    write_whole(tmp_path / "file", b"new")
    assert {path.name for path in tmp_path.iterdir()} == {"file", new.name, other.name}


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
