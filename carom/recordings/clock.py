"""Times of samples in equal steps, as files have them: rounded to some digits, or to what a float of their size holds.

Rounded times do not have equal steps (.003, .003, .002 s at 360 Hz), but each is within half of its last digit of the
straight line `start + step * k`. That is what is asked for, and the step is the line's slope. A digit that is coarser
than two thirds of a step is not taken for rounding, for a lost sample then looks the same.
"""

from collections.abc import Sequence
from decimal import Decimal
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

STEP_TOLERANCE = 1e-6
"""Largest difference of two time steps that count as equal, relative to the step."""
COARSEST = 2 / 3
"""Largest last digit of times, as a share of the step."""
MANY = 0.1
"""Share of steps that are off, from which on coarse digits are taken for the reason."""
MOST_DECIMALS = 12
ROUNDS = 60
FINE = 0.2
"""Largest last digit of times with gaps, as a share of the step."""
MOST_LOST = 50
"""A longer gap, in steps, does not tell how many samples were lost in it."""


class Clock(NamedTuple):
    """Equal steps: their length (s), and the times, as given or, where these are rounded, on the line."""

    step: float
    time: Float[np.ndarray, "N T"]


class Irregular(NamedTuple):
    """The first step that is not as the others: where it begins, its length and that of most (s), and if it goes back.

    `digit`: what the last digit of the times is worth (s); `coarse`: that is too much to tell such steps.
    """

    trajectory: int
    sample: int
    step: float
    typical: float
    back: bool
    digit: float
    coarse: bool


def clock_of(
    time: Float[np.ndarray, "N T"],
    valid: Bool[np.ndarray, "N T"],
    *,
    digit: Float[np.ndarray, "#N #T"],
    rounding: float,
    step: float | None = None,
    tolerance: float = STEP_TOLERANCE,
) -> Clock | Irregular:
    """The common step of trajectories that each begin at a time of their own, or where they have none.

    **Arguments:** `time` (s), of which the `valid` samples, at least two from the first on, are looked at; `digit`,
    what the last digit of each is worth (s); `rounding`, of a difference of two (s); `step` (s), if it is known, and
    taken where the times allow it; `tolerance`, relative to a step.
    """
    pairs = valid[:, 1:]
    with np.errstate(over="ignore", invalid="ignore"):  # what overflows is found to be unequal
        steps = np.diff(time, axis=1)
        typical = float(np.median(steps[pairs]))
        back = ~(steps > 0) & pairs
        off = np.where(pairs, np.abs(steps - typical), 0.0)
        uneven = ~(off <= tolerance * typical + rounding) & pairs
        slope = _slope(time, valid)
    worth = float(np.max(np.where(valid, digit, 0.0)))
    resolved = worth < COARSEST * slope
    if not back.any():
        if not uneven.any():
            return Clock(slope, time)
        line = _rounded(time, valid, digit / 2 + rounding, slope, worth, step) if resolved else None
        if line is not None:
            return line
    bad = back if back.any() else uneven
    if not back.any() and resolved and (off > worth + rounding).any():
        bad = off > worth + rounding  # smaller differences may well be rounding
    k, t = np.unravel_index(int(np.argmax(bad)), bad.shape)
    coarse = not resolved and int(bad.sum()) > MANY * int(pairs.sum())
    return Irregular(int(k), int(t), float(steps[k, t]), typical, bool(back.any()), worth, coarse)


def _rounded(time, valid, band, slope: float, worth: float, step: float | None) -> Clock | None:
    """The line that times were rounded from, with the `step` that is given if the times allow one so near."""
    near = slack(slope, worth, float(np.max(band)) - worth / 2, int(valid.sum(axis=1).max()))
    if step is None or abs(step - slope) > near:
        return _line(time, valid, band, slope, ROUNDS)
    # A step of whole digits loses nothing by rounding: times that are off then were off before.
    whole = abs(step / worth - round(step / worth)) < 1e-3
    return None if whole else _line(time, valid, band, step, 1)


def with_gaps(
    time: Float[np.ndarray, "N T"],
    valid: Bool[np.ndarray, "N T"],
    *,
    digit: Float[np.ndarray, "#N #T"],
    rounding: float,
) -> Float[np.ndarray, "N T"] | None:
    """Times on the equal steps that they were rounded from, of which some are not there; None if they are from none.

    **Arguments:** as of `clock_of`.
    """
    worth = float(np.max(np.where(valid, digit, 0.0)))
    steps = np.where(valid[:, 1:], np.diff(time, axis=1), np.nan)
    shortest = float(np.nanmin(steps))
    step = float(np.mean(steps[steps < 1.5 * shortest + worth]))
    # Uneven times lie near multiples of a step by chance where the digit is not a small share of it.
    if not worth < FINE * step:
        return None
    whole = np.where(valid[:, 1:], np.round(steps / step), 0)
    if whole.max() > MOST_LOST or (np.abs(steps - whole * step) > worth + rounding + 0.01 * step)[valid[:, 1:]].any():
        return None
    index = np.concatenate([np.zeros((len(time), 1), int), np.cumsum(whole.astype(int), axis=1)], axis=1)
    slope = _slope(time, valid, index)
    line = _line(time, valid, np.broadcast_to(digit / 2 + rounding, time.shape), slope, ROUNDS, index)
    return None if line is None else line.time


