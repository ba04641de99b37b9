"""Windows of observed motion, cut between impacts that the motion shows.

Where a body is hit its motion has a kink: the last samples, extended as a parabola, miss the next ones by more than
their errors allow. That is looked for, never overlap, which the motion of rigid bodies does not show. Windows hold some
impacts each and are cut in the middle of free motion, so that each sample is in one.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from carom.checks import require
from carom.recordings.clock import STEP_TOLERANCE, digit_of
from carom.recordings.observations import Observations

REACH = 8
"""Samples from which the next is foretold."""
LEAST = 4
"""Fewer do not tell a parabola and its error."""
DOUBT = 6.0
"""Standard errors by which a sample must be missed to show a kink."""
NEIGHBOURS = 2
"""Kinks found forward and backward that are so many samples apart are one."""
ROOM = 3
"""Samples of free motion that a window has at least at either end."""
SHARE = 0.1
"""Errors of positions that are left beside those of their times are this share of all at least."""
FLOOR = 1e-9
"""Errors of positions, as a share of how far the motion reaches, are not taken to be less: rounding, amplified."""
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


class Track(NamedTuple):
    """One trajectory: its times (s), positions (NaN where not seen), what errors of times make of these (m), and the
    samples after which there is a kink."""

    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T n d"]
    timing: Float[np.ndarray, "T n d"]
    kinks: Int[np.ndarray, " K"]


class Survey(NamedTuple):
    """What the motions show by themselves: tracks, the errors of each point's positions (m), where in its step each
    kink is (from 0 to 1) with the error of that, and the typical time step (s)."""

    tracks: tuple[Track, ...]
    noise: Float[np.ndarray, " n"]
    floor: float
    place: Float[np.ndarray, "K 2"]
    step: float


def survey(observations: Observations) -> Survey:
    """Errors of positions, and kinks of all trajectories."""
    tracks = []
    for time, x in zip(observations.time, observations.x, strict=True):
        there = np.isfinite(time) & np.isfinite(x).any(axis=(1, 2))
        seen = np.isfinite(x[there]).all(axis=2, keepdims=True)
        tracks.append((time[there], np.where(seen, x[there], np.nan)))
    step = float(np.median(np.concatenate([np.diff(time) for time, _ in tracks])))
    reach = max(float(np.nanmax(x) - np.nanmin(x)) for _, x in tracks)
    floor = FLOOR * reach
    digit = _digit(observations, step)
    timing = [_timing(time, x, digit) for time, x in tracks]
    noise = np.maximum(_noise([(t, x, np.zeros(0, int)) for t, x in tracks], robust=True), floor)
    misses = [_misses(time, x) for time, x in tracks]
    found = []
    for _ in range(2):
        found = [(t, x, _kinks(missed, noise)) for (t, x), missed in zip(tracks, misses, strict=True)]
        noise = np.maximum(_noise(found, robust=False), floor)
    places = [_place(t, x, k, kinks, noise) for t, x, kinks in found for k in kinks.tolist()]
    places = [place for place in places if place is not None]
    by_time = np.nanmean(np.concatenate(timing) ** 2, axis=(0, 2))
    own = np.sqrt(np.maximum(noise**2 - by_time, np.maximum(floor, SHARE * noise) ** 2))
    return Survey(
        tuple(Track(t, x, off, kinks) for (t, x, kinks), off in zip(found, timing, strict=True)),
        own,
        floor,
        np.array(places).reshape(-1, 2),
        step,
    )


def _digit(observations: Observations, step: float) -> float:
    """What the last digit of times is worth (s); none where all are at whole steps, which rounding has not moved."""
    steps = np.diff(observations.time, axis=1) / step
    steps = steps[np.isfinite(steps)]
    if np.all(np.abs(steps - np.round(steps)) <= STEP_TOLERANCE * np.maximum(steps, 1)):
        return 0.0
    return digit_of(observations.time, np.isfinite(observations.time))


def _timing(time: np.ndarray, x: np.ndarray, digit: float) -> Float[np.ndarray, "T n d"]:
    """What rounding of times to a digit makes of positions: how far they move within it, by a uniform error."""
    out = np.zeros_like(x)
    for p in range(x.shape[1]):
        rows = np.flatnonzero(np.isfinite(x[:, p, 0]))
        if len(rows) > 1:
            out[rows, p] = np.abs(np.gradient(x[rows, p], time[rows], axis=0)) * digit / np.sqrt(12)
    return out


def _design(time: np.ndarray, order: int) -> np.ndarray:
    return time[:, None] ** np.arange(order + 1)


def _noise(tracks, *, robust: bool) -> Float[np.ndarray, " n"]:
    """Standard deviation of errors of each point, from parabolas through `REACH` samples without a kink.

    If `robust`, the median of theirs: kinks have not been found yet.
    """
    n, d = tracks[0][1].shape[1:]
    own: list[list[float]] = [[] for _ in range(n)]
    for time, x, kinks in tracks:
        ends = [-1, *kinks, len(time) - 1]
        for p in range(n):
            runs = []
            for a, b in pairwise(ends):
                rows = np.arange(a + 1, b + 1)
                rows = rows[np.isfinite(x[rows, p, 0])]
                runs += [rows[k : k + REACH] for k in range(0, len(rows) - REACH + 1, 3 if robust else REACH)]
            if not runs:
                continue
            r = np.array(runs)
            span = time[r] - time[r[:, :1]]
            design = (span / span[:, -1:])[..., None] ** np.arange(3)
            basis = np.linalg.qr(design)[0]
            left = x[r, p] - np.einsum("kma,kna,knd->kmd", basis, basis, x[r, p])
            own[p] += np.sum(left**2, axis=(1, 2)).tolist()
    out = np.zeros(n)
    every = [value for part in own for value in part]
    for p, part in enumerate(own):
        part = part or every or [0.0]
        dof = (REACH - 3) * d
        out[p] = np.median(part) / (dof * (1 - 2 / (9 * dof)) ** 3) if robust else _clean(part, dof)
    return np.sqrt(out)


def _clean(part: list[float], dof: int) -> float:
    """Mean of sums of squares over their degrees of freedom, without the few that hold a kink which was not seen."""
    values = np.array(part) / dof
    limit = np.median(values) * (1 + 5 * np.sqrt(2 / dof))
    return float(np.mean(values[values <= limit]))


def _missed(time: np.ndarray, x: np.ndarray) -> Float[np.ndarray, "M T 2"]:
    """Errors of positions (m) at which samples k and k + 1 are missed by just a standard error.

    By the parabola through the m samples before k, for m from `LEAST` to `REACH`; infinite where there are not so many.
    """
    count, d = x.shape
    out = np.full((REACH - LEAST + 1, count, 2), np.inf)
    for m in range(LEAST, min(REACH, count - 1) + 1):
        k = np.arange(m, count)
        rows = k[:, None] - m + np.arange(m)
        scale = time[k] - time[rows[:, 0]]
        design = ((time[rows] - time[k, None]) / scale[:, None])[..., None] ** np.arange(3)
        inverse = np.linalg.inv(np.einsum("kma,kmb->kab", design, design))
        fit = np.einsum("kab,kmb,kmd->kad", inverse, design, x[rows])
        for ahead in range(2):
            j = k[: len(k) - ahead]
            at = ((time[j + ahead] - time[j]) / scale[: len(j)])[:, None] ** np.arange(3)
            off = x[j + ahead] - np.einsum("ka,kad->kd", at, fit[: len(j)])
            spread = 1 + np.maximum(np.einsum("ka,kab,kb->k", at, inverse[: len(j)], at), 0)
            out[m - LEAST, j, ahead] = np.linalg.norm(off, axis=1) / np.sqrt(d * spread)
    out[:, count - 1, 1] = np.inf  # nothing comes after the last
    return out


class _Misses(NamedTuple):
    """Of each point: the samples in which it was seen, and how much these are missed by, forward and backward."""

    rows: list[np.ndarray]
    forward: list[np.ndarray]
    backward: list[np.ndarray]


def _misses(time: np.ndarray, x: np.ndarray) -> _Misses:
    rows = [np.flatnonzero(np.isfinite(x[:, p, 0])) for p in range(x.shape[1])]
    forward = [_missed(time[r], x[r, p]) for p, r in enumerate(rows)]
    backward = [_missed(-time[r][::-1], x[r, p][::-1]) for p, r in enumerate(rows)]
    return _Misses(rows, forward, backward)


def _kinks(misses: _Misses, noise: np.ndarray) -> Int[np.ndarray, " K"]:
    """Samples after which a point's motion has a kink: the next two samples are missed.

    Looked for backward too, which shows those that come before there is a parabola; of two neighbours the first stays.
    """
    found: set[int] = set()
    for rows, ahead, back, size in zip(*misses, noise, strict=True):
        forward = _one_way(ahead > DOUBT * size)
        backward = [len(rows) - 2 - k for k in _one_way(back > DOUBT * size)]
        found |= {int(rows[k]) for k in forward}
        found |= {int(rows[k]) for k in backward if not any(abs(k - other) <= NEIGHBOURS for other in forward)}
    return np.array(sorted(found), int)


def _one_way(missed: Bool[np.ndarray, "M T 2"]) -> list[int]:
    found, begin, k = [], 0, LEAST
    while k < missed.shape[1]:
        if missed[min(k - begin, REACH) - LEAST, k].all():
            found.append(k - 1)
            begin, k = k, k + LEAST
        else:
            k += 1
    return found


def _place(time, x, k: int, kinks, noise) -> tuple[float, float] | None:
    """Where in the step after sample `k` the parabolas of both sides meet, and the error of that, both in steps.

    Of the point that is hit hardest; None where there is too little motion on one side.
    """
    ends = np.array([-1, *kinks, len(time) - 1])
    left, right = np.arange(max(ends[ends < k].max() + 1, k - REACH + 1), k + 1), np.arange(k + 1, ends[ends > k].min())
    best = None
    length = time[k + 1] - time[k]
    for p in range(x.shape[1]):
        sides = []
        for rows in (left, right[:REACH]):
            rows = rows[np.isfinite(x[rows, p, 0])]
            if len(rows) < LEAST + 1:
                break
            design = _design((time[rows] - time[k]) / length, 2)
            inverse = np.linalg.inv(design.T @ design)
            sides.append((inverse @ design.T @ x[rows, p], inverse[0, 0]))
        if len(sides) < 2:
            continue
        (a, va), (b, vb) = sides
        jump = a[1] - b[1]
        size = float(jump @ jump)
        if best is None or size > best[0]:
            best = size, float((b[0] - a[0]) @ jump / size), float(noise[p] * np.sqrt((va + vb) / size))
    return None if best is None else best[1:]


# --- windows ----------------------------------------------------------------------------------------------------------


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
    start = _start(time, x, int(inside[0]) if len(inside) else len(time) - 1)
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


def _start(time: np.ndarray, x: np.ndarray, end: int) -> Float[np.ndarray, "2 n d"] | None:
    """Position and velocity of each point at the first time, from the samples up to `end`; None if it is not seen."""
    out = np.zeros((2, *x.shape[1:]))
    for p in range(x.shape[1]):
        rows = np.flatnonzero(np.isfinite(x[: end + 1, p, 0]))[: 2 * REACH]
        if len(rows) < 2:
            return None
        scale = time[rows[-1]] - time[0]
        order = 2 if len(rows) >= 2 * LEAST else 1
        fit = np.linalg.lstsq(_design((time[rows] - time[0]) / scale, order), x[rows, p], rcond=None)[0]
        out[0, p], out[1, p] = fit[0], fit[1] / scale
    return out
