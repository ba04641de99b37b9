"""Packages that some figures need and carom does without."""

import importlib.util

from carom.checks import require


def check_movies(argument: str) -> None:
    """Raise `CaromError`, naming the argument that asks for it, if no MP4 can be written."""
    require(
        importlib.util.find_spec("imageio_ffmpeg") is not None,
        f"{argument} asks for an MP4, which needs the package imageio-ffmpeg. Install it (pip install imageio-ffmpeg), "
        "or choose a path that ends in .gif.",
    )
