"""The System: bodies, constraints, contacts, potential and contact properties in one pytree."""

import abc
import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from carom.checks import as_floats, at_once_if_known, is_share, not_negative, require, require_values
from carom.contact.candidates import Active, Candidates, Contact, active_set, traced_candidates
from carom.contact.impulses import ContactModel, Coulomb, contact_model_of
from carom.contact.joint_limits import DryFriction
from carom.mechanics.bodies import (
    Body,
    BodyTable,
    RigidBody,
    total_inverse_mass_matrix,
    total_mass_matrix,
)
from carom.mechanics.constraints import Constraint, Rigid
from carom.mechanics.dynamics import lagrangian_field
from carom.mechanics.forces import (
    Actuators,
    Coordinates,
    Force,
    JointDamping,
    JointSpring,
    PointDrag,
    Rotors,
    signal_of,
)
from carom.mechanics.joints import Joints
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
    - `constraints`: `Joints`, `Distance`, `Tether`, `Joint`, `Pivot`, `Angles`, `Track` objects between points; a rigid
      body's own are added. The coordinates of the system's joints are those of its `Joints`, in this order.
    - `contacts`: `DiskDisk`, `DiskPlane`, `RimPlane`, `CornerPlane`, `BallPlane`, `BallBall`, `BendLimit`,
      `StretchLimit` objects; those without a contact are left out.
    - `potential`: a `Potential`, such as `Gravity((0., -9.81))`; none by default.
    - `forces`: `JointSpring`, `JointDamping`, `Actuators`, `BodyDrag` and other forces; one `Actuators` at most.
    - `rotors`: inertias behind gears, or the armature (q,) of each coordinate of the joints (kg m^2, kg).
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
    forces: tuple[Force, ...]
    rotors: Rotors | None
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
        forces: Sequence[Force] = (),
        rotors: Rotors | ArrayLike | None = None,
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
        self.forces, self.rotors = tuple(forces), self._rotors(rotors)
        firsts = [p for p, body in zip(table.center, self.bodies, strict=True) if isinstance(body, RigidBody)]
        for part in (*self.joints, *self.forces):
            for p in (getattr(part, name, None) for name in ("i", "j", "first")):
                require(
                    p is None or p in firsts,
                    f"{type(part).__name__} names the point {p}, which is no rigid body's first: those are {firsts}.",
                )
            far = [p for p in getattr(part, "points", ()) if p >= table.n_points] if isinstance(part, PointDrag) else []
            require(not far, f"PointDrag names the points {far}, but the system has {table.n_points}.")
        held = [joint.i for joint in self.joints]
        require(len(set(held)) == len(held), "a body has two Joints: give all its joints in one.")
        motors = [force for force in self.forces if isinstance(force, Actuators)]
        require(len(motors) <= 1, f"forces may hold one Actuators object; they held {len(motors)}. Join them.")
        for motor in motors:
            require(
                motor.gears.shape[1] == self.n_coordinates,
                f"Actuators gears must have a column for each of {self.n_coordinates} coordinates of joints; they had "
                f"{motor.gears.shape[1]}.",
            )
        for force in self.forces:
            for name in ("stiffness", "rest", "deadband", "viscous", "quadratic", "cubic"):
                size = np.shape(getattr(force, name, 0.0))
                own = getattr(force, "gears", None)
                count = self.n_coordinates if own is None else own.shape[0]
                require(
                    not isinstance(force, JointSpring | JointDamping) or size in ((), (count,)),
                    f"{type(force).__name__} {name} must be one number or {count}; its shape was {size}.",
                )
        for contact in self.contacts:
            used = [b for bodies in contact.bodies_of() for b in bodies]
            require(
                all(0 <= b < len(self.bodies) for b in used),
                f"{type(contact).__name__} refers to the bodies {sorted(set(used))}, but the system has "
                f"{len(self.bodies)} (0 to {len(self.bodies) - 1}).",
            )
        self.friction, self.restitution = _properties(friction, restitution, self._property_index())
        self._check_dry_friction()
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

    def _rotors(self, rotors) -> Rotors | None:
        if rotors is None or isinstance(rotors, Rotors):
            found = rotors
        else:
            armature = np.asarray(rotors, float)
            require(
                armature.shape == (self.n_coordinates,) and bool(np.all(armature >= 0)),
                f"rotors must be Rotors, or zero or positive armatures of {self.n_coordinates} coordinates of joints; "
                f"they were {armature.tolist()}.",
            )
            there = np.flatnonzero(armature)
            found = Rotors(np.eye(len(armature))[there], armature[there]) if len(there) else None
        require(
            found is None or found.gears.shape[1] == self.n_coordinates,
            f"rotors must have a column of gears for each of {self.n_coordinates} coordinates of joints.",
        )
        return found

    def _check_dry_friction(self) -> None:
        require(
            not any(isinstance(contact, DryFriction) for contact in self.contacts)
            or (isinstance(self.contact_model, Coulomb) and self.compensation == "mass"),
            'DryFriction needs the contact model "coulomb" and compensation "mass"; use these, or leave it out.',
        )

    def _with(self, name: str, value) -> "System":
        new = object.__new__(System)
        for field in dataclasses.fields(self):
            object.__setattr__(new, field.name, value if field.name == name else getattr(self, field.name))
        if name in ("contact_model", "compensation"):
            new._check_dry_friction()
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

    def dry_friction(self) -> tuple[np.ndarray, Float[Array, " C"]]:
        """Which contacts are dry friction of joints, and what they can hold (N m, N)."""
        parts = [(isinstance(contact, DryFriction), contact) for contact in self.contacts]
        dry = np.array([is_dry for is_dry, contact in parts for _ in contact.property_index], bool)
        none = [jnp.zeros(0, self.friction.dtype)]
        loss = [getattr(c, "loss", jnp.zeros(len(c.property_index), self.friction.dtype)) for _, c in parts]
        return dry, jnp.concatenate(none + loss)

    def _property_index(self) -> np.ndarray:
        return np.array([p for contact in self.contacts for p in contact.property_index], dtype=int)

    # --- joints -----------------------------------------------------------------------------------------------

    @property
    def joints(self) -> tuple[Joints, ...]:
        """The joints among the constraints."""
        return tuple(link for link in self.links if isinstance(link, Joints))

    @property
    def n_coordinates(self) -> int:
        """Number of coordinates q of all joints."""
        return sum(joint.count for joint in self.joints)

    @property
    def coordinate_names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(name for joint in self.joints for name in joint.coordinate_names())

    @property
    def actuators(self) -> Actuators | None:
        """Its motors, if it has some."""
        return next((force for force in self.forces if isinstance(force, Actuators)), None)

    def joint_positions(self, x: Float[Array, "*t n d"]) -> Float[Array, "*t q"]:
        """Coordinates of the joints (rad, m) of a state, or of states along leading axes, see `Joints`.

        Along the last of these, which is time, angles of hinges go on over full turns.
        """
        if x.ndim > 2:
            q = jax.vmap(self.joint_positions)(x)
            hinges = np.array([is_hinge for joint in self.joints for is_hinge in joint.is_hinge()], bool)
            return jnp.where(hinges, jnp.unwrap(q, axis=-2), q) if x.ndim == 3 and q.shape[-1] else q
        return jnp.concatenate([joint.coordinates(x) for joint in self.joints] or [jnp.zeros(0, x.dtype)])

    def joint_velocities(self, x: Float[Array, "*t n d"], v: Float[Array, "*t n d"]) -> Float[Array, "*t q"]:
        """Rates of the joints' coordinates (rad/s, m/s); of balls and free bodies, angular velocities."""
        if x.ndim > 2:
            return jax.vmap(self.joint_velocities)(x, v)
        return jnp.concatenate([joint.rates(x, v) for joint in self.joints] or [jnp.zeros(0, x.dtype)])

    def state_from_joints(self, q, rates=None) -> tuple[Float[Array, "*t n d"], Float[Array, "*t n d"]]:
        """Positions (m) and velocities (m/s) of the points where the joints have these coordinates and rates, (*t, q).

        **Raises:** `CaromError` for shapes that do not fit, and for a body that no joint holds.
        """
        q = jnp.asarray(q, float)
        rates = jnp.zeros_like(q) if rates is None else jnp.asarray(rates, float)
        count = self.n_coordinates
        require(
            q.shape == rates.shape and q.shape[-1:] == (count,),
            f"q and rates must have {count} coordinates of joints in their last axis; their shapes were {q.shape} and "
            f"{rates.shape}.",
        )
        if q.ndim > 1:
            return jax.vmap(self.state_from_joints)(q, rates)

        def points(change):
            poses, first = {None: (jnp.eye(self.dim, dtype=q.dtype), jnp.zeros(self.dim, q.dtype))}, 0
            spans = {}
            for joint in self.joints:
                spans[joint.i] = joint, slice(first, first + joint.count)
                first += joint.count
            missing = [k for k, center in enumerate(self.table.center) if center not in spans]
            require(not missing, f"state_from_joints needs joints for every body; the bodies {missing} have none.")

            def pose(i):
                if i not in poses:
                    joint, span = spans[i]
                    poses[i] = joint.pose(q[span], *pose(joint.j), change[span])
                return poses[i]

            parts = [pose(i) for i in self.table.center]
            return jnp.concatenate([jnp.concatenate([place[None], place + turn.T]) for turn, place in parts])

        return jax.jvp(points, (jnp.zeros_like(q),), (rates,))

    # --- mechanics --------------------------------------------------------------------------------------------

    def mass_matrix(self) -> Float[Array, "n n"]:
        """Mass matrix (kg) over points; it acts on each axis alike."""
        return total_mass_matrix(self.bodies, self.dim)

    def inverse_mass_matrix(self) -> Float[Array, "n n"]:
        """Its inverse (1/kg), in closed form."""
        return total_inverse_mass_matrix(self.bodies, self.dim)

    def kinetic_energy(self, v: Float[Array, "n d"]) -> Float[Array, ""]:
        """`1/2 v^T M v` (J) of the bodies; rotors have their own."""
        return jnp.sum(v * (self.mass_matrix() @ v)) / 2

    def rotor_energy(self, x: Float[Array, "n d"], v: Float[Array, "n d"]) -> Float[Array, ""]:
        """Kinetic energy (J) of the rotors."""
        if self.rotors is None:
            return jnp.zeros((), x.dtype)
        return jnp.sum(self.rotors.inertia * self.rotor_rates(x, v) ** 2) / 2

    @property
    def rotor_terms(self) -> tuple[Callable, Float[Array, " r"]] | None:
        """What the equations of motion need of the rotors: `rotor_rates` and inertias."""
        return None if self.rotors is None else (self.rotor_rates, self.rotors.inertia)

    def rotor_rates(self, x: Float[Array, "n d"], v: Float[Array, "n d"]) -> Float[Array, " r"]:
        """How fast the rotors turn (rad/s); linear in `v`."""
        return jnp.zeros(0, x.dtype) if self.rotors is None else self.rotors.gears @ self.joint_velocities(x, v)

    def potential_energy(self, x: Float[Array, "n d"]) -> Float[Array, ""]:
        """`V(x)` (J), with that of springs of joints."""
        energy = self.potential(x, self.mass_matrix())
        if not any(type(force).energy is not Force.energy for force in self.forces):
            return energy
        q = self.joint_positions(x)
        return energy + sum((force.energy(q) for force in self.forces), jnp.zeros((), x.dtype))

    def other_forces(
        self, x: Float[Array, "n d"], v: Float[Array, "n d"], signal: Float[Array, " u"] | None = None
    ) -> Float[Array, "n d"]:
        """Forces (N) on the points beside those of the potential: of joints, actuators and bodies.

        `signal`: what actuators are driven with, see `Actuators`; nothing by default.
        """
        total = jnp.zeros_like(x)
        for force in self.forces:
            if type(force).on_points is not Force.on_points:
                total = total + force.on_points(x, v)
        of_joints = [force for force in self.forces if type(force).torque is not Force.torque]
        if not of_joints:
            return total
        motors = self.actuators
        if signal is None:
            signal = jnp.zeros(0 if motors is None else motors.count, x.dtype)
        rates, back = jax.vjp(lambda v: self.joint_velocities(x, v), v)
        at = Coordinates(self.joint_positions(x), rates)
        torque = sum((force.torque(at, signal) for force in of_joints), jnp.zeros_like(rates))
        return total + back(torque)[0]

    def acceleration(
        self, x: Float[Array, "n d"], v: Float[Array, "n d"], control: Float[Array, " u"] | None = None
    ) -> Float[Array, "n d"]:
        """Accelerations (m/s^2) of the points without contact, with `control` of the actuators, by default none.

        What has dynamics is taken to have followed its control, or, where it integrates, to stand at it.
        """
        motors = self.actuators
        signal = None
        if motors is not None:
            control = jnp.zeros(motors.count, x.dtype) if control is None else jnp.asarray(control, x.dtype)
            held = jnp.clip(control, motors.control_range[:, 0], motors.control_range[:, 1])
            signal = signal_of(motors, control, held).start
        return lagrangian_field(
            x,
            v,
            force=self.other_forces(x, v, signal) - jax.grad(self.potential_energy)(x),
            inverse_mass=self.inverse_mass_matrix(),
            constraints=self.constraints,
            rotors=self.rotor_terms,
        )[1]

    def dissipation(self, x: Float[Array, "*t n d"], v: Float[Array, "*t n d"]) -> Float[Array, "*t"]:
        """Power (W) that damping, drag and fluids take from a state, or from states along leading axes."""
        if x.ndim > 2:
            return jax.vmap(self.dissipation)(x, v)
        alone = self._with("forces", tuple(force for force in self.forces if force.dissipates()))
        return -jnp.sum(alone.other_forces(x, v) * v)

    def joint_accelerations(
        self, x: Float[Array, "n d"], v: Float[Array, "n d"], acceleration: Float[Array, "n d"]
    ) -> Float[Array, " q"]:
        """How fast the rates of the joints' coordinates change (rad/s^2, m/s^2)."""
        return jax.jvp(self.joint_velocities, (x, v), (v, acceleration))[1]

    def energy(self, x: Float[Array, "*t n d"], v: Float[Array, "*t n d"]) -> Float[Array, "*t"]:
        """Total energy (J) of a state, or of states along leading axes."""
        if x.ndim > 2:
            return jax.vmap(self.energy)(x, v)
        return self.kinetic_energy(v) + self.rotor_energy(x, v) + self.potential_energy(x)

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
