"""Everything that a System holds and that can be learned, fixed or tied: the registry of quantities, and choices of it.

A quantity is one number, called `kind:which`: `friction:0`, `radius:1`, `gravity:y`. It is chosen by its name, by the
beginning of it (`friction` is every `friction:...`), or by a pattern with `*` and `?`. What ends in `=`, or is joined
by it, is tied: `radius:*=` is one value for all radii, `friction:0=friction:2` one for two properties.
"""

import difflib
from collections.abc import Callable, Iterable, Iterator, Sequence
from fnmatch import fnmatchcase

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, require
from carom.errors import CaromError
from carom.learning.unknowns.body_quantities import (
    force_quantities,
    inertia_quantities,
    mass_quantities,
    model_quantities,
    property_quantities,
    radius_quantities,
    with_field,
)
from carom.learning.unknowns.force_quantities import force_quantities as joint_force_quantities
from carom.learning.unknowns.geometry_quantities import (
    anchor_quantities,
    limit_quantities,
    plane_quantities,
    rod_quantities,
)
from carom.learning.unknowns.quantity import Quantity
from carom.learning.unknowns.shape_quantities import shape_quantities
from carom.system import System

FINDERS: tuple[Callable[[System], Iterator[Quantity]], ...] = (
    mass_quantities,  # before inertia: moments go with a mass, and are then set
    inertia_quantities,
    property_quantities,
    model_quantities,
    force_quantities,
    joint_force_quantities,
    radius_quantities,
    plane_quantities,
    shape_quantities,
    limit_quantities,
    rod_quantities,
    anchor_quantities,
)
"""A finder yields quantities of one kind, in the order in which they are put into a system."""
HINTS = {
    "mass": "a single body has no ratio of masses",
    "friction_loss": "it belongs to the contact model coulomb",
    "restitution_loss": "it belongs to the contact model coulomb",
    "loss_speed": "it belongs to the contact model coulomb",
    "epsilon": "it belongs to the contact model cmr",
}
"""Why a system may not have what others have."""


def quantities(system: System) -> tuple[Quantity, ...]:
    """Everything that can be learned of a system, which must not be traced."""
    return tuple(quantity for find in FINDERS for quantity in find(system))


def matches(pattern: str, name: str) -> bool:
    """Whether a name is chosen by a pattern: the name itself, the beginning of it, or with `*` and `?`."""
    return fnmatchcase(name, pattern) or fnmatchcase(name, f"{pattern}:*")


