"""What an estimate is worth: how well held-out windows are explained, intervals, and a verdict for each quantity."""

import dataclasses
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from carom.learning.estimation.robust import spectrum
from carom.learning.estimation.shooting import LOST, Shooting, State, shoot
from carom.simulation.impact import ImpactRule

Verdict = Literal["identified", "bounded below", "bounded above", "not identified", "misfit"]

LEAST_IMPACTS = 10
"""Fewer impacts that tell do not identify a quantity, whatever its standard error."""
TOLD = 0.5
"""A standard error of a larger share of its scale does not identify a quantity."""
EXPLAINED = 1.2
"""Mean squared residual, in units of the noise, up to which held-out windows are explained."""
WORST = 0.05
"""Share of held-out windows that may be missed: where bodies graze, noise decides whether they meet."""
TELLS = 1e-3
"""An impact tells of a quantity on which its velocities depend by more than this share of its jump."""
TIED = 1.0
"""Directions in which the data leave more than so many scales are named, if there are several quantities in them."""


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A quantity: value, standard error, 95 % interval, verdict, and how many impacts tell of it (None: no matter)."""

    name: str
    of: str
    value: float
    standard_error: float
    lower: float
    upper: float
    unit: str
    verdict: Verdict
    impacts: int | None


@dataclasses.dataclass(frozen=True)
class Fit:
    """How well held-out windows are explained: mean squares over their degrees of freedom, in units of the noise.

    `chi2` without the share `WORST` of the windows that fit worst; `missed`: the share that does not fit at all;
    `by_channel`: of each point before and after its window's first impact; `noise` (m), of each point; `alike`: groups
    of quantities that these data do not tell apart.
    """

    explained: bool
    chi2: float
    missed: float
    by_channel: dict[str, dict[str, float | None]]
    impact_rule: ImpactRule
    noise: list[float]
    windows: int
    impacts: int
    alike: list[list[str]]


def noise_share(shooting: Shooting, state: State) -> float:
    """By which mean squares are divided that are left where there is no noise: the data's own, if it is less.

    Errors were found from parabolas; where motion is none, what is left before impacts is what positions err by. It is
    not taken to be less than the floor of rounding.
    """
    rows = shooting.used & shooting.fits
    before = shooting.windows.before & rows[:, None]
    total, free = _sums(shooting, state)
    left = total[before].sum() / max(free[before].sum(), 1e-300)
    return float(np.clip(left, shooting.least, 1.0))


def _sums(shooting: Shooting, state: State) -> tuple[Float[np.ndarray, "W T R"], Float[np.ndarray, "W T R"]]:
    return np.where(shooting.kept[..., None], state.residual**2, 0), shooting.freedom(state)


def how_well(
    shooting: Shooting, state: State, share: float, points: int, rows: Bool[np.ndarray, " W"]
) -> dict[str, Any]:
    """Mean squares of the windows `rows`, see `Fit`."""
    total, free = (part[rows] for part in _sums(shooting, state))
    each = total.sum(axis=(1, 2)) / np.maximum(free.sum(axis=(1, 2)), 1e-300) / share
    order = np.argsort(each)
    best = order[: len(order) - int(np.floor(WORST * len(order)))]
    total, free, before = total[best], free[best], shooting.windows.before[rows][best]
    chi2 = float(total.sum() / free.sum() / share)
    by_channel = {}
    for p, (squares, numbers) in enumerate(
        zip(np.split(total, points, axis=2), np.split(free, points, axis=2), strict=True)
    ):
        by_channel[f"x:{p}"] = {
            name: float(squares[part].sum() / numbers[part].sum() / share) if numbers[part].sum() > 1 else None
            for name, part in (("before", before), ("after", ~before))
        }
    missed = float(np.mean(each > LOST * max(chi2, 1.0)))
    return {"chi2": chi2, "missed": missed, "by_channel": by_channel, "windows": int(rows.sum())}


class Spread(NamedTuple):
    """Covariance of the free numbers, degrees of freedom of their intervals, and what cannot be told apart."""

    covariance: Float[np.ndarray, "P P"]
    freedom: int
    alike: list[list[str]]
    at_bound: Bool[np.ndarray, " P"]


def spread(shooting: Shooting, state: State, clusters: Int[np.ndarray, " W"], share: float) -> Spread:
    """By the windows that were fitted, starts profiled out: the greater of the curvature's and the sandwich's.

    Windows of one cluster are not independent. A quantity at a bound stays there.
    """
    learned = shooting.flow.learned
    scale, lower, upper = (np.asarray(part, float) for part in (learned.scale, learned.lower, learned.upper))
    rows = np.flatnonzero(shooting.used & shooting.fits)
    weight = shooting.weight(state, 1.0, "squares")
    reduced = shooting.reduced(state, weight, np.zeros(len(state.z)))
    H = reduced.curvature[rows].sum(axis=0)
    at_bound = (state.theta <= lower) | (state.theta >= upper)
    total, free = _sums(shooting, state)
    left = (weight[..., None] * total)[rows].sum() / max(free[rows].sum() - len(H), 1.0)
    prior = np.diag(scale**-2.0) * 1e-6
    directions, curvature, _ = spectrum(H, prior)
    inverse = (directions / curvature) @ directions.T
    influence = reduced.gradient[rows] @ inverse
    _, index = np.unique(clusters[rows], return_inverse=True)
    count = int(index.max(initial=0)) + 1
    sums = np.zeros((count, len(H)))
    np.add.at(sums, index, influence)
    sandwich = sums.T @ sums * count / max(count - 1, 1)
    model = inverse * max(left, share)
    # Each direction by the greater: of both the variances, scaled to the greater one.
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.diag(model), 1))
    covariance = model * ratio[:, None] * ratio[None]
    told = covariance / np.outer(scale, scale)
    sizes, ways = np.linalg.eigh(told)
    alike = [
        [learned.names[k] for k in np.flatnonzero(np.abs(way) > 0.2)]
        for size, way in zip(sizes, ways.T, strict=True)
        if size > TIED**2
    ]
    return Spread(covariance, max(count - 1, 1), [names for names in alike if len(names) > 1], at_bound)


def telling(shooting: Shooting, state: State) -> tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"], int]:
    """Impacts on which each quantity has an effect; those at its contacts on which it has none; and all impacts.

    Only those that the motion shows, by a kink in the same step or the next, in windows that fit.
    """
    hits, kink = state.motion.hits, shooting.windows.kink
    learned = shooting.flow.learned
    near = kink.copy()
    near[:, 1:] |= kink[:, :-1]
    near[:, :-1] |= kink[:, 1:]
    shown = near[hits.window, hits.step] & shooting.fits[hits.window] & shooting.used[hits.window]
    tells = (hits.by_theta > TELLS * hits.jump[:, None]) & shown[:, None]
    index = learned.skeleton._property_index()
    without = np.zeros(tells.shape[1], int)
    for j, quantity in enumerate(learned.quantities):
        if quantity.label.kind in ("friction", "restitution"):
            its = hits.closed[:, index == int(quantity.label.which or 0)].any(axis=1)
            without[j] = int(np.sum(shown & its & ~tells[:, j]))
    return tells.sum(axis=0), without, int(shown.sum())


CONTACTS = ("mass", "friction", "restitution", "radius", "plane", "tilt", "inertia", "moments", "epsilon")
"""Kinds of quantities of which impacts tell. (Of others free motion does.)"""


def estimates_of(shooting: Shooting, state: State, found: Spread, *, explained: bool) -> list[Estimate]:
    """Values, intervals and verdicts."""
    learned = shooting.flow.learned
    tells, without, _ = telling(shooting, state)
    width = float(stats.t.ppf(0.975, found.freedom))
    error = np.sqrt(np.diag(found.covariance))
    scale = np.asarray(learned.scale)
    values, lower, upper, beyond = (
        np.asarray(learned.physical(jnp.asarray(state.theta + share * error)), float)
        for share in (0.0, -width, width, 1e-3)
    )
    out = []
    for j, name in enumerate(learned.names):
        free = learned.quantities[j].label.kind not in CONTACTS
        enough, sharp = free or tells[j] >= LEAST_IMPACTS, bool(error[j] <= TOLD * scale[j])
        verdict: Verdict = "identified" if enough and sharp else "not identified"
        size = abs(beyond[j] - values[j]) / 1e-3 if not found.at_bound[j] else (upper[j] - lower[j]) / width
        low, high = float(min(lower[j], upper[j])), float(max(lower[j], upper[j]))
        kind = learned.quantities[j].label.kind
        # Where a few impacts tell, their interval says more than a bound.
        if explained and not sharp and without[j] >= LEAST_IMPACTS:
            bound = _bound(shooting, state, j, -1.0 if kind == "friction" else 1.0)
            if bound is not None and kind == "friction":
                verdict, low, high = "bounded below", bound, np.inf
            elif bound is not None:
                verdict, low, high = "bounded above", low, bound
        if not explained:
            verdict = "misfit"
        impacts = None if free else int(tells[j])
        out.append(
            Estimate(
                name,
                learned.of[j],
                float(values[j]),
                float(size),
                low,
                high,
                learned.units[j],
                verdict,
                impacts,
            )
        )
    return out


def _bound(shooting: Shooting, state: State, j: int, way: float) -> float | None:
    """Up to where a free number can go, `way` up or down, until its windows fit worse by the 95 % quantile; or None."""
    learned = shooting.flow.learned
    end = float(np.asarray(learned.lower if way < 0 else learned.upper)[j])
    if not np.isfinite(end):
        return None
    size = shooting.size(state)
    allowed = float(np.sum(shooting.costs(state, size, "redescending")[shooting.used])) + float(stats.chi2.ppf(0.95, 1))

    def is_worse(value: float) -> bool:
        theta = state.theta.copy()
        theta[j] = value
        there = shoot(shooting, theta, state.z, ("redescending",) * 2, held=True)
        return float(np.sum(shooting.costs(there, size, "redescending")[shooting.used])) > allowed

    if not is_worse(end):
        return None
    good, bad = float(state.theta[j]), end
    for _ in range(8):
        middle = (good + bad) / 2
        good, bad = (good, middle) if is_worse(middle) else (middle, bad)
    theta = state.theta.copy()
    theta[j] = bad
    return float(np.asarray(learned.physical(jnp.asarray(theta)))[j])
