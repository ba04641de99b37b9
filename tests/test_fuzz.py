"""Readers of files against damage: whatever stands in a file, one clear error or the right content comes out.

CAROM_FUZZ is the number of damaged files of each kind, if more than the usual are wanted.
"""

import os

import jax
import numpy as np
import pytest
from systems import ball_on_floor

import carom
from carom.errors import CaromError
from carom.learning.model_file import load_model_into, read_model_header
from carom.recordings.files import load_recording

EXAMPLES = int(os.environ.get("CAROM_FUZZ", "150"))


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A file with some of its bytes changed, cut out, repeated, or put in."""
    kind, at = rng.integers(5), int(rng.integers(len(data)))
    length = int(rng.integers(1, 40))
    if kind == 0:  # one bit
        return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :]
    if kind == 1:  # the rest is missing
        return data[:at]
    if kind == 2:  # a piece is missing
        return data[:at] + data[at + length :]
    if kind == 3:  # a piece is there twice
        return data[: at + length] + data[at:]
    return data[:at] + rng.bytes(length) + data[at + length :]


def nested(value):
    """What a model file says of itself, in a form that can be compared."""
    return {k: nested(v) for k, v in value.items()} if isinstance(value, dict) else value


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("sound")
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(2, 2, 4, 1, 2))
    recording = carom.Recording.of(x, v, dt=0.01, task="mine", contact=np.zeros((2, 4), bool))
    for ending in ("h5", "npz", "csv"):
        carom.save_recording(folder / f"a.{ending}", recording)
    carom.save_model(folder / "a.carom", ball_on_floor(friction=0.3, restitution=0.4))
    return {path.suffix: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("ending", [".h5", ".npz", ".csv"])
def test_damaged_trajectory_files(files, ending, tmp_path):
    rng, path = np.random.default_rng(1), tmp_path / f"a{ending}"
    path.write_bytes(files[ending])
    sound, refused = load_recording(path), []
    for _ in range(EXAMPLES):
        path.write_bytes(damaged(files[ending], rng))
        try:
            found = load_recording(path)
        except CaromError as error:
            refused.append(str(error))
            continue
        if ending != ".csv":  # a text has no checksum: another number is another number
            np.testing.assert_array_equal(found.x, sound.x)
            np.testing.assert_array_equal(found.v, sound.v)
            assert found.task == sound.task
    assert len(refused) > EXAMPLES // 4
    assert all(path.name in text and "\n" not in text for text in refused)


def test_damaged_models(files, tmp_path):
    rng, path = np.random.default_rng(2), tmp_path / "a.carom"
    path.write_bytes(files[".carom"])
    skeleton = ball_on_floor()
    sound, header = load_model_into(path, skeleton), read_model_header(path)
    refused = []
    for _ in range(EXAMPLES):
        path.write_bytes(damaged(files[".carom"], rng))
        try:
            found = load_model_into(path, skeleton)
        except CaromError as error:
            refused.append(str(error))
            continue
        assert nested(read_model_header(path)) == nested(header)
        assert jax.tree.all(jax.tree.map(lambda a, b: bool((a == b).all()), found, sound))
    assert len(refused) > EXAMPLES // 2
    assert not any("\n" in text for text in refused)


@pytest.mark.parametrize("ending", ["h5", "npz", "csv", "carom"])
def test_files_of_noise(ending, tmp_path):
    rng, path = np.random.default_rng(3), tmp_path / f"a.{ending}"
    for _ in range(EXAMPLES // 5):
        path.write_bytes(rng.bytes(int(rng.integers(0, 300))))
        with pytest.raises(CaromError):
            load_model_into(path, ball_on_floor()) if ending == "carom" else load_recording(path)
