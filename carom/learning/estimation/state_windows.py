"""Windows of recorded states around contacts, and how noisy these states are."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from carom.learning.dataset import contact_flags
from carom.learning.estimation.refine import IdentifyConfig, error_sizes, principal_directions
from carom.learning.unknowns.models import Unknowns
from carom.recordings.recording import Recording
from carom.simulation.impact import Stepper
from carom.simulation.rollout import step
from carom.system import System

LENGTH = 24
"""States in a window, where the recordings are long enough."""
RUN_IN = 12
"""States before the first contact of a window, if there are so many: they tell its start, whatever the contact does."""
LEAST_RUN_IN = 6
"""Contacts after fewer are not looked at."""
COUNT = 600
"""Most windows."""
NOISE = 0.1
"""Positions that are off by more than this share of what a step moves: which contacts close is up to the noise."""


class Windows(NamedTuple):
    """Recorded states of windows, and how many of them come before the first contact."""

    x: Float[np.ndarray, "W L n d"]
    v: Float[np.ndarray, "W L n d"]
    run_in: Int[np.ndarray, " W"]
    trajectory: Int[np.ndarray, " W"]


def choose_windows(recording: Recording, system: System, *, seed: int, count: int = COUNT) -> Windows:
    """Windows around contacts that come after free motion, and some of free motion; none if there is no room for any.

    Contacts are the recorded flags, or else closed gaps of the recorded states.
    """
    rng = np.random.default_rng((seed, 2))
    length = min(LENGTH, int(recording.length.max()))
    flags = contact_flags(recording, system)
    hit, free = [], []
    for k, (closed, valid) in enumerate(zip(flags, recording.length, strict=True)):
        before = 0  # free states up to here
        for s in range(int(valid)):
            if not closed[s]:
                before += 1
                if before >= length and s % length == length - 1:
                    free.append((k, s - length + 1, length))
                continue
            run_in = min(before, RUN_IN)
            if run_in >= min(LEAST_RUN_IN, length // 2) and s - run_in + length <= valid:
                hit.append((k, s - run_in, run_in))
            before = 0
    hit = [hit[n] for n in rng.permutation(len(hit))[: count * 3 // 4 if free else count]]
    chosen = hit + [free[n] for n in rng.permutation(len(free))[: count - len(hit)]]
    trajectory, start, run_in = np.array(chosen, int).reshape(-1, 3).T
    times = start[:, None] + np.arange(length)
    return Windows(recording.x[trajectory[:, None], times], recording.v[trajectory[:, None], times], run_in, trajectory)


def is_noisy(errors: Float[np.ndarray, " R"], recording: Recording) -> bool:
    """Whether `errors` of positions are more than `NOISE` of what a step moves."""
    moves = np.sqrt(np.mean(recording.v[recording.valid] ** 2)) * recording.dt
    return bool(errors[: len(errors) // 2].max() > NOISE * moves)


def step_errors(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, recording: Recording, *, seed: int, count: int = 500
) -> Float[np.ndarray, " R"]:
    """Standard deviations of the errors of recorded numbers, from single steps of free motion; see `error_sizes`."""
    rng = np.random.default_rng((seed, 3))
    free = ~contact_flags(recording, skeleton) & recording.valid
    steps = np.argwhere(free[:, :-1] & free[:, 1:])
    if not len(steps):
        return np.zeros(2 * skeleton.n_points * skeleton.dim)
    k, s = steps[rng.permutation(len(steps))[:count]].T
    states = [jnp.asarray(part) for part in (recording.x[k, s], recording.v[k, s])]
    x, v = _free_steps(unknowns, skeleton, dataclasses.replace(stepper, contact=False), *states)
    residual = [np.asarray(a) - b for a, b in ((x, recording.x[k, s + 1]), (v, recording.v[k, s + 1]))]
    return error_sizes(np.stack(residual, axis=1), recording)


@eqx.filter_jit
def _free_steps(unknowns, skeleton, stepper, x, v):
    out = jax.vmap(lambda x, v: step(unknowns.assemble(skeleton), x, v, stepper))(x, v)
    return out.x, out.v


def window_directions(unknowns: Unknowns, skeleton: System, windows: Windows) -> Float[np.ndarray, "W F"]:
    """Directions of the potential's weights to estimate: see `principal_directions`."""
    states = Recording.of(windows.x, windows.v, time=np.arange(windows.x.shape[1], dtype=float))
    steps = np.stack([np.arange(len(windows.x)), np.zeros(len(windows.x), int)], axis=1)
    return principal_directions(unknowns, skeleton, states, steps, IdentifyConfig())
