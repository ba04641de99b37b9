"""Learned models in the run folders of `carom learn`."""

from pathlib import Path
from typing import Any

from carom.checks import require
from carom.learning.model_file import load_model_into, read_model_header
from carom.learning.run import MODEL, RunFolder
from carom.system import System
from carom.tasks import task


def learned_system(folder: Path, name: str) -> tuple[System, dict[str, Any]]:
    """The system learned in a run folder, which must be of the task of this name, and the header of its file.

    **Raises:** `CaromError` if it is not a run folder, has no model yet, or one of another task.
    """
    model = RunFolder.open(folder).path / MODEL
    header = read_model_header(model)
    require(header["task"] == name, f"the run folder {folder} holds a model of task {header['task']!r}, not {name!r}.")
    return load_model_into(model, task(name)), header
