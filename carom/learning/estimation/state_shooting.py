"""Multiple shooting: windows of recorded states, whose start states are estimated together with the unknowns.

A chunk that starts from a recorded state carries that state's error along. Where this is larger than what a step moves,
which contacts close, and when, is up to the noise. Here the start `z_w = (x_w, v_w)` of each window `w` is unknown too
(H. G. Bock, 1983): starts and unknowns `theta` minimise together

    sum_w sum_k rho(|r_wk|^2),   r_wk = (state k of the motion that starts from z_w - recorded state k) / errors,

by steps of Gauss and Newton in which the starts are eliminated, window by window (Schur's complement; G. Golub,
V. Pereyra, 1973). So all states of a window tell of its start. `rho` is that of `robust.py`: the state right after an
impact that comes a step early or late does not fit, and has little weight.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from carom.learning.dataset import Dataset
from carom.learning.estimation.refine import MOST_CHANGE
from carom.learning.estimation.robust import CUTOFF, newton_step
from carom.learning.estimation.state_windows import Windows, choose_windows, is_noisy, step_errors, window_directions
from carom.learning.unknowns.models import Unknowns
from carom.learning.unknowns.parameters import (
    at_bounds,
    bounds,
    linear_weights,
    moved,
    physical,
    physical_vector,
    ridge,
)
from carom.recordings.recording import Recording
from carom.simulation.impact import Stepper
from carom.simulation.projection import project_state
from carom.simulation.rollout import step
from carom.system import System

BATCH = 64
"""Windows that are looked at together."""


def _residual(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, scale: Array, z: Array, x: Array, v: Array
) -> Array:
    """Of all states (L, R) of a window that starts from `z` (2, n, d), brought onto the constraints."""
    system = unknowns.assemble(skeleton)
    start = project_state(system.constraints, z[0], z[1], system.inverse_mass_matrix(), steps=3)

    def body(state, _):
        out = step(system, state[0], state[1], stepper)
        return (out.x, out.v), (out.x, out.v)

    _, (xs, vs) = jax.lax.scan(body, start, length=x.shape[0] - 1)
    both = [jnp.concatenate([first[None], rest]) for first, rest in zip(start, (xs, vs), strict=True)]
    error = jnp.concatenate([(both[0] - x).reshape(len(x), -1), (both[1] - v).reshape(len(x), -1)], axis=1)
    # A motion that goes wrong is far off, but not lost.
    error = error / scale
    return jnp.where(jnp.isfinite(error), error, jnp.full_like(error, 1e3))


def _loss(distance: Array, redescend) -> Array:
    """rho of a state's mean squared residual: Geman and McClure's, or Huber's."""
    huber = jnp.where(distance < 2, distance, 2 * jnp.sqrt(2 * jnp.maximum(distance, 2)) - 2)
    return jnp.where(jnp.asarray(redescend), distance / (1 + distance / CUTOFF), huber)


def _weight(distance: Array, redescend) -> Array:
    huber = jnp.minimum(1, jnp.sqrt(2 / jnp.maximum(distance, 1e-30)))
    return jnp.where(jnp.asarray(redescend), (1 + distance / CUTOFF) ** -2, huber)


@eqx.filter_jit
def _fit_starts(unknowns, skeleton, stepper, scale, z, x, v, used, rounds, redescend):
    """Starts that fit the states `used` of each window best, and the distances (W, L) of all its states.

    Levenberg and Marquardt's method in each window by itself: a step that fits worse is not made.
    """

    def one(z, x, v, used):
        def residual(flat):
            return _residual(unknowns, skeleton, stepper, scale, flat.reshape(z.shape), x, v)

        def cost(u):
            return jnp.sum(used * _loss(jnp.mean(u**2, axis=1), redescend))

        def body(_, state):
            flat, damping, u = state
            jacobian = jax.jacfwd(residual)(flat)
            weight = used * _weight(jnp.mean(u**2, axis=1), redescend)
            hessian = jnp.einsum("lri,l,lrj->ij", jacobian, weight, jacobian)
            gradient = jnp.einsum("lri,l,lr->i", jacobian, weight, u)
            diagonal = jnp.diag(hessian)
            diagonal = damping * diagonal + 1e-9 * jnp.max(diagonal)
            new = flat - jnp.linalg.solve(hessian + jnp.diag(diagonal), gradient)
            there = residual(new)
            better = cost(there) < cost(u)
            return (
                jnp.where(better, new, flat),
                jnp.where(better, damping / 5, damping * 5),
                jnp.where(better, there, u),
            )

        flat = z.reshape(-1)
        flat, _, u = jax.lax.fori_loop(0, rounds, body, (flat, jnp.asarray(1e-3, z.dtype), residual(flat)))
        return flat.reshape(z.shape), u

    return jax.vmap(one)(z, x, v, used)


