"""Types of command-line arguments, with the names that help texts show."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

TaskName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK")]
SystemName = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="TASK|FILE.py|FILE.xml")]
RunPath = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
ContactModelName = Annotated[str, tyro.conf.arg(metavar="{cm,cmr,lcp,coulomb}")]
CompensationSteps = float | Literal["auto"] | None
FilePath = Annotated[Path | None, tyro.conf.arg(metavar="FILE")]
FolderPath = Annotated[Path | None, tyro.conf.arg(metavar="FOLDER")]
