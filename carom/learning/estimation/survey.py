"""What observed motion shows by itself: errors of its positions, and kinks where something was hit.

Where a body is hit its motion has a kink: the last samples, extended as a polynomial, miss the next ones by more than
their errors allow. That is looked for, never overlap, which the motion of rigid bodies does not show. Free motion is a
parabola but for bodies on joints and those that turn: of these the polynomial may be of a higher order, what it misses
grows and falls with how fast they go, and a kink is what is missed by far more than the samples before were.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from carom.recordings.clock import STEP_TOLERANCE, digit_of
from carom.recordings.observations import Observations


class Shape(NamedTuple):
    """Polynomials of an `order` through the last samples, of which at least `least` are needed and `reach` are taken.

    A kink is missed by more than `jump` times what the two samples were that were foretold before it, if any were since
    the last. Samples behind a step that is longer than `gap` typical ones are not foretold.
    """

    order: int
    least: int
    reach: int
    jump: float
    gap: float


PARABOLA = Shape(2, 4, 8, 0.0, 1000.0)
BENT = tuple(Shape(order, order + 2, order + 6, 5.0, 10.0) for order in (2, 3, 4))
DOUBT = 6.0
"""Standard errors by which a sample must be missed to show a kink; of bent motion, medians of what is missed."""
NEIGHBOURS = 2
"""Kinks found forward and backward that are so many samples apart are one."""
SHARE = 0.1
"""Errors of positions that are left beside those of their times are this share of all at least."""
FLOOR = 1e-9
"""Errors of positions, as a share of how far the motion reaches, are not taken to be less: rounding, amplified."""


class Track(NamedTuple):
    """One trajectory: its times (s), positions (NaN where not seen), what errors of times make of these (m), and the
    samples after which there is a kink."""

    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T n d"]
    timing: Float[np.ndarray, "T n d"]
    kinks: Int[np.ndarray, " K"]


class Survey(NamedTuple):
    """What the motions show by themselves: tracks, the errors of each point's positions (m), where in its step each
    kink is (from 0 to 1) with the error of that, the typical time step (s), and what polynomials foretold best."""

    tracks: tuple[Track, ...]
    noise: Float[np.ndarray, " n"]
    floor: float
    place: Float[np.ndarray, "K 2"]
    step: float
    shape: Shape


def survey(observations: Observations, *, bent: bool = False) -> Survey:
    """Errors of positions, and kinks of all trajectories; `bent`: free motion is no parabola."""
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
    shapes = BENT if bent else (PARABOLA,)
    every = [[_misses(time, x, shape) for time, x in tracks] for shape in shapes]
    # The order that foretells best: a higher one follows what bends, a lower one is misled less by errors.
    best = int(np.argmin([_size(_usual(misses, raw=True)) for misses in every])) if bent else 0
    shape, misses = shapes[best], every[best]
    if bent:
        usual = np.maximum(_usual(misses), floor)
        known = usual[np.isfinite(usual)]
        limit = np.where(np.isfinite(usual), usual, np.median(known) if len(known) else np.sqrt(np.finfo(float).max))
        found = [(t, x, _kinks(missed, limit, shape)) for (t, x), missed in zip(tracks, misses, strict=True)]
        noise = np.maximum(_noise(found, shape, robust=True), floor)
    else:
        noise = np.maximum(_noise([(t, x, np.zeros(0, int)) for t, x in tracks], shape, robust=True), floor)
        found = []
        for _ in range(2):
            found = [(t, x, _kinks(missed, noise, shape)) for (t, x), missed in zip(tracks, misses, strict=True)]
            noise = np.maximum(_noise(found, shape, robust=False), floor)
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
        shape,
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


def design(time: Float[np.ndarray, "*T"], order: int) -> Float[np.ndarray, "*T m"]:
    """Powers of times, from 0 on."""
    return time[..., None] ** np.arange(order + 1)


def _noise(tracks, shape: Shape, *, robust: bool) -> Float[np.ndarray, " n"]:
    """Standard deviation of errors of each point, from polynomials through `reach` samples without a kink.

    If `robust`, the median of theirs: not all kinks have been found. Of exact motion that is bent it is what the
    polynomials do not follow.
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
                every_few = 3 if robust else shape.reach
                runs += [rows[k : k + shape.reach] for k in range(0, len(rows) - shape.reach + 1, every_few)]
            if not runs:
                continue
            r = np.array(runs)
            span = time[r] - time[r[:, :1]]
            basis = np.linalg.qr(design(span / span[:, -1:], shape.order))[0]
            left = x[r, p] - np.einsum("kma,kna,knd->kmd", basis, basis, x[r, p])
            own[p] += np.sum(left**2, axis=(1, 2)).tolist()
    out = np.zeros(n)
    every = [value for part in own for value in part]
    for p, part in enumerate(own):
        part = part or every or [0.0]
        dof = (shape.reach - shape.order - 1) * d
        out[p] = np.median(part) / (dof * (1 - 2 / (9 * dof)) ** 3) if robust else _clean(part, dof)
    return np.sqrt(out)