class _Reduced(NamedTuple):
    """Of each window: curvature and gradient by the parameters with its start eliminated, and how the start follows."""

    curvature: Float[Array, "W p p"]
    gradient: Float[Array, "W p"]
    follow: Float[Array, "W R p"]
    own: Float[Array, "W R"]


@eqx.filter_jit
def _reduced(unknowns, skeleton, stepper, features, scale, z, x, v, redescend):
    count = sum(part.size for part in physical(unknowns).values()) + features.shape[1]

    def one(z, x, v):
        def residual(flat, change):
            there = moved(unknowns, features, change)
            return _residual(there, skeleton, stepper, scale, flat.reshape(z.shape), x, v)

        flat, nothing = z.reshape(-1), jnp.zeros(count, z.dtype)
        u = residual(flat, nothing)
        by_start, by_change = jax.jacfwd(residual, argnums=(0, 1))(flat, nothing)
        root = jnp.sqrt(_weight(jnp.mean(u**2, axis=1), redescend))[:, None]
        J = (by_start * root[..., None]).reshape(u.size, -1)
        K = (by_change * root[..., None]).reshape(u.size, -1)
        r = (u * root).reshape(-1)
        hessian = J.T @ J
        hessian = hessian + 1e-9 * jnp.max(jnp.diag(hessian)) * jnp.eye(len(hessian))
        follow = jnp.linalg.solve(hessian, J.T @ K)
        own = jnp.linalg.solve(hessian, J.T @ r)
        left = K - J @ follow
        return _Reduced(left.T @ left, left.T @ r, follow, own)

    return jax.vmap(one)(z, x, v)


ROUNDS = 12
"""Most steps for the unknowns."""
CONVEX = 4
"""So many of them are by Huber's loss, the others by the redescending one."""
SETTLED = 0.05
"""A step that moves the physical parameters by less than this share of their standard errors is the last."""


