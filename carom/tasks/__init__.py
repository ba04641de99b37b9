"""The named systems. A new one is a `Task` object, listed here."""

import difflib

from jaxtyping import Array, Float, PRNGKeyArray

from carom.checks import require
from carom.system import System
from carom.tasks.base import Task as Task
from carom.tasks.bouncing import BP5, BP5_E
from carom.tasks.pendulums import CP3, CP3_E

TASKS: dict[str, Task] = {task.name: task for task in (BP5_E, BP5, CP3, CP3_E)}


def find_task(name: str) -> Task:
    """The task of this name. Raises `CaromError` with the nearest names for an unknown one."""
    near = difflib.get_close_matches(name, TASKS, n=1, cutoff=0.4)
    hint = f"Did you mean {near[0]!r}? " if near else ""
    require(name in TASKS, f"task must be one of {', '.join(sorted(TASKS))}; it was {name!r}. {hint}".rstrip())
    return TASKS[name]


def task(name: str) -> System:
    """The system of a named task, with its true parameters.

    **Raises:** `CaromError` for an unknown name.
    """
    return find_task(name).system()


def sample(
    system: System, key: PRNGKeyArray, n: int
) -> tuple[Float[Array, "N n d"], Float[Array, "N n d"]]:
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
