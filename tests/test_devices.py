"""Training on several devices and in several processes: the same as on one."""

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from carom.errors import CaromError
from carom.learning.training.devices import start_processes

TRAIN = """
import sys

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_compilation_cache_dir", None)
import carom
from carom.learning.config import LearnConfig
from carom.learning.dataset import Dataset
from carom.learning.training.devices import is_first, start_processes
from carom.learning.run import CONFIG, RunFolder
from carom.recordings.recording import Recording

folder, epochs, resume = sys.argv[1], int(sys.argv[2]), sys.argv[3] == "resume"
if len(sys.argv) > 4:
    start_processes(sys.argv[4], 2, int(sys.argv[5]))
system = carom.task("ground-wall")
x0, v0 = carom.sample(system, jax.random.key(0), 12)
motion = carom.simulate(system, x0, v0, dt=0.02, steps=40)
data = Recording.of(motion.x, motion.v, time=motion.time, contact=motion.contact)
# 33 chunks in batches of 11: neither can be halved.
config = LearnConfig(epochs=epochs, chunks_per_epoch=33, batch_size=11, chunk_length=3, width=8, depth=1, refine=False,
                     checkpoint_every=1)
run = None
if is_first():
    run = RunFolder.open(folder) if resume else RunFolder.create(folder, {})
learned, report = carom.learn(system, Dataset.split(data, val=0.2), config, run=run, progress=False)
if run is not None:
    run.close()
    run.write_json("result.json", {"friction": learned.friction, "restitution": learned.restitution,
                                   "devices": jax.device_count()})
"""


def train(folder: Path, epochs: int, *, resume: bool = False, processes: int = 1, devices: int = 1) -> dict:
    """Metrics and result of a training in processes of their own."""
    address = []
    if processes > 1:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = [f"127.0.0.1:{free.getsockname()[1]}"]
    flags = f"--xla_force_host_platform_device_count={devices}"
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags, "PYTHONPATH": os.getcwd()}
    base = [sys.executable, "-c", TRAIN, str(folder), str(epochs), "resume" if resume else "new"]
    started = [
        subprocess.Popen(
            [*base, *address, *([str(k)] if address else [])],
            env=environment,
            stderr=subprocess.PIPE,
            text=True,
        )
        for k in range(processes)
    ]
    for process in started:
        _, errors = process.communicate(timeout=150)
        assert process.returncode == 0, errors[-3000:]
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return {"losses": [json.loads(line)["loss"] for line in lines], **json.loads((folder / "result.json").read_text())}


def check_same(found: dict, one: dict) -> None:
    """Two devices, and what they came to: the shares of a batch are added in another order, which rounding shows."""
    assert found["devices"] == 2
    assert len(found["losses"]) == len(one["losses"]) == 2
    np.testing.assert_allclose(found["losses"], one["losses"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found["restitution"], one["restitution"], rtol=0, atol=1e-6)


@pytest.mark.slow
def test_two_processes_train_like_one(tmp_path):
    check_same(train(tmp_path / "two", 2, processes=2), train(tmp_path / "one", 2))


@pytest.mark.slow
def test_two_devices_train_like_one(tmp_path):
    check_same(train(tmp_path / "two", 2, devices=2), train(tmp_path / "one", 2))


@pytest.mark.slow
def test_a_checkpoint_of_two_processes_goes_on_in_one(tmp_path):
    whole = train(tmp_path / "whole", 4)
    train(tmp_path / "both", 2, processes=2)
    later = train(tmp_path / "both", 4, resume=True)
    np.testing.assert_allclose(later["losses"][-1], whole["losses"][-1], rtol=0.2)
    assert len(later["losses"]) == 4
    train(tmp_path / "single", 2)
    again = train(tmp_path / "single", 4, resume=True, processes=2)
    np.testing.assert_allclose(again["losses"], later["losses"], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("localhost:1234", 2, 2), "process_id"),
        (("localhost:1234", 0, 0), "process_count"),
        (("localhost", 2, 0), "coordinator"),
    ],
)
def test_wrong_processes_are_refused(arguments, name):
    with pytest.raises(CaromError, match=name):
        start_processes(*arguments)