class Shooting:
    """Windows to fit, with the starts found so far."""

    def __init__(self, skeleton: System, stepper: Stepper, windows: Windows, features: Float[np.ndarray, "W F"]):
        self.skeleton, self.stepper, self.windows, self.features = skeleton, stepper, windows, features
        self.z = np.stack([windows.x[:, 0], windows.v[:, 0]], axis=1)
        count, length = windows.x.shape[:2]
        self.before = np.arange(length) < windows.run_in[:, None]
        self.errors = np.ones(2 * windows.x[0, 0].size)
        self.residual = np.zeros((count, length, len(self.errors)))

    def _batches(self, *arrays):
        """Starts, states and `arrays` in batches of one size; the last one is filled up with its last window."""
        count = len(self.windows.x)
        for first in range(0, count, BATCH):
            rows = np.arange(first, first + BATCH).clip(max=count - 1)
            yield [jnp.asarray(a[rows]) for a in (self.z, self.windows.x, self.windows.v, *arrays)]

    def measure_errors(self) -> None:
        """Errors of the recorded numbers, one for the positions of each point and one for its velocities.

        Robust (median), from the states before contacts, which a fit of the starts has left.
        """
        n, d = self.windows.x.shape[2:]
        own = (self.residual * self.errors)[self.before].reshape(-1, 2, n, d)
        size = 1.4826 * np.median(np.abs(own), axis=(0, 3))
        speed = np.sqrt(np.mean(self.windows.v**2))
        floor = 1e-9 * max(speed, 1e-9) * np.array([float(self.stepper.dt), 1.0])[:, None]
        new = np.repeat(np.maximum(size, floor).reshape(-1), d)
        self.residual *= self.errors / new
        self.errors = new

    def fit_starts(self, unknowns: Unknowns, rounds: int, *, redescend: bool, before: bool = False) -> None:
        """Fit the starts to all states, or to those before contacts only."""
        used = self.before if before else np.ones_like(self.before)
        how = jnp.asarray(rounds), jnp.asarray(redescend)
        parts = [
            _fit_starts(unknowns, self.skeleton, self.stepper, jnp.asarray(self.errors), z, x, v, u, *how)
            for z, x, v, u in self._batches(used.astype(float))
        ]
        z, residual = (
            np.concatenate([np.asarray(p) for p in part])[: len(self.z)] for part in zip(*parts, strict=True)
        )
        self.z, self.residual = z, residual

    def follow(self, unknowns: Unknowns, change: Float[np.ndarray, "W 2 n d"], *, redescend: bool) -> None:
        """Move the starts of those windows that then fit better."""
        self.fit_starts(unknowns, 0, redescend=redescend)
        z, cost = self.z, self.costs(redescend=redescend)
        self.z = z + change
        self.fit_starts(unknowns, 0, redescend=redescend)
        better = self.costs(redescend=redescend) < cost
        self.z = np.where(better[:, None, None, None], self.z, z)

    def costs(self, *, redescend: bool) -> Float[np.ndarray, " W"]:
        """Mean of rho over the states of each window."""
        return np.mean(np.asarray(_loss(jnp.mean(jnp.asarray(self.residual) ** 2, axis=2), redescend)), axis=1)

    def cost(self, *, redescend: bool) -> float:
        """Mean of rho over all states."""
        return float(np.mean(self.costs(redescend=redescend)))

    def reduced(self, unknowns: Unknowns, *, redescend: bool) -> _Reduced:
        """See `_Reduced`."""
        held = (self.skeleton, self.stepper, jnp.asarray(self.features), jnp.asarray(self.errors))
        parts = [_reduced(unknowns, *held, z, x, v, jnp.asarray(redescend)) for z, x, v in self._batches()]
        return jax.tree.map(lambda *a: np.concatenate([np.asarray(p) for p in a])[: len(self.z)], *parts)

    def states(self) -> Recording:
        """The motion that was fitted, each window a trajectory."""
        x, v = self.windows.x, self.windows.v
        fitted = self.residual * self.errors + np.concatenate([part.reshape(*part.shape[:2], -1) for part in (x, v)], 2)
        x, v = (part.reshape(x.shape) for part in np.split(fitted, 2, axis=2))
        return Recording.of(x, v, time=np.arange(self.windows.x.shape[1]) * float(self.stepper.dt))

    def fit(self, unknowns: Unknowns, *, redescend: bool = True) -> float:
        """Fit the starts to the motion of `unknowns`, from the recorded ones; returns the cost."""
        self.z = np.stack([self.windows.x[:, 0], self.windows.v[:, 0]], axis=1)
        self.fit_starts(unknowns, 8, redescend=False, before=True)
        self.fit_starts(unknowns, 8, redescend=redescend)
        return self.cost(redescend=redescend)


class Fitted(NamedTuple):
    """What shooting came to: the unknowns, and the standard errors of the physical ones."""

    unknowns: Unknowns
    standard_error: Float[np.ndarray, " p"]


def shoot(
    shooting: Shooting, unknowns: Unknowns, *, rounds: int = ROUNDS, each: Callable[[], None] | None = None
) -> Fitted:
    """The unknowns that fit the windows best, by Gauss-Newton steps from those given.

    `each` is called after each step.
    """
    count, features = len(physical_vector(unknowns)), shooting.features
    directions = features.shape[1]
    stiff = ridge(unknowns)
    prior = np.eye(count + directions)
    prior[count:, count:] = features.T @ (stiff[:, None] * features)
    most = np.concatenate([np.full(count, MOST_CHANGE), np.full(directions, np.inf)])
    for _ in range(2):
        shooting.fit_starts(unknowns, 8, redescend=False, before=True)
        shooting.measure_errors()
    error = np.full(count, np.inf)
    for k in range(rounds):
        redescend = k >= CONVEX
        shooting.measure_errors()
        reduced = shooting.reduced(unknowns, redescend=redescend)
        pull = np.zeros(count + directions)
        pull[count:] = features.T @ (stiff * linear_weights(unknowns))
        now = np.concatenate([physical_vector(unknowns), np.zeros(directions)])
        lower, upper = (np.pad(end, (0, directions), constant_values=rest) - now for end, rest in _bounds(unknowns))
        H, g = reduced.curvature.sum(axis=0), reduced.gradient.sum(axis=0)
        change = newton_step(H, g, prior, pull, np.zeros_like(pull), np.maximum(lower, -most), np.minimum(upper, most))
        cost, z, residual = shooting.cost(redescend=redescend), shooting.z, shooting.residual
        for _ in range(4):
            new = moved(unknowns, features, change)
            shooting.z = z
            shooting.follow(new, -(reduced.own + reduced.follow @ change).reshape(z.shape), redescend=redescend)
            shooting.fit_starts(new, 3, redescend=redescend)
            if shooting.cost(redescend=redescend) < cost or k == 0:  # the starts have not been fitted to contacts yet
                break
            change = change / 3
        else:
            shooting.z, shooting.residual = z, residual
            if redescend:
                break
            continue
        unknowns = new
        if each is not None:
            each()
        error = _standard_errors(reduced, shooting.windows.trajectory, prior)[:count]
        if k > CONVEX and np.all(np.abs(change[:count]) < SETTLED * error):
            break
    return Fitted(unknowns, error)


