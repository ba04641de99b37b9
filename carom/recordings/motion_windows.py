"""Windows of recorded motion, and the models that are compared in them: unbroken, broken and smooth.

See `motion_events.py`, which looks for breaks by them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from carom.recordings.clock import digit_of
from carom.recordings.observations import Observations

LEAST = 2
"""Fewer samples between two breaks tell no velocity."""
ORDERS = (4, 5, 6, 7)
"""Of differences from which the noise is measured: what is smooth vanishes from higher ones, impacts from lower."""
ENOUGH = 200
"""Samples from which the noise of a session is measured."""
ROUNDING = 16 * np.finfo(float).eps
"""Of numbers, as a share of the largest, by arithmetic: no noise is taken to be smaller."""


class Series(NamedTuple):
    """A body's motion in samples that were seen, in units of the noise.

    `time` (s) and `y`, with padding; `length` samples each; `sample`: their numbers among all; `free`: how many of the
    coordinates are free (a quaternion has 3 of 4); `unit`: the noise (m) of the first `d` coordinates, the centre.
    """

    time: Float[np.ndarray, "N M"]
    y: Float[np.ndarray, "N M c"]
    length: Int[np.ndarray, " N"]
    sample: Int[np.ndarray, "N M"]
    free: int
    unit: Float[np.ndarray, "N d"]


class Fits(NamedTuple):
    """Models at intervals: of no break, broken and smooth, the squares that they leave; the break's step and slope."""

    none: Float[np.ndarray, " S"]
    broken: Float[np.ndarray, " S"]
    smooth: Float[np.ndarray, " S"]
    dof: Int[np.ndarray, " S"]
    step: Float[np.ndarray, "S c"]
    slope: Float[np.ndarray, "S c"]
    step_error: Float[np.ndarray, " S"]
    slope_error: Float[np.ndarray, " S"]


