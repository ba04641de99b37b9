"""What the data can tell: a standard error and a verdict for every contact property and mass ratio.

The estimator. The trainer's values are not an optimum with a theory (it minimises nearly absolute errors in small
batches, and stops early), so standard errors belong to an estimator of their own, which starts from them. Each recorded
step that does not start in contact gives a residual `r = F(y_k) - y_(k+1)`, predicted minus recorded state. Recorded
states are taken as true ones with independent errors of covariance `Sigma`, one size for each point's positions and one
for its velocities, found from the steps without contact (for exact data they are those of the network). To first order,
`r` then has the covariance `C = Sigma + F' Sigma F'^T`, by which it is whitened: the "effective variance" form of least
squares with errors in both variables (Fuller, *Measurement Error Models*, 1987, section 3.2). It matters: an error of
1 mm in a position turns the normal of an impact, and moves the velocity after it, by far more than velocities err.
Steps in which a gap, before or after, is closed or open by less than `doubt` standard deviations are left out, because
there errors decide which contacts act. What is left is minimised by the robust
estimator of `robust.py`, from the learned values on, clustered by trajectory.

Where states are noisier than a tenth of what a step moves, few steps are beyond doubt. Then windows of many states are
looked at, whose start states are estimated too (`state_shooting.py`), and standard errors are those of that estimator.

A neural potential is profiled out: the weights in which it is linear are estimated along with the physical parameters
(along the principal directions of the forces they can make), so that standard errors hold what masses and forces can
trade; its other layers are held. The values reported (`refined`) are this estimator's.

Friction is told by impacts that slide: a contact that sticks only says that its friction is at least the ratio of
tangential to normal impulse that held it. Restitution is told by impacts whose rebound it decides: where the contact
model's target velocity, which undoes the penetration, is the greater, it is only said to be at most the ratio of
rebound to compression. However tight, that is a bound (e = 0 is said by "<= 0.02"), and never "identified".

An impact counts where the data show it: a contact of the property overlaps at the recorded end of the step, not only at
the predicted one. Recordings whose impacts happen between the samples are refused (`meetings.py`).
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from carom.checks import require
from carom.learning.dataset import closing, properties_closed
from carom.learning.estimation.refine import (
    MOST_POINTS,
    SMALLEST_ERROR,
    IdentifyConfig,
    new_problem,
    refine,
    sensitivities,
)
from carom.learning.estimation.sensitivity import StepSensitivity
from carom.learning.estimation.state_shooting import shoot, shooting_of
from carom.learning.meetings import check_meetings
from carom.learning.unknowns.models import Unknowns
from carom.learning.unknowns.parameters import unknowns_of
from carom.mechanics.dynamics import Formulation
from carom.recordings.recording import Recording, check_system
from carom.simulation.impact import COMPENSATION_STEPS, Stepper
from carom.system import System

Verdict = Literal["identified", "bounded below", "bounded above", "not identified"]


@dataclasses.dataclass(frozen=True)
class Estimate:
    """One quantity: `impacts` looked at that tell of it (None for masses); `lower`, `upper`: its 95 % interval.

    The interval is cut off at mu = 0, e = 0 and e = 1. `bound` is the one that contacts set which stick, or rebound by
    more than their restitution (see the top of this file), where there is no better information.
    """

    value: float
    standard_error: float
    lower: float
    upper: float
    verdict: Verdict
    impacts: int | None = None
    bound: float | None = None


@dataclasses.dataclass(frozen=True)
class Identification:
    """What the data tell, by contact property and by body after the first; empty where it was not learned.

    `impacts`: in how many recorded steps a contact of each property closes. Of those, `used` were looked at (they start
    clear of contact, and their contacts are beyond doubt) and had an impulse; `sliding` and `sticking`, as predicted.
    """

    impacts: list[int]
    used: list[int]
    sliding: list[int]
    sticking: list[int]
    friction: list[Estimate]
    restitution: list[Estimate]
    mass_ratio: list[Estimate]
    steps: int


def identify(
    system: System,
    recording: Recording,
    config: IdentifyConfig | None = None,
    *,
    learned: Sequence[str] = ("mass", "friction", "restitution", "potential"),
    formulation: Formulation = "lagrangian",
    compensation_steps: float | None = COMPENSATION_STEPS,
    project: bool = False,
) -> Identification:
    """What `recording` tells about the physical parameters of `system`; see the top of this file for the method.

    **Arguments:** `system`, a learned one: its values are where the estimator starts; `recording`, the data it was
    learned from, or others; `learned`, what was unknown; the rest as in `LearnConfig`.

    **Raises:** `CaromError` if no step starts without contact, the system has more than `MOST_POINTS` points, or
    friction and restitution are asked for of a recording whose impacts happen between the samples.
    """
    config = IdentifyConfig() if config is None else config
    require(
        system.n_points <= MOST_POINTS,
        f"identify is for systems of up to {MOST_POINTS} points; this one has {system.n_points}.",
    )
    check_system(recording, system)
    if {"friction", "restitution"} & set(learned):
        check_meetings(recording, system)
    stepper = Stepper(
        dt=jnp.asarray(recording.dt),
        formulation=formulation,
        project=project,
        compensation_steps=compensation_steps,
        consistent=True,
    )
    unknowns = unknowns_of(system, learned)
    impacts = closing(recording, system)
    shooting = shooting_of(unknowns, system, stepper, recording, seed=config.seed)
    if shooting is not None:
        fitted, errors = shoot(shooting, unknowns)
        problem = new_problem(fitted, system, stepper, shooting.states(), config)
        require(len(problem.steps) > 0, "no window of the recording has a step that starts without contact.")
        seen, steps = sensitivities(problem, fitted), problem.steps
        weight, states = np.ones(len(steps)), shooting.windows.x
    else:
        problem = new_problem(unknowns, system, stepper, recording, config)
        require(len(problem.steps) > 0, "the recording has no step that starts without contact.")
        fitted, solution, seen, steps = refine(problem, config)
        errors, weight, states = solution.standard_error, solution.weight, recording.x
    closed = properties_closed(states[steps[:, 0], steps[:, 1] + 1], system)
    contact = count_contacts(system.n_properties, seen, weight, closed)
    return Identification(
        impacts=impacts.tolist(),
        **{name: contact[name].tolist() for name in ("used", "sliding", "sticking")},
        friction=_friction(fitted, errors, contact, config),
        restitution=_restitution(fitted, errors, contact, config),
        mass_ratio=_mass_ratios(fitted, errors, config),
        steps=len(weight),
    )


def count_contacts(
    P: int, seen: StepSensitivity, weight: Float[np.ndarray, " S"], overlap: Bool[np.ndarray, "S P"]
) -> dict[str, Any]:
    """By property (P of them), in how many steps its contacts act, and which of its quantities they tell; the bounds.

    A step tells of a quantity if the motion after it depends on it. Those do not count that do not fit (weight below a
    quarter), or whose recorded end shows no `overlap` of a contact of the property.
    """
    shown = np.pad(overlap, ((0, 0), (0, 1)))[np.arange(len(overlap))[:, None], seen.property]
    closed = shown & (weight > 0.25)[:, None]
    total = seen.normal.sum(axis=1)
    acting = closed & (total > 1e-6 * total.max(initial=0.0)) if seen.normal.shape[1] else closed
    slides, feels = (acting & _depends(np.asarray(part), seen, P) for part in (seen.friction, seen.restitution))

    def steps_with(flags):
        out = np.zeros((len(flags), P + 1), bool)
        np.logical_or.at(out, (np.arange(len(flags))[:, None], seen.property), flags)
        return out[:, :P].sum(axis=0)

    # The least friction that the contacts which stick need, and the greatest restitution that those allow which leave
    # faster than restitution asks. They take impulses, for the latter one of compression and one of rebound.
    held, allowed = np.zeros(P + 1), np.ones(P + 1)
    strong = seen.normal > 1e-3 * total[:, None]
    ratio = np.where(strong, seen.tangential / np.where(strong, seen.normal, 1), 0).max(axis=1, initial=0.0)
    np.maximum.at(held, seen.property, np.where(acting & ~slides, ratio, 0))
    if seen.normal.shape[1] == 2:
        compression, rebound = seen.normal[:, 0], seen.normal[:, 1]
        share = np.where(acting & ~feels, rebound / np.where(acting, compression, 1), 1)
        np.minimum.at(allowed, seen.property, share)
    return {
        "used": steps_with(acting),
        "sliding": steps_with(slides),
        "sticking": steps_with(acting & ~slides),
        "felt": steps_with(feels),
        "unfelt": steps_with(acting & ~feels),
        "held": held[:P],
        "allowed": allowed[:P],
    }


def _depends(derivative: Float[np.ndarray, "S R K"], seen: StepSensitivity, P: int) -> Bool[np.ndarray, "S K"]:
    """Whether the velocities after a step depend on a quantity of each contact's property, beside how far they jump."""
    velocities = derivative[:, derivative.shape[1] // 2 :]
    flags = np.linalg.norm(velocities, axis=1) > 1e-3 * seen.jump[:, None]
    rows = np.arange(len(flags))[:, None]
    by_property = np.zeros((len(flags), P + 1), bool)
    np.logical_or.at(by_property, (rows, seen.column), flags)
    by_property[:, P] = False
    return by_property[rows, seen.property]


def _estimates(fitted: Unknowns, errors: Float[np.ndarray, " p"], name: str):
    """Value and standard error of each parameter of one kind."""
    value, first = getattr(fitted, name), 0
    for other in ("log_mass_ratio", "friction", "restitution"):
        if other == name:
            break
        first += 0 if (part := getattr(fitted, other)) is None else len(part)
    if value is None:
        return
    for k, number in enumerate(np.asarray(value, float)):
        yield k, number, max(float(errors[first + k]), SMALLEST_ERROR)


def _friction(fitted, errors, contact, config: IdentifyConfig) -> list[Estimate]:
    out = []
    for k, value, error in _estimates(fitted, errors, "friction"):
        sliding, sticking, held = (contact[n][k] for n in ("sliding", "sticking", "held"))
        told = sliding >= config.min_impacts and error <= config.max_standard_error
        bounded = not told and sticking >= config.min_impacts and held > 0
        error = error if sliding else np.inf
        lower, upper = max(value - 1.96 * error, 0.0), value + 1.96 * error
        if bounded:
            lower, upper = float(held), np.inf
        verdict = "identified" if told else "bounded below" if bounded else "not identified"
        out.append(Estimate(value, error, lower, upper, verdict, int(sliding), float(held) if bounded else None))
    return out


def _restitution(fitted, errors, contact, config: IdentifyConfig) -> list[Estimate]:
    out = []
    for k, value, error in _estimates(fitted, errors, "restitution"):
        felt, unfelt, allowed = (contact[n][k] for n in ("felt", "unfelt", "allowed"))
        told = felt >= config.min_impacts and error <= config.max_standard_error
        bounded = not told and unfelt >= config.min_impacts and allowed < 1
        error = error if felt else np.inf
        lower, upper = max(value - 1.96 * error, 0.0), min(value + 1.96 * error, 1.0)
        verdict = "identified" if told else "bounded above" if bounded else "not identified"
        if bounded:
            lower, upper, error = 0.0, float(allowed), float(allowed) / 1.96
        out.append(Estimate(value, error, lower, upper, verdict, int(felt), float(allowed) if bounded else None))
    return out


def _mass_ratios(fitted, errors, config: IdentifyConfig) -> list[Estimate]:
    out = []
    for _, value, error in _estimates(fitted, errors, "log_mass_ratio"):
        ratio, half = np.exp(value), 1.96 * error
        told = error <= config.max_standard_error
        out.append(
            Estimate(
                float(ratio),
                float(ratio * error),
                float(ratio * np.exp(-half)),
                float(ratio * np.exp(half)),
                "identified" if told else "not identified",
            )
        )
    return out
