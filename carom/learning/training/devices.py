"""Training on several devices and in several processes: each takes a share of every batch of chunks.

All devices that JAX shows to a process are used. Over several processes (`start_processes`) each holds all of the data
and of the unknowns; the gradients of the shares are added up, so that all go on alike. Process 0 alone writes.
"""

import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from jaxtyping import Float, Int

from carom.checks import require

AXIS = "chunks"
"""Name of the devices' axis."""


def start_processes(coordinator: str, count: int, number: int) -> None:
    """Join a training of `count` processes as number `number`, before anything else is done with JAX.

    **Arguments:** `coordinator`, HOST:PORT where process 0 listens, the same for all.

    **Raises:** `CaromError` for numbers out of range, or an address without a port.
    """
    require(count >= 1, f"process_count must be at least 1; it was {count}.")
    require(0 <= number < count, f"process_id must be from 0 to {count - 1}, process_count - 1; it was {number}.")
    host, _, port = coordinator.rpartition(":")
    require(bool(host) and port.isdigit(), f"coordinator must be HOST:PORT; it was {coordinator!r}.")
    # XLA compiles on a pool of as many threads as the machine has cores, and a client of several processes compiles
    # from within that pool: on two cores it waits for itself forever (jaxlib 0.9.2). NPROC is what the pool goes by.
    os.environ.setdefault("NPROC", str(max(8, os.cpu_count() or 1)))
    jax.distributed.initialize(coordinator, num_processes=count, process_id=number)


def is_first() -> bool:
    """Whether this is the process that writes and talks."""
    return jax.process_index() == 0


def own_devices() -> Mesh | None:
    """A mesh of the devices of this process; None where there is only one.

    The environment variable CAROM_DEVICES is the number of them to use at most.
    """
    devices = jax.local_devices()
    most = os.environ.get("CAROM_DEVICES", "")
    if most:
        require(most.isdigit() and int(most) > 0, f"CAROM_DEVICES must be a positive number; it was {most!r}.")
        devices = devices[: int(most)]
    return Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None


def shares(size: int, mesh: Mesh | None) -> tuple[Int[np.ndarray, " B"], Float[np.ndarray, " B"]]:
    """Which of `size` chunks this process takes, and the share of each in the means of all.

    A number that cannot be divided by that of devices is filled up with chunks that have no share.
    """
    processes, devices = jax.process_count(), 1 if mesh is None else mesh.size
    each = -(-size // (processes * devices)) * devices
    rows = jax.process_index() * each + np.arange(each)
    return np.minimum(rows, size - 1), np.where(rows < size, 1 / size, 0.0)


def sum_over_processes(tree: Any) -> Any:
    """The sums over all processes of the arrays that each has."""
    return jax.tree.map(lambda a: jnp.asarray(np.sum(a, axis=0), a.dtype), multihost_utils.process_allgather(tree))


def from_first(tree: Any) -> Any:
    """The arrays of process 0, for all."""
    if jax.process_count() == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    sent = multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, arrays))
    return eqx.combine(jax.tree.map(lambda a, b: jnp.asarray(np.asarray(a), b.dtype), sent, arrays), rest)
