"""Where recorded motion breaks: velocities jump between two samples, as impacts make them, whatever the forces are.

Nothing is known but positions. Around each interval between two samples of a body two models of the same size are
compared, over windows of several widths:

    one that breaks     a polynomial of degree q in time, and from the interval on a step and a change of slope
    one that is smooth  a polynomial of degree q + 2

An impact within the interval at time tau changes velocities by J: after it the motion is off by `J (t - tau)`, which is
what the step and the slope are for, wherever tau is. The motion breaks where

1. the break explains more than noise does: the squares that it takes away, over the variance of the noise, are beyond
   what the chi^2 distribution has once in so many intervals;
2. smoothness does not explain it as well: a strong force bends the motion too, but a polynomial follows that.

The noise is measured on the data, by differences of high order over neighbouring samples, of which the median leaves
impacts out; where a model leaves more, as any does of curved motion without noise, that is taken in its place. So
nothing has a unit, and a threshold is a probability. Breaks are found one after the other: windows end at those that
were found, which are then looked at again, and moved or left out where they explain no more. A single sample that is
wrong bends the motion twice, and two impacts with a sample or two in between leave nothing to know the motion between
them by: where no model explains a window, and one does without such samples, they are left out.

Rotations of rigid bodies are looked at by angle (2D) or quaternion (3D), beside the centre.
"""

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import chdtri

from carom.recordings.motion_windows import LEAST, Fits, Series, fit_windows, series_of, without
from carom.recordings.observations import Observations

SCALES = ((4, 2), (7, 3), (12, 3), (20, 3))
"""Windows: samples on each side of an interval, and the degree of the polynomial."""
RATE = 1e-3
"""Share of intervals in which noise alone may break the motion, at one scale."""
CONSISTENT = 1e-3
"""Share of windows in which noise alone leaves more than is taken for noise."""
BETTER = 6.0
"""A smooth model must leave so much more than the broken one, in units of the noise,"""
CLEARLY = 10.0
"""and so many times as much, where both leave more than noise."""
AGREE = 0.05
"""Share of pairs of windows whose jumps are called different by noise alone."""
BETWEEN = 3
"""Fewer samples between two breaks fit any two, wherever these are."""
GAPS = (2, 3)
"""How many intervals impacts may share that are seen as one."""
NARROW = 2
"""Scales at which such are looked for."""
UNEXPLAINED = 1e-4
"""Share of windows of which noise alone leaves so much that no model is said to explain them."""
QUIETER = 0.9
"""Where the noise is found to be smaller by so much without the breaks, they are looked for again."""
ROUNDS = 12
NEARBY = 2
"""By so many intervals a break may be moved when it is looked at again."""


class Breaks(NamedTuple):
    """Where motion breaks, in the order of trajectories and times.

    The velocity of `body` jumps by `jump` (m/s, of its centre) at about `time` (s, give or take `time_error`) between
    the samples `before` and `after` of `trajectory`; `size`: the jump (and that of its rotation) in units of its error.
    """

    trajectory: Int[np.ndarray, " B"]
    body: Int[np.ndarray, " B"]
    before: Int[np.ndarray, " B"]
    after: Int[np.ndarray, " B"]
    time: Float[np.ndarray, " B"]
    time_error: Float[np.ndarray, " B"]
    jump: Float[np.ndarray, "B d"]
    size: Float[np.ndarray, " B"]


