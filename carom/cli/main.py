"""Entry point of the command `carom`: subcommands, errors in one line, exit codes.

A subcommand's module is imported when it is called for: JAX takes seconds to load, which help should not.
"""

import dataclasses
import importlib
import inspect
import logging
import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, Any

import tyro

from carom.errors import CaromError

COMMANDS = {
    "learn": ("learn", "Learn", "Learn masses, potential, friction and restitution of a task from trajectories."),
    "evaluate": ("evaluate", "Evaluate", "Measure a learned model, and draw what it predicts."),
    "simulate": ("simulate", "Simulate", "Simulate a task and write its trajectories to a file."),
    "view": ("view", "View", "Show a run or a trajectory file, moving, in the browser; or save it."),
    "control": ("control", "ControlCommand", "Find start or forces that bring a system where it should go."),
    "check": ("check", "Check", "Say what recorded data show of a system, and what they can tell, before learning."),
    "import": ("import_data", "Import", "Turn recorded poses of a tossed body into a trajectory file."),
    "sweep": ("sweep", "Sweep", "Train with many different options, several at a time, and find the best."),
    "reproduce": ("reproduce", "Reproduce", "Learn and measure what a table of the paper has."),
    "new": ("new", "New", "Write a commented program to start a system of your own from."),
    "doctor": ("doctor", "Doctor", "Check versions, devices, the contact solver and gradients on this machine."),
}
"""By name: module in `carom.cli`, class, and what it is for."""
DESCRIPTION = "Learn mechanical systems with contact from trajectories, simulate and control them."
EPILOG = (
    "`carom COMMAND --help` has the options of a command, --help-all the rare ones too. --debug, anywhere, shows where "
    "an error is from, and what XLA logs."
)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; exit code 1 for what goes wrong, 2 for bad input, 130 when interrupted."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if not debug:
        quiet_xla()
    command: Any = None
    try:
        command = _parsed(words)
        configure_jax()
        command.run()
    except KeyboardInterrupt:
        after = command.after_interrupt() if hasattr(command, "after_interrupt") else ""
        print(f"carom: interrupted. {after}".rstrip(), file=sys.stderr)
        sys.exit(130)
    except BrokenPipeError:  # who read the output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if debug:
            traceback.print_exc()
        text, code = _explained(error)
        print(f"carom: {text}", file=sys.stderr)
        sys.exit(code)


def _explained(error: Exception) -> tuple[str, int]:
    """What to say of an error in a line or two, and the exit code."""
    if isinstance(error, CaromError):
        return str(error), 2
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}. Check the path, its permissions and the space left.", 2
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return "out of memory. Take fewer trajectories (--trajectories), or smaller batches (--batch-size).", 1
    first = (str(error).strip().splitlines() or [""])[0][:200]
    return (
        f"this should not have happened: {type(error).__name__}{': ' if first else ''}{first}\n"
        "carom: run the same again with --debug to see where, and please report it.",
        1,
    )


def _parsed(words: list[str]) -> Any:
    """The command that the words ask for, with its options; help and wrong options end the program."""
    name = next((word for word in words if not word.startswith("-")), None)
    rest = [word for word in words if word != "--help-all"]
    everything = len(rest) < len(words)
    if everything:
        rest.append("--help")
    options = {
        "description": DESCRIPTION,
        "prog": "carom",
        "config": (tyro.conf.OmitSubcommandPrefixes, tyro.conf.OmitArgPrefixes, tyro.conf.FlagCreatePairsOff),
    }
    if name not in COMMANDS or not words or words[0] != name:
        tyro.cli(_all_commands(), args=rest, **{**options, "description": f"{DESCRIPTION}\n\n{EPILOG}"})
        raise AssertionError("without a known command the line above ends the program")
    module, kind, _ = COMMANDS[name]
    command = getattr(importlib.import_module(f"carom.cli.{module}"), kind)
    if not everything and {"-h", "--help"} & set(rest):
        _hide_rare_options(command)
    defaults = command.defaults(rest[1:]) if hasattr(command, "defaults") else None
    return tyro.cli(
        command,
        default=defaults,
        **{**options, "args": rest[1:], "prog": f"carom {name}", "description": inspect.cleandoc(command.__doc__)},
    )


def _all_commands() -> Any:
    """The commands by their names, without their options."""
    union: Any = None
    for name, (_, kind, text) in COMMANDS.items():
        light = dataclasses.make_dataclass(kind, [], namespace={"__doc__": text})
        one = Annotated[light, tyro.conf.subcommand(name, description=text)]
        union = one if union is None else union | one
    return union


def _hide_rare_options(command: type) -> None:
    """Leave options out of the help that a command calls rare: `RARE`, of the command and of its groups.

    Only ever done right before help is printed, which ends the program.
    """
    hidden = False
    for kind, rare in getattr(command, "RARE", {}).items():
        for name in rare:
            annotation = kind.__annotations__[name]
            kind.__annotations__[name] = Annotated[annotation, tyro.conf.Suppress]
            hidden = True
    if hidden:
        command.__doc__ = f"{inspect.cleandoc(command.__doc__ or '')}\n\nRare options: --help-all."


def quiet_xla() -> None:
    """Let XLA's log lines end at what ends the program; JAX must not have been loaded before.

    XLA's loader of cached programs logs, as an error, kilobytes about features of the processor that "could lead to
    execution errors such as SIGILL" wherever a program's list has XLA's own tuning options, which no processor has. The
    cache keeps processors apart, so it means nothing. Hence level 3: only fatal errors are logged. All others come as
    Python exceptions with their text. A level that is there is replaced: JAX leaves its own, 1, to the commands that a
    program or notebook starts.
    """
    os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"


def configure_jax() -> None:
    """Double precision, and a cache of compiled programs between runs.

    The environment variable CAROM_CACHE names the cache's folder; if it is empty, there is none.
    """
    import jax

    from carom.cli.cache import use_compilation_cache

    jax.config.update("jax_enable_x64", True)
    logging.getLogger("absl").setLevel(logging.ERROR)
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "carom"
    folder = os.environ.get("CAROM_CACHE", str(default))
    if folder:
        use_compilation_cache(folder)


if __name__ == "__main__":
    main()
