"""Friction-cone problems: cones, their scaling, the Newton matrix and the optimality conditions. Arrays only.

Batch last: see `carom.contact.cones` for the problem, its scaling and the notation.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.contact.linalg import Cholesky, triangle_of

TINY = 1e-30
NEAR_APEX = 1e-5
"""An impulse that is nearer to the apex than this, in shares of the scale, is at it, for the derivative."""


class ConeSettings(NamedTuple):
    """Knobs of the interior-point method; all are relative to the problem's own scale.

    `tolerance` is the largest residual of the optimality conditions (stationarity, complementarity) at which a problem
    counts as solved. `target` is the residual at which its iterations stop. `diagonal` is delta: what each contact's
    own block gets, relative to its A_nn. `smoothing` stops at that value of the complementarity products instead of at
    `target`, which smooths the derivative across the transitions between sticking, sliding and separating. `least_norm`
    says whether the impulse of least norm is wanted to rounding.
    """

    tolerance: float
    target: float
    diagonal: float
    smoothing: float = 0.0
    max_iterations: int = 40
    least_norm: bool = True

    @classmethod
    def for_dtype(cls, dtype, smoothing: float = 0.0, *, work=None) -> "ConeSettings":
        """Settings that suit problems whose data were computed in `dtype`, solved in `work` (by default the same).

        The diagonal makes up for rounding: of `A`, which is not quite positive semi-definite then, and of the
        factorisation. More of it costs proximal rounds where a contact has little of the trace.
        """
        if dtype == jnp.float64:
            return cls(tolerance=1e-8, target=1e-10, diagonal=1e-9, smoothing=smoothing)
        diagonal = 1e-6 if work == jnp.float64 else 1e-5
        return cls(tolerance=1e-4, target=1e-6, diagonal=diagonal, smoothing=smoothing)


class Problem(NamedTuple):
    """A batch of scaled problems, batch last."""

    Q: Float[Array, "n n B"]
    q: Float[Array, "K d B"]
    lower: Float[Array, "K B"]


class Iterate(NamedTuple):
    y: Float[Array, "K d B"]  # scaled impulse = slack of the cone
    u: Float[Array, "K B"]  # slack of the bound
    z: Float[Array, "K d B"]  # multiplier of the cone
    w: Float[Array, "K B"]  # multiplier of the bound


def dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=1)


def det(x: Array) -> Array:
    """`x_0^2 - |x_1|^2`: positive inside the second-order cone."""
    norm = jnp.sqrt(dot(x[:, 1:], x[:, 1:]))
    return (x[:, 0] - norm) * (x[:, 0] + norm)


def jordan_product(a, b):
    return jnp.concatenate([dot(a, b)[:, None], a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:]], axis=1)


def jordan_divide(a, b):
    """The `x` with `a o x = b`."""
    x0 = (a[:, 0] * b[:, 0] - dot(a[:, 1:], b[:, 1:])) / det(a)
    return jnp.concatenate([x0[:, None], (b[:, 1:] - x0[:, None] * a[:, 1:]) / a[:, :1]], axis=1)


class Scaling(NamedTuple):
    """Nesterov-Todd scaling of each cone, by the eigenvectors of `W` and the eigenvalues of `W^-1`."""

    direction: Float[Array, "K t B"]
    inverse: Float[Array, "K d B"]

    @classmethod
    def of(cls, s: Array, z: Array):
        det_s, det_z = det(s), det(z)
        s_bar, z_bar = s / jnp.sqrt(det_s)[:, None], z / jnp.sqrt(det_z)[:, None]
        gamma = jnp.sqrt((1 + dot(s_bar, z_bar)) / 2)
        tangent = (s_bar[:, 1:] - z_bar[:, 1:]) / (2 * gamma[:, None])
        norm = jnp.sqrt(dot(tangent, tangent))
        omega = jnp.sqrt(1 + norm**2) + norm
        default = jnp.zeros_like(tangent).at[:, 0].set(1)
        safe = norm[:, None] > 1e-30
        direction = jnp.where(safe, tangent / jnp.where(safe, norm[:, None], 1), default)
        inverse_beta = jnp.sqrt(jnp.sqrt(det_z / det_s))
        entries = [inverse_beta / omega, inverse_beta * omega, inverse_beta][: s.shape[1]]
        return cls(direction, jnp.stack(entries, axis=1))

    def along_tangent(self) -> Float[Array, "K d d B"]:
        """For each contact the matrix whose columns are the normal, the tangent `u` and (in 3D) the one across it."""
        u = self.direction
        zero, one = jnp.zeros_like(u[:, 0]), jnp.ones_like(u[:, 0])
        if u.shape[1] == 1:
            rows = [[one, zero], [zero, u[:, 0]]]
        else:
            rows = [[one, zero, zero], [zero, u[:, 0], -u[:, 1]], [zero, u[:, 1], u[:, 0]]]
        return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)

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


def matvec(Q, y):
    return jnp.sum(Q * y.reshape(1, -1, y.shape[-1]), axis=1).reshape(y.shape)


def apply(A: Float[Array, "B n n"], x: Float[Array, "B K d"]) -> Float[Array, "B K d"]:
    """`A x`, batch first."""
    return jnp.einsum("bij,bj->bi", A, x.reshape(x.shape[0], -1)).reshape(x.shape)


def pick(stacked: Any, chosen: Int[Array, " B"]) -> Any:
    """Of a tree of arrays (m, ..., B) for each of the batch the one that is `chosen`, as (..., B)."""

    def of(x: Array) -> Array:
        mine = (jnp.arange(x.shape[0])[:, None] == chosen).reshape(x.shape[0], *(1,) * (x.ndim - 2), -1)
        return jnp.any(mine & x, axis=0) if x.dtype == bool else jnp.sum(jnp.where(mine, x, 0), axis=0)

    return jax.tree.map(of, stacked)


def add_normal(x, normal):
    return x.at[:, 0].add(normal)


# The eigenvectors p, m and the one across, as columns along (normal, u, across u), times their lengths.
_TURN = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
_LENGTH = np.array([2**0.5, 2**0.5, 1.0])


class Factored(NamedTuple):
    """A factored `NewtonMatrix`, as it is kept for the derivative: its inverse is `frame L^-T L^-1 frame^T`."""

    parts: tuple[Array, ...]  # of L
    frame: Float[Array, "K d d B"]
    curvature: Float[Array, "K B"]  # D, of the bounds
    sticks: Bool[Array, "K B"]  # contacts inside of their cone: W^-2 = 0

    def triangle(self) -> Float[Array, "B n n"]:
        return triangle_of(self.parts)


class NewtonMatrix:
    """`Q + W^-2 + D e_n e_n^T`, factored, each contact in the frame in which its own block loses nothing to rounding.

    That is the frame of the scaling's eigenvectors, unless the bound holds the contact harder than the cone does:
    then it is (normal, u, across u), in which `D` is a single entry and no large entry meets the one across.
    """

    def __init__(
        self,
        Q: Float[Array, "n n B"],
        scaling: Scaling,
        curvature: Float[Array, "K B"],
        rhs: Float[Array, "K d m B"] | None = None,
        *,
        unrolled: bool = True,
    ):
        k, d, batch = scaling.inverse.shape
        rotated = (jnp.max(scaling.inverse, axis=1) ** 2 > curvature)[:, None, None]
        turn, length = (x.astype(Q.dtype) for x in (_TURN[:d, :d, None], _LENGTH[:d, None]))
        plain = scaling.along_tangent()
        self.curvature = curvature
        self.sticks = jnp.all(scaling.inverse == 0, axis=1)
        # The division keeps XLA from forming the frame again for every entry that it turns.
        turned = jnp.where(rotated, jnp.sum(plain[:, :, :, None] * turn, axis=2), plain)
        self.frame = turned / jnp.where(rotated, length, 1)
        H = self.rotate(Q.reshape(k, d, k * d, batch)).reshape(k * d, k * d, batch).swapaxes(0, 1)
        H = self.rotate(H.reshape(k, d, k * d, batch)).reshape(k, d, k, d, batch)
        # The contact's own block, W^-2 + D e_n e_n^T, in its frame; across the tangent it is W^-2 alone.
        squared, D = scaling.inverse**2, curvature
        mean, half = (squared[:, 0] + squared[:, 1]) / 2, (squared[:, 0] - squared[:, 1]) / 2
        first = jnp.where(rotated[:, 0, 0], squared[:, 0] + D / 2, mean + D)
        second = jnp.where(rotated[:, 0, 0], squared[:, 1] + D / 2, mean)
        both = jnp.where(rotated[:, 0, 0], D / 2, half)
        zero = jnp.zeros_like(D)
        rows = [[first, both, zero], [both, second, zero], [zero, zero, squared[:, -1]]]
        block = jnp.stack([jnp.stack(row[:d], axis=1) for row in rows[:d]], axis=1)
        index = jnp.arange(k)
        H = H.at[index, :, index].add(block)
        H = H.reshape(k * d, k * d, batch)
        if rhs is None:
            self.factor = Cholesky(H, unrolled=unrolled)
        else:
            self.factor = Cholesky(H, self.rotate(rhs).reshape(k * d, -1, batch), unrolled=unrolled)
            self.solution = self.restore(self.factor.solution.reshape(rhs.shape))

    def factored(self) -> Factored:
        return Factored(self.factor.parts, self.frame, self.curvature, self.sticks)

    def rotate(self, x: Float[Array, "K d *m B"]) -> Float[Array, "K d *m B"]:
        """Components along the frame's axes."""
        frame = self.frame.reshape(*self.frame.shape[:3], *(1,) * (x.ndim - 3), -1)
        return jnp.sum(frame * x[:, :, None], axis=1)

    def restore(self, x: Float[Array, "K d *m B"]) -> Float[Array, "K d *m B"]:
        """The inverse of `rotate`."""
        frame = self.frame.reshape(*self.frame.shape[:3], *(1,) * (x.ndim - 3), -1)
        return jnp.sum(frame * x[:, None], axis=2)

    def solve(self, rhs: Float[Array, "K d *m B"]) -> Float[Array, "K d *m B"]:
        flat = self.rotate(rhs).reshape(-1, *rhs.shape[2:])
        return self.restore(self.factor.solve(flat).reshape(rhs.shape))


