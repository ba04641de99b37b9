"""The command line that every figure of the documentation has."""

import argparse
from collections.abc import Callable
from pathlib import Path

import jax


def draw_from_command_line(draw: Callable[[str], Path], description: str, default: str) -> None:
    """Draw a figure, in double precision, into the file `default` of the documentation, or the one that is named."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("file", nargs="?", default=default, help="PNG file to write")
    jax.config.update("jax_enable_x64", True)
    print(f"Written to {draw(parser.parse_args().file)}")