def _bounds(unknowns: Unknowns):
    return zip(bounds(unknowns), (-np.inf, np.inf), strict=True)


def _standard_errors(reduced: _Reduced, trajectory: Int[np.ndarray, " W"], prior) -> Float[np.ndarray, " p"]:
    """The greater of the sandwich's, with windows of one trajectory together, and the curvature's (see `robust.py`)."""
    inverse = np.linalg.inv(reduced.curvature.sum(axis=0) + prior)
    influence = reduced.gradient @ inverse
    _, index = np.unique(trajectory, return_inverse=True)
    total = np.zeros((index.max(initial=0) + 1, influence.shape[1]))
    np.add.at(total, index, influence)
    return np.sqrt(np.maximum(np.sum(total**2, axis=0), np.diag(inverse)))


LEAST = 50
"""Fewer windows are not enough to estimate from."""
AS_WELL = 1e-3
"""A cost that is higher by this share is no reason against a bound."""
AS_GOOD = 1.25
"""Windows fit if the states before their contacts are left with errors of at most so many times those of one step."""


class Shot(NamedTuple):
    """Unknowns estimated together with the start states of windows; whether these are as well predicted as steps."""

    unknowns: Unknowns
    fits: bool


def shooting_of(
    unknowns: Unknowns, skeleton: System, stepper: Stepper, recording: Recording, *, seed: int
) -> Shooting | None:
    """Windows to estimate from, if the recording is noisy and has enough of them."""
    if not is_noisy(step_errors(unknowns, skeleton, stepper, recording, seed=seed), recording):
        return None
    windows = choose_windows(recording, skeleton, seed=seed)
    if len(windows.x) < LEAST:
        return None
    return Shooting(skeleton, stepper, windows, window_directions(unknowns, skeleton, windows))


def estimate(
    unknowns: Unknowns,
    skeleton: System,
    stepper: Stepper,
    dataset: Dataset,
    *,
    seed: int,
    each: Callable[[], None] | None = None,
    rival: Unknowns | None = None,
) -> Shot | None:
    """Unknowns and start states together, where recorded states are noisier than `NOISE` of what a step moves.

    None for data with less noise, or with no room for enough windows. Of what comes out and `rival`, that which fits
    windows of the validation data better, by the same sizes of errors. Frictions and restitutions near a bound are put
    there if windows of the validation data then fit at least as well.
    """
    shooting = shooting_of(unknowns, skeleton, stepper, dataset.train, seed=seed)
    held = choose_windows(dataset.val, skeleton, seed=seed)
    if shooting is None or not len(held.x):
        return None
    found = shoot(shooting, unknowns, each=each).unknowns
    held_out = Shooting(skeleton, stepper, held, shooting.features)
    held_out.errors = shooting.errors
    there, cost = at_bounds(found), held_out.fit(found)
    if np.any(physical_vector(there) != physical_vector(found)):
        cost_there = held_out.fit(there)
        if cost_there <= cost * (1 + AS_WELL):
            found, cost = there, cost_there
    if rival is not None and held_out.fit(rival) < cost:
        found = rival
    single = step_errors(found, skeleton, stepper, dataset.train, seed=seed)
    return Shot(found, bool(np.all(shooting.errors <= AS_GOOD * single)))
