r"""Friction-cone problems: a batched interior-point solver and its derivative. Arrays only.

The problem, for each of a batch of `B` independent sets of `K` contacts in `d` = 2 or 3 dimensions (paper, eqs. 5
and 7, appendix C):

    minimise  1/2 f^T A f + f^T v    subject to   |f_t,i| <= mu_i f_n,i,   f_n,i >= lower_i

with `f = (f_n, f_t)` stacked by contact and the normal component first. See `solve_cone_problem`.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.contact.linalg import Cholesky

# --- The method -------------------------------------------------------------------------------------------------
#
# Variables. With f_t = mu g_t the friction cone becomes the standard second-order cone |g_t| <= f_n for every mu,
# also mu = 0, where the tangent leaves the objective. So y = (f_n, g_t), f = S y, S = diag(1, mu, mu), Q = S A S,
# q = S v. Each contact is scaled by 1 / sqrt(A_nn) (mass ratios then do not matter) and the whole problem by its
# largest datum. The cone slack is s = y, the bound's slack u = y_n - lower; their multipliers are z and w.
#
#     Q y + q = z + e_n w,    s o z = 0,    u w = 0,    s, z in the cone,  u, w >= 0
#
# Where A is singular the impulse is not unique. A diagonal delta I added to A (before the scaling, so that the norm
# is that of the impulse itself) selects the solution of least norm as delta -> 0.
#
# Steps are Mehrotra's predictor-corrector with Nesterov-Todd scaling W (W z = W^-1 s): (Q + W^-2 + D) dy = rhs. The
# eigenvectors of W^-2 are known: p = (1, u)/sqrt 2, m = (1, -u)/sqrt 2 and, in 3D, the tangent across u. In that frame
# W^-2 is diagonal, with entries that near the solution differ by 1e15; formed in the original frame it would
# lose the small ones to rounding, in this frame it does not.


class ConeSettings(NamedTuple):
    """Knobs of the interior-point method; all are relative to the problem's own scale.

    `tolerance` is the largest residual of the optimality conditions (stationarity, complementarity) at which a problem
    counts as solved. `target` is the residual at which its iterations stop. `diagonal` is delta / mean(diag A).
    `smoothing` stops at that value of the complementarity products instead of at `target`, which smooths the
    derivative across the transitions between sticking, sliding and separating.
    """

    tolerance: float
    target: float
    diagonal: float
    smoothing: float = 0.0
    max_iterations: int = 40

    @classmethod
    def for_dtype(cls, dtype, smoothing: float = 0.0) -> "ConeSettings":
        """Settings that suit problems whose data were computed in `dtype`."""
        if dtype == jnp.float64:
            return cls(tolerance=1e-8, target=1e-10, diagonal=1e-9, smoothing=smoothing)
        return cls(tolerance=1e-4, target=1e-6, diagonal=1e-5, smoothing=smoothing)


class _Problem(NamedTuple):
    """A batch of scaled problems, batch last."""

    Q: Float[Array, "n n B"]
    q: Float[Array, "K d B"]
    lower: Float[Array, "K B"]


class _Iterate(NamedTuple):
    y: Float[Array, "K d B"]  # scaled impulse = slack of the cone
    u: Float[Array, "K B"]  # slack of the bound
    z: Float[Array, "K d B"]  # multiplier of the cone
    w: Float[Array, "K B"]  # multiplier of the bound


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=1)


def _det(x: Array) -> Array:
    """`x_0^2 - |x_1|^2`: positive inside the second-order cone."""
    norm = jnp.sqrt(_dot(x[:, 1:], x[:, 1:]))
    return (x[:, 0] - norm) * (x[:, 0] + norm)


def _jordan_product(a, b):
    return jnp.concatenate([_dot(a, b)[:, None], a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:]], axis=1)


def _jordan_divide(a, b):
    """The `x` with `a o x = b`."""
    x0 = (a[:, 0] * b[:, 0] - _dot(a[:, 1:], b[:, 1:])) / _det(a)
    return jnp.concatenate([x0[:, None], (b[:, 1:] - x0[:, None] * a[:, 1:]) / a[:, :1]], axis=1)


class _Scaling(NamedTuple):
    """Nesterov-Todd scaling of each cone, by the eigenvectors of `W` and the eigenvalues of `W^-1`."""

    direction: Float[Array, "K t B"]
    inverse: Float[Array, "K d B"]

    @classmethod
    def of(cls, s: Array, z: Array):
        det_s, det_z = _det(s), _det(z)
        s_bar, z_bar = s / jnp.sqrt(det_s)[:, None], z / jnp.sqrt(det_z)[:, None]
        gamma = jnp.sqrt((1 + _dot(s_bar, z_bar)) / 2)
        tangent = (s_bar[:, 1:] - z_bar[:, 1:]) / (2 * gamma[:, None])
        norm = jnp.sqrt(_dot(tangent, tangent))
        omega = jnp.sqrt(1 + norm**2) + norm
        default = jnp.zeros_like(tangent).at[:, 0].set(1)
        safe = norm[:, None] > 1e-30
        direction = jnp.where(safe, tangent / jnp.where(safe, norm[:, None], 1), default)
        inverse_beta = jnp.sqrt(jnp.sqrt(det_z / det_s))
        entries = [inverse_beta / omega, inverse_beta * omega, inverse_beta][: s.shape[1]]
        return cls(direction, jnp.stack(entries, axis=1))

    def rotate(self, x: Float[Array, "K d *rest B"]):
        """Components of `x` along the eigenvectors p, m and (in 3D) the cross tangent."""
        extra = (1,) * (x.ndim - 3)
        u = self.direction.reshape(*self.direction.shape[:2], *extra, -1)
        root = jnp.asarray(0.5, x.dtype) ** 0.5
        along = jnp.sum(u * x[:, 1:], axis=1)
        parts = [root * (x[:, 0] + along), root * (x[:, 0] - along)]
        if x.shape[1] == 3:
            parts.append(u[:, 0] * x[:, 2] - u[:, 1] * x[:, 1])
        return jnp.stack(parts, axis=1)

    def restore(self, x: Float[Array, "K d *rest B"]):
        """The inverse of `rotate`."""
        extra = (1,) * (x.ndim - 3)
        u = self.direction.reshape(*self.direction.shape[:2], *extra, -1)
        root = jnp.asarray(0.5, x.dtype) ** 0.5
        normal = root * (x[:, 0] + x[:, 1])
        along = root * (x[:, 0] - x[:, 1])
        parts = [normal, u[:, 0] * along]
        if x.shape[1] == 3:
            parts = [normal, u[:, 0] * along - u[:, 1] * x[:, 2], u[:, 1] * along + u[:, 0] * x[:, 2]]
        return jnp.stack(parts, axis=1)


def _matvec(Q, y):
    return jnp.sum(Q * y.reshape(1, -1, y.shape[-1]), axis=1).reshape(y.shape)


def _add_normal(x, normal):
    return x.at[:, 0].add(normal)


class _NewtonMatrix:
    """`Q + W^-2 + D e_n e_n^T`, factored, each contact in the frame in which its own block loses nothing to rounding.

    That is the frame of the scaling's eigenvectors, unless the bound holds the contact harder than the cone does:
    then it is the original one, in which `D` is a single entry.
    """

    def __init__(self, Q: Float[Array, "n n B"], scaling: _Scaling, curvature: Float[Array, "K B"]):
        k, d, batch = scaling.inverse.shape
        self.scaling = scaling
        self.rotated = jnp.max(scaling.inverse, axis=1) ** 2 > curvature
        H = Q.reshape(k, d, k * d, batch)
        H = self.rotate(H).reshape(k * d, k * d, batch).swapaxes(0, 1)
        H = self.rotate(H.reshape(k, d, k * d, batch)).reshape(k, d, k, d, batch)
        # The contact's own block is W^-2 + D e_n e_n^T = (sum_j a_j r_j r_j^T) + D e_n e_n^T in either frame, with r_j
        # the eigenvectors and a_j the eigenvalues.
        eye = jnp.broadcast_to(jnp.eye(d, dtype=H.dtype)[None, :, :, None], (k, d, d, batch))
        rotated = self.rotated[:, None, None]
        eigenvectors = jnp.where(rotated, eye, scaling.restore(eye))  # [:, :, j] = r_j
        normal = self.rotate(eye[:, :, 0])
        block = jnp.sum((scaling.inverse**2)[:, None, None] * eigenvectors[:, :, None] * eigenvectors[:, None], axis=3)
        block = block + curvature[:, None, None] * normal[:, :, None] * normal[:, None, :]
        index = jnp.arange(k)
        H = H.at[index, :, index].add(block)
        self.factor = Cholesky(H.reshape(k * d, k * d, batch))

    def rotate(self, x: Float[Array, "K d *m B"]):
        rotated = self.rotated.reshape(x.shape[0], *(1,) * (x.ndim - 2), -1)
        return jnp.where(rotated, self.scaling.rotate(x), x)

    def solve(self, rhs: Float[Array, "K d *m B"]) -> Float[Array, "K d *m B"]:
        flat = self.rotate(rhs).reshape(-1, *rhs.shape[2:])
        x = self.factor.solve(flat).reshape(rhs.shape)
        rotated = self.rotated.reshape(x.shape[0], *(1,) * (x.ndim - 2), -1)
        return jnp.where(rotated, self.scaling.restore(x), x)


def _largest_step(x: Array, dx: Array) -> Array:
    """Largest `a` with `x + a dx` in the second-order cone, for each contact."""
    det = _det(x)
    cross = x[:, 0] * dx[:, 0] - _dot(x[:, 1:], dx[:, 1:])
    root = jnp.sqrt(jnp.maximum(cross**2 - _det(dx) * det, 0))
    denominator = root - cross
    return jnp.where(denominator > 0, det / jnp.where(denominator > 0, denominator, 1), jnp.inf)


def _largest_step_line(x: Array, dx: Array) -> Array:
    return jnp.where(dx < 0, -x / jnp.where(dx < 0, dx, -1), jnp.inf)


def _step_length(it: _Iterate, step: _Iterate):
    lengths = [
        _largest_step(it.y, step.y),
        _largest_step(it.z, step.z),
        _largest_step_line(it.u, step.u),
        _largest_step_line(it.w, step.w),
    ]
    return jnp.min(jnp.stack([jnp.min(a, axis=0) for a in lengths]), axis=0)


def _advance(it: _Iterate, step: _Iterate, length) -> _Iterate:
    return _Iterate(*(a + length * b for a, b in zip(it, step, strict=True)))


def _complementarity(it: _Iterate):
    """Mean complementarity product of the cones and the bounds."""
    k = it.u.shape[0]
    return (jnp.sum(_dot(it.y, it.z), axis=0) + jnp.sum(it.u * it.w, axis=0)) / (2 * k)


def _stationarity(problem: _Problem, it: _Iterate):
    return _add_normal(_matvec(problem.Q, it.y) + problem.q - it.z, -it.w)


def _merit(problem: _Problem, it: _Iterate, smoothing):
    """Largest violation of the (perturbed) optimality conditions.

    The whole product `s o z` counts: `s . z` alone changes only with the square of the angle by which `z` misses `-s`.
    """
    identity = jnp.zeros_like(it.y).at[:, 0].set(1)
    products = jnp.abs(_jordan_product(it.y, it.z) - smoothing * identity)
    parts = [jnp.abs(_stationarity(problem, it)), products, jnp.abs(it.u * it.w - smoothing)[:, None]]
    return jnp.max(jnp.concatenate(parts, axis=1), axis=(0, 1))


# Mehrotra's second-order term is a guess. Far from the central path it may lead in circles: where two steps brought no
# progress, the next two go back towards the central path, at this fraction of the products, and without the term.
_CENTERING = 0.8
# How much of the way to the boundary a step may go. More leaves the central path behind, and costs iterations in 3D.
_FRACTION = 0.95


def _interior_point_step(problem: _Problem, it: _Iterate, smoothing, careful: Bool[Array, " B"]) -> _Iterate:
    scaling = _Scaling.of(it.y, it.z)
    curvature = it.w / it.u
    matrix = _NewtonMatrix(problem.Q, scaling, curvature)
    gradient = _matvec(problem.Q, it.y) + problem.q

    def newton(correction, bound_correction):
        dy = matrix.solve(_add_normal(correction - gradient, bound_correction))
        dz = correction - it.z - scaling.restore(scaling.inverse**2 * scaling.rotate(dy))
        dw = bound_correction - it.w - curvature * dy[:, 0]
        return _Iterate(dy, dy[:, 0], dz, dw)

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
    product = second * _jordan_product(scale_inverse(affine.y), scale(affine.z))
    correction = scale_inverse(_jordan_divide(scale(it.z), center * identity - product))
    bound_correction = (center - second * affine.u * affine.w) / it.u
    step = newton(correction, bound_correction)
    length = jnp.minimum(_FRACTION * _step_length(it, step), 1)
    return _advance(it, step, length)


def _bound_multiplier(problem: _Problem, g: Array) -> Array:
    """The largest multiplier of the bounds that leaves `g = Q y + q` in the cone; none where there is no bound."""
    slip = jnp.sqrt(_dot(g[:, 1:], g[:, 1:]))
    return jnp.where(problem.lower >= 0, jnp.maximum(g[:, 0] - slip, 0), 0)


def _residual(problem: _Problem, y: Array, diagonal: Array | float = 0.0) -> Array:
    """Violation of the optimality conditions of the problem, with `diagonal` taken away from `Q`, by `y` alone.

    Impulses are relative to the largest, velocities to the largest term of `Q y + q`: more cannot be asked of data that
    are rounded. Rounding does not explain what is above `_GROSS`: that is taken as it is, so that huge impulses do not
    hide a problem without a solution. The whole product `s o z` counts: `s . z` alone changes only with the square of
    the angle by which a tangential impulse is turned.
    """
    g = _matvec(problem.Q, y) - diagonal * y + problem.q
    w = _bound_multiplier(problem, g)
    z = _add_normal(g, -w)
    slip, push = (jnp.sqrt(_dot(a[:, 1:], a[:, 1:])) for a in (z, y))
    above = y[:, 0] - problem.lower
    impulse = jnp.maximum(jnp.max(jnp.abs(y), axis=(0, 1)), 1)
    velocity = jnp.maximum(jnp.max(_matvec(jnp.abs(problem.Q), jnp.abs(y)), axis=(0, 1)), 1)
    primal = jnp.maximum(push - y[:, 0], -above) / impulse
    cone = jnp.max(jnp.abs(_jordan_product(y, z)), axis=1) / impulse
    bound = jnp.abs(w * above) / impulse
    dual = jnp.max(jnp.stack([slip - z[:, 0], cone, bound]), axis=0)
    gross = jnp.where(dual > _GROSS, dual, 0)
    return jnp.max(jnp.max(jnp.stack([primal, dual / velocity, gross]), axis=0), axis=0)


_GROSS = 1e-3

# --- The solution itself ----------------------------------------------------------------------------------------
#
# At the solution each contact sticks, slides, separates or is held by its bound. With that known, the conditions are
# smooth equations. Their Newton matrix is the method's own, with the curvatures that those of the central path tend to:
# along p and m either none (z is zero there) or `_HELD` (s is zero there), across the tangent `z_0 / s_0`. It gives the
# last digits, which iterates near the boundary lose to rounding, and the derivative.

_HELD = 1e10


class _ActiveSet(NamedTuple):
    scaling: _Scaling
    curvature: Float[Array, "K B"]  # of the bounds
    rhs: Float[Array, "K d B"]  # of the Newton step to the solution

    @classmethod
    def at(cls, problem: _Problem, y: Array, apex: Bool[Array, "K B"] | bool = False):
        """The active set at `y`, the larger of slack and multiplier deciding.

        Bounds of contacts in `apex` (those that are zero) hold wherever the impulse is next to the apex: so the
        derivative is the one-sided one for a growing bound, whichever side rounding has put the velocity on.
        """
        g = _matvec(problem.Q, y) + problem.q
        w = _bound_multiplier(problem, g)
        z = _add_normal(g, -w)
        u = y[:, 0] - problem.lower
        push, slip = (jnp.sqrt(_dot(a[:, 1:], a[:, 1:])) for a in (y, z))
        default = jnp.zeros_like(y[:, 1:]).at[:, 0].set(1)
        by_slip = jnp.where(slip[:, None] > _TINY, -z[:, 1:] / jnp.maximum(slip, _TINY)[:, None], default)
        direction = jnp.where(push[:, None] > _TINY, y[:, 1:] / jnp.maximum(push, _TINY)[:, None], by_slip)
        frame = _Scaling(direction, jnp.ones_like(y))
        s, z = frame.rotate(y), frame.rotate(z)
        held = z[:, :2] > s[:, :2]
        across = jnp.where(held[:, 0], _HELD, jnp.where(held[:, 1], z[:, 1] / jnp.maximum(s[:, 0], _TINY), 0))
        curvature = jnp.concatenate([jnp.where(held, _HELD, 0), jnp.minimum(across, _HELD)[:, None]], axis=1)
        pull = frame.restore(
            jnp.pad(jnp.where(held, z[:, :2] - _HELD * s[:, :2], 0), ((0, 0), (0, y.shape[1] - 2), (0, 0)))
        )
        holds = w > u
        rhs = _add_normal(pull - g, jnp.where(holds, w - _HELD * u, 0))
        scaling = _Scaling(direction, jnp.sqrt(curvature[:, : y.shape[1]]))
        return cls(scaling, jnp.where(holds | (apex & (y[:, 0] < _NEAR_APEX)), _HELD, 0), rhs)


_TINY = 1e-30
# An impulse that is nearer to the apex than this is at it, for the derivative.
_NEAR_APEX = 1e-5


class _Loop(NamedTuple):
    it: _Iterate
    best: _Iterate
    merit: Float[Array, " B"]  # of `best`
    y: Float[Array, "K d B"]  # the impulse that violates the optimality conditions least, and how much
    residual: Float[Array, " B"]
    stalled: Int[Array, " B"]  # iterations since `merit` or `residual` halved
    done: Bool[Array, " B"]
    iteration: Int[Array, ""]


def _interior_point(
    problem: _Problem, start: _Iterate, solved: Bool[Array, " B"], target: Array, settings: ConeSettings
) -> _Loop:
    """Iterate until every problem of the batch that is not `solved` has met `target`, or stopped improving."""
    smoothing = jnp.asarray(settings.smoothing, problem.q.dtype)
    batch = problem.q.shape[-1]

    def keep_going(loop: _Loop):
        return jnp.any(~loop.done) & (loop.iteration < settings.max_iterations)

    def body(loop: _Loop):
        new = _interior_point_step(problem, loop.it, smoothing, (loop.stalled >= 2) & (loop.stalled % 3 >= 1))
        merit = _merit(problem, new, smoothing)
        residual = _residual(problem, new.y)
        # An iterate that rounding has pushed out of the interior has a merit that is not finite (or products
        # that are not positive); its problem stops at the best iterate seen.
        inside = jnp.isfinite(merit) & (jnp.min(_det(new.y), axis=0) > 0) & (jnp.min(_det(new.z), axis=0) > 0)
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
        return _Loop(it, best, merit, y, residual, stalled, done, loop.iteration + 1)

    merit, residual = _merit(problem, start, smoothing), _residual(problem, start.y)
    zero = jnp.zeros(batch, int)
    loop = _Loop(start, start, merit, start.y, residual, zero, solved, jnp.asarray(0))
    return jax.lax.while_loop(keep_going, body, loop)


# --- From physical to scaled problems and back -----------------------------------------------------------------


class _Scales(NamedTuple):
    """What turns scaled quantities into physical ones; see `_scale`."""

    S: Float[Array, "K d B"]  # y_scaled * S * unit = f
    size: Float[Array, "K B"]  # 1 / sqrt(A_nn): y_scaled * size * unit = (f_n, g_t)
    unit: Float[Array, " B"]
    diagonal: Float[Array, " B"]  # delta
    regularization: Float[Array, "K d B"]  # the diagonal that delta becomes in the scaled problem
    apex: Bool[Array, "K B"]  # contacts whose bound is zero


def _scale(
    A: Array, v: Array, friction: Array, lower: Array, reference: Array, delta: float
) -> tuple[_Problem, _Scales]:
    """Batch last: A (K, d, K, d, B), v and reference (K, d, B), friction, lower (K, B)."""
    k, d, batch = v.shape
    dtype = v.dtype
    index = jnp.arange(k)
    normal = A[index, 0, index, 0]
    # A contact without inverse inertia is padding. It becomes: minimise f_n^2 / 2 + f_n, with the solution 0.
    present = normal > 0
    mean = jnp.sum(jnp.where(present, normal, 0), axis=0) / jnp.maximum(jnp.sum(present, axis=0, dtype=dtype), 1)
    diagonal = delta * mean
    size = jnp.where(present, jax.lax.rsqrt(jnp.where(present, normal + diagonal, 1)), 0)
    S = size[:, None] * jnp.concatenate(
        [jnp.ones((k, 1, batch), dtype), jnp.broadcast_to(friction[:, None], (k, d - 1, batch))], axis=1
    )
    regularization = S**2 * diagonal
    # Rows that vanish (padding, tangents of frictionless contacts) get an own diagonal to be definite.
    floor = jnp.where(present[:, None], jnp.asarray(jnp.finfo(dtype).eps, dtype), 1)
    Q = S[:, :, None, None] * A * S[None, None]
    Q = Q.at[index[:, None], jnp.arange(d), index[:, None], jnp.arange(d)].add(regularization + floor)
    q = S * v
    # A bound of zero is none: the cone has it. It matters for the derivative alone.
    apex, bounded = present & (lower == 0), present & (lower > 0)
    lower = jnp.where(bounded, lower / jnp.where(present, size, 1), 0)
    largest = jnp.maximum(jnp.max(jnp.abs(q), axis=(0, 1)), jnp.max(lower, axis=0))
    largest = jnp.maximum(largest, jnp.max(jnp.abs(S * reference), axis=(0, 1)))
    unit = jnp.maximum(largest, jnp.finfo(dtype).tiny ** 0.5)
    q = jnp.where(present[:, None], q / unit, jnp.zeros_like(q).at[:, 0].set(1))
    lower = jnp.where(bounded, lower / unit, _NO_BOUND)
    problem = _Problem(Q.reshape(k * d, k * d, batch), q, lower)
    return problem, _Scales(S, size, unit, diagonal, regularization, apex)


# Where there is no bound, that of the scaled problem is here: the cone keeps the impulse away from it.
_NO_BOUND = -1.0


class _Internal(NamedTuple):
    """Solutions, batch first."""

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    iterations: Any  # int (B,); its tangent is of JAX's type for no tangent at all


class _Sensitivity(NamedTuple):
    """What the derivative needs, batch first."""

    regular: Float[Array, "B K d"]  # (f_n, g_t) of the regularised problem, in physical units
    moved: Float[Array, "B K d"]  # the same less the centre of its proximal term
    inverse: Float[Array, "B n n"]  # (Q + W^-2 + D)^-1, in the units of (f_n, g_t)
    bound: Float[Array, "B K"]  # D
    diagonal: Float[Array, " B"]  # delta


def _solve_block(A, v, friction, lower, reference, settings: ConeSettings, sensitivity: bool):
    """Solve one block of problems: batch first in and out, batch last inside."""
    batch, k, d = v.shape
    n = k * d
    finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2))
    finite = finite & jnp.isfinite(friction).all(1) & (lower < jnp.inf).all(1)
    A_last = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    v_last = jnp.moveaxis(v, 0, -1)
    reference = jnp.moveaxis(reference, 0, -1)
    problem, scales = _scale(A_last, v_last, friction.T, lower.T, reference, settings.diagonal)
    one = jnp.ones((k, batch), v.dtype)
    identity = jnp.zeros_like(v_last).at[:, 0].set(1)
    start = _Iterate(_add_normal(identity, jnp.maximum(problem.lower, 0)), one, identity, one)
    start = start._replace(u=start.y[:, 0] - problem.lower)
    out = _proximal_point(problem, scales, start, settings)
    it, y = out.it, out.y
    nan = jnp.where(finite, 0, jnp.nan).astype(v.dtype)
    solution = _Internal(
        impulse=jnp.moveaxis(scales.S * scales.unit * y + nan, -1, 0),
        residual=jnp.where(finite, out.residual, jnp.inf),
        iterations=jnp.broadcast_to(out.iterations, (batch,)),
    )
    if not sensitivity:
        return solution, None
    eye = jnp.broadcast_to(jnp.eye(n, dtype=v.dtype)[..., None], (n, n, batch)).reshape(k, d, n, batch)
    if settings.smoothing > 0:
        scaling, bound = _Scaling.of(it.y, it.z), it.w / it.u
    else:
        active = _ActiveSet.at(problem, out.regular, scales.apex)
        scaling, bound = active.scaling, active.curvature
    matrix = _NewtonMatrix(problem.Q, scaling, bound)
    inverse = matrix.solve(eye).reshape(n, n, batch)
    size = jnp.broadcast_to(scales.size[:, None], (k, d, batch))
    both = size.reshape(n, 1, batch) * size.reshape(1, n, batch)
    return solution, _Sensitivity(
        regular=jnp.moveaxis(size * scales.unit * out.regular, -1, 0),
        moved=jnp.moveaxis(size * scales.unit * (out.regular - out.center), -1, 0),
        inverse=jnp.moveaxis(inverse * both, -1, 0),
        bound=(bound / jnp.where(scales.size > 0, scales.size, jnp.inf) ** 2).T,
        diagonal=scales.diagonal,
    )


# --- The problem as it was given -------------------------------------------------------------------------------------


class _Solved(NamedTuple):
    it: _Iterate  # the best of the regularised problem
    regular: Float[Array, "K d B"]  # the solution of the regularised problem
    center: Float[Array, "K d B"]  # of its proximal term
    y: Float[Array, "K d B"]  # the solution, without the diagonal
    residual: Float[Array, " B"]
    iterations: Int[Array, ""]
    rounds: Int[Array, ""]


# The diagonal is that of a proximal term delta/2 |f - f_0|^2. With f_0 = 0 it selects the solution of least norm; one
# Newton step without the diagonal then removes most of its effect on the impulse.
#
# Round 0 goes only so far along the central path that the active set can be seen; the step onto it mostly is the end.
# What is not solved then goes on along the path in round 1. Where that is not enough (data in single precision, whose
# delta is large, with singular A or large impulses), the problem is solved again around the solution found: the
# proximal-point method (Rockafellar, 1976), which needs two or three rounds.
_COARSE = 1e-6
_ROUNDS = 6


def _proximal_point(problem: _Problem, scales: _Scales, start: _Iterate, settings: ConeSettings) -> _Solved:
    batch = problem.q.shape[-1]
    smooth = settings.smoothing > 0
    wanted = jnp.asarray(0.1 * settings.tolerance, problem.q.dtype)

    def keep_going(best: _Solved):
        return jnp.any(best.residual > wanted) & (best.rounds < (1 if smooth else _ROUNDS))

    def body(best: _Solved):
        again = best.rounds > 1
        center = jnp.where(again, best.y, 0)
        proximal = problem._replace(q=problem.q - scales.regularization * center)
        first = jax.tree.map(lambda a, b: jnp.where(again, a, b), start, best.it)
        coarse = (best.rounds == 0) & (not smooth)
        target = jnp.where(coarse, jnp.maximum(_COARSE, settings.target), settings.target)
        loop = _interior_point(proximal, first, best.residual <= wanted, target, settings)
        if smooth:
            new = _Solved(loop.best, loop.best.y, center, loop.best.y, loop.merit, best.iterations, best.rounds)
        else:
            finished = _finish(problem, proximal, scales, loop, center, wanted)
            new = _Solved(loop.best, finished[0], center, *finished[1:], best.iterations, best.rounds)
        # A problem that is solved well enough stays as it is; so does one that this round made worse.
        take = (best.residual > wanted) & ((new.residual < best.residual) | (best.rounds == 0))

        def choose(a: Array, b: Array) -> Array:
            return jnp.where(take, a, b) if a.ndim else a

        chosen = jax.tree.map(choose, new, best)
        return chosen._replace(iterations=best.iterations + loop.iteration, rounds=best.rounds + 1)

    nothing = jnp.zeros_like(start.y)
    zero = jnp.asarray(0)
    first = _Solved(start, nothing, nothing, nothing, jnp.full(batch, jnp.inf, problem.q.dtype), zero, zero)
    return jax.lax.while_loop(keep_going, body, first)


def _choose(condition: Array, a: Array, b: Array) -> Array:
    return jnp.asarray(jnp.where(condition, a, b))


# Newton steps onto the active set: each squares the error that the central path has left.
_FINISHING = 3


def _finish(
    problem: _Problem, proximal: _Problem, scales: _Scales, loop: _Loop, center: Array, wanted: Array
) -> tuple[Array, Array, Array]:
    """From the last iterate to `(solution of the proximal problem, solution of the problem given, its residual)`.

    A step is kept only where it does not make the residual worse.
    """

    def keep_going(state):
        *_, residual, count = state
        return (count < _FINISHING) & jnp.any(residual > 1e-4 * wanted)

    def body(state: tuple[Array, Array, Array, Array, Array]):
        regular, error, solution, residual, count = state
        active = _ActiveSet.at(proximal, regular)
        matrix = _NewtonMatrix(proximal.Q, active.scaling, active.curvature)
        polished = regular + matrix.solve(active.rhs)
        new_error = _residual(proximal, polished)
        improves = new_error <= error
        regular, error = _choose(improves, polished, regular), _choose(improves, new_error, error)
        corrected = regular + matrix.solve(scales.regularization * (regular - center))
        for y in (regular, corrected):
            new_residual = _residual(problem, y, scales.regularization)
            improves = new_residual <= jnp.maximum(residual, 1e-4 * wanted)
            solution, residual = _choose(improves, y, solution), _choose(improves, new_residual, residual)
        return regular, error, solution, residual, count + 1

    error = _residual(proximal, loop.best.y)
    y = _choose(loop.residual < error, loop.y, loop.best.y)
    start = (y, jnp.minimum(loop.residual, error), y, _residual(problem, y, scales.regularization), jnp.asarray(0))
    regular, _, solution, residual, _ = jax.lax.while_loop(keep_going, body, start)
    return regular, solution, residual


# --- Batches ----------------------------------------------------------------------------------------------------

BLOCK = {6: 128, 24: 64}
"""Problems solved together, by the most rows that a problem has (more rows: 32).

