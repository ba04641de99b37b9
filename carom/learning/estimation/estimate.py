"""The estimator: what observed motion tells of a system's quantities, with intervals and a verdict.

Windows are short at first, an impact each, and then as long as there is motion: what a window of many impacts tells
grows with each. Where a long one does not fit, its short ones stay. Some trajectories are held out: with the quantities
held, their windows say how well the system explains such motion.
"""

import contextlib
import dataclasses
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from carom.checks import require
from carom.learning.estimation.flow import Flow
from carom.learning.estimation.robust import spectrum
from carom.learning.estimation.shooting import EXACT, LOST, WIDE, Loss, Shooting, State, shoot
from carom.learning.estimation.survey import Survey, survey
from carom.learning.estimation.verdict import (
    EXPLAINED,
    WORST,
    Estimate,
    Fit,
    estimates_of,
    how_well,
    noise_share,
    spread,
    telling,
)
from carom.learning.estimation.windows import Windows, windows_of
from carom.learning.unknowns.quantities import Learned
from carom.recordings.observations import Observations
from carom.simulation.impact import ImpactRule
from carom.system import System

HELD = 0.15
"""Share of the trajectories, or of the sessions, that is held out."""
SLIDING = 0.1
"""Frictions begin at this value at most: what sticks does not tell how rough it is."""
INSIDE = (0.2, 0.9)
"""Restitutions begin between these."""
CONVEX: tuple[Loss, ...] = ("convex",)
REDESCENDING: tuple[Loss, ...] = ("redescending",)
FREE: tuple[Loss, ...] = (*CONVEX * 3, *REDESCENDING * 2)
SHORT: tuple[Loss, ...] = (*CONVEX * 3, *REDESCENDING * 9)
LONG: tuple[Loss, ...] = REDESCENDING * 4
LAST: tuple[Loss, ...] = ("squares",) * 3
FEW = 150
"""Windows that the first steps are taken with, while quantities are far off: more of them do not make these better."""
FIELD = 0.05
"""A change of a uniform field that matters, as a share of what turns motion around within its own extent."""
AT_SAMPLES = 0.05
"""Kinks that are within so much of a step of a sample are at it."""


class Held(NamedTuple):
    """A window that was held out: its times (s), positions as seen and as explained (m), and the start of these."""

    time: Float[np.ndarray, " T"]
    x: Float[np.ndarray, "T n d"]
    explained: Float[np.ndarray, "T n d"]
    start: Float[np.ndarray, "2 n d"]


class Told(NamedTuple):
    """What observations tell: the system that explains them best, its quantities, and how well they are explained."""

    system: System
    estimates: list[Estimate]
    fit: Fit
    theta: Float[np.ndarray, " P"]
    covariance: Float[np.ndarray, "P P"]
    held: list[Held]
    evaluation: dict[str, float | int]
    step: float
    seconds: float


@dataclasses.dataclass
class Work:
    """Says what is done, and how far that is: `say(text, share)`."""

    say: Callable[[str, float], None]

    def of(self, text: str, begin: float, end: float, steps: int) -> Callable[[float], None]:
        """What is called after each of about so many steps of a part of the work."""
        done = 0

        def each(left: float) -> None:
            nonlocal done
            done += 1
            self.say(f"{text}: off by {left:.3g} times the noise", begin + (end - begin) * min(done / steps, 1.0))

        return each


def estimate(
    system: System,
    observations: Observations,
    learn: Sequence[str],
    *,
    test: Observations | None = None,
    impact: ImpactRule | None = None,
    seed: int = 0,
    say: Callable[[str, float], None] | None = None,
) -> Told:
    """What `observations` tell of the quantities `learn` of a system, whose own values are where it starts.

    **Arguments:** `learn`, names as `Learned.chosen` takes them; `test`, observations to be explained, by default some
    trajectories of `observations`, which are then not learned from; `impact`, the rule of impacts, by default that
    which explains more; `say`, called with what is being done and the share of the work that is.

    **Raises:** `CaromError` for names of nothing, other points than those of the system, too little motion.
    """
    begun = time.monotonic()
    work = Work(say or (lambda text, share: None))
    shape = observations.x.shape[2:]
    require(
        shape == (system.n_points, system.dim),
        f"the observations have {shape[0]} points in {shape[1]}D; the system has {system.n_points} in {system.dim}D.",
    )
    require(system.step_model is None, "system must have no step_model to be estimated: it has no impacts of its own.")
    learned = Learned.chosen(system, learn).with_field_scale(_field_scale(system, observations))
    work.say("looking for impacts, and compiling for a minute or so", 0.0)
    held = _held_out(observations, test, seed)
    every = observations if test is None else Observations.concatenate([observations, test])
    rules: list[ImpactRule] = ["event"] if impact is None else [impact]
    pool = ThreadPoolExecutor(1)
    compiled = pool.submit(_compile, learned, rules[0], every)
    pool.shutdown(wait=False)  # what goes wrong here is said at once
    found = survey(every, bent=bool(learned.skeleton.links))
    if any(len(track.kinks) for track in found.tracks):
        compiled.result()
    first = _by_rule(learned, every, found, held, rules[0], _first_values(learned), work, (0.02, 0.98))
    if impact is None and not first.fit.explained and _at_samples(found):
        work.say("compiling for a minute or so (impacts by the rule 'step')", 0.6)
        start = np.where(np.isfinite(first.theta), first.theta, _first_values(learned))
        second = _by_rule(learned, every, found, held, "step", start, work, (0.6, 0.98))
        first = min(first, second, key=lambda told: told.fit.chi2)
    work.say("done", 1.0)
    return first._replace(seconds=time.monotonic() - begun)


