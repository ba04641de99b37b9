"""How carom's figures look and how they are written, apart from matplotlib's global state.

Figures are `matplotlib.figure.Figure` objects drawn by Agg; pyplot is never imported.
"""

import contextlib
import contextvars
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import matplotlib.style
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection
from matplotlib.colors import to_rgb, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import LogLocator

from carom.atomic import replacing
from carom.errors import CaromError

BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
PURPLE, ORANGE, SKY = "#CC79A7", "#E69F00", "#56B4E9"
PALETTE = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY)
"""Okabe and Ito's colors, which people with any kind of color blindness can tell apart.

Without their yellow, which is too faint for lines on white, and their black, which is for the truth
and for text.
"""
INK, MUTED, FAINT, SOLID = "#20242B", "#69707B", "#E4E7EB", "#F3F4F6"
"""Text and truth; less important text; grid; the solid side of walls."""
PAPER = "#FFFFFF"
TINT, TINT_EDGE, HATCH = "#BBD6EA", "#6FA8CF", "#D3D8DE"
"""Bodies and their edges; the hatching of walls."""

DASHES = (0, (4, 2))
"""Of lines that show the truth."""
DPI = 160
"""Pixels an inch of the figures."""

_STYLE = {
    "font.family": "sans-serif",
    # Comes with matplotlib: the same figure on every machine, and no glyph is missing.
    "font.sans-serif": ["DejaVu Sans"],
    "mathtext.fontset": "dejavusans",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.titlepad": 7.0,
    "axes.labelsize": 9.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "xtick.major.width": 0.8,
    "ytick.major.width": 0.8,
    "xtick.major.size": 3.0,
    "ytick.major.size": 3.0,
    "ytick.minor.size": 0.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "lines.linewidth": 1.6,
    "lines.solid_capstyle": "round",
    "axes.xmargin": 0.02,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.borderaxespad": 0.2,
    "hatch.linewidth": 0.7,
}


@contextlib.contextmanager
def figure_style() -> Iterator[None]:
    """carom's style, on top of matplotlib's defaults; after the block all is as it was before."""
    with matplotlib.style.context(["default", _STYLE]):
        yield


_DARK = {
    INK: "#E6E8EB",
    MUTED: "#9AA3AF",
    FAINT: "#30363D",
    SOLID: "#21262D",
    PAPER: "#14181D",
    TINT: "#274763",
    TINT_EDGE: "#4F86B0",
    HATCH: "#3D444D",
    BLUE: "#4AA8E0",
    VERMILLION: "#F0803C",
    GREEN: "#2FC79A",
    "#000000": "#E6E8EB",
}
"""What stands for each color on a dark background: the same hues, light enough to be read there."""
_theme: contextvars.ContextVar[str] = contextvars.ContextVar("theme", default="light")


@contextlib.contextmanager
def theme(name: str) -> Iterator[None]:
    """Figures written in this block are for a background that is "light" or "dark"; animations are always light.

    **Raises:** `CaromError` for another name.
    """
    if name not in ("light", "dark"):
        raise CaromError(f"theme must be 'light' or 'dark'; it was {name!r}.")
    token = _theme.set(name)
    try:
        yield
    finally:
        _theme.reset(token)


def _darken(figure: Figure) -> None:
    """Exchange the colors of everything in a figure for those of the dark theme; their opacity stays."""
    dark = {to_rgb(light): to_rgb(other) for light, other in _DARK.items()}

    def exchanged(color):
        rgba = np.atleast_2d(to_rgba_array(color))
        return [(*dark.get(tuple(c[:3]), tuple(c[:3])), c[3]) for c in rgba.tolist()]

    def recolor(artist: Artist, *names: str) -> None:
        for name in names:
            colors = exchanged(getattr(artist, f"get_{name}")())
            if colors:
                getattr(artist, f"set_{name}")(colors if isinstance(artist, Collection) else colors[0])

    for artist in figure.findobj():
        if isinstance(artist, Line2D):
            recolor(artist, "color", "markerfacecolor", "markeredgecolor")
        elif isinstance(artist, Text):
            recolor(artist, "color")
        elif isinstance(artist, Collection | Patch):
            recolor(artist, "facecolor", "edgecolor")


def new_figure(width: float, height: float, *, dpi: int = DPI, constrained: bool = True) -> Figure:
    """An empty figure of `width` by `height` inches, drawn by Agg."""
    figure = Figure((width, height), dpi=dpi, layout="constrained" if constrained else None)
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write `figure` at its own dpi, in the colors of the `theme`, and return the path.

    Nothing half-written is ever seen there.

    **Raises:** `CaromError` for a path that does not end in .png, a missing folder, or one that
    cannot be written to.
    """
    path = checked_path(path, (".png",))
    if _theme.get() == "dark":
        _darken(figure)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=figure.dpi, format="png", facecolor=figure.get_facecolor())
    return path


def checked_path(path: str | os.PathLike[str], suffixes: Sequence[str]) -> Path:
    """`path`, if it ends in one of `suffixes` and its folder exists; else raises `CaromError`."""
    path = Path(path)
    if path.suffix.lower() not in suffixes:
        raise CaromError(f"path must end in {' or '.join(suffixes)}; it was {str(path)!r}.")
    if not path.parent.is_dir():
        raise CaromError(
            f"path is in the folder {str(path.parent)!r}, which does not exist. Make it, or choose another path."
        )
    return path


def note(axes: Axes, text: str) -> None:
    """Say in the middle of an empty panel why it is empty."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=MUTED)


def log_axis(axes: Axes) -> None:
    """A logarithmic vertical axis with few marks."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(numticks=6))


def power(value: float) -> str:
    """`value` with two digits, as one writes it: 1.3 x 10^-4."""
    if value == 0:
        return "0"
    digits, exponent = f"{value:.1e}".split("e")
    return rf"${digits} \times 10^{{{int(exponent)}}}$"


def draw_line(axes: Axes, x: np.ndarray, y: np.ndarray, keep: np.ndarray, **style) -> bool:
    """Draw the values to keep, as a dot if it is one; whether there were any."""
    if not keep.any():
        return False
    axes.plot(x[keep], y[keep], marker="o" if keep.sum() == 1 else None, markersize=4, **style)
    return True


def draw_log_line(axes: Axes, x: np.ndarray, y: np.ndarray, **style) -> bool:
    """Draw the finite positive values on a logarithmic axis; whether there were any."""
    drawn = draw_line(axes, x, y, np.isfinite(y) & (y > 0), **style)
    if drawn:
        log_axis(axes)
    return drawn


def say_empty(axes: Axes, text: str) -> None:
    """Say why a panel shows nothing."""
    note(axes, text)
    axes.set_yticks([])
