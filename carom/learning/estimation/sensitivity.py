"""One step's prediction error, its derivatives by everything it depends on, and what its contacts did."""

import dataclasses
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from carom.contact.impulses import Jump
from carom.learning.unknowns.models import NeuralPotential, Unknowns
from carom.simulation.impact import Stepper, contact_jump
from carom.simulation.rollout import step
from carom.system import System


class StepSensitivity(NamedTuple):
    """Of one step from a recorded state, with rows for positions (m), then velocities (m/s) of all points.

    `residual`, predicted minus recorded; its derivatives by `log_mass_ratio`, by `friction` and `restitution` of the
    properties `column` of the closed contacts (P, the number of properties, for unused places), by the logarithm of
    CMr's epsilon if that is unknown, by the `state` before the step, and by the linear weights of a neural potential
    (none without one), see `force_features`.
    `gap_before`, `gap`: of every contact at the recorded start and at the predicted end; `gap_slope`, derivative of the
    former by positions; `property` of each contact in the solver (P for an unused place); `jump`, how far the contacts
    changed the velocities (m/s, norm over all points); normal and tangential impulses (N s) by phase, see `Jump`.
    """

    residual: Float[Array, " R"]
    log_mass_ratio: Float[Array, "R B"]
    friction: Float[Array, "R K"]
    restitution: Float[Array, "R K"]
    log_epsilon: Float[Array, "R E"]
    state: Float[Array, "R R"]
    weights: Float[Array, "R W"]
    column: Int[Array, " K"]
    gap_before: Float[Array, " C"]
    gap: Float[Array, " C"]
    gap_slope: Float[Array, "C nd"]
    property: Int[Array, " K"]
    jump: Float[Array, ""]
    normal: Float[Array, "phases K"]
    tangential: Float[Array, "phases K"]


