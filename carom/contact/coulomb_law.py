"""Coulomb's law as equations: their residual, their derivatives, and what of these the derivative needs. Arrays only.

Batch last, but where it is said: see `carom.contact.coulomb` for the problem, its scaling and the notation.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from carom.contact.batching import of_each
from carom.contact.cone_algebra import NEAR_APEX, dot, matvec

DELTA = 1e-9
"""The diagonal of softened problems, beside A_nn."""


class Problem(NamedTuple):
    """A batch of scaled problems, batch last."""

    Q: Float[Array, "n n B"]
    q: Float[Array, "K d B"]
    mu: Float[Array, "K B"]
    lower: Float[Array, "K B"]
    rho: Float[Array, "K B"]
    present: Bool[Array, "K B"]


class Modes(NamedTuple):
    """How the law looks near an impulse: which rows say what. `H` and its derivative, both by `u` and `y`."""

    H: Float[Array, "K d B"]
    closes: Bool[Array, "K B"]  # u_n = 0, and not f_n = lower
    sticks: Bool[Array, "K B"]
    along: Float[Array, "K t B"]  # direction of y_t - rho u_t
    share: Float[Array, "K B"]  # radius / |y_t - rho u_t| of those that slide
    radius: Float[Array, "K B"]  # of the disc, per unit of mu

    @classmethod
    def nothing(cls, problem: Problem) -> "Modes":
        """Where nothing is known yet."""
        zeros, no = jnp.zeros_like(problem.q), jnp.zeros(problem.mu.shape, bool)
        return cls(zeros, no, no, zeros[:, 1:], zeros[:, 0], zeros[:, 0])


def modes_at(problem: Problem, y: Float[Array, "K d B"], u: Float[Array, "K d B"], apex: Array | bool = False) -> Modes:
    """Modes at `y` with the velocities `u`; contacts in `apex` are held by their bound where `y` is next to zero."""
    trial = y[:, 0] - u[:, 0]
    closes = (trial > problem.lower) & ~(apex & (y[:, 0] < NEAR_APEX))
    pressed = jnp.where(closes, trial, problem.lower)
    radius = problem.mu * pressed
    push = y[:, 1:] - problem.rho[:, None] * u[:, 1:]
    length = jnp.sqrt(dot(push, push))
    sticks = (length <= radius) & (radius > 0)
    safe = jnp.where(length > 0, length, 1)
    along = push / safe[:, None]
    share = jnp.where(sticks, 1.0, radius / safe)
    normal = jnp.where(closes, u[:, 0], y[:, 0] - problem.lower)
    tangent = jnp.where(sticks[:, None], problem.rho[:, None] * u[:, 1:], y[:, 1:] - radius[:, None] * along)
    H = jnp.concatenate([normal[:, None], tangent], axis=1)
    return Modes(jnp.asarray(H), closes, sticks, along, jnp.asarray(share), pressed)


def _by_velocity(problem: Problem, modes: Modes, du: Float[Array, "K d m B"]) -> Float[Array, "K d m B"]:
    """`dH/du du`."""
    along, share = modes.along[:, :, None], modes.share[:, None, None]
    slides = ~modes.sticks
    normal = jnp.where(modes.closes[:, None], du[:, 0], 0)
    tangent = problem.rho[:, None, None] * du[:, 1:]
    across = tangent - along * jnp.sum(along * tangent, axis=1, keepdims=True)
    narrower = jnp.where(modes.closes, problem.mu, 0)[:, None, None] * along * du[:, :1]
    sliding = share * across + narrower
    tangent = jnp.where(slides[:, None, None], sliding, tangent)
    return jnp.concatenate([normal[:, None], tangent], axis=1)


def _by_impulse(problem: Problem, modes: Modes) -> Float[Array, "K d d B"]:
    """`dH/dy` of each contact at given velocities."""
    k, t, batch = modes.along.shape
    along, share = modes.along, modes.share
    eye = jnp.eye(t, dtype=along.dtype)[None, :, :, None]
    across = eye - along[:, :, None] * along[:, None]
    tangent = jnp.where(modes.sticks[:, None, None], 0, eye - share[:, None, None] * across)
    narrower = jnp.where(modes.sticks | ~modes.closes, 0, problem.mu)[:, None] * along
    first = jnp.where(modes.closes, 0, 1).astype(along.dtype)
    top = jnp.concatenate([first[:, None, None], jnp.zeros((k, 1, t, batch), along.dtype)], axis=2)
    return jnp.concatenate([top, jnp.concatenate([-narrower[:, :, None], tangent], axis=2)], axis=1)


def jacobian(problem: Problem, modes: Modes) -> Float[Array, "B n n"]:
    """`dH/dy + dH/du Q`."""
    k, d, batch = problem.q.shape
    whole = _by_velocity(problem, modes, problem.Q.reshape(k, d, k * d, batch)).reshape(k, d, k, d, batch)
    index = jnp.arange(k)
    whole = whole.at[index, :, index].add(_by_impulse(problem, modes))
    return jnp.moveaxis(whole.reshape(k * d, k * d, batch), -1, 0)


def softened(problem: Problem, delta=DELTA) -> Problem:
    n = problem.Q.shape[0]
    return problem._replace(Q=problem.Q + delta * jnp.eye(n, dtype=problem.Q.dtype)[..., None])


class Judged(NamedTuple):
    """An impulse and how it meets the law."""

    y: Float[Array, "K d B"]
    modes: Modes
    residual: Float[Array, " B"]


def judge(problem: Problem, y: Float[Array, "K d B"]) -> Judged:
    """Largest |H|: impulses relative to the largest, velocities to the largest term of `Q y + q`.

    Unlike `H` of the modes no mode can hide it: an impulse outside of its cone counts.
    """
    u = matvec(problem.Q, y) + problem.q
    modes = modes_at(problem, y, u)
    impulse = jnp.maximum(jnp.max(jnp.abs(y), axis=(0, 1)), 1)
    velocity = jnp.maximum(jnp.max(matvec(jnp.abs(problem.Q), jnp.abs(y)), axis=(0, 1)), 1)
    by_velocity = jnp.concatenate([modes.closes[:, None], jnp.broadcast_to(modes.sticks[:, None], y[:, 1:].shape)], 1)
    parts = jnp.abs(modes.H) / jnp.where(by_velocity, velocity, impulse)
    # What keeps to its bound or its cone by H alone may still be pushed through it.
    approach = jnp.where(problem.present, jnp.maximum(-u[:, 0], 0), 0) / velocity
    outside = jnp.sqrt(dot(y[:, 1:], y[:, 1:])) - problem.mu * jnp.maximum(y[:, 0], 0)
    beyond = jnp.maximum(jnp.maximum(outside, problem.lower - y[:, 0]), 0) / impulse
    worst = jnp.max(jnp.concatenate([parts, approach[:, None], beyond[:, None]], axis=1), axis=(0, 1))
    return Judged(y, modes, jnp.where(jnp.isfinite(worst), worst, jnp.inf))


class Scaled(NamedTuple):
    """Problems whose data are batch first as a scaled one, batch last; those that are not `finite` as one of zeros."""

    problem: Problem
    size: Float[Array, "K B"]  # y size unit = f
    unit: Float[Array, " B"]
    finite: Bool[Array, " B"]

    @classmethod
    def of(cls, A: Array, v: Array, friction: Array, lower: Array, reference: Array) -> "Scaled":
        """Each contact by its mobility, the whole by the largest velocity, or that of `reference` (m/s)."""
        finite = jnp.isfinite(v).all((1, 2)) & jnp.isfinite(A).all((1, 2)) & jnp.isfinite(friction).all(1)
        finite = finite & (lower < jnp.inf).all(1)

        def sound(x: Array) -> Array:
            return jnp.asarray(jnp.where(of_each(finite, x), x, 0))

        problem, size, unit = _scale(sound(A), sound(v), sound(friction), sound(lower), reference)
        return cls(problem, size, unit, finite)

    def inside(self, impulse: Float[Array, "B K d"]) -> Float[Array, "K d B"]:
        """Impulses (N s) as those of the scaled problem."""
        whole = self.size[:, None] * self.unit
        sound = jnp.where(of_each(self.finite, impulse), impulse, 0)
        return jnp.moveaxis(sound, 0, -1) / jnp.where(whole > 0, whole, jnp.inf)

    def outside(self, y: Float[Array, "K d B"]) -> Float[Array, "B K d"]:
        """Impulses (N s) of a scaled one; NaN where the data are not finite."""
        nan = jnp.asarray(jnp.where(self.finite, 0, jnp.nan), y.dtype)
        return jnp.moveaxis(y * self.size[:, None] * self.unit + nan, -1, 0)


def _scale(A: Array, v: Array, friction: Array, lower: Array, reference: Array):
    """Batch first to a scaled problem, batch last; also what turns its impulses into physical ones, and velocities."""
    batch, k, d = v.shape
    A = jnp.moveaxis(A, 0, -1).reshape(k, d, k, d, batch)
    index = jnp.arange(k)
    normal = A[index, 0, index, 0]
    present = normal > 0
    size = jnp.where(present, jax.lax.rsqrt(jnp.where(present, normal, 1)), 0)
    Q = size[:, None, None, None] * A * size[None, None, :, None]
    v, reference = jnp.moveaxis(v, 0, -1), jnp.moveaxis(reference, 0, -1)
    q = size[:, None] * v
    # Padding becomes: u_n = y_n + 1, with the solution 0.
    Q = Q.at[index, 0, index, 0].add(jnp.where(present, 0, 1))
    lower = jnp.where(present & (lower.T > 0), lower.T / jnp.where(present, size, 1), 0)
    largest = jnp.maximum(jnp.max(jnp.abs(q), axis=(0, 1)), jnp.max(lower, axis=0))
    largest = jnp.maximum(largest, jnp.max(jnp.abs(size[:, None] * reference), axis=(0, 1)))
    unit = jnp.maximum(largest, jnp.finfo(v.dtype).tiny ** 0.5)
    q = jnp.where(present[:, None], q / unit, jnp.zeros_like(q).at[:, 0].set(1))
    own = jnp.abs(Q[index, 1:, index, 1:])
    stiff = jnp.max(jnp.sum(own, axis=2), axis=1)
    rho = jnp.where(stiff > 0, 1 / jnp.where(stiff > 0, stiff, 1), 1)
    return Problem(Q.reshape(k * d, k * d, batch), q, friction.T, lower / unit, rho, present), size, unit


class Sensitivity(NamedTuple):
    """What the derivative needs, batch first and in physical units: `df = -inverse (by_u (dA f + dv) + ...)`."""

    matrix: Float[Array, "B n n"]  # dH/dy, which is solved with
    by_velocity: Float[Array, "B K d d"]  # dH/du of each contact
    by_friction: Float[Array, "B K d"]  # dH/dmu
    by_bound: Float[Array, "B K d"]  # dH/dlower
    size: Float[Array, "B K"]


def sensitivity_of(A: Array, v: Array, friction: Array, lower: Array, reference: Array, impulse: Array) -> Sensitivity:
    """That of solved problems, batch first in and out; of those whose data are not finite, any."""
    scaled = Scaled.of(A, v, friction, lower, reference)
    problem, size, unit, _ = scaled
    y = scaled.inside(impulse)
    k, d, batch = y.shape
    bounded, soft = (lower >= 0).T, softened(problem)
    u = matvec(soft.Q, y) + problem.q
    # A bound of zero holds wherever the impulse is next to zero: the derivative is the one-sided one for a growing
    # bound, whichever side rounding has put the velocity on.
    modes = modes_at(soft, y, u, bounded & (problem.lower == 0))
    eye = jnp.broadcast_to(jnp.eye(d, dtype=y.dtype)[None, :, :, None], (k, d, d, batch))
    by_velocity = _by_velocity(soft, modes, eye)
    slides = ~modes.sticks
    by_friction = jnp.where(slides[:, None], -modes.radius[:, None] * modes.along, 0)
    by_friction = jnp.concatenate([jnp.zeros_like(by_friction[:, :1]), by_friction], axis=1)
    held = jnp.where(modes.closes, 0, 1).astype(y.dtype)
    by_bound = jnp.where((slides & ~modes.closes)[:, None], -problem.mu[:, None] * modes.along, 0)
    by_bound = jnp.concatenate([-held[:, None], by_bound], axis=1)
    return Sensitivity(
        matrix=jacobian(soft, modes),
        by_velocity=jnp.moveaxis(by_velocity * size[:, None, None], -1, 0),
        by_friction=jnp.moveaxis(by_friction * unit, -1, 0),
        by_bound=jnp.moveaxis(by_bound / jnp.where(size > 0, size, 1)[:, None], -1, 0),
        size=size.T,
    )
