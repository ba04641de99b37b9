"""Entry point of the command `carom`: subcommands, errors in one line, exit codes."""

import logging
import os
import sys
from pathlib import Path
from typing import Annotated

# XLA's loader of cached programs logs pages about processor features; set this to 0 to see all it says.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import tyro

from carom.cli.cache import use_compilation_cache
from carom.cli.control import ControlCommand
from carom.cli.evaluate import Evaluate
from carom.cli.import_data import Import
from carom.cli.learn import Learn
from carom.cli.reproduce import Reproduce
from carom.cli.simulate import Simulate
from carom.errors import CaromError

Command = (
    Annotated[Learn, tyro.conf.subcommand("learn")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[ControlCommand, tyro.conf.subcommand("control")]
    | Annotated[Import, tyro.conf.subcommand("import")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit code 2 for bad input, 130 when interrupted."""
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        prog="carom",
        description="Learn mechanical systems with contact from trajectories, simulate and control them.",
        args=arguments,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    configure_jax()
    try:
        command.run()
    except CaromError as error:
        print(f"carom: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"carom: interrupted. {command.after_interrupt()}".rstrip(), file=sys.stderr)
        sys.exit(130)


def configure_jax() -> None:
    """Double precision, and a cache of compiled programs between runs.

    The environment variable CAROM_CACHE names the cache's folder; if it is empty, there is none.
    """
    import jax

    jax.config.update("jax_enable_x64", True)
    logging.getLogger("absl").setLevel(logging.ERROR)
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "carom"
    folder = os.environ.get("CAROM_CACHE", str(default))
    if folder:
        use_compilation_cache(folder)


if __name__ == "__main__":
    main()
