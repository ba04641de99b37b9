"""What a recording shows of a system before anything is learned: does it fit, and what can it tell?"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from carom.contact.limits import BendLimit, StretchLimit
from carom.learning.config import LearnConfig
from carom.learning.data_checks import LARGEST_DRIFT
from carom.learning.dataset import Chunks, all_gaps, closing, contact_flags
from carom.learning.estimation.refine import IdentifyConfig
from carom.learning.estimation.tosses import can_learn_tosses
from carom.learning.meetings import meetings
from carom.mechanics.constraints import Rigid
from carom.mechanics.potentials import Gravity
from carom.recordings.motion_impacts import impact_counts, motion_impacts
from carom.recordings.observation_checks import check_observations
from carom.recordings.observations import Observations, check_points
from carom.recordings.recording import Recording, check_system
from carom.recordings.recording_checks import Finding, check_recording
from carom.system import System

LOOSE = 1e-3
"""Constraints that are off by more, relative to what they hold, deserve a look; see `LARGEST_DRIFT`."""


class Inspection(NamedTuple):
    """Findings, and in how many recorded steps a contact of each property (P,) closes."""

    findings: list[Finding]
    closings: list[int]


def inspect_recording(recording: Recording, system: System, config: LearnConfig | None = None) -> Inspection:
    """What a recording shows, alone and of the geometry of `system`; nothing is learned.

    **Arguments:** `recording`, the data; `system`, whose radii, walls, rods and joints are taken as right, and of whose
    potential a uniform field alone is looked at; `config`, how it is to be learned.

    **Raises:** `CaromError` if the recording is of another number of points or dimension.
    """
    check_system(recording, system)
    config = LearnConfig() if config is None else config
    out = check_recording(recording)
    if system.links:
        out.append(_constraints(recording.x[recording.valid], system))
    closings = closing(recording, system)
    if system.contacts:
        out.append(_depth(recording.x, recording.valid, system))
        out += _meetings(recording, system)
    closed = contact_flags(recording, system) if system.contacts else np.zeros(recording.x.shape[:2], bool)
    more = (_step_length(recording, system), _free_fall(recording, system, closed))
    out += [finding for finding in more if finding is not None]
    out.append(_chunks(recording, system, closed, config))
    for k in np.flatnonzero(closings < IdentifyConfig().min_impacts):
        advice = f"too few to tell its friction and restitution: {IdentifyConfig().min_impacts} or more are needed"
        out.append(Finding(f"impacts of property {k}", str(closings[k]), advice))
    return Inspection(out, closings.tolist())


def inspect_observations(observations: Observations, system: System) -> list[Finding]:
    """What positions show, alone and of the geometry of `system`: nothing need be complete, or in equal steps.

    **Raises:** `CaromError` if the observations are of another number of points or dimension.
    """
    check_points(observations, system)
    out = check_observations(observations)
    whole = np.asarray(observations.seen.all(axis=2))
    if system.links and whole.any():
        out.append(_constraints(observations.x[whole], system))
    if system.contacts:
        if whole.any():
            out.append(_depth(observations.x, whole, system))
        out.append(_impacts(observations, system))
    return out


def _impacts(observations: Observations, system: System) -> Finding:
    """Impacts that motion shows, wherever bodies overlap."""
    found = motion_impacts(observations, system)
    parts = ", ".join(f"{name} {count}" for name, count in impact_counts(found, system).items())
    enough = len(found) >= IdentifyConfig().min_impacts
    advice = "" if enough else f"{IdentifyConfig().min_impacts} or more tell friction and restitution"
    return Finding("impacts seen in the motion", f"{len(found)}{f' ({parts})' if parts else ''}", advice)


def _constraints(states: Float[np.ndarray, "S n d"], system: System) -> Finding:
    off = np.abs(np.asarray(system.violation(jnp.asarray(states))))
    worst = float(off.max(initial=0.0))
    advice = "" if worst <= LOOSE else "lengths of rods, units or the order of points may be wrong"
    advice += "; `learn` refuses it" if worst > LARGEST_DRIFT else ""
    return Finding("rods and joints are off by", f"{worst:.1e} of what they hold, median {np.median(off):.0e}", advice)


def _depth(x: Float[np.ndarray, "N T n d"], whole: Bool[np.ndarray, "N T"], system: System) -> Finding:
    """The deepest contact of whole states, as a share of the depth at which bodies would be through each other."""
    reach, deepest, place, states = np.asarray(system.reach()), 0.0, "", 0
    count = 0
    for k, (gaps, there) in enumerate(zip(all_gaps(x, system), whole, strict=True)):
        depth = np.where(there[:, None], -gaps, 0.0)
        states += int((depth > 0).any(axis=1).sum())
        share = np.divide(depth, reach, out=np.zeros_like(depth), where=reach > 0)  # points have none
        count += int(there.sum())
        if share.max(initial=0.0) > deepest:
            deepest = float(share.max())
            place = f" (trajectory {k}, sample {int(share.max(axis=1).argmax())})"
    advice = f"bodies are through walls or each other{place}: check radii, walls and units" if deepest > 1 else ""
    return Finding("states in contact", f"{states / count:.0%}, the deepest {deepest:.0%} of what can be", advice)


def _meetings(recording: Recording, system: System) -> list[Finding]:
    """Whether impacts are at the samples; nothing of bodies that never meet. Tosses are learned in either case.

    Where they are between the samples, the motion shows them.
    """
    found = meetings(recording, system)
    if not sum(found):
        return []
    advice = ""
    if found.not_seen and not can_learn_tosses(system):
        advice = "impacts happen between the samples: the command finds them in the motion"
    out = [Finding("where bodies meet", str(found), advice)]
    return [*out, _impacts(Observations.of(recording), system)] if found.not_seen else out


def _step_length(recording: Recording, system: System) -> Finding | None:
    """The longest way of a step, as a share of the smallest depth that a contact can have; limits of chains aside."""
    touching = [contact for contact in system.contacts if not isinstance(contact, BendLimit | StretchLimit)]
    reach = np.concatenate([np.zeros(0), *(np.asarray(contact.reach(system.radii)) for contact in touching)])
    if not len(reach):
        return None
    longest = float(np.linalg.norm(recording.v, axis=-1)[recording.valid].max()) * recording.dt
    share = longest / float(reach.min())
    rate = np.ceil(1.5 * share) / recording.dt
    advice = f"contacts may pass between samples: record at {rate:.0f} Hz or more" if share > 1 else ""
    return Finding("longest way of a step", f"{longest:.2g} m, {share:.0%} of the smallest contact depth", advice)


def _free_fall(recording: Recording, system: System, closed: Bool[np.ndarray, "N T"]) -> Finding | None:
    """Acceleration of bodies that touch nothing, against the system's uniform field; None where that says nothing."""
    free_bodies = all(isinstance(link, Rigid) for link in system.links)
    if not (free_bodies and isinstance(system.potential, Gravity)):
        return None
    field = np.asarray(system.potential.acceleration)
    size = float(np.linalg.norm(field))
    near = closed[:, 2:] | closed[:, 1:-1] | closed[:, :-2]
    flight = recording.valid[:, 2:] & ~near
    if size == 0 or not flight.any():
        return None
    centers = recording.x[:, :, list(system.table.center)]
    bend = (centers[:, 2:] - 2 * centers[:, 1:-1] + centers[:, :-2]) / recording.dt**2
    fall = float(np.median((bend[flight] @ field) / size))
    share = fall / size
    advice = ""
    if abs(share - 1) > 0.05:
        advice = f"{share:.3g} times what the system says: are lengths in m and times in s, and does it point down?"
    return Finding("acceleration in free flight", f"{fall:.4g} m/s^2, the system says {size:.4g}", advice)


def _chunks(recording: Recording, system: System, closed: Bool[np.ndarray, "N T"], config: LearnConfig) -> Finding:
    """Pieces of trajectories to learn from: those without and with a contact."""
    smooth, hit = Chunks.of(closed, recording.length, config.states).count()
    advice = "" if hit or not system.contacts else "no contact to learn from"
    if smooth + hit == 0:
        longest = int(recording.length.max())
        advice = (
            f"trajectories are shorter ({longest} states): give --chunk-length {longest}"
            if longest < config.states
            else "none starts without contact"
        )
    return Finding(f"chunks of {config.states} states", f"{smooth} without, {hit} with a contact", advice)
