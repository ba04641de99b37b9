"""Which system a command is about: a task's, by its name, or one of the user's own, from a Python or robot file."""

import dataclasses
import hashlib
import runpy
import sys
import traceback
from pathlib import Path
from typing import Any, NamedTuple

from jaxtyping import Array, Float

from carom.checks import require
from carom.errors import CaromError
from carom.learning.model_file import load_model_into, read_model_header
from carom.learning.run import CONFIG, MODEL, SYSTEM, RunFolder
from carom.mjcf.load import load_mujoco, whole_xml
from carom.recordings.files import load_recording
from carom.recordings.observations import Observations, load_observations, task_in
from carom.recordings.recording import Recording
from carom.system import System
from carom.tasks import TASKS, task

VARIABLE = "system"
"""What a Python file calls its system."""
UNKNOWN = "unknown"
"""What it calls the names of what is to be learned, if it says them."""


class Start(NamedTuple):
    """Where a robot file says that motion begins, (n, 3) in m and m/s, and its time step (s)."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    dt: float


@dataclasses.dataclass(frozen=True)
class Chosen:
    """A system that was asked for: `name`, as it was given; `source`, the bytes of its file if it is the user's own.

    Of a user's own the masses, friction and restitution need not be true: they are what the file says. `unknown`: the
    names of the quantities that the file says are to be learned, if it does; `start`, of a robot file.
    """

    name: str
    system: System
    source: bytes | None = None
    unknown: tuple[str, ...] = ()
    start: Start | None = None

    @property
    def own(self) -> bool:
        """Whether it is from a file."""
        return self.source is not None

    @property
    def stem(self) -> str:
        """A name for folders and files."""
        return Path(self.name).stem if self.own else self.name

    @property
    def truth(self) -> System | None:
        """The true system, where it is known."""
        return None if self.own else self.system

    @property
    def task(self) -> str | None:
        """The task that a recording of it names; None where it need not name any."""
        return None if self.own else self.name

    @property
    def digest(self) -> str | None:
        """SHA-256 of its file."""
        return None if self.source is None else hashlib.sha256(self.source).hexdigest()


def is_robot(name: str) -> bool:
    """Whether a name means an MJCF or URDF file."""
    return name.lower().endswith((".xml", ".urdf"))


def is_file(name: str) -> bool:
    """Whether a name means a Python or robot file, not a task."""
    return name.endswith(".py") or is_robot(name)


def copy_of(run: RunFolder, name: str) -> Path:
    """Where a run folder keeps its own copy of the user's file."""
    return run.path / (Path(SYSTEM).with_suffix(".xml") if is_robot(name) else SYSTEM)


def choose(name: str) -> Chosen:
    """The system of the task of this name, of the Python file, which is run, or of the MJCF or URDF file.

    **Raises:** `CaromError` for an unknown task, and for a file that is missing, fails, makes no `System`, or has
    an `unknown` that is no list of names.
    """
    if not is_file(name):
        return Chosen(name, task(name))
    path = Path(name)
    if is_robot(name):
        return _robot(name, path)
    require(path.is_file(), f"task is the file {name!r}, which does not exist. `carom new {path.name}` writes one.")
    defined = _run_file(path)
    system, unknown = defined.get(VARIABLE), defined.get(UNKNOWN, ())
    if not isinstance(system, System):
        found = "missing" if system is None else type(system).__name__
        raise CaromError(f"{name} must set `{VARIABLE}` to a carom.System outside of any function; it was {found}.")
    require(
        isinstance(unknown, list | tuple) and all(isinstance(each, str) for each in unknown),
        f"{name} must set `{UNKNOWN}` to a list of names of quantities; it was {unknown!r}.",
    )
    return Chosen(name, system, path.read_bytes(), tuple(unknown))


def _robot(name: str, path: Path) -> Chosen:
    require(path.is_file(), f"task is the file {name!r}, which does not exist.")
    # What a run folder keeps is read again from this text, which has fewer digits than the file may have.
    source = whole_xml(path)
    loaded = load_mujoco(source.decode())
    return Chosen(name, loaded.system, source, start=Start(loaded.x0, loaded.v0, loaded.dt))


def data_and_system(path: Path, name: str) -> tuple[Recording, Chosen | None, str]:
    """A recording; the system of this name, or without one that of the recording's task; and a word where these differ.

    **Raises:** `CaromError` if the file cannot be read, or there is no system of the name that was given.
    """
    chosen, recording = choose(name) if name else None, load_recording(path)
    return recording, *_of_task(path, recording.task, chosen, name)


def observed_and_system(path: Path, name: str) -> tuple[Observations, Chosen | None, str]:
    """As `data_and_system`, of observations: positions suffice, and samples may be missing."""
    chosen, observations = choose(name) if name else None, load_observations(path)
    return observations, *_of_task(path, task_in(path), chosen, name)


def _of_task(path: Path, its: str, chosen: Chosen | None, name: str) -> tuple[Chosen | None, str]:
    """The system that was chosen, or that of the task that a file names; and a word where these differ."""
    if chosen is None:
        if its in TASKS:
            return choose(its), ""
        known = f"is of {its!r}, which is no task of carom's" if its else "does not say of which task it is"
        return None, f"{path} {known}. Give --task NAME, or --task FILE.py that sets `{VARIABLE}`, or FILE.xml."
    differs = bool(its) and chosen.task not in (None, its)
    return chosen, f"{path} says that it is of {its!r}; it is taken as of {name!r}." if differs else ""


def chosen_by(run: RunFolder) -> Chosen:
    """The system that a run learns: of its task, or of its own copy of the user's file."""
    name = run.read_json(CONFIG)["task"]
    return choose(str(copy_of(run, name))) if is_file(name) else choose(name)


def learned_system(folder: Path, name: str) -> tuple[System, dict[str, Any]]:
    """The system learned in a run folder, which must be of the task or file of this name, and the header of its file.

    **Raises:** `CaromError` if it is not a run folder, has no model yet, or one of another system.
    """
    run = RunFolder.open(folder)
    learned = run.read_json(CONFIG)["task"]
    require(
        learned == name or (is_file(learned) and is_file(name)),
        f"the run folder {folder} holds a model of {learned!r}, not {name!r}.",
    )
    model = run.path / MODEL
    return load_model_into(model, chosen_by(run).system), read_model_header(model)


def _run_file(path: Path) -> dict[str, Any]:
    """The names that a Python file defines; modules beside it can be imported, as when it is run itself."""
    sys.path.insert(0, str(path.absolute().parent))
    try:
        return runpy.run_path(str(path))
    except Exception as error:
        places = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
        line = error.lineno if isinstance(error, SyntaxError) else places[-1].lineno if places else None
        first = (str(error).splitlines() or [""])[0]
        raise CaromError(f"{path}{f', line {line}' if line else ''}: {type(error).__name__}: {first}") from error
    finally:
        sys.path.pop(0)
