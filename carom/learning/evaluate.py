"""How good a learned system is: contact properties, mass ratios, trajectory error, energy and constraints."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from carom.learning.unknowns.baselines import physical_quantities
from carom.learning.unknowns.models import mass_ratios
from carom.mechanics.dynamics import Formulation
from carom.recordings.recording import Recording, check_system
from carom.recordings.recording_checks import state_noise
from carom.simulation.impact import COMPENSATION_STEPS, ImpactRule
from carom.simulation.rollout import Trajectory, simulate
from carom.system import System


def predict(
    system: System,
    recording: Recording,
    *,
    formulation: Formulation = "lagrangian",
    project: bool = True,
    compensation_steps: float | None = COMPENSATION_STEPS,
    impact: ImpactRule = "step",
) -> Trajectory:
    """Motion of `system` from the first recorded state of each trajectory, as long as the recording.

    A prediction that goes wrong is not an error here: it is a bad prediction, and measured as such.
    """
    return simulate(
        system,
        jnp.asarray(recording.x[:, 0]),
        jnp.asarray(recording.v[:, 0]),
        dt=recording.dt,
        steps=recording.x.shape[1] - 1,
        formulation=formulation,
        project=project,
        compensation_steps=compensation_steps,
        impact=impact,
        throw=False,
    )


def state_errors(
    recording: Recording, predicted: Trajectory
) -> tuple[Float[np.ndarray, "N T"], Float[np.ndarray, "N T"]]:
    """Relative errors of each predicted state: `|z - z^| / |z|`, and bounded `|z - z^| / sqrt(|z|^2 + |z^|^2)`.

    `z` holds positions and velocities together (m and m/s, as the paper); NaN after a trajectory's own end.
    """

    def flat(x, v):
        return np.concatenate([np.asarray(a).reshape(*np.shape(a)[:2], -1) for a in (x, v)], axis=-1)

    true, guess = flat(recording.x, recording.v), flat(predicted.x, predicted.v)
    true = np.where(recording.valid[..., None], true, np.nan)
    distance = np.linalg.norm(true - guess, axis=-1)
    size = np.linalg.norm(true, axis=-1)
    bounded = distance / np.sqrt(size**2 + np.linalg.norm(guess, axis=-1) ** 2)
    lost = recording.valid & ~np.isfinite(guess).all(axis=-1)
    return np.where(lost, np.inf, distance / size), np.where(lost, 1.0, bounded)


def energy_errors(recording: Recording, predicted: Trajectory, truth: System) -> Float[np.ndarray, "N T"]:
    """Error of the energy of each predicted state: `|E^ - E|` by the true system, over its largest kinetic energy.

    That of the trajectory is meant; the zero of a potential says nothing. NaN after a trajectory's own end.
    """
    x, v = jnp.asarray(recording.x), jnp.asarray(recording.v)
    true, guess = np.asarray(truth.energy(x, v)), np.asarray(truth.energy(predicted.x, predicted.v))
    kinetic = 0.5 * np.einsum("tkid,ij,tkjd->tk", recording.v, np.asarray(truth.mass_matrix()), recording.v)
    largest = np.max(np.where(recording.valid, kinetic, 0), axis=1, keepdims=True)
    error = np.where(np.isfinite(guess), np.abs(guess - true), np.inf) / np.maximum(largest, 1e-300)
    return np.where(recording.valid, error, np.nan)


FAR_OFF = 0.1
"""Predictions that are off by a larger share do not explain the data, unless noise may be why."""
NOISE_GROWS = 5.0
"""By which the noise of a start may have grown, as a share of the state, in the mean over a prediction."""


def error_allowed(recording: Recording) -> float:
    """The largest relative error of predictions that explain a recording: see docs/identifiability.md."""
    return max(FAR_OFF, NOISE_GROWS * state_noise(recording))


def far_off(measures: dict[str, Any]) -> bool:
    """Whether predictions do not explain the data: too many are off, not only a few that are lost.

    Of the trajectories' errors the median is judged, which a few do not move, and the mean of the bounded form.
    """
    errors = (measures["trajectory_error_median"], measures["bounded_error"])
    return not all(error <= measures["error_allowed"] for error in errors)


def mean_and_interval(errors: Float[np.ndarray, "N T"]) -> dict[str, list[float]]:
    """At each time, the mean over trajectories (those that last so long), and half of its 95 % interval."""
    count = np.maximum(np.sum(~np.isnan(errors), axis=0), 1)
    mean = np.nanmean(errors, axis=0)
    spread = 1.96 * np.nanstd(errors, axis=0, ddof=1) / np.sqrt(count) if len(errors) > 1 else np.zeros_like(mean)
    return {"mean": mean.tolist(), "ci95": spread.tolist(), "median": np.nanmedian(errors, axis=0).tolist()}


def evaluate(
    system: System,
    recording: Recording,
    *,
    truth: System | None = None,
    formulation: Formulation = "lagrangian",
    compensation_steps: float | None = COMPENSATION_STEPS,
    impact: ImpactRule = "step",
) -> tuple[dict[str, Any], Trajectory]:
    """Measures of `system` on test recordings, and its predictions.

    **Arguments:** `system`, learned; `recording`, test data; `truth`, the true system where it is known, for the errors
    of properties and the drift of the true energy; `formulation`, `compensation_steps` and `impact` of the predictions,
    as those of `simulate`.

    **Returns:** a dictionary of numbers (definitions: the paper, section 5 and appendix L; the first of each pair below
    is the paper's) with

    - `trajectory_error`: mean over time, then over trajectories, of the relative error, with `_ci95`, half of the 95 %
      interval of that mean; `_median` over trajectories; `_geometric`, geometric mean over time, mean over
      trajectories; `bounded_error`: mean of the bounded form.
    - `error_allowed`: above which predictions do not explain the data (see `far_off`).
    - `energy_drift`: largest `|E - E_0| / max |E|` along predictions of a system that keeps energy, by the true system.
    - `constraint_error`: largest `|Phi|` (m^2).
    - `friction_error`, `restitution_error` (absolute, by property) and `mass_ratio_error` (relative, by body), of
      a system that has them: a baseline does not.

    **Raises:** `CaromError` if the recording is of another system.
    """
    check_system(recording, system)
    predicted = predict(
        system, recording, formulation=formulation, compensation_steps=compensation_steps, impact=impact
    )
    relative, bounded = state_errors(recording, predicted)
    later, later_bounded = relative[:, 1:], bounded[:, 1:]
    per_trajectory = np.nanmean(later, axis=1)
    count, valid = len(per_trajectory), recording.valid  # a prediction goes on where its trajectory has ended
    out: dict[str, Any] = {
        "trajectories": count,
        "steps": int(recording.length.max()) - 1,
        "trajectory_error": float(np.mean(per_trajectory)),
        "trajectory_error_ci95": float(1.96 * np.std(per_trajectory, ddof=1) / np.sqrt(count)) if count > 1 else None,
        "trajectory_error_median": float(np.median(per_trajectory)),
        "trajectory_error_geometric": float(np.mean(np.exp(np.nanmean(np.log(np.maximum(later, 1e-16)), axis=1)))),
        "bounded_error": float(np.mean(np.nanmean(later_bounded, axis=1))),
        "error_allowed": error_allowed(recording),
        "constraint_error": float(np.max(np.abs(np.asarray(system.constraints(predicted.x)))[valid], initial=0.0)),
        "overflowed_contacts": int(np.sum(np.asarray(predicted.overflow)[valid])),
    }
    if truth is not None:
        known = physical_quantities(system)
        for name in ("friction", "restitution"):
            if name in known:
                out[f"{name}_error"] = np.abs(np.asarray(getattr(system, name) - getattr(truth, name))).tolist()
        if "mass" in known:
            out["mass_ratio_error"] = np.abs(mass_ratios(system) / mass_ratios(truth) - 1).tolist()
        if np.all(np.asarray(truth.restitution) == 1) and np.all(np.asarray(truth.friction) == 0):
            energy = np.asarray(truth.energy(predicted.x, predicted.v))
            drift = np.abs(energy - energy[:, :1])[valid]
            out["energy_drift"] = float(np.max(drift) / np.max(np.abs(energy[valid])))
    return out, predicted
