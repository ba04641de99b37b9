"""The public recordings: from an archive in their layout to a pose file, without running what is in it."""

import hashlib
import io
import tarfile
import zipfile

import numpy as np
import pytest
from systems import refused

from carom.cli.main import main
from carom.recordings import contactnets
from carom.recordings.poses import load_poses

PICKLE = b"\x80\x02ctorch._utils\n_rebuild_tensor_v2\n(X\x07\x00\x00\x00storagectorch\nFloatStorage\n"


def toss(rng, samples):
    """Rows of a toss that falls, in units of half the cube's width."""
    rows = np.zeros((samples, 19))
    time = np.arange(samples) / contactnets.RATE
    rows[:, :3] = rng.normal(size=3) + np.outer(time, [1.0, 2.0, 0.0]) - np.outer(time**2, [0, 0, 90.0])
    rows[:, 3] = 1.0
    rows[:, 7:10] = [1.0, 2.0, 0.0]
    rows[:, 9] = -180 * time
    return rows


def tensor_file(rows, storage=PICKLE):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as parts:
        parts.writestr("toss/data.pkl", storage)
        parts.writestr("toss/data/0", rows.astype("<f4").tobytes())
        parts.writestr("toss/version", "3\n")
    return buffer.getvalue()


def archive_of(path, files):
    with tarfile.open(path, "w:gz") as archive:
        for name, data in files.items():
            info = tarfile.TarInfo(f"contact-nets-c3dc21c/data/{name}")
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))
    return path


@pytest.fixture
def tosses(monkeypatch):
    """Twelve tosses, of which the last is the third, turned; all but the first four are thrown the other way."""
    rng = np.random.default_rng(0)
    rows = [toss(rng, 20 + k) for k in range(11)]
    for part in rows[4:]:
        part[:, [0, 1, 7, 8]] *= -1
    turned = rows[2].copy()
    turned[:, [0, 1, 7, 8]] *= -1
    rows.append(turned)
    monkeypatch.setattr(contactnets, "TOSSES", 12)
    monkeypatch.setattr(contactnets, "SAMPLES", sum(map(len, rows)))
    return rows


@pytest.fixture
def archive(tosses, tmp_path):
    files = {f"tosses_processed/{k}.pt": tensor_file(rows) for k, rows in enumerate(tosses)}
    return archive_of(tmp_path / "contact-nets.tar.gz", {**files, "other/0.pt": b"nothing"})


def test_an_archive_becomes_poses(tosses, archive, tmp_path, capsys):
    out = tmp_path / "cube.npz"
    digest = hashlib.sha256(archive.read_bytes()).hexdigest()
    main(["import", "contactnets", str(archive), "--out", str(out), "--sha256", digest])
    assert "12 tosses (1 copies) in 2 sessions" in capsys.readouterr().out
    poses, copies = load_poses(out, keep_copies=True)
    assert copies == 0
    assert np.array_equal(poses.length, [len(rows) for rows in tosses])
    assert np.allclose(poses.position[3, :23], tosses[3][:, :3] * 0.0524, atol=1e-6)
    assert poses.velocity is not None
    assert np.allclose(poses.velocity[3, :23], tosses[3][:, 7:10] * 0.0524, atol=1e-6)
    assert poses.dt == pytest.approx(1 / 148)
    without, copies = load_poses(out)
    assert copies == 1
    assert len(without.length) == 11


def test_what_is_not_the_recordings_is_refused_and_nothing_is_written(tosses, archive, tmp_path):
    out = tmp_path / "cube.npz"
    with refused("has the SHA-256"):
        contactnets.convert(archive, out, sha256="00" * 32)
    fewer = archive_of(tmp_path / "fewer.tar.gz", {"tosses_processed/0.pt": tensor_file(tosses[0])})
    with refused("holds 1 tosses with 20 samples; the recordings are 12"):
        contactnets.convert(fewer, out)
    cut = tmp_path / "cut.tar.gz"
    cut.write_bytes(archive.read_bytes()[:-400])
    with refused("cannot be read"):
        contactnets.convert(cut, out)
    with refused("cannot be read"):
        contactnets.convert(tmp_path / "none.tar.gz", out)
    assert not out.exists()


def test_files_that_are_no_tensors_are_refused(tosses):
    with refused("is not an archive of torch.save"):
        contactnets.tensor_of(b"\x80\x04]\x94(K\x01K\x02e.", "0.pt")
    with refused("is not a tensor of 32- or 64-bit floats"):
        contactnets.tensor_of(tensor_file(tosses[0], b"LongStorage"), "0.pt")
    with refused("which are not rows of 19"):
        contactnets.tensor_of(tensor_file(tosses[0][:3, :5]), "0.pt")
    shifted = np.roll(tosses[0], 1, axis=1)
    with refused("another order of columns"):
        contactnets.tensor_of(tensor_file(shifted), "0.pt")


def test_a_download_is_whole_or_not_there(archive, tmp_path):
    copy = contactnets.download(tmp_path / "copy.tar.gz", archive.as_uri())
    assert copy.read_bytes() == archive.read_bytes()
    missing = tmp_path / "missing.tar.gz"
    with refused("could not be fetched"):
        contactnets.download(missing, (tmp_path / "nowhere").as_uri())
    assert not missing.exists()
