"""The unknowns as one vector: masses, contact properties, and the weights in which the potential is linear."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from carom.learning.unknowns.models import NeuralPotential, Unknowns
from carom.system import System

PHYSICAL = {
    "log_mass_ratio": (-np.inf, np.inf),
    "friction": (0.0, np.inf),
    "restitution": (0.0, 1.0),
    "log_epsilon": (np.log(1e-9), np.log(10.0)),
}
"""The physical parameters, in their order in a vector, and the bounds of each."""
AT_BOUND = 0.02
"""Frictions and restitutions so near to a bound, which data seldom tell apart from it, are tried there."""
_FREE = 1e-6
"""Precision of the weights that are no network's, as a share of those that are."""


def unknowns_of(system: System, learned: Sequence[str]) -> Unknowns:
    """The values of a learned system as `Unknowns`."""
    potential = system.potential if isinstance(system.potential, NeuralPotential) else None
    return Unknowns(
        log_mass_ratio=jnp.log(system.masses[1:] / system.masses[0]) if "mass" in learned else None,
        friction=system.friction if "friction" in learned else None,
        restitution=system.restitution if "restitution" in learned else None,
        potential=potential if "potential" in learned else None,
    )


def physical(unknowns: Unknowns) -> dict[str, Array]:
    """Those that are unknown."""
    parts = {name: getattr(unknowns, name) for name in PHYSICAL}
    return {name: part for name, part in parts.items() if part is not None}


def physical_vector(unknowns: Unknowns) -> Float[np.ndarray, " p"]:
    """The physical parameters that are unknown."""
    parts = (np.asarray(part, float).reshape(-1) for part in physical(unknowns).values())
    return np.concatenate([np.zeros(0), *parts])


def bounds(unknowns: Unknowns) -> list[Float[np.ndarray, " p"]]:
    """Lower and upper bounds of the physical parameters."""
    sizes = {name: part.size for name, part in physical(unknowns).items()}
    return [
        np.concatenate([np.zeros(0), *(np.full(size, PHYSICAL[name][k]) for name, size in sizes.items())])
        for k in range(2)
    ]


def linear_weights(unknowns: Unknowns) -> Float[np.ndarray, " W"]:
    """All weights in which the potential is linear; none without one."""
    parts = () if unknowns.potential is None else unknowns.potential.linear_weights()
    return np.concatenate([np.zeros(0), *(np.asarray(w, float).ravel() for w in parts)])


def ridge(unknowns: Unknowns) -> Float[np.ndarray, " W"]:
    """Precision of a prior on the linear weights: those of the network are of the size that they begin with."""
    if unknowns.potential is None:
        return np.zeros(0)
    sizes = [w.size for w in unknowns.potential.linear_weights()]
    output = 0 if unknowns.potential.network is None else sizes[0]
    share = np.where(np.arange(sum(sizes)) < output, 1.0, _FREE)
    return 3 * max(output, 1) * share  # uniform within +-1 / sqrt(output)


def moved(unknowns: Unknowns, features: Float[ArrayLike, "W F"], change: Float[ArrayLike, " p_and_F"]) -> Unknowns:
    """The unknowns, changed: physical parameters first, then linear weights along `features`. May be traced."""
    out, first, change = unknowns, 0, jnp.asarray(change)
    for name, part in physical(out).items():
        step = change[first : first + part.size].reshape(part.shape)
        out = eqx.tree_at(lambda u, name=name: getattr(u, name), out, (part + step).astype(part.dtype))
        first += part.size
    return out if out.potential is None else with_weights(out, jnp.asarray(features) @ change[first:])


def with_weights(unknowns: Unknowns, change: Float[ArrayLike, " W"]) -> Unknowns:
    """The unknowns with the potential's linear weights changed. May be traced."""
    assert unknowns.potential is not None
    old = unknowns.potential.linear_weights()
    by = jnp.split(jnp.asarray(change), np.cumsum([w.size for w in old])[:-1])
    new = tuple((jnp.asarray(w, d.dtype) + d.reshape(w.shape)).astype(w.dtype) for w, d in zip(old, by, strict=True))
    return eqx.tree_at(lambda u: u.potential, unknowns, unknowns.potential.with_linear_weights(new))


def at_bounds(unknowns: Unknowns) -> Unknowns:
    """Frictions and restitutions moved onto a bound that is near."""
    for name in ("friction", "restitution"):
        lower, upper = PHYSICAL[name]
        value = getattr(unknowns, name)
        if value is not None:
            value = jnp.select([value < lower + AT_BOUND, value > upper - AT_BOUND], [lower, upper], value)
            value = jnp.asarray(value, getattr(unknowns, name).dtype)
            unknowns = eqx.tree_at(lambda u, name=name: getattr(u, name), unknowns, value)
    return unknowns
