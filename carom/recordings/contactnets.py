"""The public recordings of ContactNets (570 tosses of an acrylic cube), from their archive to a pose file.

Pfrommer, Halm, Posa, *ContactNets* (CoRL 2020); https://github.com/DAIRLab/contact-nets, BSD 3-Clause: keep its notice
with the data. Each toss is a file `data/tosses_processed/NUMBER.pt`, a PyTorch archive of one tensor (samples, 19):
position, quaternion (w first), velocity, angular velocity (body frame), six inputs. Lengths are in units of half the
cube's width. Numbers are read from the archive's storage; nothing in it is run.
"""

import hashlib
import http.client
import io
import os
import re
import shutil
import tarfile
import urllib.error
import urllib.request
import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from carom.atomic import replacing, write_whole
from carom.checks import require
from carom.errors import CaromError
from carom.recordings.pose_checks import earlier_equal

URL = "https://github.com/DAIRLab/contact-nets/archive/c3dc21c.tar.gz"
TOSSES, SAMPLES = 570, 59953
"""What the archive holds; another number is another state of it."""
RATE = 148.0
LENGTH_UNIT = 0.0524
COLUMNS = 19
STORAGES = {b"FloatStorage": "<f4", b"DoubleStorage": "<f8"}
SESSION_TURN = 20.0
"""Consecutive tosses whose headings differ by less (degrees) are taken for one session."""
MEMBER = re.compile(r"(?:^|/)data/tosses_processed/(\d+)\.pt$")


def download(path: str | os.PathLike[str], url: str = URL) -> Path:
    """Fetch the archive to `path`, which is there only once it is whole.

    **Raises:** `CaromError` if the server cannot be reached or ends early.
    """
    with replacing(Path(path)) as temporary:
        try:
            with urllib.request.urlopen(url, timeout=60) as source, temporary.open("wb") as out:
                shutil.copyfileobj(source, out)
            expected = source.headers.get("Content-Length")
        except (urllib.error.URLError, TimeoutError, ConnectionError, http.client.HTTPException) as error:
            raise CaromError(f"{url} could not be fetched ({error}). Get it elsewhere and name the file.") from None
        size = temporary.stat().st_size
        require(expected is None or int(expected) == size, f"{url} ended after {size} of {expected} bytes.")
    return Path(path)


def convert(archive: str | os.PathLike[str], out: str | os.PathLike[str], *, sha256: str | None = None) -> dict:
    """Write the tosses of an archive (`.tar.gz`) into a pose file (`.npz`), in SI units, with sessions and copies.

    **Arguments:** `sha256`, of the archive, checked if given.

    **Returns:** the numbers of `tosses`, `samples`, `sessions` and `copies`, and the archive's `sha256`.

    **Raises:** `CaromError` for an archive that is not the recordings', is damaged, or has another checksum.
    """
    path = Path(archive)
    try:
        found = hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CaromError(f"the archive {path} cannot be read ({error.strerror}).") from None
    require(
        sha256 is None or found == sha256.lower(),
        f"the archive {path} has the SHA-256 {found}, not {sha256}. Fetch it again.",
    )
    tosses = _read(path)
    count, samples = len(tosses), sum(map(len, tosses))
    require(
        (count, samples) == (TOSSES, SAMPLES),
        f"{path} holds {count} tosses with {samples} samples; the recordings are {TOSSES} with {SAMPLES}.",
    )
    rows = np.concatenate(tosses)
    offsets = np.cumsum([0, *map(len, tosses)])
    groups, copies = (
        sessions(np.array([toss[0, 7:9] for toss in tosses])),
        np.array(earlier_equal((toss[:, 2] for toss in tosses), 5)),
    )
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        pos=rows[:, :3] * LENGTH_UNIT,
        quat=rows[:, 3:7],
        vel=rows[:, 7:10] * LENGTH_UNIT,
        omega=rows[:, 10:13],
        offsets=offsets,
        group=groups,
        dup_of=copies,
        dt=1 / RATE,
    )
    write_whole(out, buffer.getvalue())
    return {
        "tosses": count,
        "samples": samples,
        "sessions": len(np.unique(groups)),
        "copies": int(np.sum(copies >= 0)),
        "sha256": found,
    }


def _read(path: Path) -> list[np.ndarray]:
    """The tensors in the order of their numbers."""
    tensors = {}
    try:
        with tarfile.open(path) as archive:
            for member in archive:
                match = MEMBER.search(member.name)
                file = archive.extractfile(member) if match and member.isfile() else None
                if match and file is not None:
                    tensors[int(match[1])] = tensor_of(file.read(), member.name)
    except (tarfile.TarError, EOFError, OSError) as error:
        why = str(error).splitlines()[0].rstrip(":")
        raise CaromError(f"the archive {path} cannot be read ({why}). Fetch it again.") from None
    return [tensors[k] for k in sorted(tensors)]


def tensor_of(data: bytes, name: str) -> Float[np.ndarray, "T 19"]:
    """The one tensor (samples, 19) of a file of `torch.save`, read without unpickling.

    **Raises:** `CaromError` for a file that is not such.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as parts:
            storages = [part for part in parts.namelist() if re.search(r"/data/\d+$", part)]
            pickles = [part for part in parts.namelist() if part.endswith("/data.pkl")]
            require(len(storages) == len(pickles) == 1, f"{name} does not hold one tensor.")
            about, raw = parts.read(pickles[0]), parts.read(storages[0])
    except (zipfile.BadZipFile, EOFError) as error:
        raise CaromError(f"{name} is not an archive of torch.save ({error}).") from None
    kinds = [dtype for storage, dtype in STORAGES.items() if storage in about]
    require(len(kinds) == 1, f"{name} is not a tensor of 32- or 64-bit floats.")
    numbers = np.frombuffer(raw, kinds[0]).astype(float)
    require(
        numbers.size > 0 and numbers.size % COLUMNS == 0,
        f"{name} holds {numbers.size} numbers, which are not rows of {COLUMNS}.",
    )
    rows = numbers.reshape(-1, COLUMNS)
    unit = np.abs(np.linalg.norm(rows[:, 3:7], axis=1) - 1)
    require(bool(np.max(unit) < 0.01), f"{name} has quaternions that are not unit ones: another order of columns?")
    return rows


def sessions(velocity: Float[np.ndarray, "N 2"]) -> Int[np.ndarray, " N"]:
    """Numbers of throwing sessions: consecutive tosses in about one direction, by their first horizontal velocities."""
    heading = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0]))
    turn = np.abs((np.diff(heading) + 180) % 360 - 180)
    return np.concatenate([[0], np.cumsum(turn > SESSION_TURN)])