def fit_windows(
    series: Series,
    row: Int[np.ndarray, " S"],
    k: Int[np.ndarray, " S"],
    low: Int[np.ndarray, " S"],
    high: Int[np.ndarray, " S"],
    half: int,
    degree: int,
    gap: int = 1,
) -> Fits:
    """The models at the intervals after samples `k` of rows, in windows of `half` on each side within [low, high).

    `gap`: the interval ends at sample k + gap, and what lies within is not looked at.
    """
    around = np.arange(1 - half, half + 1)
    at = k[:, None] + around + np.where(around > 0, gap - 1, 0)
    inside = (at >= low[:, None]) & (at < high[:, None])
    at = np.clip(at, 0, series.time.shape[1] - 1)
    t = series.time[row[:, None], at]
    middle = (series.time[row, k] + series.time[row, np.minimum(k + gap, series.time.shape[1] - 1)]) / 2
    u = np.where(inside, t - middle[:, None], 0.0)
    span = np.maximum(np.abs(u).max(axis=1), 1e-300)
    u = u / span[:, None]
    late = inside & (np.arange(2 * half) >= half)
    y = np.where(inside[..., None], series.y[row[:, None], at], 0.0)
    y = y - np.where(inside[..., None], (y.sum(axis=1) / inside.sum(axis=1)[:, None])[:, None], 0.0)
    powers = np.polynomial.legendre.legvander(u, degree + 2) * inside[..., None]
    plain, kink = powers[..., : degree + 1], np.stack([late.astype(float), np.where(late, u, 0.0)], axis=-1)
    # The triangular factor alone tells all: squares of y below its first p rows are what p columns leave.
    R = _triangle(np.concatenate([plain, kink, y], axis=2))
    smooth = _triangle(np.concatenate([powers, y], axis=2))[:, degree + 3 :, degree + 3 :]
    s = degree + 1
    step_size, slope_size, mixed = R[:, s, s], R[:, s + 1, s + 1], R[:, s, s + 1]
    sides = np.minimum(late.sum(axis=1), (inside & ~late).sum(axis=1))
    known = (sides >= LEAST) & (inside.sum(axis=1) > degree + 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = R[:, s + 1, s + 2 :] / slope_size[:, None]
        step = (R[:, s, s + 2 :] - mixed[:, None] * slope) / step_size[:, None]
        step_error = np.hypot(1, mixed / slope_size) / np.abs(step_size)
        slope_error = 1 / np.abs(slope_size * span)
    return Fits(
        none=np.sum(R[:, s:, s + 2 :] ** 2, axis=(1, 2)),
        broken=np.sum(R[:, s + 2 :, s + 2 :] ** 2, axis=(1, 2)),
        smooth=np.sum(smooth**2, axis=(1, 2)),
        dof=np.where(known, inside.sum(axis=1) - degree - 3, 0),
        step=step,
        slope=slope / span[:, None],
        step_error=step_error,
        slope_error=slope_error,
    )


def _triangle(columns: Float[np.ndarray, "S w p"]) -> Float[np.ndarray, "S r p"]:
    return np.asarray(np.linalg.qr(columns, mode="r"))


def without(series: Series, row: int, first: int, end: int) -> None:
    """Take the samples [first, end) of a row out of a series, in place."""
    kept = np.r_[0:first, end : series.time.shape[1], [series.time.shape[1] - 1] * (end - first)]
    for part in (series.time, series.y, series.sample):
        part[row] = part[row, kept]
    series.length[row] -= end - first


def series_of(
    observations: Observations, points: Sequence[int], piece: Int[np.ndarray, "N M"] | None = None
) -> Series | None:
    """The motion of the body with these points, one or d + 1; None where too little was seen to know its noise.

    **Arguments:** `piece`, a number for each sample that was seen; of those with one the noise is measured.
    """
    x, dim = observations.x[:, :, list(points)], observations.dim
    seen = np.asarray(observations.seen[:, :, list(points)].all(axis=2))
    sample = np.argsort(~seen, axis=1, kind="stable")
    count = seen.sum(axis=1)
    most = int(count.max())
    if most <= max(ORDERS):
        return None
    sample = sample[:, :most]
    rows = np.arange(len(x))[:, None]
    valid = np.arange(most) < count[:, None]
    time = np.where(valid, observations.time[rows, sample], 0.0)
    x = np.where(valid[..., None, None], x[rows, sample], 0.0)
    parts, free = [x[:, :, 0]], dim
    if len(points) > 1:
        parts.append(_turns(x, valid))
        free += 1 if dim == 2 else 3
    session = np.zeros(len(x), int)
    if observations.group is not None:
        session = np.unique(observations.group, return_inverse=True)[1]
    piece = np.zeros(time.shape, int) if piece is None else piece
    units = [_units(time, part, valid, piece, session, recorded=part is parts[0]) for part in parts]
    if len(points) > 1 and dim == 3:  # errors of a quaternion have three directions of its four
        units[1] = np.repeat(np.sqrt(np.sum(units[1] ** 2, axis=1, keepdims=True) / 3), 4, axis=1)
    y = np.concatenate([part / unit[:, None] for part, unit in zip(parts, units, strict=True)], axis=2)
    return Series(time, y, count, sample, free, units[0])


def _units(
    time: Float[np.ndarray, "N M"],
    part: Float[np.ndarray, "N M c"],
    valid: Bool[np.ndarray, "N M"],
    piece: Int[np.ndarray, "N M"],
    session: Int[np.ndarray, " N"],
    recorded: bool,
) -> Float[np.ndarray, "N c"]:
    """The noise of each coordinate, by session where that has enough samples to tell: cameras differ."""
    out = np.empty((len(part), part.shape[2]))
    for k in range(part.shape[2]):
        out[:, k] = _noise(time, part[..., k], valid, piece, recorded)
        for own in np.unique(session) if session.any() else ():
            rows = session == own
            if valid[rows].sum() >= ENOUGH:
                out[rows, k] = _noise(time[rows], part[rows, :, k], valid[rows], piece[rows], recorded)
    return out


def _turns(x: Float[np.ndarray, "N M p d"], valid: Bool[np.ndarray, "N M"]) -> Float[np.ndarray, "N M c"]:
    """The angle (2D) or quaternion (3D) of a rigid body, without jumps."""
    axes = x[:, :, 1:] - x[:, :, :1]
    if axes.shape[-1] == 2:
        angle = np.arctan2(axes[..., 0, 1] - axes[..., 1, 0], axes[..., 0, 0] + axes[..., 1, 1])
        return np.unwrap(angle, axis=1)[..., None]
    axes = np.where(valid[..., None, None], axes, np.eye(3))
    u, _, vh = np.linalg.svd(np.swapaxes(axes, 2, 3))
    u[..., -1] *= np.linalg.det(u @ vh)[..., None]
    flat = Rotation.from_matrix((u @ vh).reshape(-1, 3, 3)).as_quat()
    quaternion = flat.reshape(*valid.shape, 4)
    flip = np.sum(quaternion[:, 1:] * quaternion[:, :-1], axis=2) < 0
    quaternion[:, 1:] *= np.where(np.cumsum(flip, axis=1) % 2 == 1, -1.0, 1.0)[..., None]
    return quaternion


def _noise(
    time: Float[np.ndarray, "N M"],
    y: Float[np.ndarray, "N M"],
    valid: Bool[np.ndarray, "N M"],
    piece: Int[np.ndarray, "N M"],
    recorded: bool,
) -> float:
    """Standard deviation of independent errors of a coordinate, from divided differences of high order.

    Each is scaled to have the variance of the errors. Of the orders that with the smallest median is the one to which
    smooth motion and impacts add least. A body at rest, of which nothing changes, says nothing: then numbers that were
    `recorded` are off by the rounding of their last digit.
    """
    values = y[valid]
    floor = max(ROUNDING * float(np.abs(values).max(initial=0.0)), 1e-300)
    if recorded:
        floor = max(floor, digit_of(values[None], np.ones((1, len(values)), bool)) / np.sqrt(12))
    found = []
    for order in ORDERS:
        t, part = (np.lib.stride_tricks.sliding_window_view(a, order + 1, axis=1) for a in (time, y))
        whole = valid[:, order:] & (piece[:, order:] == piece[:, :-order])
        t, part = t[whole], part[whole]
        t = (t - t[:, :1]) / np.where(t[:, -1:] > t[:, :1], t[:, -1:] - t[:, :1], 1.0)
        apart = t[:, :, None] - t[:, None] + np.eye(order + 1)
        weight = 1 / np.prod(apart, axis=2)
        size = np.abs(np.sum(weight * (part - part[:, :1]), axis=1)) / np.linalg.norm(weight, axis=1)
        size = size[size > 0]
        if len(size):
            found.append(float(np.median(size)) / 0.6745)
    return max(min(found, default=0.0), floor)
