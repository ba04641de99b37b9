"""Friction-cone problems: the primal-dual interior-point method. Arrays only.

Batch last: see `carom.contact.cones` for the problem, its scaling and the notation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from carom.contact.cone_algebra import (
    ConeSettings,
    Iterate,
    NewtonMatrix,
    Problem,
    Scaling,
    add_normal,
    det,
    dot,
    jordan_divide,
    jordan_product,
    matvec,
    residual_of,
)


def _largest_step(x: Array, dx: Array) -> Array:
    """Largest `a` with `x + a dx` in the second-order cone, for each contact."""
    room = det(x)
    cross = x[:, 0] * dx[:, 0] - dot(x[:, 1:], dx[:, 1:])
    root = jnp.sqrt(jnp.maximum(cross**2 - det(dx) * room, 0))
    denominator = root - cross
    return jnp.where(denominator > 0, room / jnp.where(denominator > 0, denominator, 1), jnp.inf)


def _largest_step_line(x: Array, dx: Array) -> Array:
    return jnp.where(dx < 0, -x / jnp.where(dx < 0, dx, -1), jnp.inf)


def _step_length(it: Iterate, step: Iterate):
    lengths = [
        _largest_step(it.y, step.y),
        _largest_step(it.z, step.z),
        _largest_step_line(it.u, step.u),
        _largest_step_line(it.w, step.w),
    ]
    return jnp.min(jnp.stack([jnp.min(a, axis=0) for a in lengths]), axis=0)


def _advance(it: Iterate, step: Iterate, length) -> Iterate:
    return Iterate(*(a + length * b for a, b in zip(it, step, strict=True)))


def _complementarity(it: Iterate):
    """Mean complementarity product of the cones and the bounds."""
    k = it.u.shape[0]
    return (jnp.sum(dot(it.y, it.z), axis=0) + jnp.sum(it.u * it.w, axis=0)) / (2 * k)


def _stationarity(problem: Problem, it: Iterate):
    return add_normal(matvec(problem.Q, it.y) + problem.q - it.z, -it.w)


def _merit(problem: Problem, it: Iterate, smoothing):
    """Largest violation of the (perturbed) optimality conditions.

    The whole product `s o z` counts: `s . z` alone changes only with the square of the angle by which `z` misses `-s`.
    """
    identity = jnp.zeros_like(it.y).at[:, 0].set(1)
    products = jnp.abs(jordan_product(it.y, it.z) - smoothing * identity)
    parts = [jnp.abs(_stationarity(problem, it)), products, jnp.abs(it.u * it.w - smoothing)[:, None]]
    return jnp.max(jnp.concatenate(parts, axis=1), axis=(0, 1))


# Mehrotra's second-order term is a guess. Far from the central path it may lead in circles: where two steps brought no
# progress, the next two go back towards the central path, at this fraction of the products, and without the term.
_CENTERING = 0.8
# How much of the way to the boundary a step may go. More leaves the central path behind, and costs iterations in 3D.
_FRACTION = 0.95


def _interior_point_step(problem: Problem, it: Iterate, smoothing, careful: Bool[Array, " B"]) -> Iterate:
    scaling = Scaling.of(it.y, it.z)
    curvature = it.w / it.u
    matrix = NewtonMatrix(problem.Q, scaling, curvature, unrolled=False)
    gradient = matvec(problem.Q, it.y) + problem.q

    def newton(correction, bound_correction):
        dy = matrix.solve(add_normal(correction - gradient, bound_correction))
        dz = correction - it.z - scaling.restore(scaling.inverse**2 * scaling.rotate(dy))
        dw = bound_correction - it.w - curvature * dy[:, 0]
        return Iterate(dy, dy[:, 0], dz, dw)

    mean = _complementarity(it)
    affine = newton(jnp.zeros_like(it.y), jnp.zeros_like(it.u))
    length = jnp.minimum(_step_length(it, affine), 1)
    sigma = jnp.maximum(_complementarity(_advance(it, affine, length)) / mean, 0) ** 3
    sigma = jnp.where(careful, _CENTERING, jnp.minimum(sigma, 1))
    center = jnp.maximum(sigma * mean, smoothing)
    second = jnp.where(careful, jnp.zeros_like(mean), 1)

    def scale_inverse(x):  # W^-1 x
        return scaling.restore(scaling.inverse * scaling.rotate(x))

    def scale(x):  # W x
        return scaling.restore(scaling.rotate(x) / scaling.inverse)

    identity = jnp.zeros_like(it.y).at[:, 0].set(1)
    product = second * jordan_product(scale_inverse(affine.y), scale(affine.z))
    correction = scale_inverse(jordan_divide(scale(it.z), center * identity - product))
    bound_correction = (center - second * affine.u * affine.w) / it.u
    step = newton(correction, bound_correction)
    length = jnp.minimum(_FRACTION * _step_length(it, step), 1)
    return _advance(it, step, length)


class Loop(NamedTuple):
    it: Iterate
    best: Iterate
    merit: Float[Array, " B"]  # of `best`
    y: Float[Array, "K d B"]  # the impulse that violates the optimality conditions least, and how much
    residual: Float[Array, " B"]
    stalled: Int[Array, " B"]  # iterations since `merit` or `residual` halved
    done: Bool[Array, " B"]
    iteration: Int[Array, ""]


def interior_point(
    problem: Problem, start: Iterate, solved: Bool[Array, " B"], target: Array, settings: ConeSettings
) -> Loop:
    """Iterate until every problem of the batch that is not `solved` has met `target`, or stopped improving."""
    smoothing = jnp.asarray(settings.smoothing, problem.q.dtype)
    batch = problem.q.shape[-1]

    def keep_going(loop: Loop):
        return jnp.any(~loop.done) & (loop.iteration < settings.max_iterations)

    def body(loop: Loop):
        new = _interior_point_step(problem, loop.it, smoothing, (loop.stalled >= 2) & (loop.stalled % 3 >= 1))
        merit = _merit(problem, new, smoothing)
        residual = residual_of(problem, new.y)
        # An iterate that rounding has pushed out of the interior has a merit that is not finite (or products
        # that are not positive); its problem stops at the best iterate seen.
        inside = jnp.isfinite(merit) & (jnp.min(det(new.y), axis=0) > 0) & (jnp.min(det(new.z), axis=0) > 0)
        move = inside & ~loop.done
        better = move & (merit < loop.merit)
        nearer = move & (residual < loop.residual)
        halved = (merit < 0.5 * loop.merit) | (residual < 0.5 * loop.residual)
        stalled = jnp.where(halved, 0, loop.stalled + 1)
        # At the level of rounding nothing more is to be had; far from it, redundant contacts may take a while.
        patience = jnp.where(loop.merit <= 10 * target, 3, 25)
        merit = jnp.where(better, merit, loop.merit)
        done = loop.done | ~inside | (merit <= target) | (stalled >= patience)
        it = jax.tree.map(lambda a, b: jnp.where(move, a, b), new, loop.it)
        best = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, loop.best)
        y = jnp.where(nearer, new.y, loop.y)
        residual = jnp.where(nearer, residual, loop.residual)
        return Loop(it, best, merit, y, residual, stalled, done, loop.iteration + 1)

    # What the start is worth is not looked at: the first iterate is better.
    worst = jnp.full(batch, jnp.inf, problem.q.dtype)
    zero = jnp.zeros(batch, int)
    loop = Loop(start, start, worst, start.y, worst, zero, solved, jnp.asarray(0))
    return jax.lax.while_loop(keep_going, body, loop)
