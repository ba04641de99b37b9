"""The System: bodies, constraints, contacts, potential and contact properties in one pytree."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from carom.checks import as_floats, at_once_if_known, is_share, not_negative, require, require_values
from carom.contact.candidates import Active, Candidates, Contact, active_set, traced_candidates
from carom.contact.impulses import ContactModel, contact_model_of
from carom.mechanics.bodies import (
    Body,
    BodyTable,
    RigidBody,
    total_inverse_mass_matrix,
    total_mass_matrix,
)
from carom.mechanics.constraints import Constraint, Rigid
from carom.mechanics.potentials import NoPotential, Potential

Compensation = Literal["mass", "paper"]
"""How steps undo penetration, and whether contact that lasts acts over them: see docs/contact.md."""
COMPENSATIONS = get_args(Compensation)


class StepModel(eqx.Module):
    """A law for a whole time step, in place of the equations of motion and the contact model: a network, say."""

    @abc.abstractmethod
    def __call__(
        self, system: "System", x: Float[Array, "n d"], v: Float[Array, "n d"], dt: Float[Array, ""]
    ) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
        """Positions (m) and velocities (m/s) after a step of `dt` (s)."""


class System(eqx.Module):
    """A mechanical system with contact. True and learned systems are the same type.

    **Arguments:**

    - `bodies`: `PointMass` and `RigidBody` objects; their points are stacked in this order into `x` (n, d).
    - `constraints`: `Distance`, `Tether`, `Joint`, `Pivot`, `Angles`, `Track` objects between points; a rigid body's
      own are added.
    - `contacts`: `DiskDisk`, `DiskPlane`, `RimPlane`, `CornerPlane`, `BallPlane`, `BallBall`, `BendLimit`,
      `StretchLimit` objects; those without a contact are left out.
    - `potential`: a `Potential`, such as `Gravity((0., -9.81))`; none by default.
    - `friction`, `restitution`: contact properties (P,), Coulomb's mu >= 0 and Poisson's e in [0, 1]. A contact refers
      to them by its `property` index; a single number is shared by all.
    - `max_active`: how many contacts can be closed at once (the solver's size). By default as many as there are
      candidates, or twice as many as points where that is less: more are an error, never dropped.
    - `contact_model`: how closed contacts change the velocity: `"coulomb"`, `"cm"` (the paper's), `"cmr"`, `"lcp"`, or
      a `ContactModel`.
    - `compensation`: `"mass"`: contact that lasts acts over the whole step, and penetration is undone by moving bodies,
      in the metric of the mass and without a velocity. `"paper"`: contact acts at the end of a step, and penetration is
      undone by a velocity (appendix G), as the paper's tasks have it.
    - `step_model`: a law for a whole step that replaces forces, constraints and the contact model; none by default.
    - `dim`: 2 or 3, needed only where neither the potential, a contact nor a rigid body tells.
    - `name`: the task's name, for a task's system.

    **Raises:** `CaromError` for negative masses, mu < 0, e outside [0, 1], indices out of range, mixed dimensions, an
    unknown contact model.

    SI units throughout.
    """

    bodies: tuple[Body, ...]
    links: tuple[Constraint, ...]
    contacts: tuple[Contact, ...]
    potential: Potential
    friction: Float[Array, " P"]
    restitution: Float[Array, " P"]
    contact_model: ContactModel
    step_model: StepModel | None
    compensation: Compensation = eqx.field(static=True)
    dim: int = eqx.field(static=True)
    max_active: int = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        bodies: Sequence[Body],
        constraints: Sequence[Constraint] = (),
        contacts: Sequence[Contact] = (),
        potential: Potential | None = None,
        friction: ArrayLike | Sequence[float] = 0.0,
        restitution: ArrayLike | Sequence[float] = 0.0,
        *,
        contact_model: str | ContactModel = "coulomb",
        compensation: Compensation = "mass",
        step_model: StepModel | None = None,
        max_active: int | None = None,
        dim: int | None = None,
        name: str = "",
    ):
        require(len(bodies) > 0, "bodies must hold at least one body; it was empty.")
        # A family without a contact is nothing.
        self.bodies, self.name = tuple(bodies), name
        self.contacts = tuple(contact for contact in contacts if contact.property_index)
        self.potential = NoPotential() if potential is None else potential
        self.contact_model = contact_model_of(contact_model)
        self.step_model = step_model
        self.compensation = _compensation_of(compensation)
        self.dim = _dimension(self.bodies, contacts, self.potential, dim)
        table = self.table
        rigid = [
            Rigid(first, self.dim)
            for first, body in zip(table.center, self.bodies, strict=True)
            if isinstance(body, RigidBody)
        ]
        self.links = (*constraints, *rigid)
        for link in self.links:
            require(
                all(0 <= p < table.n_points for p in link.points()),
                f"{type(link).__name__} refers to the points {link.points()}, but the system has {table.n_points} "
                f"(0 to {table.n_points - 1}).",
            )
        for contact in self.contacts:
            used = [b for bodies in contact.bodies_of() for b in bodies]
            require(
                all(0 <= b < len(self.bodies) for b in used),
                f"{type(contact).__name__} refers to the bodies {sorted(set(used))}, but the system has "
                f"{len(self.bodies)} (0 to {len(self.bodies) - 1}).",
            )
        self.friction, self.restitution = _properties(friction, restitution, self._property_index())
        count = self.n_candidates
        default = count if count <= 4 else min(count, 2 * table.n_points)
        self.max_active = default if max_active is None else min(int(max_active), count)
        require(
            count == 0 or self.max_active > 0,
            f"max_active must be at least 1 in a system with contacts; it was {max_active}.",
        )

    def with_max_active(self, max_active: int) -> "System":
        """The same system with room for another number of closed contacts in the solver."""
        return self._with("max_active", max(1, min(max_active, self.n_candidates)))

    def with_contact_model(self, contact_model: str | ContactModel) -> "System":
        """The same system with another contact model.

        **Raises:** `CaromError` for an unknown one.
        """
        return self._with("contact_model", contact_model_of(contact_model))

    def with_compensation(self, compensation: Compensation) -> "System":
        """The same system with another way to undo penetration.

        **Raises:** `CaromError` for an unknown one.
        """
        return self._with("compensation", _compensation_of(compensation))

    def _with(self, name: str, value) -> "System":
        new = object.__new__(System)
        for field in dataclasses.fields(self):
            object.__setattr__(new, field.name, value if field.name == name else getattr(self, field.name))
        return new

    # --- structure -------------------------------------------------------------------------------------------

    @property
    def table(self) -> BodyTable:
        """Which points belong to which body."""
        return BodyTable.of(self.bodies, self.dim)

    @property
    def n_points(self) -> int:
        """Number of points n."""
        return self.table.n_points

    @property
    def n_candidates(self) -> int:
        """Number of contacts that could be closed."""
        return len(self._property_index())

    @property
    def n_properties(self) -> int:
        """Number of contact properties P."""
        return self.friction.shape[0]

    @property
    def masses(self) -> Float[Array, " bodies"]:
        """Masses of the bodies (kg)."""
        return jnp.stack([body.mass for body in self.bodies])

    @property
    def radii(self) -> Float[Array, " bodies"]:
        """Radii of the bodies (m)."""
        return jnp.stack([body.radius for body in self.bodies])

    def _property_index(self) -> np.ndarray:
        return np.array([p for contact in self.contacts for p in contact.property_index], dtype=int)

    # --- mechanics --------------------------------------------------------------------------------------------

    def mass_matrix(self) -> Float[Array, "n n"]:
        """Mass matrix (kg) over points; it acts on each axis alike."""
        return total_mass_matrix(self.bodies, self.dim)

    def inverse_mass_matrix(self) -> Float[Array, "n n"]:
        """Its inverse (1/kg), in closed form."""
        return total_inverse_mass_matrix(self.bodies, self.dim)

    def kinetic_energy(self, v: Float[Array, "n d"]) -> Float[Array, ""]:
        """`1/2 v^T M v` (J)."""
        return jnp.sum(v * (self.mass_matrix() @ v)) / 2

    def potential_energy(self, x: Float[Array, "n d"]) -> Float[Array, ""]:
        """`V(x)` (J)."""
        return self.potential(x, self.mass_matrix())

    def energy(self, x: Float[Array, "*t n d"], v: Float[Array, "*t n d"]) -> Float[Array, "*t"]:
        """Total energy (J) of a state, or of states along leading axes."""
        if x.ndim > 2:
            return jax.vmap(self.energy)(x, v)
        return self.kinetic_energy(v) + self.potential_energy(x)

    def constraints(self, x: Float[Array, "*t n d"]) -> Float[Array, "*t E"]:
        """`Phi(x)` of all links and rigid bodies, zero where they hold (m^2)."""
        if x.ndim > 2:
            return jax.vmap(self.constraints)(x)
        if not self.links:
            return jnp.zeros(0, x.dtype)
        return jnp.concatenate([link(x) for link in self.links])

    def violation(self, x: Float[Array, "*t n d"]) -> Float[Array, "*t E"]:
        """`Phi(x)` relative to what each constraint holds: twice the share of its length that a rod is off by."""
        if x.ndim > 2:
            return jax.vmap(self.violation)(x)
        if not self.links:
            return jnp.zeros(0, x.dtype)
        size, body_sizes, owner = self.size(x), self._body_sizes(), self._owners()
        parts = []
        for link in self.links:
            own = jnp.max(body_sizes[np.array([owner[p] for p in link.points()])])
            phi = link(x)
            scale = jnp.asarray(link.size(jnp.where(own > 0, own, size)), x.dtype)
            parts.append(phi / jnp.where(scale > 0, scale, 1))
        return jnp.concatenate(parts)

    def size(self, x: Float[Array, "n d"]) -> Float[Array, ""]:
        """A length (m) to compare lengths with: of the largest body, else how far bodies are apart, or from 0."""
        centers = x[jnp.array(self.table.center)]
        apart = jnp.max(jnp.linalg.norm(centers - centers[0], axis=1))
        largest = jnp.max(self._body_sizes()).astype(x.dtype)
        rest = jnp.where(apart > 0, apart, jnp.max(jnp.linalg.norm(centers, axis=1)))
        return jnp.asarray(jnp.where(largest > 0, largest, rest))

    def _body_sizes(self) -> Float[Array, " bodies"]:
        """The larger of radius and radius of gyration (m) of each body; 0 for points."""
        turning = [jnp.sqrt(jnp.sum(b.moments) / b.mass) if isinstance(b, RigidBody) else 0 for b in self.bodies]
        return jnp.stack([jnp.maximum(b.radius, k) for b, k in zip(self.bodies, turning, strict=True)])

    def _owners(self) -> list[int]:
        """The body that each point belongs to."""
        return [k for k, body in enumerate(self.bodies) for _ in range(body.n_points(self.dim))]

    # --- contact ----------------------------------------------------------------------------------------------

    def candidates(self, x: Float[Array, "n d"]) -> Candidates:
        """Gaps (m) and Jacobians of all contacts that could be."""
        return traced_candidates(self.contacts, x, self.radii, self.table)

    def active(self, x: Float[Array, "n d"], closed: Bool[Array, " C"] | None = None) -> Active:
        """The closed contacts at `x`, in order, padded to `max_active`; `closed`: if not by their gaps, which."""
        return active_set(self.candidates(x), self._property_index(), self.max_active, self.n_points, closed)

    def gaps(self, x: Float[Array, "*t n d"]) -> Float[Array, "*t C"]:
        """Gap (m) of every candidate; negative where closed."""
        if x.ndim > 2:
            return jax.vmap(self.gaps)(x)
        if not self.contacts:
            return jnp.zeros(0, x.dtype)
        return self.candidates(x).gap

    def reach(self) -> Float[Array, " C"]:
        """Depth (m) beyond which a contact is not closed but passed through."""
        if not self.contacts:
            return jnp.zeros(0)
        return jnp.concatenate([contact.reach(self.radii) for contact in self.contacts])

    def travel(self) -> Float[Array, " C"]:
        """How much points may move while the gap of a candidate changes smoothly; see `Contact.travel`."""
        return jnp.concatenate([contact.travel(self.radii) for contact in self.contacts])


def _compensation_of(compensation) -> Compensation:
    known = ", ".join(map(repr, COMPENSATIONS))
    require(compensation in COMPENSATIONS, f"compensation must be one of {known}; it was {compensation!r}.")
    return compensation


def _dimension(bodies, contacts, potential, dim) -> int:
    """The one dimension that all parts agree on."""
    said = {} if dim is None else {"dim": dim}
    if potential.dimension() is not None:
        said["potential"] = potential.dimension()
    for contact in contacts:
        if contact.dimension() is not None:
            said[type(contact).__name__] = contact.dimension()
    for body in bodies:
        if isinstance(body, RigidBody):
            said["RigidBody"] = body.moments.shape[0]
    require(
        len(set(said.values())) <= 1,
        f"all parts of a system must have the same dimension; they had {said}. Check the vectors that were given.",
    )
    found = next(iter(said.values()), 2)
    require(found in (2, 3), f"dim must be 2 or 3; it was {found}.")
    return found


def _properties(friction, restitution, index):
    friction, restitution = as_floats(friction), as_floats(restitution)
    with at_once_if_known(friction, restitution):
        friction, restitution = jnp.atleast_1d(friction), jnp.atleast_1d(restitution)
        count = max(friction.shape[0], restitution.shape[0])
        if friction.shape[0] == 1:
            friction = jnp.broadcast_to(friction, (count,))
        if restitution.shape[0] == 1:
            restitution = jnp.broadcast_to(restitution, (count,))
    require(
        friction.shape == restitution.shape and friction.ndim == 1,
        f"friction and restitution must have one value for each property; they had {friction.shape[0]} and "
        f"{restitution.shape[0]}.",
    )
    require_values("friction", friction, not_negative, "at least 0 (Coulomb's mu), and finite")
    require_values("restitution", restitution, is_share, "between 0 and 1")
    wrong = index[(index < 0) | (index >= count)]
    require(
        wrong.size == 0,
        f"a contact's property index must be below the number of friction values ({count}); one was "
        f"{wrong[0] if wrong.size else 0}. Give one friction and restitution for each property.",
    )
    return friction, restitution
