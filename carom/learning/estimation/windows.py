"""Windows of observed motion, cut between impacts that the motion shows.

Windows hold some impacts each and are cut in the middle of free motion, so that each sample is in one.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from carom.checks import require
from carom.learning.estimation.survey import Shape, Survey, Track, design

ROOM = 3
"""Samples of free motion that a window has at least at either end."""
GAP = 1.5
"""Steps longer than this many typical ones are divided."""


class Windows(NamedTuple):
    """Windows of trajectories, padded to the longest with NaN.

    `steps` (s) from each time to the next, `x` seen there (NaN where not), and what errors of their times make of them
    (`timing`, m); `before`: times before the first kink;
    `kink`: steps in which there is one; `start`: positions and velocities to begin with; `first`: the sample that a
    window begins with.
    """

    steps: Float[np.ndarray, "W L"]
    x: Float[np.ndarray, "W T R"]
    timing: Float[np.ndarray, "W T R"]
    before: Bool[np.ndarray, "W T"]
    kink: Bool[np.ndarray, "W L"]
    start: Float[np.ndarray, "W 2 n d"]
    trajectory: Int[np.ndarray, " W"]
    first: Int[np.ndarray, " W"]

    def take(self, rows: np.ndarray) -> "Windows":
        """Some of them."""
        return Windows(*(part[rows] for part in self))

    def before_impacts(self) -> "Windows":
        """The free motion that they begin with, alone."""
        most = max(int(self.before.sum(axis=1).max(initial=1)), 2)
        steps, x, timing, before, kink = (part[:, :most] for part in self[:5])
        steps, kink = steps[:, : most - 1], kink[:, : most - 1]
        return self._replace(
            steps=np.where(before[:, 1:], steps, np.nan),
            x=np.where(before[..., None], x, np.nan),
            timing=timing,
            before=before,
            kink=np.zeros_like(kink),
        )

    @classmethod
    def concatenate(cls, parts: Sequence["Windows"]) -> "Windows":
        """All of several."""
        most = max(part.steps.shape[1] for part in parts)

        def padded(part: np.ndarray, wide: int, fill) -> np.ndarray:
            width = [(0, 0), (0, wide - part.shape[1])] + [(0, 0)] * (part.ndim - 2)
            return np.pad(part, width, constant_values=fill)

        wide = {
            "steps": (most, np.nan),
            "x": (most + 1, np.nan),
            "timing": (most + 1, 0.0),
            "before": (most + 1, False),
            "kink": (most, False),
        }
        return cls(
            **{
                name: np.concatenate(
                    [padded(getattr(p, name), *wide[name]) if name in wide else getattr(p, name) for p in parts]
                )
                for name in cls._fields
            }
        )


def windows_of(found: Survey, impacts: int | None) -> Windows:
    """All motions in windows of so many impacts (None: as many as there are)."""
    parts = []
    for number, track in enumerate(found.tracks):
        for first, last in _cuts(track, impacts):
            window = _window(found, track, number, first, last)
            if window is not None:
                parts.append(window)
    require(bool(parts), f"the observations have no {2 * ROOM} samples in a row between impacts to learn from.")
    return Windows.concatenate(parts)


def _cuts(track: Track, impacts: int | None) -> list[tuple[int, int]]:
    """First and last sample of each window."""
    last, kinks = len(track.time) - 1, track.kinks.tolist()
    first = 0
    while kinks and kinks[0] - first + 1 < 2 * ROOM:  # too little motion before it
        first = kinks.pop(0) + 1
    groups: list[list[int]] = []
    for k in kinks:
        # Between kinks that are near there is no room for an end and a start.
        if groups and k - groups[-1][-1] < 2 * ROOM:
            groups[-1].append(k)
        else:
            groups.append([k])
    cuts, since = [], 0
    for here, there in pairwise(groups):
        since += len(here)
        if impacts is not None and since >= impacts:
            middle = (here[-1] + 1 + there[0]) // 2
            cuts.append((first, middle))
            first, since = middle + 1, 0
    cuts.append((first, last))
    return [(a, b) for a, b in cuts if b - a + 1 >= 2 * ROOM]


def _window(found: Survey, track: Track, number: int, first: int, last: int) -> Windows | None:
    time, x = track.time[first : last + 1], track.x[first : last + 1]
    inside = track.kinks[(track.kinks >= first) & (track.kinks < last)] - first
    start = _start(time, x, int(inside[0]) if len(inside) else len(time) - 1, found.shape)
    if start is None:
        return None
    pieces = [max(1, int(np.ceil(step / (GAP * found.step)))) for step in np.diff(time)]
    steps = np.repeat(np.diff(time) / pieces, pieces)
    at = np.concatenate([[0], np.cumsum(pieces)])
    there = np.full((len(steps) + 1, x[0].size), np.nan)
    there[at] = x.reshape(len(x), -1)
    timing = np.zeros_like(there)
    timing[at] = track.timing[first : last + 1].reshape(len(x), -1)
    kink = np.zeros(len(steps), bool)
    for k in inside:
        kink[at[k] : at[k + 1]] = True
    before = np.arange(len(steps) + 1) <= (at[inside[0]] if len(inside) else len(steps))
    one = steps, there, timing, before, kink, start, np.array(number), np.array(first)
    return Windows(*(part[None] for part in one))


def _start(time: np.ndarray, x: np.ndarray, end: int, shape: Shape) -> Float[np.ndarray, "2 n d"] | None:
    """Position and velocity of each point at the first time, from the samples up to `end`; None if it is not seen.

    On a parabola, from twice as many as kinks are looked for with, or as a line from few. Of bent motion by the order
    that foretells it, from as many; by a lower one from few, and where the point is seen late only.
    """
    out = np.zeros((2, *x.shape[1:]))
    bent = shape.jump > 0
    for p in range(x.shape[1]):
        rows = np.flatnonzero(np.isfinite(x[: end + 1, p, 0]))[: shape.reach * (1 if bent else 2)]
        if len(rows) < 2:
            return None
        scale = time[rows[-1]] - time[0]
        order = 2 if len(rows) >= 2 * shape.least else 1
        if bent:
            late = time[rows[0]] - time[0] > (time[rows[-1]] - time[rows[0]]) / 3
            order = 1 if late else max(1, min(shape.order, len(rows) // 2 - 1))
        fit = np.linalg.lstsq(design((time[rows] - time[0]) / scale, order), x[rows, p], rcond=None)[0]
        out[0, p], out[1, p] = fit[0], fit[1] / scale
    return out
