"""Do recorded impacts fall on samples, as those of carom's steps do, or between them?

A contact of carom closes at the end of a step: bodies that meet overlap at that sample, where their velocities jump.
What meets impacts at their own time, as the world does, has turned around by the next sample, and no sample shows an
overlap. Steps cannot tell friction and restitution from such a recording: every impact comes at another time than that
of the model, and where it was is not looked for.

So each sample is compared with where the two before it lead, in a straight line. Where the line closes a gap, the
recording either overlaps there too, or its velocities have jumped on the way. The line is off by what bends the motion
and by noise: how far, the median of all free samples says, gap by gap.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from carom.checks import require
from carom.learning.dataset import all_gaps
from carom.recordings.recording import Recording
from carom.system import System

CLEAR = 5.0
"""A line closes a gap for certain where it ends so many typical errors deep: noise does so once in 10 000 samples."""
LEAST_DEPTH = 1e-3
"""No typical error is taken to be smaller than this share of what a gap changes in a step: rounding is not."""
LEAST = 5
"""Fewer meetings between the samples do not say of which kind a recording is."""
MAJORITY = 3
"""A recording has its impacts between the samples where so many times as many as overlap do not."""
SAMPLE = 20
"""Trajectories from which the typical error is measured."""


class Meetings(NamedTuple):
    """Samples by which bodies that moved freely must have met: `overlapping` in the recording, or not (`between`)."""

    overlapping: int
    between: int

    @property
    def not_seen(self) -> bool:
        """Whether impacts happen between the samples."""
        return self.between >= LEAST and self.between > MAJORITY * self.overlapping

    def __str__(self) -> str:
        return f"{self.overlapping} of {self.overlapping + self.between} samples show an overlap"


def meetings(recording: Recording, system: System) -> Meetings:
    """How often the bodies of a recording meet, and whether they overlap then (see the top of this file)."""
    n, samples = recording.x.shape[:2]
    if not system.contacts or samples < 3:
        return Meetings(0, 0)
    chosen = np.unique(np.linspace(0, n - 1, min(n, SAMPLE)).astype(int))
    typical = _typical_error(recording.select(chosen), system)
    overlapping = between = 0
    for ahead, there, _ in _free_samples(recording, system):
        closes = ahead < -CLEAR * typical
        seen = (closes & (there < -typical)).any(axis=1)
        overlapping += int(seen.sum())
        between += int((closes.any(axis=1) & ~seen).sum())
    return Meetings(overlapping, between)


def check_meetings(recording: Recording, system: System, what: str = "the recording") -> None:
    """Raise `CaromError` where impacts happen between the samples of the recording, which the message calls `what`."""
    found = meetings(recording, system)
    require(
        not found.not_seen,
        f"{what} cannot tell friction and restitution: impacts happen between the samples. Where bodies meet, "
        f"{found}. Check radii and walls, or leave both out of `learn`.",
    )


def _free_samples(recording: Recording, system: System):
    """By trajectory: gaps (S, C) where the two samples before lead, those recorded, and their changes in the step.

    Of the samples before which every gap was open twice.
    """
    x = recording.x
    lines = all_gaps(2 * x[:, 1:-1] - x[:, :-2], system)
    for gaps, ahead, length in zip(all_gaps(x, system), lines, recording.length, strict=True):
        is_open = np.asarray((gaps >= 0).all(axis=1))
        kept = is_open[:-2] & is_open[1:-1] & (np.arange(2, len(gaps)) < length)
        yield ahead[kept], gaps[2:][kept], (gaps[2:] - gaps[1:-1])[kept]


def _typical_error(recording: Recording, system: System) -> Float[np.ndarray, " C"]:
    """By which straight lines are off in the median, by gap; infinite where there is no free sample."""
    parts = [(np.abs(there - ahead), np.abs(change)) for ahead, there, change in _free_samples(recording, system)]
    off, change = (np.concatenate(part) for part in zip(*parts, strict=True))
    if not len(off):
        return np.full(off.shape[1], np.inf)
    return np.maximum(np.median(off, axis=0), LEAST_DEPTH * np.median(change, axis=0))
