"""What a task is: a named system with its initial-state distribution and its time step."""

import abc
import difflib
from collections.abc import Callable, Mapping
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from carom.checks import require
from carom.system import System


class Task(eqx.Module):
    """A named system of the benchmark. `dt` in s; `steps` of a training trajectory."""

    name: eqx.AbstractVar[str]
    dt: eqx.AbstractVar[float]
    steps: eqx.AbstractVar[int]

    @abc.abstractmethod
    def system(self) -> System:
        """The system, with its true parameters."""

    @abc.abstractmethod
    def sample(self, system: System, key: PRNGKeyArray, n: int) -> tuple[Float[Array, "N n d"], Float[Array, "N n d"]]:
        """`n` initial states: positions (m) and velocities (m/s)."""

    def add_noise(
        self, x: Float[np.ndarray, "N T n d"], v: Float[np.ndarray, "N T n d"], sd: float, rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "N T n d"], Float[np.ndarray, "N T n d"]]:
        """Recorded states with normal errors of `sd` on every coordinate (m) and velocity (m/s)."""
        return x + sd * rng.normal(size=x.shape), v + sd * rng.normal(size=v.shape)


T = TypeVar("T")


def find_named(kind: str, name: str, known: Mapping[str, T]) -> T:
    """The object of this name. Raises `CaromError` with the nearest names for an unknown one."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"Did you mean {near[0]!r}? " if near else ""
    require(name in known, f"{kind} must be one of {', '.join(sorted(known))}; it was {name!r}. {hint}".rstrip())
    return known[name]


def sample_free(
    system: System, key: PRNGKeyArray, n: int, draw: Callable, *, most_rounds: int = 1000
) -> tuple[Float[Array, "N n d"], Float[Array, "N n d"]]:
    """`n` states from `draw(key, count)`, leaving out those in which a contact is closed (rejection)."""
    size = max(4 * n, 1024)
    closed = eqx.filter_jit(lambda x: jnp.any(system.gaps(x) < 0, axis=-1))
    kept: list[tuple[np.ndarray, np.ndarray]] = []
    count = 0
    for round_key in jax.random.split(key, most_rounds):
        x, v = draw(round_key, size)
        free: Bool[np.ndarray, " size"] = ~np.asarray(closed(x))
        kept.append((np.asarray(x)[free], np.asarray(v)[free]))
        count += int(free.sum())
        if count >= n:
            break
    require(
        count >= n,
        f"only {count} of {n} initial states without contact were found in {most_rounds} rounds of {size}: the bodies "
        "of this system hardly fit. Make them smaller or fewer.",
    )
    x, v = (np.concatenate(parts)[:n] for parts in zip(*kept, strict=True))
    return jnp.asarray(x), jnp.asarray(v)
