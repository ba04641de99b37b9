"""Friction-cone problems: which contacts stick, slide or separate, and Newton steps onto that. Arrays only.

Batch last: see `carom.contact.cones` for the problem, its scaling and the notation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from carom.contact.batching import FEW
from carom.contact.cone_algebra import (
    NEAR_APEX,
    TINY,
    Factored,
    NewtonMatrix,
    Problem,
    Scaling,
    add_normal,
    bound_multiplier,
    dot,
    matvec,
    residual_of,
)
from carom.contact.interior_point import Loop

# --- The solution itself ----------------------------------------------------------------------------------------
#
# At the solution each contact sticks, slides, separates or is held by its bound. With that known, the conditions are
# smooth equations. Their Newton matrix is the method's own, with the curvatures that those of the central path tend to:
# along p and m either none (z is zero there) or `_HELD` (s is zero there), across the tangent `z_0 / s_0`. It gives the
# last digits, which iterates near the boundary lose to rounding, and the derivative.

_HELD = 1e10


class ActiveSet(NamedTuple):
    scaling: Scaling
    curvature: Float[Array, "K B"]  # of the bounds
    rhs: Float[Array, "K d B"]  # of the Newton step to the solution
    margin: Float[Array, " B"]  # how far the nearest contact is from changing sides

    @classmethod
    def at(cls, problem: Problem, y: Array, apex: Bool[Array, "K B"] | bool = False):
        """The active set at `y`, the larger of slack and multiplier deciding.

        Bounds of contacts in `apex` (those that are zero) hold wherever the impulse is next to the apex: so the
        derivative is the one-sided one for a growing bound, whichever side rounding has put the velocity on.
        """
        g = matvec(problem.Q, y) + problem.q
        w = bound_multiplier(problem, g)
        z = add_normal(g, -w)
        u = y[:, 0] - problem.lower
        push, slip = (jnp.sqrt(dot(a[:, 1:], a[:, 1:])) for a in (y, z))
        default = jnp.zeros_like(y[:, 1:]).at[:, 0].set(1)
        by_slip = jnp.where(slip[:, None] > TINY, -z[:, 1:] / jnp.maximum(slip, TINY)[:, None], default)
        direction = jnp.where(push[:, None] > TINY, y[:, 1:] / jnp.maximum(push, TINY)[:, None], by_slip)
        frame = Scaling(direction, jnp.ones_like(y))
        s, z = frame.rotate(y), frame.rotate(z)
        held = z[:, :2] > s[:, :2]
        across = jnp.where(held[:, 0], _HELD, jnp.where(held[:, 1], z[:, 1] / jnp.maximum(s[:, 0], TINY), 0))
        curvature = jnp.concatenate([jnp.where(held, _HELD, 0), jnp.clip(across, 0, _HELD)[:, None]], axis=1)
        pull = frame.restore(
            jnp.pad(jnp.where(held, z[:, :2] - _HELD * s[:, :2], 0), ((0, 0), (0, y.shape[1] - 2), (0, 0)))
        )
        holds = w > u
        rhs = add_normal(pull - g, jnp.where(holds, w - _HELD * u, 0))
        scaling = Scaling(direction, jnp.sqrt(curvature[:, : y.shape[1]]))
        margin = jnp.min(jnp.minimum(jnp.min(jnp.maximum(s[:, :2], z[:, :2]), axis=1), jnp.maximum(w, u)), axis=0)
        return cls(scaling, jnp.where(holds | (apex & (y[:, 0] < NEAR_APEX)), _HELD, 0), rhs, margin)


def choose(condition: Array, a: Array, b: Array) -> Array:
    return jnp.asarray(jnp.where(condition, a, b))


# Most Newton steps onto the active set. Each squares the error that the central path has left, once the set is right.
_FINISHING = 6


def finish(
    problem: Problem, proximal: Problem, regularization: Array, loop: Loop, center: Array, wanted: Array
) -> tuple[Array, Array, Array]:
    """From the last iterate to `(solution of the proximal problem, solution of the problem given, its residual)`.

    Steps go on from where they lead, also outside of the cones: a contact at its boundary whose multiplier is next to
    zero is seen to be held only from there. The best is kept.
    """
    # Three candidates, each judged by the problem that it should solve.
    judged = problem._replace(q=jnp.stack([proximal.q, problem.q, problem.q]))
    diagonal = jnp.stack([jnp.zeros_like(regularization), regularization, regularization])
    judge = jax.vmap(residual_of, in_axes=(Problem(Q=None, q=0, lower=None), 0, 0))  # pyright: ignore[reportArgumentType]

    class Finish(NamedTuple):
        y: Array
        regular: Array
        error: Array  # of `regular`
        solution: Array
        residual: Array  # of `solution`
        steps: Array

    def keep_going(best: Finish):
        return (best.steps < _FINISHING) & jnp.any(jnp.maximum(best.residual, best.error) > 1e-4 * wanted)

    def body(best: Finish) -> Finish:
        active = ActiveSet.at(proximal, best.y)
        matrix = NewtonMatrix(proximal.Q, active.scaling, active.curvature, active.rhs[:, :, None], unrolled=False)
        polished = best.y + matrix.solution[:, :, 0]
        corrected = polished + matrix.solve(regularization * (polished - center))
        new_error, *residuals = judge(judged, jnp.stack([polished, best.y, corrected]), diagonal)
        solution, residual = best.solution, best.residual
        for y, new_residual in zip((best.y, corrected), residuals, strict=True):
            improves = new_residual <= jnp.maximum(residual, 1e-4 * wanted)
            solution, residual = choose(improves, y, solution), choose(improves, new_residual, residual)
        improves = new_error <= best.error
        regular, error = choose(improves, polished, best.regular), choose(improves, new_error, best.error)
        return Finish(polished, regular, error, solution, residual, best.steps + 1)

    nothing_yet = jnp.full_like(loop.residual, jnp.inf)
    start = Finish(loop.y, loop.y, loop.residual, loop.y, nothing_yet, jnp.asarray(0))
    best = jax.lax.while_loop(keep_going, body, start)
    return best.regular, best.solution, best.residual


# --- Without the central path -----------------------------------------------------------------------------------
#
# Most problems need no central path: some sweeps of projected Gauss-Seidel over the contacts show the active set, and a
# few Newton steps onto it, each of which may change it, end in the solution.

_SWEEPS = 30
# Of the step that a bound of the contact's largest eigenvalue allows: the bound is a loose one.
_OVERRELAXATION = 1.6
_NEWTON_STEPS = 4
# Most contacts whose updates are written out for many problems; else they are a loop, which compiles at once.
_UNROLLED = 8


def sweep(problem: Problem, mu: Float[Array, "K B"], present: Bool[Array, "K B"]) -> Float[Array, "K d B"]:
    """An impulse near the solution, by projected Gauss-Seidel in the metric of `(f_n, f_t)`.

    In single precision, which is enough to see the active set. Contacts that are not `present` have no impulse.
    """
    k, d, batch = problem.q.shape
    dtype = problem.q.dtype
    problem, mu = jax.tree.map(lambda x: x.astype(jnp.float32), (problem, mu))
    index = jnp.arange(k)
    rows = problem.Q.reshape(k, d, k * d, batch)
    metric = jnp.concatenate([jnp.ones_like(mu)[:, None], jnp.broadcast_to(mu[:, None], (k, d - 1, batch))], axis=1)
    metric = jnp.where(metric > 0, metric, 1)
    own = jnp.abs(problem.Q.reshape(k, d, k, d, batch)[index, :, index]) / (metric[:, :, None] * metric[:, None])
    stiffness = metric**2 * jnp.max(jnp.sum(own, axis=2), axis=1)[:, None] / _OVERRELAXATION

    def contact(i: int | Array, y: Array) -> Array:
        gradient = jnp.sum(rows[i] * y.reshape(1, k * d, batch), axis=1) + problem.q[i]
        # The division keeps XLA from computing the sum again for each use of the result.
        moved = (stiffness[i] * y[i] - gradient) / stiffness[i]
        normal, m = moved[0], mu[i]
        length = jnp.sqrt(sum(t**2 for t in moved[1:]))  # of g_t; that of f_t is mu times as much
        onto = jnp.maximum((normal + m**2 * length) / (1 + m**2), 0)
        normal = jnp.maximum(jnp.where(length <= normal, normal, onto), problem.lower[i])
        shrunk = moved * jnp.minimum(1, normal / jnp.maximum(length, TINY))
        return y.at[i].set(jnp.where(jnp.arange(d)[:, None] == 0, normal, shrunk))

    written_out = k <= _UNROLLED and batch > FEW
    count = k if written_out else jnp.max(jnp.where(present, jnp.arange(1, k + 1)[:, None], 0), initial=0)

    def body(_, y: Array) -> Array:
        return jax.lax.fori_loop(0, count, contact, y, unroll=written_out or None)

    return jax.lax.fori_loop(0, _SWEEPS, body, jnp.zeros_like(problem.q)).astype(dtype)


class NewtonStep(NamedTuple):
    """Where the last of `newton_steps` has led."""

    regular: Float[Array, "K d B"]  # the solution, if the active set was the right one
    y: Float[Array, "K d B"]  # the same without the diagonal
    margin: Float[Array, " B"]  # how far the nearest contact is from changing sides
    matrix: Factored


def newton_steps(
    problem: Problem, y: Float[Array, "K d B"], regularization: Float[Array, "K d B"], apex: Bool[Array, "K B"]
) -> NewtonStep:
    """Some Newton steps from `y`, each onto the active set seen at its start. For `apex` see `ActiveSet.at`."""

    def step(y: Array, apex: Array) -> NewtonStep:
        active = ActiveSet.at(problem, y, apex)
        sides = jnp.stack([active.rhs, regularization * y], axis=2)
        matrix = NewtonMatrix(problem.Q, active.scaling, active.curvature, sides, unrolled=y.shape[-1] > FEW)
        regular = y + matrix.solution[:, :, 0]
        return NewtonStep(regular, regular + matrix.solution[:, :, 1], active.margin, matrix.factored())

    def body(count, last: NewtonStep) -> NewtonStep:
        return step(last.regular, apex & (count == _NEWTON_STEPS - 1))

    nothing = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(step, y, apex))
    return jax.lax.fori_loop(0, _NEWTON_STEPS, body, nothing._replace(regular=y))