def _clean(part: list[float], dof: int) -> float:
    """Mean of sums of squares over their degrees of freedom, without the few that hold a kink which was not seen."""
    values = np.array(part) / dof
    limit = np.median(values) * (1 + 5 * np.sqrt(2 / dof))
    return float(np.mean(values[values <= limit]))


def _missed(time: np.ndarray, x: np.ndarray, shape: Shape) -> Float[np.ndarray, "M T 2 2"]:
    """By how much (m) samples k and k + 1 are missed, and that in standard errors of positions of 1 m.

    By the polynomial through the m samples before k, for m from `least` to `reach`; infinite where there are too few.
    """
    count, d = x.shape
    out = np.full((shape.reach - shape.least + 1, count, 2, 2), np.inf)
    if count <= shape.least:
        return out
    steps = np.diff(time)
    longest = shape.gap * np.median(steps)
    for m in range(shape.least, min(shape.reach, count - 1) + 1):
        k = np.arange(m, count)
        rows = k[:, None] - m + np.arange(m)
        near = np.max(steps[rows], axis=1) <= longest  # the last is that to sample k
        k, rows = k[near], rows[near]
        scale = time[k] - time[rows[:, 0]]
        powers = design((time[rows] - time[k, None]) / scale[:, None], shape.order)
        inverse = np.linalg.inv(np.einsum("kma,kmb->kab", powers, powers))
        fit = np.einsum("kab,kmb,kmd->kad", inverse, powers, x[rows])
        for ahead in range(2):
            there = k + ahead < count
            j = k[there] + ahead
            at = design((time[j] - time[k[there]]) / scale[there], shape.order)
            off = np.linalg.norm(x[j] - np.einsum("ka,kad->kd", at, fit[there]), axis=1) / np.sqrt(d)
            spread = 1 + np.maximum(np.einsum("ka,kab,kb->k", at, inverse[there], at), 0)
            out[m - shape.least, k[there], ahead] = np.stack([off, off / np.sqrt(spread)], axis=1)
    out[:, count - 1, 1] = np.inf  # nothing comes after the last
    return out


class _Misses(NamedTuple):
    """Of each point: the samples in which it was seen, and how much these are missed by, forward and backward."""

    rows: list[np.ndarray]
    forward: list[np.ndarray]
    backward: list[np.ndarray]


def _misses(time: np.ndarray, x: np.ndarray, shape: Shape) -> _Misses:
    rows = [np.flatnonzero(np.isfinite(x[:, p, 0])) for p in range(x.shape[1])]
    forward = [_missed(time[r], x[r, p], shape) for p, r in enumerate(rows)]
    backward = [_missed(-time[r][::-1], x[r, p][::-1], shape) for p, r in enumerate(rows)]
    return _Misses(rows, forward, backward)