def _field_scale(system: System, observations: Observations) -> float:
    """A change of a uniform field (m/s^2) that matters: a share of what turns motion around within its extent.

    Speeds are those of centres, over a twentieth of the samples, so that noise adds little; of bodies that move, as
    most may rest. 0 where nothing was seen to move.
    """
    x = observations.x[:, :, list(system.table.center)]
    lag = max(1, x.shape[1] // 20)
    speeds = [
        np.linalg.norm(x[:, k:] - x[:, :-k], axis=-1)
        / (observations.time[:, k:] - observations.time[:, :-k])[..., None]
        for k in (lag, lag + 1)
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of bodies that were never seen twice
        speed = np.nanquantile(np.nanquantile(np.concatenate(speeds, axis=1), 0.9, axis=1), 0.9)
        spread = np.nanmean(np.sum((x - np.nanmean(x, axis=(0, 1, 2))) ** 2, axis=-1))
    return float(FIELD * speed**2 / (2 * np.sqrt(spread))) if speed > 0 and spread > 0 else 0.0


def _compile(learned: Learned, rule: ImpactRule, every: Observations) -> None:
    """What moves windows, while impacts are looked for. What goes wrong will do so again, where it is said."""
    whole = np.argwhere(every.seen.all(axis=2))
    if not len(whole):
        return
    step = float(np.nanmedian(np.diff(every.time, axis=1)))
    with contextlib.suppress(Exception):
        Flow(learned, rule).compile(_first_values(learned), every.x[tuple(whole[0])], step)


def _held_out(observations: Observations, test: Observations | None, seed: int) -> Bool[np.ndarray, " N"]:
    """Which trajectories are held out: whole sessions, where there are some."""
    count = observations.n_trajectories
    if test is not None:
        return np.arange(count + test.n_trajectories) >= count
    groups = np.array(observations.group) if observations.group is not None else np.arange(count)
    names = np.unique(groups)
    if len(names) < 2:
        return np.zeros(count, bool)
    chosen = np.random.default_rng((seed, 5)).permutation(names)[: max(1, round(HELD * len(names)))]
    return np.isin(groups, chosen)


def _first_values(learned: Learned) -> Float[np.ndarray, " P"]:
    theta = np.array(learned.free(), float)
    for k, quantity in enumerate(learned.quantities):
        if quantity.label.kind == "friction":
            theta[k] = min(theta[k], SLIDING)
        if quantity.label.kind == "restitution":
            theta[k] = np.clip(theta[k], *INSIDE)
    return theta


def _at_samples(found: Survey) -> bool:
    """Whether kinks are at samples, by far more often than those of impacts at any time would be."""
    place, error = found.place.T
    sharp = error < AT_SAMPLES / 2
    if sharp.sum() < 5:
        return len(place) > 0  # it cannot be told
    near = np.abs(place[sharp] - np.round(place[sharp])) < AT_SAMPLES
    return bool(stats.binomtest(int(near.sum()), int(sharp.sum()), 2 * AT_SAMPLES).pvalue < 1e-6 and near.mean() > 0.5)


def _by_rule(
    learned: Learned,
    every: Observations,
    found: Survey,
    held: Bool[np.ndarray, " N"],
    rule: ImpactRule,
    theta: Float[np.ndarray, " P"],
    work: Work,
    shares: tuple[float, float],
) -> Told:
    begin, end = shares
    noise = np.repeat(found.noise, every.dim)
    flow, least = Flow(learned, rule), float(np.max(found.floor / noise)) ** 2
    short = windows_of(found, 1)

    def shooting_of(windows: Windows) -> Shooting:
        return Shooting(flow, windows, noise, ~held[windows.trajectory], least)

    def part(a: float, b: float, text: str, steps: int):
        a, b = (begin + share * (end - begin) for share in (a, b))
        return work.of(f"{text} (impacts by the rule {rule!r})", a, b, steps)

    few = _few(short, held)
    require(len(few) > 0, "the observations have no window with free motion to learn from.")
    if learned.skeleton.links:
        # Between joints free motion is no parabola, by which starts were found: it is fitted first.
        free = shooting_of(short.before_impacts())
        still = np.array([q.label.kind in ("friction", "restitution") for q in learned.quantities], bool)
        each = part(0.0, 0.1, "free motion", len(FREE))
        begun = shoot(free, theta, free.windows.start, FREE, still=still, each=each)
        theta, short = begun.theta, short._replace(start=begun.z)
    shooting = shooting_of(short.take(few))
    each = part(0.1, 0.4, "windows of an impact each", len(SHORT))
    state = shoot(shooting, theta, shooting.windows.start, SHORT, each=each)
    state = _begun_again(shooting, state, shooting_of)
    starts = short.start.copy()
    starts[few] = state.z
    longer = windows_of(found, None)
    longer = longer._replace(start=_starts(short, short.start, longer))
    wide = shooting_of(longer)
    there = wide.at(state.theta, _starts(short, starts, longer))
    if wide.size(there) > LOST * shooting.size(state):
        # What grows without bounds has to be right at its start before it says anything of the quantities.
        each = part(0.4, 0.6, "starts of longer windows", len(REDESCENDING * 6))
        there = shoot(wide, there.theta, there.z, REDESCENDING * 6, held=True, each=each)
        there = _begun_again(wide, there, shooting_of)
    each = part(0.6, 0.8, "longer windows", len(LONG))
    there = shoot(wide, there.theta, there.z, LONG, each=each)
    there = _begun_again(wide, there, shooting_of)
    windows, z = _those_that_fit(wide, there, short, starts, shooting_of)
    shooting = shooting_of(windows)
    state = shooting.at(there.theta, z)
    shooting.keep_what_fits(state)
    state = shoot(shooting, state.theta, state.z, LAST, each=part(0.8, 1.0, "standard errors", len(LAST)))
    bias = np.zeros_like(state.theta)
    if rule == "event" and noise_share(shooting, state) < EXACT:
        error, bias = _integration_error(shooting, state)
        shooting.least = max(shooting.least, error)
    return _told(shooting, state, found, held, rule, bias)


def _integration_error(shooting: Shooting, state: State) -> tuple[float, Float[np.ndarray, " P"]]:
    """What half of the time steps change: a mean squared residual, typically, and the free numbers.

    Data are not explained better, nor are these numbers known better. (By the rule of steps it is part of the model.)
    """
    windows, learned = shooting.windows, shooting.flow.learned
    finer = shooting.flow(state.theta, state.z, np.repeat(windows.steps / 2, 2, axis=1))
    off = np.where(shooting.kept[..., None] & shooting.seen, (finer.x[:, ::2] - state.motion.x) / shooting.noise, 0.0)
    each = np.sum(off**2, axis=(1, 2)) / np.maximum(np.sum(shooting.seen, axis=(1, 2)), 1)
    rows = shooting.used & shooting.fits & np.isfinite(each)
    if not rows.any():
        return 0.0, np.zeros_like(state.theta)
    typical = float(np.median(each[rows]))
    rows &= each <= LOST * typical  # where a contact is met or missed, another motion is compared
    off = np.where(rows[:, None, None], off, 0.0)
    moved = shooting.reduced(state._replace(residual=off), shooting.kept.astype(float), np.zeros(len(off)))
    directions, curvature, _ = spectrum(
        moved.curvature[rows].sum(axis=0), np.diag((WIDE * np.asarray(learned.scale)) ** -2.0)
    )
    return typical, directions @ (directions.T @ moved.gradient[rows].sum(axis=0) / curvature)


def _begun_again(shooting: Shooting, state: State, shooting_of: Callable[[Windows], Shooting]) -> State:
    """With starts of windows that do not fit found anew, from the samples before their first impacts.

    They may have been led astray while the quantities were not known yet.
    """
    shooting.keep_what_fits(state)
    lost = np.flatnonzero(~shooting.fits)
    if not len(lost):
        return state
    part = shooting_of(shooting.windows.take(lost))
    there = shoot(part, state.theta, part.windows.start, ("redescending",) * 4, held=True)
    better = part.of_windows(there) < shooting.of_windows(state)[lost]
    z = state.z.copy()
    z[lost[better]] = there.z[better]
    return shooting.at(state.theta, z)


def _few(short: Windows, held: Bool[np.ndarray, " N"]) -> Int[np.ndarray, " F"]:
    """Windows to take the first steps with, from all the motion: first of all those with an impact."""
    rows = np.random.default_rng(0).permutation(np.flatnonzero(~held[short.trajectory]))
    hit = short.kink[rows].any(axis=1)
    return np.sort(np.concatenate([rows[hit], rows[~hit]])[:FEW])


def _starts(short: Windows, z: Float[np.ndarray, "W 2 n d"], longer: Windows) -> Float[np.ndarray, "V 2 n d"]:
    """Starts of longer windows: those of the first of their short ones."""
    where = {key: k for k, key in enumerate(zip(short.trajectory.tolist(), short.first.tolist(), strict=True))}
    keys = zip(longer.trajectory.tolist(), longer.first.tolist(), strict=True)
    index = np.array([where.get(key, -1) for key in keys])
    return np.where((index >= 0)[:, None, None, None], z[index], longer.start)


def _those_that_fit(
    wide: Shooting,
    there: State,
    short: Windows,
    starts: Float[np.ndarray, "V 2 n d"],
    shooting_of: Callable[[Windows], Shooting],
) -> tuple[Windows, Float[np.ndarray, "W 2 n d"]]:
    """Long windows that fit; in place of the others, the short ones of their trajectories, fitted from `starts`."""
    wide.keep_what_fits(there)
    fit = np.flatnonzero(wide.fits)
    rest = np.flatnonzero(~np.isin(short.trajectory, wide.windows.trajectory[fit]))
    windows, z = [wide.windows.take(fit)], [there.z[fit]]
    if len(rest):
        part = shooting_of(short.take(rest))
        windows.append(part.windows)
        z.append(shoot(part, there.theta, starts[rest], (*CONVEX, *REDESCENDING * 4), held=True).z)
    return Windows.concatenate(windows), np.concatenate(z)


def _told(
    shooting: Shooting,
    state: State,
    found: Survey,
    held: Bool[np.ndarray, " N"],
    rule: ImpactRule,
    bias: Float[np.ndarray, " P"],
) -> Told:
    learned, points = shooting.flow.learned, len(found.noise)
    share = noise_share(shooting, state)
    of = spread(shooting, state, shooting.windows.trajectory, share)
    of = of._replace(covariance=of.covariance + np.outer(bias, bias))
    rows = held[shooting.windows.trajectory]
    rows = rows if rows.any() else shooting.used
    kept = shooting.kept
    shooting.kept = shooting.numbers > 0
    well = how_well(shooting, state, share, points, rows)
    shooting.kept = kept
    explained = well["chi2"] <= EXPLAINED and well["missed"] <= WORST
    fit = Fit(
        explained=explained,
        impact_rule=rule,
        noise=(found.noise * np.sqrt(share)).tolist(),
        impacts=telling(shooting, state)[2],
        alike=of.alike,
        **well,
    )
    estimates = estimates_of(shooting, state, of, explained=explained)
    system = learned.assemble(jnp.asarray(state.theta))
    shown = [_shown(shooting, state, row) for row in np.flatnonzero(rows).tolist()]
    return Told(system, estimates, fit, state.theta, of.covariance, shown, _evaluation(shown), found.step, 0.0)


def _shown(shooting: Shooting, state: State, row: int) -> Held:
    shape = state.z.shape[2:]
    steps = shooting.windows.steps[row]
    time = np.concatenate([[0.0], np.cumsum(steps[np.isfinite(steps)])])
    there = np.flatnonzero(shooting.numbers[row] > 0)
    x, explained = (part[row, there].reshape(-1, *shape) for part in (shooting.windows.x, state.motion.x))
    return Held(time[there], x, explained, state.z[row])


def _evaluation(held: list[Held]) -> dict[str, float | int]:
    """Errors of positions over their sizes, by the mean over time, then over windows."""
    errors = []
    for window in held:
        off, size = (np.sqrt(np.nansum(part**2, axis=(1, 2))) for part in (window.x - window.explained, window.x))
        errors.append(float(np.mean(off / np.maximum(size, 1e-300))))
    return {
        "trajectories": len(held),
        "trajectory_error": float(np.mean(errors)),
        "trajectory_error_median": float(np.median(errors)),
    }
