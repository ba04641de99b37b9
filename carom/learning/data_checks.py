"""Whether data and skeleton fit, before a training begins."""

import jax.numpy as jnp
import numpy as np

from carom.checks import require
from carom.learning.config import LearnConfig
from carom.learning.dataset import Dataset, closed_contacts
from carom.learning.meetings import check_meetings
from carom.recordings.recording import Recording, check_system
from carom.simulation.impact import COMPENSATION_STEPS
from carom.simulation.start_checks import through
from carom.system import System

LARGEST_DRIFT = 5e-2
"""Recorded constraints that are off by more, relative to what they hold, are of another system (rods: by 1 in 40)."""


def check_dataset(skeleton: System, dataset: Dataset, config: LearnConfig) -> int:
    """Raise `CaromError` where data and skeleton do not fit; return the largest number of contacts closed at once."""
    check_system(dataset.train, skeleton, "the training recording")
    require(
        int(dataset.train.length.max()) >= config.states,
        f"chunk_length is {config.states} states, but the longest training trajectory has "
        f"{int(dataset.train.length.max())}. Use longer trajectories or a shorter chunk.",
    )
    most = 0
    for name, part in (("train", dataset.train), ("val", dataset.val)):
        valid = part.valid
        drift = np.abs(np.asarray(skeleton.violation(jnp.asarray(part.x[valid]))))
        require(
            drift.size == 0 or drift.max() <= LARGEST_DRIFT,
            f"the {name} data do not fit the system's rods and joints: a constraint is off by "
            f"{drift.max() if drift.size else 0:.2g} of what it holds. Check units, order of the points and lengths.",
        )
        most = max(most, int(np.where(valid, closed_contacts(part.x, skeleton), 0).max()))
        check_not_inside(name, part, skeleton, valid)
    if config.learns_contact:
        check_meetings(dataset.train, skeleton, "the training data")
    return most


def check_not_inside(name: str, part: Recording, skeleton: System, valid: np.ndarray) -> None:
    """Raise `CaromError` for recorded states with a body in a wall, or bodies through each other."""
    if not skeleton.contacts:
        return
    states = jnp.asarray(part.x[valid]), jnp.asarray(part.v[valid])
    depth, limit = through(skeleton, *states, part.dt, COMPENSATION_STEPS)
    wrong = depth > limit
    if wrong.any():
        row, candidate = np.argwhere(wrong)[0]
        trajectory, sample = np.argwhere(valid)[row]
        bodies = [b for contact in skeleton.contacts for b in contact.bodies_of()][candidate]
        what = (
            f"body {bodies[0]} in a wall" if len(bodies) == 1 else f"bodies {bodies[0]} and {bodies[1]} in each other"
        )
        require(
            False,
            f"the {name} data have {what} (trajectory {trajectory}, sample {sample}, {depth[row, candidate]:.3g} m "
            f"deep, {int(wrong.any(axis=1).sum())} samples in all). Check units, radii and walls.",
        )
