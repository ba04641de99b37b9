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
    jax.distributed.initialize(coordinator, num_processes=count, process_id=number)


def is_first() -> bool:
    """Whether this is the process that writes and talks."""
    return jax.process_index() == 0


def all_devices() -> Mesh | None:
    """A mesh of all devices of all processes; None where there is only one.

    The environment variable CAROM_DEVICES is the number of devices of a single process to use at most.
    """
    devices = jax.devices()
    most = os.environ.get("CAROM_DEVICES", "")
    if most and jax.process_count() == 1:
        require(most.isdigit() and int(most) > 0, f"CAROM_DEVICES must be a positive number; it was {most!r}.")
        devices = devices[: int(most)]
    return Mesh(np.array(devices), (AXIS,)) if len(devices) > 1 else None


def for_all(tree: Any) -> Any:
    """Arrays as a program of several processes takes them: the same on each."""
    return jax.tree.map(lambda a: np.asarray(a) if eqx.is_array(a) else a, tree)


def own(tree: Any) -> Any:
    """Arrays that are the same on all devices, as arrays of this process."""
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a.addressable_data(0))) if eqx.is_array(a) else a, tree)


def from_first(tree: Any) -> Any:
    """The arrays of process 0, for all."""
    if jax.process_count() == 1:
        return tree
    arrays, rest = eqx.partition(tree, eqx.is_array)
    sent = multihost_utils.broadcast_one_to_all(jax.tree.map(np.asarray, arrays))
    return eqx.combine(jax.tree.map(lambda a, b: jnp.asarray(np.asarray(a), b.dtype), sent, arrays), rest)