def bound_multiplier(problem: Problem, g: Array) -> Array:
    """The largest multiplier of the bounds that leaves `g = Q y + q` in the cone; none where there is no bound."""
    slip = jnp.sqrt(dot(g[:, 1:], g[:, 1:]))
    return jnp.where(problem.lower >= 0, jnp.maximum(g[:, 0] - slip, 0), 0)


def residual_of(problem: Problem, y: Array, diagonal: Array | float = 0.0) -> Array:
    """Violation of the optimality conditions of the problem, with `diagonal` taken away from `Q`, by `y` alone.

    Impulses are relative to the largest, velocities to the largest term of `Q y + q`: more cannot be asked of data that
    are rounded. Rounding does not explain what is above `_GROSS`: that is taken as it is, so that huge impulses do not
    hide a problem without a solution. The whole product `s o z` counts: `s . z` alone changes only with the square of
    the angle by which a tangential impulse is turned.
    """
    g = matvec(problem.Q, y) - diagonal * y + problem.q
    w = bound_multiplier(problem, g)
    z = add_normal(g, -w)
    slip, push = (jnp.sqrt(dot(a[:, 1:], a[:, 1:])) for a in (z, y))
    above = y[:, 0] - problem.lower
    impulse = jnp.maximum(jnp.max(jnp.abs(y), axis=(0, 1)), 1)
    velocity = jnp.maximum(jnp.max(matvec(jnp.abs(problem.Q), jnp.abs(y)), axis=(0, 1)), 1)
    primal = jnp.maximum(push - y[:, 0], -above) / impulse
    cone = jnp.max(jnp.abs(jordan_product(y, z)), axis=1) / impulse
    bound = jnp.abs(w * above) / impulse
    dual = jnp.max(jnp.stack([slip - z[:, 0], cone, bound]), axis=0)
    gross = jnp.where(dual > _GROSS, dual, 0)
    return jnp.max(jnp.max(jnp.stack([primal, dual / velocity, gross]), axis=0), axis=0)