def step_sensitivity(unknowns: Unknowns, skeleton: System, stepper: Stepper, start, end) -> StepSensitivity:
    """Of the step from the recorded state `start` to `end`, each `(x, v)`.

    The Jacobian has a column for the properties of the closed contacts only, so that its cost does not grow with the
    number of properties. Derivatives by state and weights are those of a step of the midpoint rule, which costs half of
    RK4's. Of a network's many weights, which are known by their forces, they are to first order in the time step: the
    forces are those at the start, held over it.
    """
    x, v = start
    system = unknowns.assemble(skeleton)
    if skeleton.contacts and system.compensation != "paper":
        return _of_whole_step(unknowns, skeleton, stepper, start, end)
    free = dataclasses.replace(stepper, contact=False)
    masses = jnp.zeros(0 if unknowns.log_mass_ratio is None else unknowns.log_mass_ratio.shape, x.dtype)

    def flow(nudge):
        out = step(_nudged(unknowns, nudge, skeleton), x, v, free)
        return (out.x, out.v), (out.x, out.v)

    potential = unknowns.potential
    by_force = potential is not None and potential.network is not None

    def coarse(nudge):
        coarser = dataclasses.replace(free, solver=diffrax.Midpoint())
        moved, force = system, nudge["weights"] if by_force else None
        if not by_force:
            moved = _with_weights(system, potential, nudge["weights"])
        out = step(moved, x + nudge["x"], v + nudge["v"], coarser, force)
        return out.x, out.v

    nothing = _no_weights(potential, x)
    by_mass, (x1, v1) = jax.jacfwd(flow, has_aux=True)({"mass": masses})
    by_state = jax.jacfwd(coarse)({"x": jnp.zeros_like(x), "v": jnp.zeros_like(x), "weights": nothing})
    place, column = _columns(system, x1) if skeleton.contacts else (jnp.zeros(0, int),) * 2

    def touch(nudge):
        if not skeleton.contacts:
            return v1 + nudge["v"], Jump(jnp.zeros_like(v1), jnp.zeros((), x.dtype))
        moved = _nudged(unknowns, nudge, skeleton, column)
        after = v1 + nudge["v"]
        _, jump = contact_jump(moved, x1 + nudge["x"], after, moved.inverse_mass_matrix(), stepper)
        return after + jump.velocity, jump

    zeros = jnp.zeros(column.shape, x.dtype)
    nothing = {"mass": masses, "friction": zeros, "restitution": zeros, "x": jnp.zeros_like(x), "v": jnp.zeros_like(x)}
    nothing["log_epsilon"] = jnp.zeros(0 if unknowns.log_epsilon is None else 1, x.dtype)
    by_jump, jump = jax.jacfwd(touch, has_aux=True)(nothing)
    impulse = jnp.zeros((0, len(column), x.shape[1]), x.dtype) if jump.impulse is None else jump.impulse
    by_jump = {name: part.reshape(x.size, -1) for name, part in by_jump.items()}
    v1 = v1 + jump.velocity

    def rows(first):
        """Derivatives after the contacts of those before them."""
        position, velocity = (part.reshape(x.size, -1) for part in first)
        return jnp.concatenate([position, by_jump["x"] @ position + by_jump["v"] @ velocity])

    def contact_rows(name):
        return jnp.concatenate([jnp.zeros_like(by_jump[name]), by_jump[name]])

    def weight_rows():
        if by_force:
            return rows([part["weights"] for part in by_state]) @ force_features(potential, x)
        if potential is None:
            return jnp.zeros((2 * x.size, 0), x.dtype)
        flat = ([w.reshape(x.size, -1) for w in part["weights"]] for part in by_state)
        return rows([jnp.concatenate(part, axis=1) for part in flat])

    return StepSensitivity(
        residual=jnp.concatenate([(x1 - end[0]).reshape(-1), (v1 - end[1]).reshape(-1)]),
        log_mass_ratio=rows([part["mass"] for part in by_mass]) + contact_rows("mass"),
        friction=contact_rows("friction"),
        restitution=contact_rows("restitution"),
        log_epsilon=contact_rows("log_epsilon"),
        state=jnp.concatenate([rows([part[name] for part in by_state]) for name in ("x", "v")], axis=1),
        weights=weight_rows(),
        column=column,
        gap_before=system.gaps(x),
        gap=system.gaps(x1),
        gap_slope=jax.jacfwd(system.gaps)(x).reshape(-1, x.size),
        property=place,
        jump=jnp.linalg.norm(jump.velocity),
        normal=impulse[..., 0],
        tangential=jnp.linalg.norm(impulse[..., 1:], axis=-1),
    )


def _columns(system: System, x: Float[Array, "n d"]) -> tuple[Int[Array, " K"], Int[Array, " K"]]:
    """The property of each contact that is closed at `x`, and which of these get a column of their own.

    A property of two closed contacts gets one, else its derivative would be counted twice.
    """
    active = system.active(x)
    place = jnp.where(active.active, active.property_index, system.n_properties)
    twice = jnp.any(jnp.tril(place[:, None] == place[None, :], -1), axis=1)
    return place, jnp.where(twice, system.n_properties, place)


def _no_weights(potential: NeuralPotential | None, x: Float[Array, "n d"]):
    """No change of the weights, or, of a network, of the forces."""
    if potential is None:
        return ()
    if potential.network is not None:
        return jnp.zeros_like(x)
    return tuple(jnp.zeros_like(w, x.dtype) for w in potential.linear_weights())


def _with_weights(system: System, potential: NeuralPotential | None, change) -> System:
    """The system with the weights changed in which its potential is linear."""
    if potential is None:
        return system
    weights = (w + d.astype(w.dtype) for w, d in zip(potential.linear_weights(), change, strict=True))
    return eqx.tree_at(lambda s: s.potential, system, potential.with_linear_weights(tuple(weights)))


