"""How contacts change the velocity at one time, and what says how to step."""

from collections.abc import Callable
from typing import Literal, get_args

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.checks import positive, require, require_values
from carom.contact.energy import dissipative
from carom.contact.impulses import ContactState, Jump, consistent_velocity, target_velocity
from carom.mechanics.dynamics import FIELDS, Formulation, saddle_point
from carom.mechanics.forces import Signal, signal_of
from carom.simulation.integrators import RK4, flow
from carom.simulation.projection import project_state
from carom.system import System

ImpactRule = Literal["step", "event"]
"""When contacts act: at the end of a step in which they close, or at the time at which they do."""
IMPACT_RULES = get_args(ImpactRule)

COMPENSATION_STEPS = 8.0
"""Time steps over which a penetration is undone, by default (paper, appendix G)."""


MAX_EVENTS = 24
"""Times at which a step is cut at most, by default, by the rule of events."""


def check_compensation_steps(steps: float | Float[Array, ""] | None) -> None:
    """Raise `CaromError` unless `steps` is a positive number, or `None` for no compensation."""
    if steps is None:
        return
    require(np.shape(steps) == (), f"compensation_steps must be one number; its shape was {np.shape(steps)}.")
    require_values("compensation_steps", steps, positive, "a positive number, or None for no compensation")


def _as_steps(steps) -> Float[Array, ""] | None:
    return None if steps is None else jnp.asarray(steps, float)


class Stepper(eqx.Module):
    """How to step: everything but the system and its state.

    `consistent` matters where states are not projected: a violation of the joints then does not enter contacts whose
    impulses are not unique (see `consistent_velocity`). The paper's simulator lets it, which gives jumps that hang on
    the drift, and derivatives that training cannot use.
    """

    dt: Float[Array, ""]
    formulation: Formulation = eqx.field(static=True, default="lagrangian")
    solver: diffrax.AbstractSolver = eqx.field(default_factory=RK4)
    project: bool = eqx.field(static=True, default=True)
    compensation_steps: Float[Array, ""] | None = eqx.field(default=COMPENSATION_STEPS, converter=_as_steps)
    smoothing: float = eqx.field(static=True, default=0.0)
    contact: bool = eqx.field(static=True, default=True)
    consistent: bool = eqx.field(static=True, default=False)
    impact: ImpactRule = eqx.field(static=True, default="step")
    events: int = eqx.field(
        static=True, default=MAX_EVENTS
    )  # most impacts that a step is cut at, where `impact` is "event"