_GROSS = 1e-3


# --- From physical to scaled problems and back -----------------------------------------------------------------


class Scales(NamedTuple):
    """What turns scaled quantities into physical ones; see `scale`."""

    S: Float[Array, "K d B"]  # y_scaled * S * unit = f
    mu: Float[Array, "K B"]
    size: Float[Array, "K B"]  # 1 / sqrt(A_nn): y_scaled * size * unit = (f_n, g_t)
    unit: Float[Array, " B"]
    diagonal: Float[Array, "K B"]  # delta A_nn
    regularization: Float[Array, "K d B"]  # the diagonal that delta becomes in the scaled problem
    apex: Bool[Array, "K B"]  # contacts whose bound is zero


def scale(A: Array, v: Array, friction: Array, lower: Array, reference: Array, delta: float) -> tuple[Problem, Scales]:
    """Batch last: A (K, d, K, d, B), v and reference (K, d, B), friction, lower (K, B)."""
    k, d, batch = v.shape
    dtype = v.dtype
    index = jnp.arange(k)
    normal = A[index, 0, index, 0]
    # A contact without inverse inertia is padding. It becomes: minimise f_n^2 / 2 + f_n, with the solution 0.
    present = normal > 0
    diagonal = jnp.asarray(delta * jnp.where(present, normal, 0))
    size = jnp.where(present, jax.lax.rsqrt(jnp.where(present, normal + diagonal, 1)), 0)
    S = size[:, None] * jnp.concatenate(
        [jnp.ones((k, 1, batch), dtype), jnp.broadcast_to(friction[:, None], (k, d - 1, batch))], axis=1
    )
    regularization = S**2 * diagonal[:, None]
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
    problem = Problem(Q.reshape(k * d, k * d, batch), q, lower)
    return problem, Scales(S, friction, size, unit, diagonal, regularization, apex)


# Where there is no bound, that of the scaled problem is here: the cone keeps the impulse away from it.
_NO_BOUND = -1.0
