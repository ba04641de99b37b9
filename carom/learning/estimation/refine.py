"""The estimator behind `identify` and the end of a training: which recorded steps it looks at, and how it refines.

A step of Gauss and Newton moves masses, contact properties and the linear weights of the potential at once. So it goes
straight to where the gradient steps of a training, which take one after the other, creep along a valley.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.learning.dataset import all_gaps
from carom.learning.estimation.robust import Blocks, Solution, solve
from carom.learning.estimation.sensitivity import StepSensitivity, force_features, step_sensitivity
from carom.learning.unknowns.models import NeuralPotential, Unknowns
from carom.learning.unknowns.parameters import (
    at_bounds,
    bounds,
    linear_weights,
    moved,
    physical_vector,
    ridge,
    with_weights,
)
from carom.mechanics.dynamics import saddle_point
from carom.recordings.recording import Recording
from carom.simulation.impact import Stepper
from carom.system import System

MOST_POINTS = 64
"""Largest system that is refined: derivatives of a step by the state before it grow with the cube of its size."""
BATCH = 250
"""Steps that are looked at together."""
MOST_CHANGE = 1.0
"""By which a physical parameter moves in one step at most."""
SMALLEST_ERROR = 1e-6
"""No standard error is taken to be smaller than this: the contact solver's own accuracy."""


@dataclasses.dataclass(frozen=True)
class IdentifyConfig:
    """What to look at, and what counts as told."""

    impacts: int = 3000
    """Most steps with a contact to use, shared out over the properties."""
    smooth_steps: int = 1000
    """Most steps without contact to use."""
    rounds: int = 6
    """Most linearisations of the motion."""
    doubt: float = 2.0
    """Steps are left out in which a gap is nearer to zero than so many standard deviations of its error."""
    min_impacts: int = 10
    """Fewer recorded impacts that speak about a quantity do not identify it, whatever their standard error."""
    max_standard_error: float = 0.05
    """A quantity with a larger standard error (of mass ratios: relative) is not identified."""
    directions: int = 100
    """Most principal directions of the potential's forces to estimate along with the physical parameters."""
    smallest_force: float = 1e-5
    """Directions are left out whose root mean square force is less than this share of the largest."""
    redescend: bool = True
    """Leave out steps that do not fit (see `robust.py`), and take errors to be of the size seen at the start.
    Otherwise steps that do not fit have less weight only, and errors are those left by the last round."""
    seed: int = 0
    """Which steps are used where there are more."""


# --- which steps --------------------------------------------------------------------------------------------------