class StepResult(eqx.Module):
    """State after a step, whether a contact was closed, and how the contact solver fared."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    contact: Bool[Array, ""]
    overflow: Int[Array, ""]
    residual: Float[Array, ""]


def smooth_flow(
    system: System, stepper: Stepper, inverse_mass: Float[Array, "n n"], force=None, signal: Signal | None = None
) -> tuple[Callable, Callable]:
    """The motion between impacts, as two functions of a state `(x, v)`: its rate, and the state after a time (s).

    Both take the forces of contacts that last, if any: (C, d) in N, in the frame of each candidate (normal first); and
    the time (s) since the step began, which only what `signal` drives hangs on.
    """
    field = FIELDS[stepper.formulation]
    motors = system.actuators
    if signal is None and motors is not None:
        none = jnp.zeros(motors.count, inverse_mass.dtype)
        signal = signal_of(motors, none, none)

    def rate(state, pressing=None, since=0.0):
        x, v = state
        total = -jax.grad(system.potential_energy)(x)
        if system.forces:
            total = total + system.other_forces(x, v, None if signal is None else signal.at(since))
        if force is not None:
            total = total + force
        if pressing is not None:
            total = total + contact_force(system, x, pressing)
        terms = {} if system.rotors is None else {"rotors": system.rotor_terms}
        return field(x, v, force=total, inverse_mass=inverse_mass, constraints=system.constraints, **terms)

    # Each is traced once: a step calls them a dozen times, within loops that are transformed several times.
    once = jax.jit(rate)
    moves = signal is not None and system.actuators is not None and set(system.actuators.dynamics) != {"none"}

    def with_clock(state, pressing):
        return (*once(state[:2], pressing, state[2]), jnp.ones_like(state[2]))

    def after(state, time, pressing=None, since=0.0):
        if moves:
            begin = (*state, jnp.asarray(since, state[0].dtype))
            x, v, _ = flow(stepper.solver, lambda state: with_clock(state, pressing), begin, time)
        else:
            x, v = flow(stepper.solver, lambda state: once(state, pressing), state, time)
        return project_state(system.constraints, x, v, inverse_mass) if stepper.project else (x, v)

    return once, jax.jit(after)


def contact_force(system: System, x: Float[Array, "n d"], pressing: Float[Array, "C d"]) -> Float[Array, "n d"]:
    """What forces `pressing` (N) of the candidates, each in its frame, are on the points at `x`: `J_C^T pressing`."""
    candidates = system.candidates(x)
    share = jnp.einsum("cipj,ci->cpj", candidates.rows, pressing)
    return jnp.zeros_like(x).at[candidates.stencil].add(share)


def closed_contacts(
    system: System,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    stepper: Stepper,
    closed: Bool[Array, " C"] | None = None,
) -> ContactState:
    """The contacts that are closed at `x`, and all that a contact model may know of them (S.8 to S.13).

    `closed`: which these are, if not those whose gap is negative. Their target velocity is that of the paper's rule if
    the system compensates penetration so, and none otherwise.
    """
    active = system.active(x, closed)
    k, d = active.jacobian.shape[:2]
    rows = active.jacobian.reshape(k * d, system.n_points, d)
    response = jnp.einsum("ij,rjd->rid", inverse_mass, rows)  # M^-1 J_C^T
    held = system.links or system.rotors is not None
    saddle = saddle_point(system.constraints, x, inverse_mass, system.rotor_terms) if held else None
    if saddle is None:
        delassus = jnp.einsum("rid,sid->rs", rows, response)
    else:
        free = jnp.einsum("rid,rid->r", rows, response)
        response = saddle.project_exactly(response)  # a large impulse shows its rounding
        dry = jnp.asarray(system.dry_friction()[0])[active.candidate] & active.active
        rows, response, delassus = _held(rows, response, free, d, system, x, dry)
    delassus = (delassus + delassus.T) / 2
    velocity = jnp.einsum("rid,id->r", rows, v).reshape(k, d)
    friction = system.friction[active.property_index]
    if saddle is not None and system.rotors is None and stepper.consistent and not stepper.project:
        drift = jnp.einsum("rid,id->r", rows, v - saddle.project(v[None])[0]).reshape(k, d)
        velocity = consistent_velocity(velocity, drift, delassus, friction)
    v_star = jnp.zeros_like(velocity)
    if stepper.compensation_steps is not None and system.compensation == "paper":
        joints = jnp.zeros((0, *x.shape), x.dtype) if saddle is None else saddle.jacobian
        if system.rotors is not None:
            joints = joints[: -system.rotors.inertia.shape[0]]  # they turn
        depth = jnp.where(active.active, jnp.maximum(-active.gap, 0), 0)
        v_star = target_velocity(active.jacobian, depth, joints, time=stepper.dt * compensation_steps_of(stepper))
    return ContactState(
        x=x,
        v=v,
        active=active,
        response=response,
        delassus=delassus,
        velocity=velocity,
        target=v_star,
        friction=friction,
        restitution=system.restitution[active.property_index],
    )


def compensation_steps_of(stepper: Stepper) -> Float[Array, ""]:
    """The steps over which penetration is undone, in the precision of the time step."""
    require(stepper.compensation_steps is not None, "compensation_steps must be a number here; it was None.")
    return jnp.asarray(stepper.compensation_steps, stepper.dt.dtype)


def contact_jump(
    system: System,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    stepper: Stepper,
    closed: Bool[Array, " C"] | None = None,
) -> tuple[ContactState, Jump]:
    """The contacts that are closed at `x`, and how an impact there changes the velocity (S.8 to S.15).

    `closed`: which these are, if not those whose gap is negative. An impact adds no energy, but for the target velocity
    of the paper's rule.
    """
    contacts = closed_contacts(system, x, v, inverse_mass, stepper, closed)
    jump = system.contact_model(contacts, smoothing=stepper.smoothing)
    return contacts, jump if system.compensation == "paper" else dissipative(contacts, jump)


def _held(
    rows: Float[Array, "r n d"],
    response: Float[Array, "r n d"],
    free: Float[Array, " r"],
    d: int,
    system: System,
    x: Float[Array, "n d"],
    dry: Bool[Array, " K"],
) -> tuple[Float[Array, "r n d"], Float[Array, "r n d"], Float[Array, "r r"]]:
    """Rows and responses `R = M^^-1 J_C^T` of contacts on bodies that joints hold, and their Delassus matrix.

    The matrix is taken as the square that it is, `R^T M R`. `J_C R`, in which joints may leave little of `free`, the
    diagonal without them, has the rounding of that and would not be positive semi-definite.

    A contact whose normal the joints hold for themselves, as below a pendulum that hangs straight, can do nothing: of
    its mobility there is rounding, the share eps of `free`, and an impulse over that would be any. It becomes padding.
    """
    delassus = jnp.einsum("rid,sid->rs", response, jnp.einsum("ij,sjd->sid", system.mass_matrix(), response))
    if system.rotors is not None:
        turning = jax.vmap(lambda v: system.rotor_rates(x, v))(response)
        delassus = delassus + (turning * system.rotors.inertia) @ turning.T
    # Dry friction has no normal, but a tangent.
    moves = jnp.where(
        dry,
        jnp.diagonal(delassus)[1::d] > jnp.finfo(free.dtype).eps * free[1::d],
        jnp.diagonal(delassus)[::d] > jnp.finfo(free.dtype).eps * free[::d],
    )
    moves = jnp.repeat(moves, d)
    both = jnp.asarray(moves[:, None] & moves)
    rows, response = (jnp.asarray(jnp.where(moves[:, None, None], part, 0)) for part in (rows, response))
    return rows, response, jnp.asarray(jnp.where(both, delassus, 0))


def has_impulses(system: System, x: Float[Array, "n d"], v: Float[Array, "n d"], stepper: Stepper) -> bool:
    """Whether the contact model tells the impulses of contacts: one that does not cannot hold contacts that last."""

    def impulses(x, v):
        return contact_jump(system, x, v, system.inverse_mass_matrix(), stepper)[1].impulse

    return jax.eval_shape(impulses, x, v) is not None


def impact_at(
    system: System, x: Float[Array, "n d"], v: Float[Array, "n d"], inverse_mass: Float[Array, "n n"], stepper: Stepper
) -> StepResult:
    """Let the contacts that are closed at `x` change the velocity."""
    contacts, jump = contact_jump(system, x, v, inverse_mass, stepper)
    active = contacts.active
    return StepResult(
        x=contacts.x,
        v=contacts.v + jump.velocity,
        contact=jnp.any(active.active),
        overflow=active.overflow,
        residual=jump.residual,
    )