def digit_of(time: Shaped[np.ndarray, "N T"], valid: Bool[np.ndarray, "N T"]) -> float:
    """What the last digit of numbers is worth (s), judged by the numbers: decimals, or the spacing of their floats.

    A difference of large times has their spacing: seconds since 1970 are multiples of 2^-22 s, whatever was taken off.
    """
    values = time[valid].astype(float)
    most = float(np.abs(values).max())
    grain = rounding_of(time, most)
    if time.dtype.kind == "f":
        with np.errstate(over="ignore"):  # becomes infinite, which is another number
            single = values.astype(np.float32)
        if np.array_equal(values, single):
            grain = max(grain, float(np.spacing(np.abs(single).max())))
    grains = [grain]
    if grain > 0 and (grid := _binary_grid(values, grain)) > grain:
        grains.append(grid)
    for grain in grains:
        for decimals in range(MOST_DECIMALS + 1):
            digit = 10.0**-decimals
            if digit <= 4 * grain:
                break
            if np.all(np.abs(values - np.round(values, decimals)) <= grain):
                return digit + 4 * grain  # floats before and after the decimals, and while they were made
    return 2 * grains[-1]


def digits_of(texts: Sequence[str]) -> Float[np.ndarray, " S"]:
    """What the last digit of each printed number is worth: they have the same decimals, or as many digits in all.

    A program may leave zeros at the end out, so that it is the longest that tells.
    """
    numbers = [Decimal(text.strip()) for text in texts]
    ends = [int(number.as_tuple().exponent) for number in numbers]
    begins = [number.adjusted() for number in numbers]
    most = max((begin - end for number, begin, end in zip(numbers, begins, ends, strict=True) if number), default=0)
    return np.array([10.0 ** max(min(ends), begin - most) for begin in begins])


def rounding_of(time: Shaped[np.ndarray, "..."], most: float) -> float:
    """The spacing (s) of floats of the type of `time` at its largest number."""
    return float(np.spacing(np.asarray(most).astype(time.dtype))) if time.dtype.kind == "f" else 0.0


def slack(step: float, digit: float, rounding: float, samples: int) -> float:
    """By how much (s) two steps may differ that so many samples cannot tell apart.

    Least squares are off by 3/4 of a digit over half the number of samples if all errors conspire.
    """
    return STEP_TOLERANCE * step + rounding + 2 * digit / (samples - 1)


def _binary_grid(values: Float[np.ndarray, " S"], least: float) -> float:
    """The largest power of two, from `least` on, that all values are multiples of; 0 if there is none."""
    power = 2.0 ** np.ceil(np.log2(least))
    if not np.all(np.fmod(values, power) == 0):
        return 0.0
    while power < 1 and np.all(np.fmod(values, 2 * power) == 0):
        power *= 2
    return float(power)


def _slope(
    time: Float[np.ndarray, "N T"], valid: Bool[np.ndarray, "N T"], number: Int[np.ndarray, "N T"] | None = None
) -> float:
    """Slope of the straight lines with one slope that are nearest to the times of all trajectories (least squares).

    `number`: which sample each is; by default none is missing.
    """
    index = np.where(valid, np.arange(time.shape[1]) if number is None else number, 0)
    count = valid.sum(axis=1, keepdims=True)
    index = np.where(valid, index - index.sum(axis=1, keepdims=True) / count, 0)
    from_first = np.where(valid, time - time[:, :1], 0)  # exact for neighbours, however large the times
    slope = float(np.sum(index * from_first) / np.sum(index**2))
    longest = int(np.argmax(count))
    ends = from_first[longest, count[longest, 0] - 1] / (count[longest, 0] - 1)
    return slope if np.isfinite(slope) else float(ends)


def _line(
    time: Float[np.ndarray, "N T"],
    valid: Bool[np.ndarray, "N T"],
    tolerance: Float[np.ndarray, "#N #T"],
    slope: float,
    rounds: int,
    number: Int[np.ndarray, "N T"] | None = None,
) -> Clock | None:
    """Lines of one slope within the tolerances of all times, with the slope `slope` if it can be; None if none are.

    A line of slope s exists where the excess `max_k (t_k - tol_k - s k) - min_k (t_k + tol_k - s k)` is not positive:
    convex in s, with the slope `argmin - argmax`, by which the interval that s is in is halved.
    """
    index = np.broadcast_to(np.arange(time.shape[1]) if number is None else number, time.shape)
    start = time[:, :1]
    low = np.where(valid, time - start - tolerance, -np.inf)
    high = np.where(valid, time - start + tolerance, np.inf)
    steps = (np.diff(time, axis=1) / np.maximum(np.diff(index, axis=1), 1))[valid[:, 1:]]
    wide = 2 * float(np.max(tolerance))
    below, above = float(steps.min()) - wide, float(steps.max()) + wide
    for _ in range(rounds):
        lower, upper = low - slope * index, high - slope * index
        excess = lower.max(axis=1) - upper.min(axis=1)
        worst = int(np.argmax(excess))
        if excess[worst] <= 0:
            begin = np.sum(np.where(valid, time - start - slope * index, 0), axis=1) / valid.sum(axis=1)
            return Clock(slope, start + begin[:, None] + slope * index)
        rise = int(index[worst, upper[worst].argmin()]) - int(index[worst, lower[worst].argmax()])
        if rise == 0:
            return None
        below, above = (below, slope) if rise > 0 else (slope, above)
        slope = (below + above) / 2
    return None
