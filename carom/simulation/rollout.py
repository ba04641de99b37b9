"""One time step, and many: `step`, `simulate` and the `Trajectory` they give."""

from collections.abc import Mapping

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from carom.checks import is_known, positive, require, require_values
from carom.contact.impulses import ContactModel
from carom.mechanics.dynamics import FIELDS, Formulation
from carom.mechanics.forces import Signal, signal_of
from carom.simulation.impact import (
    COMPENSATION_STEPS,
    IMPACT_RULES,
    MAX_EVENTS,
    ImpactRule,
    Stepper,
    StepResult,
    check_compensation_steps,
    has_impulses,
    impact_at,
    smooth_flow,
)
from carom.simulation.integrators import RK4, check_solver
from carom.simulation.segments import step_in_segments
from carom.simulation.start_checks import check_initial_state, in_one_precision
from carom.system import Compensation, System


class Trajectory(eqx.Module):
    """Motion of a system; a batch of them has leading axes.

    `x`, `v` (..., time, n, d) in m and m/s; `contact` (..., time): the step that ends here had a closed contact; `time`
    (time,) in s; `overflow` (..., time): closed contacts that found no place in the solver; `residual` (..., time): the
    solver's relative residual, infinite where the state is not finite. `simulate` raises where the last two say that a
    result is wrong, unless it is traced.
    """

    x: Float[Array, "*b time n d"]
    v: Float[Array, "*b time n d"]
    contact: Bool[Array, "*b time"]
    time: Float[Array, " time"]
    overflow: Int[Array, "*b time"]
    residual: Float[Array, "*b time"]


def step(
    system: System,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    stepper: Stepper,
    force: Float[Array, "n d"] | None = None,
    signal: Signal | None = None,
) -> StepResult:
    """One step of `stepper.dt`: contact that lasts acts over it, and impacts happen (see `carom.simulation.segments`).

    By the paper's rule, and where a contact model has no impulses (a network), the whole step is integrated, and then
    the contacts act that are closed at its end.

    `signal`: what its actuators are driven with. A system with a `step_model` is moved by that alone.
    """
    if system.step_model is not None:
        require(force is None, "force must be None for a system with a step_model: it has no forces.")
        require(signal is None, "control must be None for a system with a step_model: it has no forces.")
        x, v = system.step_model(system, x, v, stepper.dt)
        closed = jnp.any(system.gaps(x) < 0)
        return StepResult(x, v, closed, overflow=jnp.asarray(0), residual=jnp.zeros((), x.dtype))
    inverse_mass = system.inverse_mass_matrix()
    rate, after = smooth_flow(system, stepper, inverse_mass, force, signal)
    if not stepper.contact or not system.contacts:
        x, v = after((x, v), stepper.dt)
        return StepResult(x, v, jnp.asarray(False), jnp.asarray(0), jnp.zeros((), x.dtype))
    if stepper.impact == "step" and (system.compensation == "paper" or not has_impulses(system, x, v, stepper)):
        x, v = after((x, v), stepper.dt)
        return impact_at(system, x, v, inverse_mass, stepper)
    return step_in_segments(system, x, v, inverse_mass, stepper, (rate, after))


def rollout(system: System, x0, v0, stepper: Stepper, steps: int, force=None, control=None) -> Trajectory:
    """`steps` steps from one state (n, d): the pure function under `simulate`."""
    motors = system.actuators if control is not None else None

    def body(state, given):
        x, v, activation = state
        force, control = given
        signal = None if motors is None else signal_of(motors, control, activation)
        result = step(system, x, v, stepper, force, signal)
        return (result.x, result.v, activation if signal is None else signal.at(stepper.dt)), result

    begin = jnp.zeros(0 if motors is None else motors.count, x0.dtype)
    _, out = jax.lax.scan(body, (x0, v0, begin), (force, control), length=steps)

    def start(first, rest):
        return jnp.concatenate([jnp.asarray(first, rest.dtype)[None], rest])

    x, v, residual = start(x0, out.x), start(v0, out.v), start(0, out.residual)
    # What is not finite was not solved, although no contact can be seen in it.
    finite = jnp.isfinite(x).all((-1, -2)) & jnp.isfinite(v).all((-1, -2))
    return Trajectory(
        x=x,
        v=v,
        contact=start(False, out.contact),
        time=stepper.dt * jnp.arange(steps + 1, dtype=x0.dtype),
        overflow=start(0, out.overflow),
        residual=jnp.where(finite, residual, jnp.inf),
    )


