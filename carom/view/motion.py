"""What a viewer shows of a trajectory, as arrays: bodies, links, contacts with their impulses, energy and gaps."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.checks import require
from carom.simulation.impact import COMPENSATION_STEPS, Stepper, contact_jump
from carom.simulation.rollout import Trajectory, step
from carom.system import System
from carom.view.scene import lines_of


class Motion(NamedTuple):
    """Of T samples; B bodies, L lines (rods, axes, edges of boxes), K places for closed contacts.

    `impulse` (N s) is what a contact gave to the first of its bodies at the sample, at `place`, where `normal` points
    into that body; `friction` its coefficient, `acting` whether there was a contact. `energy` in J; `gap` (m) is the
    smallest of all contacts that are distances, NaN without any.
    """

    time: Float[np.ndarray, " T"]
    center: Float[np.ndarray, "T B d"]
    lines: Float[np.ndarray, "T L 2 d"]
    place: Float[np.ndarray, "T K d"]
    normal: Float[np.ndarray, "T K d"]
    impulse: Float[np.ndarray, "T K d"]
    friction: Float[np.ndarray, "T K"]
    acting: Bool[np.ndarray, "T K"]
    energy: Float[np.ndarray, " T"]
    gap: Float[np.ndarray, " T"]

    @property
    def impulse_size(self) -> Float[np.ndarray, " T"]:
        """Sum of the sizes of all impulses at each sample (N s)."""
        return np.sum(np.linalg.norm(self.impulse, axis=-1), axis=1)


def motion_of(
    system: System, trajectory: Trajectory, *, compensation_steps: float | None = COMPENSATION_STEPS
) -> Motion:
    """All that is shown of one trajectory, `x` (time, n, d).

    Impulses are those that `system` answers with to the step that ends at each sample, where it had a closed contact.

    **Raises:** `CaromError` for a trajectory that does not fit the system.
    """
    x, v = (np.asarray(part, float) for part in (trajectory.x, trajectory.v))
    shape = (system.n_points, system.dim)
    require(
        x.ndim == 3 and x.shape[1:] == shape and len(x) >= 2,
        f"trajectory must have the shape (time, {shape[0]}, {shape[1]}) with at least 2 samples; it was {x.shape}.",
    )
    time = np.asarray(trajectory.time, float)
    drawn = lines_of(system)
    lines = np.einsum("len,tnd->tled", drawn.weights, x) + drawn.offset
    energy = np.asarray(system.energy(jnp.asarray(x), jnp.asarray(v)))
    gaps = np.asarray(system.gaps(jnp.asarray(x)))
    touches = _touches(system, x, v, float(time[1] - time[0]), np.asarray(trajectory.contact), compensation_steps)
    return Motion(
        time=time,
        center=x[:, list(system.table.center)],
        lines=lines,
        energy=energy,
        gap=gaps.min(axis=1) if gaps.shape[1] else np.full(len(x), np.nan),
        **touches,
    )


def _touches(system: System, x, v, dt: float, contact, compensation_steps) -> dict[str, np.ndarray]:
    """Place, normal, impulse and friction of the contacts of each sample; the first has none."""
    samples, dim = len(x), system.dim
    if not system.contacts or system.step_model is not None:
        none = np.zeros((samples, 0, dim))
        flat = np.zeros((samples, 0))
        return {"place": none, "normal": none, "impulse": none, "friction": flat, "acting": flat.astype(bool)}
    stepper = Stepper(dt=jnp.asarray(dt), compensation_steps=compensation_steps)
    owner = np.zeros((len(system.bodies), system.n_points))
    for body, (center, axes) in enumerate(zip(system.table.center, system.table.axes, strict=True)):
        owner[body, [center, *axes]] = 1
    found = _solved(system, stepper, jnp.asarray(owner), jnp.asarray(x[:-1]), jnp.asarray(v[:-1]))
    acting, place, normal, impulse, friction = (np.asarray(part) for part in found)
    # A limit of a chain pushes no body at a place.
    acting = acting & contact[1:, None] & (np.linalg.norm(normal, axis=-1) > 0.5) & np.isfinite(impulse).all(axis=-1)
    out = {"place": place, "normal": normal, "impulse": impulse, "friction": friction}
    out = {
        name: np.where(acting.reshape(*acting.shape, *(1,) * (part.ndim - 2)), part, 0) for name, part in out.items()
    }
    out["acting"] = acting
    return {name: np.concatenate([np.zeros_like(part[:1]), part]) for name, part in out.items()}


@eqx.filter_jit
def _solved(system: System, stepper: Stepper, owner: Float[Array, "B n"], x, v):
    free = Stepper(dt=stepper.dt, compensation_steps=stepper.compensation_steps, contact=False)
    # Whether a body is a ball whose contacts act through its middle: they are drawn on its surface.
    radii = jnp.asarray(system.radii)

    def one(x, v):
        before = step(system, x, v, free)
        state, jump = contact_jump(system, before.x, before.v, system.inverse_mass_matrix(), stepper)
        rows = state.active.jacobian  # (K, d, n, d)
        push = jnp.einsum("bn,knd->kbd", owner, rows[:, 0])  # the normal, as each body feels it
        first = jnp.argmax(jnp.linalg.norm(push, axis=-1) > 0.5, axis=1)
        normal = jnp.take_along_axis(push, first[:, None, None], axis=1)[:, 0]
        mine = owner[first]
        weight = jnp.einsum("knd,kd,kn->kn", rows[:, 0], normal, mine)
        place = weight @ before.x
        center = jnp.where(jnp.cumsum(mine, axis=1) == 1, mine, 0)
        middle = jnp.abs(weight - center).max(axis=1) < 1e-9
        place = place - jnp.where(middle, radii[first], 0)[:, None] * normal
        impulse = jnp.zeros(rows.shape[:2], x.dtype) if jump.impulse is None else jnp.sum(jump.impulse, axis=0)
        given = jnp.einsum("kfnd,kf,kn->kd", rows, impulse, mine)
        return state.active.active, place, normal, given, state.friction

    return jax.vmap(one)(x, v)
