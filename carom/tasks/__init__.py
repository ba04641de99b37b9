"""The named systems. A new one is a `Task` object, listed here."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from carom.checks import require
from carom.contact.impulses import ContactModel, contact_model_name
from carom.learning.dataset import recording_of
from carom.learning.model_file import load_model_into, read_model_header
from carom.recordings.recording import Recording
from carom.simulation.impact import COMPENSATION_STEPS
from carom.simulation.rollout import simulate
from carom.system import System
from carom.tasks.base import Task as Task
from carom.tasks.base import find_named
from carom.tasks.bouncing import BP5, BP5_E
from carom.tasks.cubes import CUBE
from carom.tasks.disks import BD5, BILLIARDS, THROW
from carom.tasks.gyroscopes import GYRO, GYRO_E
from carom.tasks.impacts import BOUNCE_ONCE, GROUND_WALL, TWO_BALLS
from carom.tasks.pendulums import CP3, CP3_E
from carom.tasks.ropes import ROPE, ROPE_50, ROPE_100, ROPE_200

_PAPER = (BP5_E, BP5, BD5, CP3, CP3_E, GYRO, GYRO_E, ROPE, ROPE_50, ROPE_100, ROPE_200)
TASKS: dict[str, Task] = {
    task.name: task for task in (*_PAPER, BILLIARDS, THROW, BOUNCE_ONCE, GROUND_WALL, TWO_BALLS, CUBE)
}


def find_task(name: str) -> Task:
    """The task of this name. Raises `CaromError` with the nearest names for an unknown one."""
    return find_named("task", name, TASKS)


def task(name: str, *, contact_model: str | ContactModel = "cm") -> System:
    """The system of a named task, with its true parameters.

    **Arguments:** `name`, of the task; `contact_model`, `"cm"` (the paper's), `"cmr"`, `"lcp"` or a `ContactModel`.

    **Raises:** `CaromError` for an unknown name or contact model.
    """
    return find_task(name).system().with_contact_model(contact_model)


def sample(system: System, key: PRNGKeyArray, n: int) -> tuple[Float[Array, "N n d"], Float[Array, "N n d"]]:
    """`n` initial states `(x0, v0)` of a task's system, from the task's own distribution; none starts in contact.

    **Arguments:** `system`, from `carom.task` (or one learned for a task); `key`, a JAX random key; `n`, how many.

    **Raises:** `CaromError` for a system that is no task's.
    """
    require(
        system.name != "",
        "sample knows the initial states of named tasks only; this system has no name. Make your own x0 and v0.",
    )
    require(n > 0, f"n must be a positive number of states; it was {n}.")
    return find_task(system.name).sample(system, key, n)


def make_recording(
    system: System,
    key: PRNGKeyArray,
    n: int,
    *,
    contact_model: str | ContactModel | None = None,
    compensation_steps: float | None = COMPENSATION_STEPS,
) -> Recording:
    """`n` simulated trajectories of a task's system, at the task's time step and length.

    **Arguments:** `system`, `key` and `n` as those of `sample`; `contact_model`, in place of the system's own, and
    `compensation_steps` as those of `simulate`.
    """
    (recording,) = make_recordings(
        system, [(key, n)], contact_model=contact_model, compensation_steps=compensation_steps
    )
    return recording


def make_recordings(
    system: System,
    parts: Sequence[tuple[PRNGKeyArray, int]],
    *,
    steps: int | None = None,
    contact_model: str | ContactModel | None = None,
    compensation_steps: float | None = COMPENSATION_STEPS,
) -> list[Recording]:
    """Several recordings, each as by `make_recording` from its key and number, in one simulation.

    `steps`: how long they are, if not as the task says. The program that simulates is compiled once for each number of
    trajectories, which takes longer than to run it.
    """
    x0, v0 = (jnp.concatenate(states) for states in zip(*(sample(system, *part) for part in parts), strict=True))
    if contact_model is not None:
        system = system.with_contact_model(contact_model)
    chosen = find_task(system.name)
    steps = chosen.steps if steps is None else steps
    trajectory = simulate(system, x0, v0, dt=chosen.dt, steps=steps, compensation_steps=compensation_steps)
    model = contact_model_name(system.contact_model)
    source = "carom" if model == "cm" else f"carom, contact model {model or 'of its own'}"
    whole = recording_of(trajectory, task=system.name, source=source)
    ends = np.cumsum([n for _, n in parts])
    return [whole.select(np.arange(end - n, end)) for end, (_, n) in zip(ends, parts, strict=True)]


def noisy(name: str, recording: Recording, sd: float, rng: np.random.Generator) -> Recording:
    """A recording of the task `name` with normal errors: on angles and rates of pendulums, else on every number.

    **Arguments:** `sd`, standard deviation in rad and rad/s, or m and m/s.
    """
    require(0 <= sd < np.inf, f"sd must be a finite number of at least 0; it was {sd}.")
    x, v = find_task(name).add_noise(recording.x, recording.v, sd, rng)
    return dataclasses.replace(recording, x=x, v=v)


LEAST_TEST_STEPS = 100
"""Predictions are measured over so many steps, also where a task's trajectories are shorter."""


def make_data_sets(
    system: System,
    train: tuple[PRNGKeyArray, int],
    val: tuple[PRNGKeyArray, int],
    test: tuple[PRNGKeyArray, int],
    **how,
) -> list[Recording]:
    """Recordings to train, validate and test with, the last of at least `LEAST_TEST_STEPS` steps.

    **Arguments:** as those of `make_recordings`.
    """
    if find_task(system.name).steps >= LEAST_TEST_STEPS:
        return make_recordings(system, [train, val, test], **how)
    return [
        *make_recordings(system, [train, val], **how),
        *make_recordings(system, [test], steps=LEAST_TEST_STEPS, **how),
    ]


def load_model(path: str | os.PathLike, skeleton: System | None = None) -> System:
    """The learned system of a `model.carom` file.

    **Arguments:** `path`, of the file; `skeleton`, the system it was learned with, needed where that is no named task.

    **Raises:** `CaromError` if the file cannot be read, is damaged, or does not fit.
    """
    if skeleton is None:
        name = read_model_header(Path(path))["task"]
        require(name != "", f"the model {path} is of a system of your own: give the skeleton it was learned with.")
        skeleton = task(name)
    return load_model_into(Path(path), skeleton)
