"""Whether a simulation can start: shapes, precision, places inside of walls, states off the constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, at_once_if_known, is_known, require
from carom.system import System

LARGEST_VIOLATION = 2e-2
"""Constraints of a start that are off by more, relative to what they hold, do not hold: one part in 100 of a rod."""

_STEPS_OF_DEPTH = 4.0
"""How much deeper than in one time step a start may be: it may come from a simulation with a larger one."""


def in_one_precision(system: System, *states) -> tuple:
    """The system and arrays of its states (or `None`), all in the widest precision among them, as JAX promotes.

    Half precision becomes single: contacts cannot be solved in it.
    """
    arrays = [None if state is None else as_floats(state) for state in states]
    doubles = (eqx.is_array(leaf) and leaf.dtype == jnp.float64 for leaf in jax.tree.leaves((system, arrays)))
    widest = jnp.dtype(jnp.float64 if any(doubles) else jnp.float32)

    def widen(leaf):
        if not (eqx.is_array(leaf) and jnp.issubdtype(leaf.dtype, jnp.floating)) or leaf.dtype == widest:
            return leaf
        with at_once_if_known(leaf):
            return leaf.astype(widest)

    return jax.tree.map(widen, system), *(None if array is None else widen(array) for array in arrays)


def check_initial_state(system: System, x0, v0, *, dt, compensation_steps) -> None:
    """Raise `CaromError` for initial states that cannot be: shapes, NaN, inside walls, off the constraints.

    `dt` (s) and `compensation_steps` tell how deep contacts may be that a simulation has let in.
    """
    shape = (system.n_points, system.dim)
    require(
        x0.shape[-2:] == shape and x0.ndim in (2, 3),
        f"x0 must have the shape {shape} or (N, {shape[0]}, {shape[1]}) for this system; it was {x0.shape}.",
    )
    require(x0.shape == v0.shape, f"v0 must have the shape of x0, {x0.shape}; it was {v0.shape}.")
    for name, value in (("x0", x0), ("v0", v0)):
        if is_known(value):
            require(bool(np.isfinite(value).all()), f"{name} must be finite; it had NaN or infinite values.")
    if not is_known(x0, v0, system, dt, compensation_steps) or x0.size == 0:
        return
    with jax.ensure_compile_time_eval():  # inside of jit too
        x, v = x0.reshape(-1, *shape), v0.reshape(-1, *shape)
        _check_not_through(system, x, v, dt, compensation_steps)
        violation = np.abs(np.asarray(system.violation(x)))
    if violation.size and not violation.max() <= LARGEST_VIOLATION:
        state, row = np.unravel_index(violation.argmax(), violation.shape)
        require(
            False,
            f"x0 does not obey the constraints: equation {row} of state {state} is off by {violation.max():.2g} of "
            "what it holds. Start from positions that fit the rods and joints (carom.sample gives such).",
        )


def _check_not_through(system: System, x, v, dt, compensation_steps) -> None:
    depth, limit = through(system, x, v, dt, compensation_steps)
    wrong = depth > limit
    if wrong.any():
        state, candidate = np.argwhere(wrong)[0]
        bodies = [b for contact in system.contacts for b in contact.bodies_of()][candidate]
        raise_through(int(state), bodies, float(depth[state, candidate]))


def through(
    system: System, x: Float[Array, "N n d"], v: Float[Array, "N n d"], dt, compensation_steps
) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, "N C"]]:
    """How deep contacts are (m), and how deep they can be.

    Beyond a contact's `reach`, only as deep as time steps of `dt` (s) let bodies in: an impact leaves with a velocity
    that undoes its depth within `compensation_steps` (`depth / (N dt)`), and what rests is as deep as the acceleration
    `a` makes it, `N a dt^2 / 2`. Without compensation a body that rests sinks ever deeper, and nothing is too deep.
    """
    depth, reach = -np.asarray(system.gaps(x)), np.asarray(system.reach())
    if compensation_steps is None:
        return depth, np.full_like(depth, np.inf)
    limit = np.broadcast_to(reach, depth.shape).copy()
    states = np.flatnonzero((depth > reach).any(axis=1))
    if not states.size:
        return depth, limit
    inverse_mass = system.inverse_mass_matrix()

    def let_in(x, v):
        candidates = system.candidates(x)
        normal, at = candidates.rows[:, 0], candidates.stencil
        sizes = jnp.linalg.norm(normal, axis=-1)
        acceleration = jnp.linalg.norm(inverse_mass @ jax.grad(system.potential_energy)(x), axis=-1)
        opening = jnp.maximum(jnp.einsum("cpd,cpd->c", normal, v[at]), 0)
        fall = jnp.sum(sizes * acceleration[at], axis=1)
        rounding = 8 * jnp.finfo(x.dtype).eps * jnp.sum(sizes * jnp.linalg.norm(x[at], axis=-1), axis=1)
        return compensation_steps * (2 * _STEPS_OF_DEPTH * opening * dt + _STEPS_OF_DEPTH * fall * dt**2) + rounding

    limit[states] += np.asarray(jax.vmap(let_in)(x[states], v[states]))
    return depth, limit


def raise_through(state: int, bodies: tuple[int, ...], depth: float) -> None:
    """Say which bodies start inside each other or a wall."""
    where = f"body {bodies[0]} is inside a wall" if len(bodies) == 1 else f"bodies {bodies[0]} and {bodies[1]} overlap"
    require(False, f"x0 starts in an impossible place: in state {state}, {where} ({depth:.3g} m deep). Move it out.")