def _usual(misses: list[_Misses], raw: bool = False) -> Float[np.ndarray, " n"]:
    """By how much the next sample is missed in the median, at each point: in m if `raw`, else in standard errors.

    NaN where there are too few samples to tell.
    """
    out = []
    for p in range(len(misses[0].rows)):
        parts = np.concatenate([one.forward[p][-1, :, 0, 0 if raw else 1] for one in misses])
        parts = parts[np.isfinite(parts)]
        out.append(np.median(parts) if len(parts) else np.nan)
    return np.array(out)


def _size(usual: Float[np.ndarray, " n"]) -> float:
    """Of all points; infinite where one cannot be told."""
    size = float(np.sqrt(np.mean(usual**2)))
    return size if np.isfinite(size) else np.inf


def _kinks(misses: _Misses, noise: np.ndarray, shape: Shape) -> Int[np.ndarray, " K"]:
    """Samples after which a point's motion has a kink: the next two samples are missed.

    Looked for backward too, which shows those that come before there is a polynomial; of two neighbours the first
    stays, of bodies that are joined also where they are those of two points.
    """
    found: set[int] = set()
    for rows, ahead, back, size in zip(*misses, noise, strict=True):
        forward = _one_way(ahead[..., 1] / size, shape)
        backward = [len(rows) - 2 - k for k in _one_way(back[..., 1] / size, shape)]
        found |= {int(rows[k]) for k in forward}
        found |= {int(rows[k]) for k in backward if not any(abs(k - other) <= NEIGHBOURS for other in forward)}
    kinks: list[int] = []
    for k in sorted(found):
        if not shape.jump or not kinks or k - kinks[-1] > NEIGHBOURS:
            kinks.append(k)
    return np.array(kinks, int)


def _one_way(missed: Float[np.ndarray, "M T 2"], shape: Shape) -> list[int]:
    found, begin, k = [], 0, shape.least
    usual: list[float] = []
    while k < missed.shape[1]:
        next_two = missed[min(k - begin, shape.reach) - shape.least, k]
        if np.isinf(next_two[0]):  # behind a gap
            k, usual = k + 1, []
            continue
        # A kink too many makes windows shorter; one that is missed, right after another, leads them astray.
        before = max(usual[-2:], default=0.0)
        if (next_two > DOUBT).all() and next_two[0] > shape.jump * before:
            found.append(k - 1)
            begin, k, usual = k, k + shape.least, []
        else:
            usual.append(float(next_two[0]))
            k += 1
    return found


def _place(time, x, k: int, kinks, noise) -> tuple[float, float] | None:
    """Where in the step after sample `k` the parabolas of both sides meet, and the error of that, both in steps.

    Of the point that is hit hardest; None where there is too little motion on one side.
    """
    ends = np.array([-1, *kinks, len(time) - 1])
    left, right = (
        np.arange(max(ends[ends < k].max() + 1, k - PARABOLA.reach + 1), k + 1),
        np.arange(k + 1, ends[ends > k].min()),
    )
    best = None
    length = time[k + 1] - time[k]
    for p in range(x.shape[1]):
        sides = []
        for rows in (left, right[: PARABOLA.reach]):
            rows = rows[np.isfinite(x[rows, p, 0])]
            if len(rows) <= PARABOLA.least:
                break
            powers = design((time[rows] - time[k]) / length, 2)
            inverse = np.linalg.inv(powers.T @ powers)
            sides.append((inverse @ powers.T @ x[rows, p], inverse[0, 0]))
        if len(sides) < 2:
            continue
        (a, va), (b, vb) = sides
        jump = a[1] - b[1]
        size = float(jump @ jump)
        if best is None or size > best[0]:
            best = size, float((b[0] - a[0]) @ jump / size), float(noise[p] * np.sqrt((va + vb) / size))
    return None if best is None else best[1:]