Enough to fill vector units; few enough for their matrices to stay in cache, and for the slowest not to hold up many.
"""


def _block_size(rows: int) -> int:
    return next((size for most, size in BLOCK.items() if rows <= most), 32)


SMALL = 2
"""Contacts up to which a problem of a larger batch is solved in a small form of its own."""


def _solve_batch(A, v, friction, lower, reference, settings: ConeSettings, sensitivity: bool):
    """Solve a batch block by block. Problems without a contact cost nothing and give zeros.

    In a batch with room for many contacts most problems have one or two: these, where they come first in their
    problem, are solved without the room that they do not use.
    """
    batch, k, d = v.shape
    n = k * d
    index = jnp.arange(k)
    diagonal = A.reshape(batch, k, d, k, d)[:, index, 0, index, 0]
    present = ~(diagonal <= 0)  # NaN counts as present, so that it is reported
    used = jnp.max(jnp.where(present, index + 1, 0), axis=1)
    out = _Internal(
        impulse=jnp.zeros((batch, k, d), v.dtype),
        residual=jnp.zeros(batch, v.dtype),
        iterations=jnp.zeros(batch, int),
    )
    extra = None
    if sensitivity:
        extra = _Sensitivity(
            regular=jnp.zeros((batch, k, d), v.dtype),
            moved=jnp.zeros((batch, k, d), v.dtype),
            inverse=jnp.zeros((batch, n, n), v.dtype),
            bound=jnp.zeros((batch, k), v.dtype),
            diagonal=jnp.zeros(batch, v.dtype),
        )
    out = (out, extra)
    sizes = (SMALL, k) if k > 2 * SMALL else (k,)
    at_least = 0
    for size in sizes:
        chosen = (used > at_least) & (used <= size)
        out = _solve_chosen((A, v, friction, lower, reference), settings, sensitivity, out, chosen, size)
        at_least = size
    return out


def _solve_chosen(arrays, settings, sensitivity, out, chosen, size: int):
    """Solve the `chosen` problems, of which only the first `size` contacts are used, and put them into `out`."""
    A, v, friction, lower, reference = arrays
    batch, _, d = v.shape
    m = size * d
    block = min(_block_size(m), batch)
    order = jnp.nonzero(chosen, size=-(-batch // block) * block, fill_value=batch)[0]

    def body(i, out):
        rows = jax.lax.dynamic_slice(order, (i * block,), (block,))
        data = (A[:, :m, :m], v[:, :size], friction[:, :size], lower[:, :size], reference[:, :size])
        data = (x.at[rows].get(mode="fill", fill_value=0) for x in data)
        solved = _solve_block(*data, settings, sensitivity)

        def put(whole, part):
            return whole.at[(rows, *(slice(0, s) for s in part.shape[1:]))].set(part, mode="drop")

        return jax.tree.map(put, out, solved)

    blocks = (jnp.sum(chosen) + block - 1) // block
    return jax.lax.fori_loop(0, blocks, body, out)


@functools.cache
def _batched(settings: ConeSettings, sensitivity: bool):
    """`_solve_batch` for these settings, whose batching under vmap is one larger batch."""

    @jax.custom_batching.custom_vmap
    def solve(A, v, friction, lower, reference):
        return _solve_batch(A, v, friction, lower, reference, settings, sensitivity)

    @solve.def_vmap
    def _(size, batched, *arrays):
        flat = []
        for x, is_batched in zip(arrays, batched, strict=True):
            x = x if is_batched else jnp.broadcast_to(x, (size, *x.shape))
            flat.append(x.reshape(-1, *x.shape[2:]))
        out = solve(*flat)
        out = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), out)
        return out, jax.tree.map(lambda _: True, out)

    @jax.custom_jvp
    def undifferentiated(*arrays):
        return solve(*arrays)

    @undifferentiated.defjvp
    def _(primals, tangents):
        raise NotImplementedError(
            "carom's cone solver has first derivatives only: its derivative cannot be differentiated again. "
            "Use a Gauss-Newton approximation, or differences of gradients, in place of second derivatives."
        )

    return undifferentiated


def _friction_scale(x, friction):
    """`S x`: the tangential components times mu."""
    return jnp.concatenate([x[..., :1], x[..., 1:] * friction[..., None]], axis=-1)


def _apply(A, x):
    """`A x` for `x` as (B, K, d)."""
    return jnp.einsum("bij,bj->bi", A, x.reshape(x.shape[0], -1)).reshape(x.shape)


@functools.partial(jax.custom_jvp, nondiff_argnums=(5,))
def _impulse(A, v, friction, lower, reference, settings: ConeSettings) -> _Internal:
    return _batched(settings, False)(A, v, friction, lower, reference)[0]


# The derivative. At the solution (or at the point of the central path where `smoothing` ends) the conditions
#
#     S (A f + delta (f - f_0) + v) = z + w e_n,   f = S y,   y = (f_n, g_t)
#
# with z and w eliminated by their linearised complementarity (dz = -W^-2 dy, dw = -D (dy_n - dlower)) give
#
#     (Q + W^-2 + D e_n e_n^T) dy
#         = -( dS (A f + delta (f - f_0) + v) + S (dA f + dv + (A + delta) dS y) ) + D e_n dlower
#
# with f_0 the centre of the proximal term, zero in the first round
# (optimality conditions as in Amos and Kolter, OptNet, 2017, eq. 6, for the cones used here). Everything on the right
# is linear in the tangents and the matrix is the solver's own, so that both modes, vmap and jit follow from this rule.
@_impulse.defjvp
def _impulse_jvp(settings, primals, tangents):
    A, v, friction, *_ = primals
    dA, dv, dfriction, dlower, _ = tangents  # `reference` only sets a scale
    solution, out = _batched(settings, True)(*primals)
    f = _friction_scale(out.regular, friction)
    after = _apply(A, f) + out.diagonal[:, None, None] * _friction_scale(out.moved, friction) + v
    # Where mu = 0 the tangent g is not determined by the problem, and z is the apex of its cone. For a growing mu,
    # friction opposes sliding, g = -f_n after_t / |after_t|, and z leaves the apex along its boundary: z_n = |z_t|,
    # with z_t = mu after_t.
    tangent = after[..., 1:]
    norm = jnp.sqrt(jnp.sum(tangent**2, axis=-1, keepdims=True))
    frictionless = friction[..., None] == 0
    sliding = -out.regular[..., :1] * tangent / jnp.where(norm > 0, norm, 1)
    g = jnp.where(frictionless, sliding, out.regular[..., 1:])
    boundary = jnp.where(frictionless, norm * dfriction[..., None], 0)
    dSy = jnp.concatenate([jnp.zeros_like(g[..., :1]), dfriction[..., None] * g], axis=-1)
    dS_after = jnp.concatenate([jnp.zeros_like(g[..., :1]), dfriction[..., None] * tangent], axis=-1)
    force = _apply(dA, f) + dv + _apply(A, dSy) + out.diagonal[:, None, None] * dSy
    rhs = -(dS_after + _friction_scale(force, friction))
    rhs = jnp.concatenate([rhs[..., :1] + (out.bound * dlower)[..., None] + boundary, rhs[..., 1:]], axis=-1)
    df = dSy + _friction_scale(_apply(out.inverse, rhs), friction)
    no_tangent = np.zeros(solution.iterations.shape, jax.dtypes.float0)
    return solution, _Internal(df, jnp.zeros_like(solution.residual), no_tangent)


class ConeSolution(NamedTuple):
    """Solutions of a batch of problems.

    `residual` is the largest violation of the optimality conditions, relative to the problem's scale (infinite where
    the data were not finite, which makes the impulse NaN); `iterations` is that of the block a problem was solved in.
    """

    impulse: Float[Array, "B K d"]
    residual: Float[Array, " B"]
    iterations: Int[Array, " B"]


def solve_cone_problem(
    A: Float[Array, "B n n"],
    v: Float[Array, "B K d"],
    friction: Float[Array, "B K"],
    lower: Float[Array, "B K"] | None = None,
    *,
    reference: Float[Array, "B K d"] | None = None,
    smoothing: float = 0.0,
) -> ConeSolution:
    """Minimise `1/2 f^T A f + f^T v` over friction cones, for a batch of problems.

    **Arguments:** `A` (B, K d, K d), symmetric positive semi-definite, velocity per impulse (1 / kg); `v` (B, K, d),
    velocities of the contact points, normal first (m/s); `friction` (B, K), Coulomb's mu >= 0; `lower` (B, K),
    least normal impulses (N s), >= 0, or `None` for zero; `reference` (B, K, d), velocities (m/s) that `v` is what
    remains of, if so: what is small beside them is rounding; `smoothing`, final value of the complementarity products
    relative to the problem's scale. An entry of `lower` that is `-inf` is no bound, as `None` is for all.

    A contact whose normal entry of `A` is zero is padding and gets no impulse. Where the impulse is not unique it is
    the one of least norm. The iterations run in double precision where that is enabled, whatever the dtype of the
    data. Differentiable once, in forward and reverse mode.

    **Source:** paper, eqs. 5 and 7, appendix C; method: Vandenberghe, *The CVXOPT linear and quadratic cone program
    solvers*, 2010.
    """
    dtype = v.dtype
    settings = ConeSettings.for_dtype(dtype, smoothing)
    widest = jnp.zeros((), float).dtype
    work = widest if widest.itemsize > dtype.itemsize else dtype
    lower = jnp.full_like(friction, -jnp.inf) if lower is None else lower
    reference = jnp.zeros_like(v) if reference is None else jax.lax.stop_gradient(reference)
    out = _impulse(*(x.astype(work) for x in (A, v, friction, lower, reference)), settings)
    return ConeSolution(out.impulse.astype(dtype), out.residual.astype(dtype), out.iterations)