def choose_steps(recording: Recording, system: System, config: IdentifyConfig) -> tuple[Int[np.ndarray, "S 2"], int]:
    """Steps `(trajectory, start)` to look at, and the most contacts closed at once in them.

    None starts in contact. They are chosen by `x + v dt`, which does not look at how they end.
    """
    rng = np.random.default_rng(config.seed)
    dt, P = recording.dt, system.n_properties
    index = np.array([p for contact in system.contacts for p in contact.property_index], int)
    touched, smooth, most = [], [], 0
    ends = all_gaps(recording.x + dt * recording.v, system)
    for k, (now, then) in enumerate(zip(all_gaps(recording.x, system), ends, strict=True)):
        open_now, closed = (now >= 0).all(axis=-1), then < 0
        start = np.flatnonzero(open_now & (np.arange(len(now)) < recording.length[k] - 1))
        hit = closed[start].any(axis=-1)
        smooth += [(k, s) for s in start[~hit]]
        touched += [((k, s), np.unique(index[closed[s]])) for s in start[hit]]
        most = max(most, int(closed[start].sum(axis=-1).max(initial=0)))
    by_property = [[n for n, (_, hit) in enumerate(touched) if p in hit] for p in range(P)]
    seen = sum(bool(steps) for steps in by_property)
    chosen: set[int] = set()
    for steps in by_property:
        chosen.update(rng.permutation(steps)[: config.impacts // max(seen, 1)].astype(int).tolist())
    free = rng.permutation(len(smooth))[: config.smooth_steps]
    out = [touched[n][0] for n in sorted(chosen)] + [smooth[n] for n in sorted(free)]
    return np.array(out, int).reshape(-1, 2), most


# --- the estimator ------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Problem:
    """What is held while the parameters are refined."""

    unknowns: Unknowns
    skeleton: System
    stepper: Stepper
    recording: Recording
    steps: Int[np.ndarray, "S 2"]
    features: Float[np.ndarray, "W F"]


@eqx.filter_jit
def _accelerations(potential: NeuralPotential, system: System, x: Float[Array, "S n d"]) -> Float[Array, "S nd W"]:
    """What a unit of each linear weight of a potential adds to the accelerations (m/s^2), joints taken into account."""
    inverse_mass = system.inverse_mass_matrix()

    def at(x):
        force = force_features(potential, x)
        free = jnp.einsum("ij,jdw->wid", inverse_mass, force.reshape(*x.shape, -1))
        if system.links:
            free = saddle_point(system.constraints, x, inverse_mass).project(free)
        return jnp.moveaxis(free, 0, -1).reshape(force.shape)

    return jax.vmap(at)(x)


def principal_directions(unknowns: Unknowns, system: System, recording: Recording, steps, config: IdentifyConfig):
    """The principal directions (W, F) of a potential's linear weights, by what they do.

    F = 0 without a potential, and without a step to look at.

    At most `config.directions`, with a root mean square acceleration of at least `smallest_force` of the largest one's:
    forces that joints take up do nothing.
    """
    if unknowns.potential is None or not len(steps):
        return np.zeros((len(linear_weights(unknowns)), 0))
    x = jnp.asarray(recording.x[steps[:, 0], steps[:, 1]][:: max(1, len(steps) // 500)])
    done = np.array(_accelerations(unknowns.potential, unknowns.assemble(system), x))
    done = done.reshape(-1, done.shape[-1])
    _, sizes, directions = np.linalg.svd(done, full_matrices=False)
    return directions[sizes > config.smallest_force * sizes[0]][: config.directions].T


@eqx.filter_jit
def _sensitivities(unknowns, skeleton, stepper, x0, v0, x1, v1):
    return jax.vmap(lambda a, b, c, d: step_sensitivity(unknowns, skeleton, stepper, (a, b), (c, d)))(x0, v0, x1, v1)


def sensitivities(problem: Problem, unknowns: Unknowns) -> StepSensitivity:
    """Of all steps, in batches of a size that hardly depends on their number: each size is a program to compile.

    Those by the linear weights are along the directions `problem.features`.
    """
    trajectory, start = problem.steps.T
    count = len(start)
    size = min(BATCH, 1 << (count - 1).bit_length())
    x, v = problem.recording.x, problem.recording.v
    parts = []
    for first in range(0, count, size):
        rows = np.arange(first, first + size).clip(max=count - 1)
        k, s = trajectory[rows], start[rows]
        states = (jnp.asarray(part) for part in (x[k, s], v[k, s], x[k, s + 1], v[k, s + 1]))
        out = _sensitivities(unknowns, problem.skeleton, problem.stepper, *states)
        parts.append(out._replace(weights=np.asarray(out.weights) @ problem.features))
    return jax.tree.map(lambda *a: np.concatenate(a)[:count], *parts)


def new_problem(
    unknowns: Unknowns, system: System, stepper: Stepper, recording: Recording, config: IdentifyConfig
) -> Problem:
    """Chooses the steps of `recording` to look at, none of which starts in contact, and the forces that may change."""
    steps, most = choose_steps(recording, system, config)
    # Room for as many contacts as the steps close at once, and two more for what the ballistic guess misses.
    skeleton = system.with_max_active(most + 2) if system.contacts else system
    features = principal_directions(unknowns, skeleton, recording, steps, config)
    return Problem(unknowns, skeleton, stepper, recording, steps, features)


class Refined(NamedTuple):
    """The parameters of the robust estimator, its last solution, and its steps with their last linearisation."""

    unknowns: Unknowns
    solution: Solution
    seen: StepSensitivity
    steps: Int[np.ndarray, "S 2"]


def refinements(problem: Problem, config: IdentifyConfig) -> Iterator[Refined]:
    """One Gauss-Newton step after another, from `problem.unknowns` towards what fits the steps best; without end."""
    unknowns, count = problem.unknowns, len(physical_vector(problem.unknowns))

    directions = problem.features.shape[1]

    def whole(physical, rest: float):
        return np.concatenate([physical, np.full(directions, rest)])

    # A prior of standard deviation 1 on all physical parameters, which says nothing where data speak; and towards no
    # network, where a uniform field and the energy of segments explain the data as well.
    weights, stiff = linear_weights(unknowns), ridge(unknowns)
    prior = np.eye(count + directions)
    prior[count:, count:] = problem.features.T @ (stiff[:, None] * problem.features)
    most = whole(np.full(count, MOST_CHANGE), np.inf)
    lower, upper = (whole(end, rest) for end, rest in zip(bounds(unknowns), (-np.inf, np.inf), strict=True))
    changed = np.zeros(len(prior))
    seen = sensitivities(problem, unknowns)
    errors = _errors(seen, problem.recording)
    kept = beyond_doubt(seen, errors, config.doubt)
    for k in itertools.count():
        kept = kept & _finite(seen)
        seen = _those(seen, kept)
        now = whole(physical_vector(unknowns), 0.0)
        pull = prior @ changed
        if not config.redescend:
            pull[:count] = 0  # what is blind here need not have been where the first step began
        pull[count:] += problem.features.T @ (stiff * weights)
        solution = solve(
            whitened(seen, problem, errors, kept),
            prior,
            pull,
            np.maximum(lower - now, -most),
            np.minimum(upper - now, most),
            redescend=config.redescend and k > 0,
        )
        changed = changed + solution.change
        unknowns = moved(problem.unknowns, problem.features, changed)
        yield Refined(unknowns, solution, seen, problem.steps[kept])
        seen = sensitivities(problem, unknowns)
        if not config.redescend:
            errors = _errors(seen, problem.recording)
            kept = beyond_doubt(seen, errors, config.doubt)


def refine(problem: Problem, config: IdentifyConfig) -> Refined:
    """The parameters that fit the steps best: Gauss-Newton steps until these move by little of their errors."""
    count = len(physical_vector(problem.unknowns))
    for k, refined in enumerate(refinements(problem, config), 1):
        if k == config.rounds or (k > 1 and _settled(refined.solution, count)):
            return refined
    raise AssertionError("there is always another step")


POLISH = IdentifyConfig(
    impacts=1000, smooth_steps=1000, rounds=14, directions=400, smallest_force=1e-7, redescend=False
)
"""How a training refines, before the first epoch, on the way and at its end.

Steps that do not fit keep some weight: a model that is not there yet is not a wrong one.
"""
PATIENCE = 3
"""So many steps may pass until the loss is half of what it was; else the last step is made."""
STILL = 1e-4
"""A step that moves physical parameters by less is the last one: rare contacts hardly show in the typical error."""


def can_be_refined(unknowns: Unknowns, skeleton: System) -> bool:
    """Whether `polish` has anything to do.

    It has not for networks in place of contacts or steps, for systems of more than `MOST_POINTS` points, in single
    precision, which rounding leaves too little of one step's error, and where nothing physical or neural is unknown.
    """
    networks = unknowns.contact_model is not None or unknowns.step_model is not None
    nothing = unknowns.potential is None and not len(physical_vector(unknowns))
    double = skeleton.friction.dtype == jnp.float64
    return double and skeleton.n_points <= MOST_POINTS and not (networks or nothing)


class Fit(NamedTuple):
    """How well unknowns predict chunks: the mean error, and that of the better nine tenths of the chunks.

    A few chunks in which rounding decides what is in contact say nothing about the unknowns.
    """

    mean: float
    typical: float


def polish(
    unknowns: Unknowns,
    skeleton: System,
    stepper: Stepper,
    recording: Recording,
    judge: Callable[[Unknowns], Fit],
    enough: float,
) -> tuple[Unknowns, Fit]:
    """Learned unknowns that `can_be_refined`, refined until their typical error is `enough`, or falls no more.

    Also how well they fit: infinitely badly where no recorded step starts without contact.
    """
    best, fit = unknowns, Fit(np.inf, np.inf)
    problem = new_problem(unknowns, unknowns.assemble(skeleton), stepper, recording, POLISH)
    if not len(problem.steps):
        return best, fit
    errors: list[float] = []
    count = len(physical_vector(unknowns))
    for refined in itertools.islice(refinements(_within(problem), POLISH), POLISH.rounds):
        now = judge(refined.unknowns)
        if now.mean < fit.mean:
            best, fit = refined.unknowns, now
        errors.append(now.typical)
        slow = len(errors) > PATIENCE and not min(errors[-PATIENCE:]) < 0.5 * min(errors[:-PATIENCE])
        moved = np.abs(refined.solution.change[:count]).max(initial=0.0)
        if slow or (now.typical <= enough and moved < STILL):
            break
    there = at_bounds(best)
    now = judge(there)
    return (there, now) if now.mean < fit.mean else (best, fit)


def _those(seen: StepSensitivity, kept: Bool[np.ndarray, " S"]) -> StepSensitivity:
    return jax.tree.map(lambda a: a[kept], seen)


def _settled(solution: Solution, count: int) -> bool:
    errors = np.maximum(solution.standard_error[:count], SMALLEST_ERROR)
    return bool(np.all(np.abs(solution.change[:count]) < 0.02 * errors))


def _within(problem: Problem) -> Problem:
    """The problem without the part of the weights that makes no force on the data to speak of: it would elsewhere."""
    unknowns, features = problem.unknowns, problem.features
    if unknowns.potential is None or features.shape[1] == POLISH.directions:
        return problem
    weights = linear_weights(unknowns)
    kept = features @ (features.T @ weights)
    return dataclasses.replace(problem, unknowns=with_weights(unknowns, kept - weights))


def error_sizes(residual: Float[np.ndarray, "S 2 n d"], recording: Recording) -> Float[np.ndarray, " R"]:
    """Standard deviation of the error of each recorded number: one for the positions of a point, one for velocities.

    Robust (median), from residuals of single steps without a closed contact: they have the errors of two states.
    """
    size = 1.4826 * np.median(np.abs(residual), axis=(0, 3)) / np.sqrt(2)
    speed = np.sqrt(np.mean(recording.v[:, 0] ** 2))
    floor = 1e-9 * max(speed, 1e-9) * np.array([recording.dt, 1.0])[:, None]
    return np.repeat(np.maximum(size, floor).reshape(-1), residual.shape[3])


def _errors(seen: StepSensitivity, recording: Recording) -> Float[np.ndarray, " R"]:
    """`error_sizes` of the steps looked at."""
    smooth = (seen.gap >= 0).all(axis=1) if seen.gap.shape[1] else np.ones(len(seen.gap), bool)
    residual = seen.residual[smooth if smooth.sum() >= 10 else slice(None)]
    return error_sizes(np.asarray(residual).reshape(-1, 2, *recording.x.shape[2:]), recording)


def beyond_doubt(seen: StepSensitivity, errors: Float[np.ndarray, " R"], doubt: float) -> Bool[np.ndarray, " S"]:
    """Steps in which no gap is so near to zero, before or after, that errors of the data decide what is closed."""
    margin = doubt * np.linalg.norm(seen.gap_slope * errors[: seen.gap_slope.shape[2]], axis=-1)
    return np.asarray(((seen.gap_before > margin) & (np.abs(seen.gap) > margin)).all(axis=1))


def _finite(seen: StepSensitivity) -> Bool[np.ndarray, " S"]:
    """Steps whose end and its derivatives are finite: a solver may fail where the parameters make no sense yet."""
    flat = np.concatenate([seen.residual, seen.state.reshape(*seen.state.shape[:1], -1)], axis=1)
    return np.all(np.isfinite(flat), axis=1)


def whitened(seen: StepSensitivity, problem: Problem, errors, kept) -> Blocks:
    """Residuals and Jacobians in units of their standard deviation, by step."""
    unknowns, P = problem.unknowns, problem.skeleton.n_properties
    steps, rows = seen.residual.shape
    columns = [np.asarray(seen.log_mass_ratio)]
    for name in ("friction", "restitution"):
        if getattr(unknowns, name) is not None:
            dense = np.zeros((steps, rows, P + 1))
            for k in range(seen.column.shape[1]):
                dense[np.arange(steps), :, seen.column[:, k]] += getattr(seen, name)[:, :, k]
            columns.append(dense[:, :, :P])
    jacobian = np.concatenate([*columns, seen.log_epsilon, seen.weights], axis=2)
    spread = seen.state * errors
    covariance = spread @ spread.transpose(0, 2, 1) + np.diag(errors**2)
    # In units of the errors, so that positions and velocities are alike in size. What rounding leaves of a step that
    # multiplies the errors of its state by 1e7 and more is not positive definite without the last term.
    covariance = covariance / (errors[:, None] * errors)
    largest = np.max(np.diagonal(covariance, axis1=1, axis2=2), axis=1)
    factor = np.linalg.cholesky(covariance + 1e-14 * len(errors) * largest[:, None, None] * np.eye(len(errors)))
    both = np.concatenate([seen.residual[..., None], jacobian], axis=2) / errors[:, None]
    both = np.linalg.solve(factor, both)
    kind = np.any(seen.gap < 0, axis=1).astype(int)
    return Blocks(both[..., 0], both[..., 1:], problem.steps[kept, 0], kind)
