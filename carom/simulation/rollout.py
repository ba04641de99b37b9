"""One time step, and many: `step`, `simulate` and the `Trajectory` they give."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.checks import as_floats, is_known, require, require_values
from carom.contact.impulses import ContactModel
from carom.mechanics.dynamics import FIELDS, Formulation
from carom.simulation.impact import (
    COMPENSATION_STEPS,
    MAX_EVENTS,
    IMPACT_RULES,
    ImpactRule,
    Stepper,
    StepResult,
    check_compensation_steps,
    has_impulses,
    impact_at,
    smooth_flow,
)
from carom.simulation.integrators import RK4
from carom.simulation.segments import step_in_segments
from carom.system import System


class Trajectory(eqx.Module):
    """Motion of a system; a batch of them has leading axes.

    `x`, `v` (..., time, n, d) in m and m/s; `contact` (..., time): the step that ends here had a closed contact; `time`
    (time,) in s; `overflow` (..., time): closed contacts that found no place in the solver; `residual` (..., time): the
    solver's relative residual. `simulate` raises where the last two say that a result is wrong, unless it is traced.
    """

    x: Float[Array, "*b time n d"]
    v: Float[Array, "*b time n d"]
    contact: Bool[Array, "*b time"]
    time: Float[Array, " time"]
    overflow: Int[Array, "*b time"]
    residual: Float[Array, "*b time"]


def step(system: System, x: Float[Array, "n d"], v: Float[Array, "n d"], stepper: Stepper, force=None) -> StepResult:
    """One step of `stepper.dt`: contact that lasts acts over it, and impacts happen (see `carom.simulation.segments`).

    By the paper's rule, and where a contact model has no impulses (a network), the whole step is integrated, and then
    the contacts act that are closed at its end.

    A system with a `step_model` is moved by that alone.
    """
    if system.step_model is not None:
        require(force is None, "force must be None for a system with a step_model: it has no forces.")
        x, v = system.step_model(system, x, v, stepper.dt)
        closed = jnp.any(system.gaps(x) < 0)
        return StepResult(x, v, closed, overflow=jnp.asarray(0), residual=jnp.zeros((), x.dtype))
    inverse_mass = system.inverse_mass_matrix()
    rate, after = smooth_flow(system, stepper, inverse_mass, force)
    if not stepper.contact or not system.contacts:
        x, v = after((x, v), stepper.dt)
        return StepResult(x, v, jnp.asarray(False), jnp.asarray(0), jnp.zeros((), x.dtype))
    if stepper.impact == "step" and (system.compensation == "paper" or not has_impulses(system, x, v, stepper)):
        return impact_at(system, *after((x, v), stepper.dt), inverse_mass, stepper)
    return step_in_segments(system, x, v, inverse_mass, stepper, (rate, after))


def rollout(system: System, x0, v0, stepper: Stepper, steps: int, force=None) -> Trajectory:
    """`steps` steps from one state (n, d): the pure function under `simulate`."""

    def body(state, force):
        result = step(system, state[0], state[1], stepper, force)
        return (result.x, result.v), result

    _, out = jax.lax.scan(body, (x0, v0), force, length=steps)

    def start(first, rest):
        return jnp.concatenate([jnp.asarray(first, rest.dtype)[None], rest])

    return Trajectory(
        x=start(x0, out.x),
        v=start(v0, out.v),
        contact=start(False, out.contact),
        time=stepper.dt * jnp.arange(steps + 1, dtype=x0.dtype),
        overflow=start(0, out.overflow),
        residual=start(0, out.residual),
    )


@eqx.filter_jit
def _simulate(system, x0, v0, stepper, steps, force):
    if x0.ndim == 2:
        return rollout(system, x0, v0, stepper, steps, force)
    out = jax.vmap(lambda x, v, f: rollout(system, x, v, stepper, steps, f), (0, 0, None if force is None else 0))(
        x0, v0, force
    )
    return eqx.tree_at(lambda t: t.time, out, out.time[0])


def simulate(
    system: System,
    x0: Float[Array, "*b n d"],
    v0: Float[Array, "*b n d"],
    *,
    dt: float | Float[Array, ""],
    steps: int,
    impact: ImpactRule = "step",
    max_events: int = MAX_EVENTS,
    project: bool = True,
    force: Float[Array, "*b steps n d"] | None = None,
    formulation: Formulation = "lagrangian",
    solver: diffrax.AbstractSolver | None = None,
    compensation_steps: float | None = COMPENSATION_STEPS,
    contact_model: str | ContactModel | None = None,
    smoothing: float = 0.0,
    throw: bool = True,
) -> Trajectory:
    """Motion of `system` from `x0`, `v0`: pure, jit-able, vmap-able, differentiable in both modes.

    **Arguments:**

    - `x0`, `v0`: (n, d) or (N, n, d), positions (m) and velocities (m/s) of the points.
    - `dt`, `steps`: time step (s) and number of steps.
    - `impact`: `"step"` integrates a whole step and lets the contacts act that are closed at its end. `"event"` cuts
      the step at the times at which contacts close and lets them act there: derivatives through impacts are right then.
    - `max_events`: most times at which a step is cut; what comes after is left to the rule of `"step"`.
    - `project`: bring each step's end back onto the constraints.
    - `force`: (steps, n, d) or (N, steps, n, d) in N, held over each step, added to the generalised force.
    - `formulation`: `"lagrangian"` or `"hamiltonian"`; the same motion.
    - `solver`: any explicit diffrax solver; by default `RK4`.
    - `compensation_steps`: time steps over which penetration is undone, or `None` to leave it.
    - `contact_model`: `"cm"`, `"cmr"`, `"lcp"` or a `ContactModel`, in place of the system's own.
    - `smoothing`: see `solve_impulse`.
    - `throw`: raise on a result that is not right, where it can be seen (outside of jit). If false, or traced, look at
      `Trajectory.overflow` and `Trajectory.residual`.

    **Raises:** `CaromError` for shapes that do not fit, NaN, a start inside a wall or off the constraints, more closed
    contacts than `max_active`, an unsolved contact, motion that is not finite, an unknown contact model.
    """
    if contact_model is not None:
        system = system.with_contact_model(contact_model)
    x0, v0 = as_floats(x0), as_floats(v0)
    require(impact in IMPACT_RULES, f"impact must be one of {sorted(IMPACT_RULES)}; it was {impact!r}.")
    require(
        isinstance(max_events, int | np.integer) and max_events > 0,
        f"max_events must be a positive whole number; it was {max_events}.",
    )
    require(formulation in FIELDS, f"formulation must be one of {sorted(FIELDS)}; it was {formulation!r}.")
    require(
        isinstance(steps, int | np.integer) and steps > 0, f"steps must be a positive whole number; it was {steps}."
    )
    require_values("dt", dt, np.asarray(dt) > 0 if is_known(dt) else True, "a positive number of seconds")
    check_compensation_steps(compensation_steps)
    require(
        impact == "step" or system.step_model is None,
        f'impact must be "step" for a system with a step_model, which is blind to events; it was {impact!r}.',
    )
    check_initial_state(system, x0, v0)
    if force is not None:
        force = as_floats(force)
        wanted = (*x0.shape[:-2], steps, *x0.shape[-2:])
        if force.shape == wanted[-3:]:
            force = jnp.broadcast_to(force, wanted)
        require(force.shape == wanted, f"force must have the shape {wanted}; it was {force.shape}.")
    stepper = Stepper(
        dt=jnp.asarray(dt, x0.dtype),
        formulation=formulation,
        solver=RK4() if solver is None else solver,
        project=project,
        compensation_steps=compensation_steps,
        smoothing=smoothing,
        impact=impact,
        events=int(max_events),
    )
    out = _simulate(system, x0, v0, stepper, int(steps), force)
    if throw:
        check_trajectory(system, out)
    return out


def check_initial_state(system: System, x0, v0) -> None:
    """Raise `CaromError` for initial states that cannot be: shapes, NaN, inside walls, off the constraints."""
    shape = (system.n_points, system.dim)
    require(
        x0.shape[-2:] == shape and x0.ndim in (2, 3),
        f"x0 must have the shape {shape} or (N, {shape[0]}, {shape[1]}) for this system; it was {x0.shape}.",
    )
    require(x0.shape == v0.shape, f"v0 must have the shape of x0, {x0.shape}; it was {v0.shape}.")
    if not is_known(x0, v0, system):
        return
    for name, value in (("x0", x0), ("v0", v0)):
        require(bool(np.isfinite(value).all()), f"{name} must be finite; it had NaN or infinite values.")
    x = x0.reshape(-1, *shape)
    gaps = np.asarray(system.gaps(x))
    through = gaps < -np.asarray(system.reach()) - 1e-9
    if through.any():
        state, candidate = np.argwhere(through)[0]
        bodies = [b for contact in system.contacts for b in contact.bodies_of()][candidate]
        raise_through(int(state), bodies, float(-gaps[state, candidate]))
    drift = np.abs(np.asarray(system.constraints(x)))
    if drift.size and drift.max() > 2e-2:
        state, row = np.unravel_index(drift.argmax(), drift.shape)
        require(
            False,
            f"x0 does not obey the constraints: equation {row} of state {state} is off by {drift.max():.2g} m^2. "
            "Start from positions that fit the rods and joints (carom.sample gives such).",
        )


def raise_through(state: int, bodies: tuple[int, ...], depth: float) -> None:
    """Say which bodies start inside each other or a wall."""
    where = f"body {bodies[0]} is inside a wall" if len(bodies) == 1 else f"bodies {bodies[0]} and {bodies[1]} overlap"
    require(False, f"x0 starts in an impossible place: in state {state}, {where} ({depth:.3g} m deep). Move it out.")


def check_trajectory(system: System, trajectory: Trajectory) -> None:
    """Raise `CaromError` where a simulation went wrong, if its values are known."""
    if not is_known(trajectory):
        return
    over = np.asarray(trajectory.overflow)
    require(
        not over.any(),
        f"more contacts closed at once than the solver has places for: max_active is {system.max_active}, "
        f"{system.max_active + over.max()} were needed. Build the System with a larger max_active.",
    )
    finite = np.isfinite(np.asarray(trajectory.x)).all((-1, -2)) & np.isfinite(np.asarray(trajectory.v)).all((-1, -2))
    if not finite.all():
        index = np.argwhere(~finite)[0]
        require(
            False,
            f"the motion is not finite from step {index[-1]} on"
            + (f" in trajectory {index[0]}" if len(index) > 1 else "")
            + ". Use a smaller dt, or look at the potential.",
        )
    worst = float(np.max(trajectory.residual))
    allowed = 1e-6 if trajectory.x.dtype == jnp.float64 else 1e-2
    require(
        worst <= allowed,
        f"a contact was not solved: relative residual {worst:.1e}, allowed {allowed:.0e}. Bodies may be wedged between "
        "walls; use a smaller dt, or start elsewhere.",
    )