def motion_breaks(observations: Observations, bodies: Sequence[Sequence[int]] | None = None) -> Breaks:
    """Where the motion of bodies breaks (see the top of this file).

    **Arguments:** `bodies`, the points of each: one, or d + 1 of a rigid body; by default each point is a body.
    """
    points = [(k,) for k in range(observations.n_points)] if bodies is None else bodies
    parts = []
    for body, own in enumerate(points):
        series = series_of(observations, own)
        if series is None:
            continue
        found = _search(series)
        again = series_of(observations, own, _pieces(series, found))
        if again is not None and bool((again.unit < QUIETER * series.unit).any()):
            series, found = again, _search(again)
        parts.append(_described(series, found, body))
    if not parts:
        none = np.zeros(0, int)
        return Breaks(none, none, none, none, none * 1.0, none * 1.0, np.zeros((0, observations.dim)), none * 1.0)
    whole = Breaks(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    order = np.lexsort((whole.body, whole.time, whole.trajectory))
    return Breaks(*(column[order] for column in whole))


class Found(NamedTuple):
    """Breaks of a series: the rows, and the samples `k` after which they are."""

    row: Int[np.ndarray, " B"]
    k: Int[np.ndarray, " B"]


def _pieces(series: Series, found: Found) -> Int[np.ndarray, "N M"]:
    """In which piece of its motion, from one break to the next, each sample is."""
    breaks = np.zeros(series.time.shape, int)
    breaks[found.row, found.k + 1] = 1
    return np.cumsum(breaks, axis=1)


def _search(series: Series) -> Found:
    """All breaks, one after the other."""
    breaks: list[list[int]] = [[] for _ in series.length]
    _find(series, breaks, np.arange(len(breaks)))
    hidden = _hidden(series, breaks)
    for r, k, gap in sorted(hidden, reverse=True):
        without(series, r, k + 1, k + gap)
    if hidden:
        rows = np.unique([r for r, _, _ in hidden])
        for r in rows:
            breaks[r] = []
        _find(series, breaks, rows)
    return _found((r, k) for r, own in enumerate(breaks) for k in own)


def _found(pairs: Iterable[tuple[int, int]]) -> Found:
    both = np.array(list(pairs), int).reshape(-1, 2)
    return Found(both[:, 0], both[:, 1])


def _find(series: Series, breaks: list[list[int]], active: Int[np.ndarray, " R"]) -> None:
    """Add to `breaks` those of these rows."""
    tried: set[tuple[int, int]] = set()
    for _ in range(ROUNDS):
        row, k = _intervals(series, active, breaks)
        if not len(row):
            break
        score, half = _best(series, row, k, *_limits(series, breaks, row, k))
        new = [(r, at) for r, at in _peaks(row, k, score, half) if (r, at) not in tried]
        if not new:
            break
        tried.update(new)
        for r, at in new:
            breaks[r] = sorted([*breaks[r], at])
        active = np.array(sorted({r for r, _ in new}))
        _look_again(series, breaks, active)


def _hidden(series: Series, breaks: list[list[int]]) -> list[tuple[int, int, int]]:
    """Rows, samples k and gaps where what lies between k and k + gap is to be left out.

    There no model explains the motion, and one does without these samples: two impacts follow one another so soon that
    nothing is known of the motion in between, or a sample is wrong.
    """
    best: dict[tuple[int, int], tuple[float, int]] = {}
    row, k = _intervals(series, np.arange(len(breaks)), [[] for _ in breaks])
    low, high = _limits(series, breaks, row, k, (BETWEEN - 1, max(GAPS) + BETWEEN - 2))
    shape, usual, lefts = series.time.shape, [], []
    told = np.ones(shape, bool)  # where a model explains the motion; ends are not looked at
    told[row, k] = False
    for half, degree in SCALES[:NARROW]:
        fits = fit_windows(series, row, k, low, high, half, degree)
        least = np.where(fits.dof > 0, np.minimum(fits.broken, fits.smooth), np.inf)
        usual.append(CLEARLY * float(np.median(least[fits.dof > 0])) if (fits.dof > 0).any() else 0.0)
        told[row, k] |= least <= np.maximum(chdtri(np.maximum(series.free * fits.dof, 1), UNEXPLAINED), usual[-1])
        lefts.append(np.full(shape, np.inf))
        lefts[-1][row, k] = least
    for scale, gap in itertools.product(range(NARROW), GAPS):
        there = np.minimum(k[None] + np.arange(gap)[:, None], shape[1] - 1)
        odd = ~told[row, there].any(axis=0) & np.isfinite(lefts[scale][row, there]).all(axis=0)
        if not odd.any():
            continue
        r, at, least = row[odd], k[odd], lefts[scale][row, there].min(axis=0)[odd]
        wide = fit_windows(series, r, at, low[odd], high[odd], *SCALES[scale], gap)
        rest = np.maximum(series.free * wide.dof, 1)
        now = np.where(_score(wide, series.free, RATE) > 1, wide.broken, np.inf)
        now = np.minimum(now, wide.none) if gap == GAPS[0] else now
        good = (wide.dof > 0) & (now <= np.maximum(chdtri(rest, CONSISTENT), usual[scale]))
        gain = np.where(good, least / np.maximum(now, rest), 0.0)
        for i in np.flatnonzero(gain > CLEARLY):
            key, own = (int(r[i]), int(at[i])), (float(gain[i]), gap)
            best[key] = max(own, best.get(key, own))
    out: list[tuple[int, int, int]] = []
    for gap, _, r, at in sorted((gap, -gain, r, at) for (r, at), (gain, gap) in best.items()):
        if all(r != other or abs(at - there) > max(GAPS) + 1 for other, there, _ in out):
            out.append((r, at, gap))
    return out


def _intervals(series: Series, rows: Int[np.ndarray, " R"], breaks: list[list[int]]) -> Found:
    """All intervals of these rows that have enough samples on either side up to the next break."""
    pairs: list[tuple[int, int]] = []
    for r in rows.tolist():
        ends = [-1, *breaks[r], series.length[r] - 1]
        for first, last in itertools.pairwise(ends):
            begin = first + (BETWEEN if first >= 0 else LEAST)
            end = last - (BETWEEN if last < series.length[r] - 1 else LEAST)
            pairs += [(r, k) for k in range(begin, end + 1)]
    return _found(pairs)


def _limits(
    series: Series, breaks: list[list[int]], row, k, ignored: tuple[int, int] = (0, 0)
) -> tuple[np.ndarray, np.ndarray]:
    """Between which samples windows around intervals may lie: breaks before and after, but for those `ignored`.

    These are as many before and after the interval; one at the interval is always.
    """
    pairs, (back, ahead) = list(zip(row, k, strict=True)), ignored
    low = [max((b + 1 for b in breaks[r] if b < at - back), default=0) for r, at in pairs]
    high = [min((b + 1 for b in breaks[r] if b > at + ahead), default=series.length[r]) for r, at in pairs]
    return np.array(low, int), np.array(high, int)


def _best(series: Series, row, k, low, high, rate: float = RATE) -> tuple[np.ndarray, np.ndarray]:
    """How significant a break is at each interval, more than 1 where it is one; and the scale that says so."""
    best, chosen = np.zeros(len(row)), np.zeros(len(row), int)
    for scale, (half, degree) in enumerate(SCALES):
        score = _score(fit_windows(series, row, k, low, high, half, degree), series.free, rate)
        chosen = np.where(score > best, scale, chosen)
        best = np.maximum(score, best)
    return best, chosen


def _score(fits: Fits, free: int, rate: float) -> Float[np.ndarray, " S"]:
    rest = np.maximum(free * fits.dof, 1)
    spare = np.maximum(1.0, fits.broken / rest)
    gain = (fits.none - fits.broken) / spare
    as_noise = fits.broken <= chdtri(rest, CONSISTENT)
    not_smooth = np.where(as_noise, fits.smooth - fits.broken > BETTER, fits.smooth > CLEARLY * fits.broken)
    with np.errstate(invalid="ignore"):
        jump = np.sum((fits.slope / fits.slope_error[:, None]) ** 2, axis=1) / spare
    good = (fits.dof > 0) & not_smooth & (jump > chdtri(free, rate))
    return np.where(good, gain / chdtri(2 * free, rate), 0.0)


def _peaks(row, k, score, scale) -> list[tuple[int, int]]:
    """The most significant intervals, none within the window of another."""
    out: list[tuple[int, int]] = []
    taken: dict[int, list[tuple[int, int]]] = {}
    for i in np.argsort(-score, kind="stable"):
        if score[i] <= 1:
            break
        r, at, half = int(row[i]), int(k[i]), SCALES[scale[i]][0]
        if all(abs(at - other) > max(half, near) for other, near in taken.get(r, [])):
            taken.setdefault(r, []).append((at, half))
            out.append((r, at))
    return out


def _look_again(series: Series, breaks: list[list[int]], rows: Int[np.ndarray, " R"]) -> None:
    """Move breaks of these rows to where they explain most, and leave those out that are none any more."""
    row = np.array([r for r in rows for _ in breaks[r]], int)
    k = np.array([b for r in rows for b in breaks[r]], int)
    low, high = _limits(series, breaks, row, k)
    _, scale = _best(series, row, k, low, high)
    moved = _moved(series, row, k, low, high, scale)
    for r in rows:
        own = sorted({int(b) for b in moved[row == r]})
        if len(own) == len(breaks[r]) and all(b - a >= BETWEEN for a, b in itertools.pairwise(own)):
            breaks[r] = own
    k = np.array([b for r in rows for b in breaks[r]], int)
    score, _ = _best(series, row, k, *_limits(series, breaks, row, k))
    for r in rows:
        breaks[r] = [int(b) for b in k[(row == r) & (score > 1)]]


def _moved(series: Series, row, k, low, high, scale) -> Int[np.ndarray, " B"]:
    """The interval nearby in which the motion breaks most likely, of the same samples."""
    out = k.copy()
    for s, (half, degree) in enumerate(SCALES):
        at = np.flatnonzero(scale == s)
        if not len(at):
            continue
        first, end = np.maximum(low[at], k[at] - half + 1), np.minimum(high[at], k[at] + half + 1)
        costs = []
        for shift in range(-NEARBY, NEARBY + 1):
            there = np.clip(k[at] + shift, first + LEAST - 1, end - LEAST - 1)
            fits = fit_windows(series, row[at], there, first, end, half + NEARBY, degree)
            cost = np.where(fits.dof > 0, fits.broken + _off(series, row[at], there, fits), np.inf)
            costs.append(np.where(there == k[at] + shift, cost, np.inf))
        out[at] = k[at] + np.argmin(costs, axis=0) - NEARBY
    return out


def _off(series: Series, row, k, fits: Fits) -> Float[np.ndarray, " S"]:
    """How far (chi^2) the step is from what a jump within the interval makes."""
    late = _late(fits.step, fits.slope, series.time[row, k + 1] - series.time[row, k])
    with np.errstate(invalid="ignore"):
        return np.sum((fits.step + fits.slope * late[:, None]) ** 2, axis=1) / fits.step_error**2


def _described(series: Series, found: Found, body: int) -> Breaks:
    """Breaks with their times and jumps.

    Of wide windows, in which errors are small, where a narrow one does not contradict: forces bend motion in those.
    """
    breaks: list[list[int]] = [[] for _ in series.length]
    for r, at in zip(*found, strict=True):
        breaks[r].append(int(at))
    low, high = _limits(series, breaks, *found)
    score, _ = _best(series, *found, low, high)
    row, k, low, high = (part[score > 1] for part in (*found, low, high))
    slope, step = (np.zeros((len(row), series.y.shape[2])) for _ in range(2))
    slope_error, step_error = np.full(len(row), np.inf), np.full(len(row), np.inf)
    for half, degree in SCALES:
        fits = fit_windows(series, row, k, low, high, half, degree)
        spare = np.sqrt(np.maximum(1.0, fits.broken / np.maximum(series.free * fits.dof, 1)))
        error = spare * fits.slope_error
        with np.errstate(invalid="ignore"):
            apart = np.sum((fits.slope - slope) ** 2, axis=1) / (error**2 + slope_error**2)
        first = np.isinf(slope_error)
        taken = (_score(fits, series.free, RATE) > 1) & (
            first | ((apart < chdtri(series.free, AGREE)) & (error < slope_error))
        )
        slope, step = (np.where(taken[:, None], new, old) for new, old in ((fits.slope, slope), (fits.step, step)))
        slope_error = np.where(taken, error, slope_error)
        step_error = np.where(taken, spare * fits.step_error, step_error)
    before, after = series.time[row, k], series.time[row, k + 1]
    length = np.linalg.norm(slope, axis=1)
    time = (before + after) / 2 + _late(step, slope, after - before)
    error = np.minimum(step_error / length, (after - before) / np.sqrt(12))
    samples = series.sample[row, k], series.sample[row, k + 1]
    jump = slope[:, : series.unit.shape[1]] * series.unit[row]
    return Breaks(row, np.full(len(row), body), *samples, time, error, jump, length / slope_error)


def _late(step: Float[np.ndarray, "S c"], slope: Float[np.ndarray, "S c"], width: Float[np.ndarray, " S"]):
    """How long after the middle of an interval of this width (s) a jump of this slope makes a step nearest to this."""
    late = -np.sum(step * slope, axis=1) / np.maximum(np.sum(slope**2, axis=1), 1e-300)
    return np.clip(late, -width / 2, width / 2)
