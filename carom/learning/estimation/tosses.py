"""Learning a body that is tossed onto a plane from recorded poses: geometry, inertia, gravity, friction, restitution.

Real recordings are noisy, and a rigid body that tumbles is chaotic: errors of one step say little, those of a whole
toss say little more. So the fit goes by segments: each starts at a recorded state in flight shortly before an impact,
is predicted over a horizon, and compared with the recorded poses. Gauss-Newton steps with the robust estimator of
`robust.py`, clustered by toss or session, over horizons that grow, give the parameters and their standard errors. At
the end whole tosses are fitted, from their first states, in the measure in which predictions are judged, by the simplex
search of Nelder and Mead, which needs no derivatives: those through a whole toss are as large as they are useless.

Every evaluation of that search is a line of the run's metrics, from which a run that was stopped goes on.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Int

from carom.checks import require
from carom.contact.boxes import CornerPlane
from carom.learning.dataset import closed_contacts
from carom.learning.estimation.protocols import body_points, box_of, box_points, pose_errors
from carom.learning.estimation.robust import Blocks, Solution, solve
from carom.learning.estimation.toss_config import TossConfig, search_steps, tossed_names
from carom.learning.progress import LoopProgress
from carom.learning.run import RunFolder
from carom.learning.unknowns.quantities import Learned
from carom.mechanics.bodies import RigidBody
from carom.mechanics.potentials import Gravity
from carom.recordings.recording import Recording
from carom.simulation.impact import ImpactRule, Stepper
from carom.simulation.rollout import Trajectory, rollout
from carom.system import System


@dataclasses.dataclass(frozen=True)
class TossEstimate:
    """A learned number, what it is of, its unit, and its standard error by the segments (None: there were none).

    `told`: the segments tell it to half of a change that matters, and it is within its bounds.
    """

    value: float
    standard_error: float | None
    of: str
    unit: str
    told: bool


@dataclasses.dataclass(frozen=True)
class TossReport:
    """What a fit came to: the estimates, and the mean errors of whole training tosses (share of the width, rad)."""

    estimates: dict[str, TossEstimate]
    position: float
    rotation: float
    tosses: int
    segments: int
    evaluations: int
    seconds: float


def can_learn_tosses(system: System) -> bool:
    """Whether this is one rigid body in 3D whose corners meet a plane under gravity."""
    return (
        len(system.bodies) == 1
        and isinstance(system.bodies[0], RigidBody)
        and any(isinstance(contact, CornerPlane) for contact in system.contacts)
        and isinstance(system.potential, Gravity)
    )


# --- predictions --------------------------------------------------------------------------------------------------


COMPENSATION = 2.0
"""Samples in which a penetration is undone. A body at rest sinks by 3 mm with 8, by less than 1 mm with 2."""


IMPACT: ImpactRule = "event"
"""Contacts act when they close, which needs no small steps."""
EVENTS = 4
"""Times at which a step is cut at most: corners of a box that comes to rest chatter, in some steps more than 20 times,
and all tosses of a batch wait for the one that does."""


def toss_stepper(dt: float, substeps: int = 1) -> Stepper:
    """How tosses are simulated."""
    step = jnp.asarray(dt / substeps)
    return Stepper(dt=step, impact=IMPACT, events=EVENTS, compensation_steps=COMPENSATION * substeps)


def _motion(system: System, x, v, stepper: Stepper, samples: int, substeps: int) -> Trajectory:
    """Motion of the body from recorded points and velocities, at every step."""
    return rollout(system, body_points(system, x), body_points(system, v), stepper, samples * substeps)


def _predict(system: System, x0, v0, stepper: Stepper, samples: int, substeps: int):
    """Recorded points at the samples, from recorded points and velocities."""

    def one(x, v):
        return box_points(system, _motion(system, x, v, stepper, samples, substeps).x[::substeps])

    return jax.vmap(one)(x0, v0)


@eqx.filter_jit
def _tosses(learned: Learned, theta, x0, v0, stepper, samples, substeps):
    return _predict(learned.assemble(theta), x0, v0, stepper, samples, substeps)


BATCH = 100
"""Segments that are simulated at once; batches are filled up, so that there is one program whatever their number."""


def _segments(learned: Learned, theta, x0, v0, end, stepper, samples, substeps):
    """Residuals (S, samples, points, 3) of segments and their derivatives (..., P) by the free numbers."""
    count = len(x0)
    rows = np.minimum(np.arange(-(-count // BATCH) * BATCH), count - 1).reshape(-1, BATCH)
    parts = [
        _segment_batch(learned, theta, x0[r], v0[r], end[r], stepper, samples, substeps) for r in jnp.asarray(rows)
    ]
    return (np.concatenate([np.asarray(part) for part in each])[:count] for each in zip(*parts, strict=True))


@eqx.filter_jit
def _segment_batch(learned: Learned, theta, x0, v0, end, stepper, samples, substeps):

    def residual(theta):
        x = _predict(learned.assemble(theta), x0, v0, stepper, samples, substeps)
        return x[:, 1:] - end

    basis = jnp.eye(len(theta))
    out, columns = jax.vmap(lambda t: jax.jvp(residual, (theta,), (t,)), out_axes=(None, -1))(basis)
    return out, columns


@eqx.filter_jit
def _motions(system: System, x0, v0, stepper: Stepper, samples: int, substeps: int) -> Trajectory:
    def one(x, v):
        motion = _motion(system, x, v, stepper, samples, substeps)
        contact = motion.contact[1:].reshape(samples, substeps).any(axis=1)
        at_samples = jax.tree.map(lambda part: part[::substeps], motion)
        return dataclasses.replace(at_samples, contact=jnp.concatenate([motion.contact[:1], contact]))

    out = jax.vmap(one)(x0, v0)
    return dataclasses.replace(out, time=out.time[0])


def toss_motions(system: System, recording: Recording, *, samples: int | None = None, substeps: int = 1) -> Trajectory:
    """Motion (N, T, 4, 3) of the body in all tosses from their first recorded states, `samples` steps (all by default).

    Its points are the body's own, from the centre of mass on; those of recordings are from the middle of its box.
    """
    most = recording.x.shape[1] - 1
    count = most if samples is None else min(samples, most)
    stepper = toss_stepper(recording.dt, substeps)
    x0, v0 = jnp.asarray(recording.x[:, 0]), jnp.asarray(recording.v[:, 0])
    return _motions(system.with_max_active(4), x0, v0, stepper, count, substeps)


def predict_tosses(system: System, recording: Recording, *, samples: int | None = None, substeps: int = 1):
    """The same, as points that are recorded."""
    return np.asarray(box_points(system, toss_motions(system, recording, samples=samples, substeps=substeps).x))


# --- segments -----------------------------------------------------------------------------------------------------


def choose_segments(
    recording: Recording, system: System, horizon: int, count: int, seed: int
) -> Int[np.ndarray, "S 2"]:
    """Starts `(toss, sample)` in flight: no impact near to its velocities, and one within half a horizon."""
    rng = np.random.default_rng((seed, horizon))
    near = closed_contacts(np.asarray(body_points(system, jnp.asarray(recording.x))) - [0, 0, 1e-3], system) > 0
    starts = []
    for k, length in enumerate(recording.length):
        for s in range(length - horizon):
            before, after = near[k, max(0, s - 3) : s + 2], near[k, s + 2 : s + 2 + horizon // 2]
            if not before.any() and after.any():
                starts.append((k, s))
    chosen = np.array(starts, int).reshape(-1, 2)
    return chosen[np.sort(rng.permutation(len(chosen))[:count])]


BOUNCY = ("restitution", "restitution_loss")
"""Quantities that begin once at 0.5 too: segments may end in two places, one without a rebound."""
TOLD = 0.5
"""A standard error of a larger share of a change that matters does not tell a quantity."""
DAMPING = 1e-2
"""Curvature added for each quantity, in units of its scale and of errors of 1 mm: what no segment tells stays."""


def _stage(learned: Learned, theta, recording: Recording, horizon: int, config: TossConfig, seed: int):
    """Gauss-Newton steps over one horizon: free numbers, their standard errors, and how many segments there were."""
    system, count = learned.skeleton, len(learned.names)
    steps = choose_segments(recording, system, horizon, config.segments, seed)
    require(
        len(steps) >= count,
        f"the recording has {len(steps)} segments of {horizon} samples around impacts, too few for {count} "
        "quantities. Give more tosses, learn less, or use shorter horizons.",
    )
    k, s = steps.T
    x0, v0 = jnp.asarray(recording.x[k, s]), jnp.asarray(recording.v[k, s])
    end = jnp.asarray(recording.x[k[:, None], s[:, None] + 1 + np.arange(horizon)])
    size = float(jnp.min(box_of(system).half_widths))
    # The axes' ends move by as much as the body's surface does.
    reach = np.concatenate([[1.0], np.full(3, size)])[:, None]
    scale, lower, upper = search_steps(learned), np.asarray(learned.lower), np.asarray(learned.upper)
    cluster = k if recording.group is None else np.asarray(recording.group)[k]
    stepper = toss_stepper(recording.dt, config.substeps)
    solution = None
    for _ in range(config.toss_rounds):
        residual, columns = _segments(learned, jnp.asarray(theta), x0, v0, end, stepper, horizon, config.substeps)
        residual = np.concatenate([residual[..., :1, :], residual[..., 1:, :] - residual[..., :1, :]], axis=-2) * reach
        first = columns[..., :1, :, :]
        columns = np.concatenate([first, columns[..., 1:, :, :] - first], axis=-3) * reach[..., None] * scale
        flat = residual.reshape(len(k), -1), columns.reshape(len(k), -1, count)
        fine = np.isfinite(flat[0]).all(axis=1) & np.isfinite(flat[1]).all(axis=(1, 2))
        blocks = Blocks(flat[0][fine] / 1e-3, flat[1][fine] / 1e-3, cluster[fine], np.zeros(int(fine.sum()), int))
        solution = solve(
            blocks,
            DAMPING * np.eye(count),
            np.zeros(count),
            np.maximum((lower - theta) / scale, -2.0),
            np.minimum((upper - theta) / scale, 2.0),
            redescend=True,
        )
        theta = theta + scale * solution.change
    assert isinstance(solution, Solution)
    return theta, scale * solution.standard_error, len(steps)


# --- whole tosses -------------------------------------------------------------------------------------------------


def learn_tosses(
    skeleton: System,
    recording: Recording,
    learn: Sequence[str] | None = None,
    config: TossConfig | None = None,
    *,
    seed: int = 0,
    run: RunFolder | None = None,
    progress: bool = True,
) -> tuple[System, TossReport]:
    """Learn numbers of a tossed body from recorded tosses; see the top of this file for the method.

    **Arguments:** `skeleton`, one rigid body whose corners meet a plane under gravity: its numbers are where the fit
    starts, its contact model that of the fit; `recording`, of tosses, with velocities at the samples (`carom import
    poses` makes such); `learn`, names of quantities as `Learned.chosen` takes them, by default `tossed_names`; `seed`,
    of which segments are used where there are more; `run`, a folder for metrics, by which a fit that was stopped goes
    on.

    **Returns:** the learned system and a report.

    **Raises:** `CaromError` for another kind of system, names of nothing, or too few impacts.
    """
    import time

    config = TossConfig() if config is None else config
    config.check()
    require(
        can_learn_tosses(skeleton),
        "tosses are learned for one rigid body with a CornerPlane contact under Gravity; this system is another.",
    )
    require(recording.x.shape[2:] == (4, 3), f"tosses have 4 points in 3D; the recording has {recording.x.shape[2:]}.")
    learned = Learned.chosen(skeleton.with_max_active(4), tossed_names(skeleton) if learn is None else learn)
    require(len(learned.names) > 0, "learn must name something, such as half_width, friction; it was empty.")
    theta = np.array(learned.free())
    known = [] if run is None else run.metrics()
    started = time.monotonic() - (known[-1]["seconds"] if known else 0.0)
    errors, count = np.full(len(theta), np.nan), 0
    stages = [(horizon, False) for horizon in config.horizons]
    begins = np.array(theta)
    bouncy = [k for k, q in enumerate(learned.quantities) if q.label.kind in BOUNCY]
    if config.evaluations and bouncy:
        stages.append((config.horizons[-1], True))
    found: list[tuple[np.ndarray, np.ndarray]] = []
    done = {(row["horizon"], row.get("bouncy", False)): row for row in known if "horizon" in row}

    def log(**row: Any) -> None:
        if run is not None:
            run.log({"epoch": 0, "seconds": round(time.monotonic() - started, 3), **row})

    total = len(stages) + config.evaluations
    with LoopProgress("step", total, shown=progress) as shown:
        for number, (horizon, again) in enumerate(stages, 1):
            if (horizon, again) in done:
                row = done[horizon, again]
                theta, errors, count = np.array(row["theta"]), np.array(row["errors"], float), row["segments"]
            else:
                if again:
                    theta = np.array(begins)
                    theta[bouncy] = 0.5
                theta, errors, count = _stage(learned, theta, recording, horizon, config, seed)
                log(horizon=horizon, bouncy=again, theta=theta.tolist(), errors=errors.tolist(), segments=count)
                shown.update(number, f"segments of {horizon}: " + _named(learned, theta))
            if number == len(config.horizons) - 1:
                begins = np.array(theta)
            if number >= len(config.horizons):
                found.append((theta, errors))
        before = [row for row in known if "loss" in row]
        some = np.random.default_rng((seed, 3)).permutation(recording.n_trajectories)[: config.toss_count]
        of_stages = [theta for theta, _ in found]
        made = 0
        if config.evaluations:
            theta, made, best = _search(
                learned, of_stages, recording.select(np.sort(some)), config, before, log, shown, len(stages)
            )
            errors = found[best][1]
    position, rotation = _whole(learned, theta, recording, config)
    system, seconds = learned.assemble(jnp.asarray(theta)), time.monotonic() - started
    lower, upper = np.asarray(learned.lower), np.asarray(learned.upper)
    told = (errors <= TOLD * search_steps(learned)) & (theta > lower) & (theta < upper)
    # What a small change of each free number does to its value, one that stays within the bounds.
    way = np.where(theta + 1e-3 * errors > upper, -1e-3, 1e-3)
    values, beyond = (np.asarray(learned.physical(jnp.asarray(at))) for at in (theta, theta + way * errors))
    size = np.abs(beyond - values) / 1e-3
    estimates = {
        name: TossEstimate(
            float(values[k]),
            float(size[k]) if np.isfinite(size[k]) else None,
            learned.of[k],
            learned.units[k],
            bool(told[k]),
        )
        for k, name in enumerate(learned.names)
    }
    report = TossReport(estimates, float(position.mean()), float(rotation.mean()), len(position), count, made, seconds)
    return system, report


def _whole(learned: Learned, theta, recording: Recording, config: TossConfig):
    """Errors of whole tosses from their first states: position (share of the width) and rotation (rad), each (N,)."""
    samples = min(config.toss_samples, recording.x.shape[1] - 1)
    stepper = toss_stepper(recording.dt, config.substeps)
    x0, v0 = jnp.asarray(recording.x[:, 0]), jnp.asarray(recording.v[:, 0])
    x = np.asarray(_tosses(learned, jnp.asarray(theta), x0, v0, stepper, samples, config.substeps))
    position, rotation = pose_errors(x, recording.x[:, : samples + 1], np.minimum(recording.length, samples + 1))
    return position / (2 * float(jnp.min(box_of(learned.assemble(jnp.asarray(theta))).half_widths))), rotation


def _search(learned: Learned, starts, recording, config: TossConfig, before: list[dict[str, Any]], log, shown, stages):
    """Nelder and Mead's search over whole tosses, from the best of several starts.

    It repeats what `before` holds without computing it again. Returns the best free numbers, how often tosses were
    predicted, and which start it was.
    """
    scale, count = search_steps(learned), len(learned.names)
    known = {tuple(row["theta"]): row["loss"] for row in before}
    made, best = 0, (np.inf, np.asarray(starts[0]))

    def loss_at(theta) -> float:
        nonlocal made, best
        tried = np.asarray(learned.project(jnp.asarray(theta)))
        made += 1
        key = tuple(tried.tolist())
        if key not in known:
            position, rotation = _whole(learned, tried, recording, config)
            # A simulation that ends nowhere is as bad as can be.
            known[key] = float(np.nan_to_num(position, nan=10.0).mean() + np.nan_to_num(rotation, nan=np.pi).mean())
            log(theta=tried.tolist(), loss=known[key])
        if known[key] < best[0]:
            best = known[key], tried
        shown.update(stages + made, f"whole tosses {best[0]:.4f}: " + _named(learned, best[1]))
        return known[key]

    first = int(np.argmin([loss_at(theta) for theta in starts]))
    base = best[1]
    for tried, value in known.items():  # of a run that was stopped: nothing that was found is lost
        if value < best[0]:
            best = value, np.array(tried)
    simplex = np.concatenate([np.zeros((1, count)), 0.5 * np.eye(count)])
    most = max(config.evaluations - made, 1)
    options = {"maxfev": most, "initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-4, "adaptive": True}
    scipy.optimize.minimize(lambda z: loss_at(base + scale * z), np.zeros(count), method="Nelder-Mead", options=options)
    return best[1], made, first


def _named(learned: Learned, theta) -> str:
    values = np.asarray(learned.physical(jnp.asarray(theta)))
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(learned.names, values, strict=True))