class Learned(eqx.Module):
    """Quantities that are learned of a system, as one vector of free numbers `theta` (P,).

    `skeleton`: the system, with all that is not learned; where a uniform field is learned of a system that has none, it
    has one of zero. `groups`: the quantities behind each free number, several where they are tied.
    """

    skeleton: System
    groups: tuple[tuple[Quantity, ...], ...]
    names: tuple[str, ...] = eqx.field(static=True)

    @classmethod
    def chosen(cls, system: System, names: Iterable[str], fix: Iterable[str] = ()) -> "Learned":
        """Those chosen by `names`, but for those chosen by `fix`: see the top of this file.

        **Raises:** `CaromError` for names of nothing that the system has, numbers that would be learned twice, and ties
        between different things.
        """
        skeleton = with_field(system)
        every, names = quantities(skeleton), tuple(names)
        fixed = {q.name for pattern in fix for q in _those(pattern, every)}
        tied, owner = [], {}
        for name in (name for name in names if "=" in name):
            group = tuple(q for q in _tied(name, every) if q.name not in fixed)
            for quantity in group:
                require(quantity.name not in owner, f"{quantity.name} is tied twice, by {name!r} too: tie it once.")
                owner[quantity.name] = len(tied)
            tied.append((name.rstrip("="), group))
        wanted = {q.name for name in names if "=" not in name for q in _those(name, every)} - fixed
        chosen, seen = [], set()
        for quantity in every:
            number = owner.get(quantity.name)
            if number is not None and number not in seen:
                seen.add(number)
                chosen.append(tied[number])
            elif number is None and quantity.name in wanted:
                chosen.append((quantity.name, (quantity,)))
        groups = tuple(group for _, group in chosen)
        _check_parts(groups)
        uses_field = any(q.label.kind.startswith("gravity") for group in groups for q in group)
        return cls(skeleton if uses_field else system, groups, tuple(name for name, _ in chosen))

    def with_field_scale(self, acceleration: float) -> "Learned":
        """With this change (m/s^2) of a uniform field for one that matters, or a hundredth of the field, if more.

        How strong a field may be that nobody told is known by what moves in it.
        """
        fields = [q for q in quantities(self.skeleton) if q.label.kind == "gravity"]
        told = np.linalg.norm([float(q.value(self.skeleton)) for q in fields])
        scale = max(acceleration, 0.01 * told)

        def scaled(quantity: Quantity) -> Quantity:
            if not (quantity.label.kind.startswith("gravity") and scale > 0):
                return quantity
            return eqx.tree_at(lambda q: q.scale, quantity, as_floats(scale))

        return Learned(self.skeleton, tuple(tuple(map(scaled, group)) for group in self.groups), self.names)

    def with_max_active(self, max_active: int) -> "Learned":
        """With room for so many closed contacts; see `System`."""
        return Learned(self.skeleton.with_max_active(max_active), self.groups, self.names)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """The first of each group."""
        return tuple(group[0] for group in self.groups)

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of each."""
        return tuple(q.unit for q in self.quantities)

    @property
    def of(self) -> tuple[str, ...]:
        """What each belongs to, in words."""
        return tuple("; ".join(q.of for q in group) for group in self.groups)

    @property
    def scale(self) -> Float[Array, " P"]:
        """A change of each free number that matters."""
        return self._vector(q.scale for q in self.quantities)

    @property
    def lower(self) -> Float[Array, " P"]:
        """Lower bounds of the free numbers."""
        return self._vector(q.to_free(q.lower) for q in self.quantities)

    @property
    def upper(self) -> Float[Array, " P"]:
        """Upper bounds of the free numbers."""
        return self._vector(q.to_free(q.upper) for q in self.quantities)

    def free(self, system: System | None = None) -> Float[Array, " P"]:
        """The free numbers of a system of the skeleton's structure (by default, of itself); of tied ones, the mean."""
        system = self.skeleton if system is None else system
        return self._vector(jnp.mean(jnp.stack([q.to_free(q.value(system)) for q in group])) for group in self.groups)

    def assemble(self, theta: Float[Array, " P"], skeleton: System | None = None) -> System:
        """The system with these free numbers. `skeleton`: another one of the same structure to put them into."""
        system = self.skeleton if skeleton is None else skeleton
        for free, group in zip(theta, self.groups, strict=True):
            for quantity in group:
                system = quantity.put(system, quantity.from_free(free))
        return system

    def physical(self, theta: Float[Array, " P"]) -> Float[Array, " P"]:
        """The values that free numbers stand for, each in its unit."""
        return self._vector(q.from_free(free) for q, free in zip(self.quantities, theta, strict=True))

    def project(self, theta: Float[Array, " P"]) -> Float[Array, " P"]:
        """The nearest free numbers within the bounds."""
        return jnp.clip(theta, self.lower.astype(theta.dtype), self.upper.astype(theta.dtype))

    def at_bounds(self, theta: Float[Array, " P"], share: float = 0.2) -> Float[Array, " P"]:
        """Free numbers that are nearer to a bound than a `share` of their scale, moved onto it: data seldom tell."""
        lower, upper, near = (part.astype(theta.dtype) for part in (self.lower, self.upper, share * self.scale))
        return jnp.where(theta < lower + near, lower, jnp.where(theta > upper - near, upper, theta))

    def _vector(self, parts: Iterable[Array]) -> Float[Array, " P"]:
        found = list(parts)
        return jnp.stack(found) if found else jnp.zeros(0, self.skeleton.friction.dtype)


def describe(system: System) -> list[tuple[str, str, str, str]]:
    """Rows of a table of everything that can be learned of a system: name, what it belongs to, value, unit."""
    system = with_field(system)
    return [(q.name, q.of, f"{float(q.value(system)):.6g}", q.unit) for q in quantities(system)]


def _those(pattern: str, every: Sequence[Quantity]) -> list[Quantity]:
    """All that a pattern chooses; at least one."""
    found = [q for q in every if matches(pattern, q.name)]
    if found:
        return found
    kinds = list(dict.fromkeys(q.label.kind for q in every))
    near = difflib.get_close_matches(pattern.split(":")[0], kinds, n=1, cutoff=0.6)
    kind = pattern.split(":")[0]
    why = f" ({HINTS[kind]})" if kind in HINTS and kind not in kinds else ""
    hint = f" Did you mean {near[0]!r}?" if near and near[0] != kind else ""
    raise CaromError(f"{pattern!r} is nothing that can be learned of this system{why}: it has {_listed(every)}.{hint}")


def _listed(every: Sequence[Quantity]) -> str:
    """Names, by kind: `friction:0,1`."""
    by_kind: dict[str, list[str]] = {}
    for quantity in every:
        by_kind.setdefault(quantity.label.kind, []).append(quantity.label.which)
    few = 4
    return ", ".join(
        kind if which == [""] else f"{kind}:{','.join(which)}" if len(which) <= few else f"{kind}:* ({len(which)})"
        for kind, which in by_kind.items()
    )


def _tied(name: str, every: Sequence[Quantity]) -> tuple[Quantity, ...]:
    """All that is tied by a name that ends in `=` or is joined by it."""
    group = tuple({q.name: q for part in name.split("=") if part for q in _those(part, every)}.values())
    alike = {(q.unit, q.label.log) for q in group}
    require(
        len(alike) == 1,
        f"{name!r} ties different things, {group[0].name} and {group[-1].name}: tie what has one unit.",
    )
    return group


def _check_parts(groups: Sequence[Sequence[Quantity]]) -> None:
    names = {q.name for group in groups for q in group}
    for quantity in (q for group in groups for q in group):
        whole = quantity.label.part_of
        require(whole not in names, f"{quantity.name} is a part of {whole}: learn one of them, or `fix` one.")