def _of_whole_step(unknowns: Unknowns, skeleton: System, stepper: Stepper, start, end) -> StepSensitivity:
    """`step_sensitivity` where contact acts over the step, which does not fall into a motion and a jump."""
    x, v = start
    system, potential = unknowns.assemble(skeleton), unknowns.potential
    by_force = potential is not None and potential.network is not None
    reached = step(system, x, v, stepper)
    place, column = _columns(system, reached.x)
    zeros = jnp.zeros(column.shape, x.dtype)
    nothing = {
        "mass": jnp.zeros(0 if unknowns.log_mass_ratio is None else unknowns.log_mass_ratio.shape, x.dtype),
        "friction": zeros,
        "restitution": zeros,
        "log_epsilon": jnp.zeros(0 if unknowns.log_epsilon is None else 1, x.dtype),
        "x": jnp.zeros_like(x),
        "v": jnp.zeros_like(x),
        "weights": _no_weights(potential, x),
    }

    def whole(nudge):
        moved = _nudged(unknowns, nudge, skeleton, column)
        if not by_force:
            moved = _with_weights(moved, potential, nudge["weights"])
        out = step(moved, x + nudge["x"], v + nudge["v"], stepper, nudge["weights"] if by_force else None)
        return jnp.concatenate([out.x.reshape(-1), out.v.reshape(-1)])

    by = jax.jacfwd(whole)(nothing)
    rows = {name: by[name].reshape(2 * x.size, -1) for name in nothing if name != "weights"}
    if by_force:
        weights = by["weights"].reshape(2 * x.size, -1) @ force_features(potential, x)
    else:
        parts = [w.reshape(2 * x.size, -1) for w in by["weights"]]
        weights = jnp.concatenate([jnp.zeros((2 * x.size, 0), x.dtype), *parts], axis=1)
    free = step(system, x, v, dataclasses.replace(stepper, contact=False))
    _, jump = contact_jump(system, free.x, free.v, system.inverse_mass_matrix(), stepper, system.gaps(reached.x) < 0)
    impulse = jnp.zeros((0, len(column), x.shape[1]), x.dtype) if jump.impulse is None else jump.impulse
    return StepSensitivity(
        residual=jnp.concatenate([(reached.x - end[0]).reshape(-1), (reached.v - end[1]).reshape(-1)]),
        log_mass_ratio=rows["mass"],
        friction=rows["friction"],
        restitution=rows["restitution"],
        log_epsilon=rows["log_epsilon"],
        state=jnp.concatenate([rows["x"], rows["v"]], axis=1),
        weights=weights,
        column=column,
        gap_before=system.gaps(x),
        gap=system.gaps(reached.x),
        gap_slope=jax.jacfwd(system.gaps)(x).reshape(-1, x.size),
        property=place,
        jump=jnp.linalg.norm(jump.velocity),
        normal=impulse[..., 0],
        tangential=jnp.linalg.norm(impulse[..., 1:], axis=-1),
    )


def _nudged(unknowns: Unknowns, nudge, skeleton: System, column: Int[Array, " K"] | None = None) -> System:
    """The system with its masses changed a little, and epsilon, friction and restitution of the properties `column`."""
    if unknowns.log_mass_ratio is not None:
        unknowns = eqx.tree_at(lambda u: u.log_mass_ratio, unknowns, unknowns.log_mass_ratio + nudge["mass"])
    if column is not None and unknowns.log_epsilon is not None:
        unknowns = eqx.tree_at(lambda u: u.log_epsilon, unknowns, unknowns.log_epsilon + nudge["log_epsilon"][0])
    system = unknowns.assemble(skeleton)
    if column is None:
        return system
    friction, restitution = (
        getattr(system, name).at[column].add(nudge[name], mode="drop") for name in ("friction", "restitution")
    )
    return eqx.tree_at(lambda s: (s.friction, s.restitution), system, (friction, restitution))


def force_features(potential: NeuralPotential | None, x: Float[Array, "n d"]) -> Float[Array, "nd W"]:
    """Generalised force (N) of a unit change of each weight in which the potential is linear.

    These are all the forces that the output layer of the network and the energy of the segments can add.
    """
    if potential is None:
        return jnp.zeros((x.size, 0), x.dtype)
    weights = potential.linear_weights()

    def value(x, weights):
        return potential.with_linear_weights(weights)(x, jnp.zeros((0, 0), x.dtype))

    def slope(x):
        return jnp.concatenate([g.reshape(-1).astype(x.dtype) for g in jax.grad(value, argnums=1)(x, weights)])

    force = -jax.jacfwd(slope)(x).reshape(-1, x.size).T
    return force.astype(x.dtype)