@eqx.filter_jit
def _simulate(system, x0, v0, stepper, steps, force, control):
    def one(x, v, force, control):
        return rollout(system, x, v, stepper, steps, force, control)

    if x0.ndim == 2:
        return one(x0, v0, force, control)
    axes = (0, 0, *(None if given is None else 0 for given in (force, control)))
    out = jax.vmap(one, axes)(x0, v0, force, control)
    return eqx.tree_at(lambda t: t.time, out, out.time[0])


def _nothing(stepper: Stepper, x0: Float[Array, "0 n d"], steps: int) -> Trajectory:
    """The trajectories of no state at all."""
    x = jnp.zeros((0, steps + 1, *x0.shape[1:]), x0.dtype)
    flags = jnp.zeros((0, steps + 1), bool)
    time = stepper.dt * jnp.arange(steps + 1, dtype=x0.dtype)
    return Trajectory(x, x, flags, time, overflow=flags.astype(int), residual=flags.astype(x0.dtype))


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
    control: ArrayLike | Mapping[str, ArrayLike] | None = None,
    formulation: Formulation = "lagrangian",
    solver: diffrax.AbstractSolver | None = None,
    compensation_steps: float | Float[Array, ""] | None = COMPENSATION_STEPS,
    contact_model: str | ContactModel | None = None,
    compensation: Compensation | None = None,
    smoothing: float = 0.0,
    throw: bool = True,
) -> Trajectory:
    """Motion of `system` from `x0`, `v0`: pure, jit-able, vmap-able, differentiable in both modes.

    **Arguments:**

    - `x0`, `v0`: (n, d) or (N, n, d), positions (m) and velocities (m/s) of the points. All is computed in the widest
      precision among these, the system and the force, but at least in single.
    - `dt`, `steps`: time step (s) and number of steps.
    - `impact`: `"step"` integrates a whole step and lets the contacts act that are closed at its end. `"event"` cuts
      the step at the times at which contacts close and lets them act there: derivatives through impacts are right then.
    - `max_events`: most times at which a step may be cut; more are an error.
    - `project`: bring each step's end back onto the constraints.
    - `force`: (steps, n, d) or (N, steps, n, d) in N, held over each step, added to the generalised force.
    - `control`: (steps, u) or (N, steps, u), of the system's actuators, or by their names (steps,) or (N, steps) each
      (those not named get zero); held over each step. None: nothing drives them.
    - `formulation`: `"lagrangian"` or `"hamiltonian"`; the same motion.
    - `solver`: an explicit Runge-Kutta method of diffrax, such as `Tsit5()`; by default `RK4`.
    - `compensation_steps`: time steps over which penetration is undone where nothing pushes it back, or `None` to
      leave it.
    - `contact_model`: `"coulomb"`, `"cm"`, `"cmr"`, `"lcp"` or a `ContactModel`, in place of the system's own.
    - `compensation`: `"mass"` or `"paper"`, in place of the system's own (see `System`).
    - `smoothing`: see `solve_impulse`.
    - `throw`: raise on a result that is not right, where it can be seen (outside of jit). If false, or traced, look at
      `Trajectory.overflow` and `Trajectory.residual`.

    **Raises:** `CaromError` for shapes that do not fit, NaN, a start inside a wall or off the constraints, more closed
    contacts than `max_active`, an unsolved contact, motion that is not finite, an unknown contact model, a solver that
    is not an explicit Runge-Kutta method.
    """
    if contact_model is not None:
        system = system.with_contact_model(contact_model)
    if compensation is not None:
        system = system.with_compensation(compensation)
    system, x0, v0, force = in_one_precision(system, x0, v0, force)
    require(impact in IMPACT_RULES, f"impact must be one of {sorted(IMPACT_RULES)}; it was {impact!r}.")
    for name, count in (("max_events", max_events), ("steps", steps)):
        require(
            isinstance(count, int | np.integer) and count > 0,
            f"{name} must be a positive whole number; it was {count}.",
        )
    require(formulation in FIELDS, f"formulation must be one of {sorted(FIELDS)}; it was {formulation!r}.")
    require(np.shape(dt) == (), f"dt must be one number of seconds; its shape was {np.shape(dt)}.")
    require_values("dt", dt, positive, "a positive number of seconds")
    check_compensation_steps(compensation_steps)
    check_solver(solver)
    require(is_known(smoothing), "smoothing must be a known number; it was traced by JAX.")
    require(
        impact == "step" or system.step_model is None,
        f'impact must be "step" for a system with a step_model, which is blind to events; it was {impact!r}.',
    )
    check_initial_state(system, x0, v0, dt=dt, compensation_steps=compensation_steps)
    if force is not None:
        wanted = (*x0.shape[:-2], steps, *x0.shape[-2:])
        if force.shape == wanted[-3:]:
            force = jnp.broadcast_to(force, wanted)
        require(force.shape == wanted, f"force must have the shape {wanted}; it was {force.shape}.")
    control = controls(system, control, x0.shape[:-2], int(steps), x0.dtype)
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
    if x0.shape[0] == 0 and x0.ndim == 3:
        return _nothing(stepper, x0, int(steps))
    out = _simulate(system, x0, v0, stepper, int(steps), force, control)
    if throw:
        check_trajectory(system, out)
    return out


