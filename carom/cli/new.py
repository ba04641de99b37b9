"""`carom new FILE`: a commented program to start an own system from."""

import dataclasses
from importlib import resources
from pathlib import Path
from typing import Annotated

import tyro

from carom.atomic import write_whole
from carom.checks import require


@dataclasses.dataclass(frozen=True)
class New:
    """Write a commented Python program: a system of your own, simulated, learned again, and looked at.

    It runs as it is: `python FILE` writes motions.csv, from which `carom learn FILE --data motions.csv` learns the
    system. Change it from there.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File to write (.py)."""
    force: bool = False
    """Write over a file that is there."""

    def run(self) -> None:
        """Do it."""
        require(self.file.suffix == ".py", f"file must end in .py; it was {str(self.file)!r}.")
        require(
            self.file.parent.is_dir(),
            f"file is in the folder {str(self.file.parent)!r}, which does not exist: make it.",
        )
        require(self.force or not self.file.exists(), f"{self.file} is there already: choose another, or add --force.")
        write_whole(self.file, (resources.files("carom.cli") / "new_system.txt").read_bytes())
        print(
            f"Written to {self.file}. Try it: python {self.file}, which writes motions.csv, then\n"
            f"carom learn {self.file} --data motions.csv"
        )