def controls(system: System, control, batch: tuple[int, ...], steps: int, dtype) -> Float[Array, "*b steps u"] | None:
    """`control` as one array, with the axes of the batch; None for a system without actuators.

    **Raises:** `CaromError` for names and shapes that do not fit, and numbers that are not finite.
    """
    motors = system.actuators
    if control is None and system.step_model is not None:
        return None
    if motors is None:
        require(control is None, "control must be None for a system without actuators.")
        return None
    names = ", ".join(motors.names)
    if control is None:
        return jnp.zeros((*batch, steps, motors.count), dtype)
    if isinstance(control, Mapping):
        unknown = [name for name in control if name not in motors.names]
        require(not unknown, f"control names {unknown[:1]}, which is no actuator of the system: it has {names}.")
        columns = [jnp.asarray(control.get(name, jnp.zeros(steps)), dtype) for name in motors.names]
        for name, column in zip(motors.names, columns, strict=True):
            require(
                column.shape in ((steps,), (*batch, steps)),
                f"control of {name!r} must have the shape {(*batch, steps)} or {(steps,)}; it was {column.shape}.",
            )
        control = jnp.stack([jnp.broadcast_to(column, (*batch, steps)) for column in columns], axis=-1)
    control, wanted = jnp.asarray(control, dtype), (*batch, steps, motors.count)
    require(
        control.shape in (wanted, wanted[-2:]),
        f"control must have the shape {wanted} (or {wanted[-2:]}), an actuator a column ({names}); it was "
        f"{control.shape}.",
    )
    require_values("control", control, np.isfinite, "finite numbers")
    return jnp.broadcast_to(control, wanted)


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
    require(
        np.isfinite(worst),
        "a time step has more impacts than max_events, or bodies move so far in it, beside their size, that it cannot "
        "be told which of them meet. Use a smaller dt, or a larger max_events.",
    )
    allowed = 1e-6 if trajectory.x.dtype == jnp.float64 else 1e-2
    require(
        worst <= allowed,
        f"a contact was not solved: relative residual {worst:.1e}, allowed {allowed:.0e}. Bodies may be wedged between "
        "walls; use a smaller dt, or start elsewhere.",
    )
