"""Multiple shooting: the start of each window is estimated together with the quantities.

Starts `z_w` and free numbers `theta` minimise together (H. G. Bock, 1983)

    sum_w sum_k rho(|r_wk|^2),   r_wk = (positions at time k of the motion from z_w - those seen) / errors,

by steps of Gauss and Newton, in which the starts are eliminated window by window (Schur's complement). `rho` is convex
at first, then that of Geman and McClure: what fits under no quantities, such as the motion after an impact that
is missed, has little weight. What counts as not fitting is told by the size of what is left after impacts, so that
exact data, whose motion before impacts fits at once, are learned from as well.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from carom.learning.estimation.flow import Flow, Motion
from carom.learning.estimation.robust import CUTOFF, newton_step, spectrum
from carom.learning.estimation.windows import Windows

Loss = Literal["convex", "redescending", "squares"]
SETTLED = 0.1
"""A step that moves the free numbers by less than this share of their standard errors is the last."""
MOST = 3.0
"""A step moves a free number by so many of its scales at most."""
WIDE = 3.0
"""Standard deviation of what a step may move, in scales of the quantities."""
CHAOTIC = 1e9
"""Motion whose derivatives by the start have grown to so many times their size there is lost."""
FAR = 10.0
"""Motion that is lost is so far off, in sizes of what is seen."""
EXACT = 0.1
"""Where so much of the noise is left before impacts, in mean squares, data are better than it was found to be."""
TIES = 1e-11
"""Curvature of a start below this share is none: constraints hold it."""
OUTLIER = 6.0
"""So are samples that are off by more than so many typical errors."""
LOST = 4.0
"""Windows whose mean squared residual is more than so many times the typical one do not fit."""


MISFIT = 2.0
"""What is left after impacts is no noise where it is more than so many times what is left before them."""


class Reduced(NamedTuple):
    """Of each window: curvature and gradient by theta with its start eliminated, and how the start follows."""

    curvature: Float[np.ndarray, "W P P"]
    gradient: Float[np.ndarray, "W P"]
    follow: Float[np.ndarray, "W S P"]
    own: Float[np.ndarray, "W S"]


class State(NamedTuple):
    """Where the estimate is: free numbers, starts, the motion from there, and its residuals."""

    theta: Float[np.ndarray, " P"]
    z: Float[np.ndarray, "W 2 n d"]
    motion: Motion
    residual: Float[np.ndarray, "W T R"]


class Shooting:
    """Windows to fit.

    `noise`: errors of each number (R,), beside those of times; `used`: windows that tell of theta, the others only fit;
    `least`: a mean squared residual that is rounding.
    """

    def __init__(
        self,
        flow: Flow,
        windows: Windows,
        noise: Float[np.ndarray, " R"],
        used: Bool[np.ndarray, " W"] | None = None,
        least: float = 1.0,
    ):
        self.flow, self.windows, self.least = flow, windows, least
        self.noise = np.sqrt(noise**2 + windows.timing**2)  # (W, T, R)
        self.used = np.ones(len(windows.x), bool) if used is None else used
        self.seen = np.isfinite(windows.x)
        self.numbers = self.seen.sum(axis=2)
        self.reach = float(np.nanmax(windows.x) - np.nanmin(windows.x))
        self.kept = self.numbers > 0
        self.fits = np.ones(len(windows.x), bool)
        self.misfit = 1.0

    def keep_what_fits(self, state: State) -> None:
        """Leave out, of plain sums of squares, windows that do not fit, and single samples that are far off."""
        each = self.of_windows(state)
        typical = max(float(np.median(each[self.used] if self.used.any() else each)), self.least)
        self.fits = each <= LOST * typical
        near = self.distance(state) <= OUTLIER**2 * typical
        self.kept = (self.numbers > 0) & self.fits[:, None] & near
        before, after = self.sizes(state)
        self.misfit = after / before if after > MISFIT * before else 1.0

    @np.errstate(over="ignore", invalid="ignore")
    def at(self, theta: Float[np.ndarray, " P"], z: Float[np.ndarray, "W 2 n d"]) -> State:
        """The motion from starts `z`."""
        motion = self.flow(theta, z, self.windows.steps)
        # A motion that goes wrong is far off, but not lost: from there on it says nothing of where to go.
        slopes = np.abs(motion.by_start).max(axis=(2, 3)) / np.abs(motion.by_start[:, :1]).max(axis=(2, 3))
        sound = np.isfinite(motion.x).all(axis=2) & np.isfinite(motion.by_theta).all(axis=(2, 3)) & (slopes < CHAOTIC)
        wrong = np.maximum.accumulate(~sound, axis=1)
        motion.by_start[wrong], motion.by_theta[wrong] = 0.0, 0.0
        off = np.where(wrong[..., None], FAR * self.reach, motion.x - np.where(self.seen, self.windows.x, 0))
        return State(theta, motion.start, motion, np.where(self.seen, off / self.noise, 0.0))

    def distance(self, state: State) -> Float[np.ndarray, "W T"]:
        """Mean squared residual of each sample; 0 where nothing was seen."""
        return np.sum(state.residual**2, axis=2) / np.maximum(self.numbers, 1)

    def sizes(self, state: State) -> tuple[float, float]:
        """What is left before and after impacts, typically: mean squared residuals, after of no less than before."""
        rows, distance = (self.numbers > 0) & self.used[:, None], self.distance(state)
        before, after = rows & self.windows.before, rows & ~self.windows.before
        if not before.any():
            size = max(1.0, float(np.median(distance[after if after.any() else self.numbers > 0])))
            return size, size
        least = float(np.median(distance[before]))
        least = max(least, self.least) if least < EXACT else 1.0
        return least, max(least, float(np.median(distance[after if after.any() else before])))

    def size(self, state: State) -> float:
        """That after impacts."""
        return self.sizes(state)[1]

    def of_windows(self, state: State) -> Float[np.ndarray, " W"]:
        """Mean squared residual of each window, starts taken into account."""
        free = np.maximum(self.seen.sum(axis=(1, 2)) - self.start_numbers(), 1)
        return np.sum(state.residual**2, axis=(1, 2)) / free

    def start_numbers(self) -> int:
        """Numbers that a start is free in."""
        system = self.flow.learned.skeleton
        ties = 0 if not system.links else int(system.constraints(jnp.asarray(self.windows.start[0, 0])).shape[0])
        return self.windows.start[0].size - 2 * ties

    def weight(self, state: State, size: float, loss: Loss) -> Float[np.ndarray, "W T"]:
        """Weights of all samples; of plain sums of squares, of those that are `kept`.

        Of these, samples after impacts count for less where no quantities explain them: starts would be bent to them.
        """
        if loss == "squares":
            return self.kept / np.where(self.windows.before, 1.0, self.misfit)
        distance = self.distance(state) / size
        if loss == "redescending":
            return np.where(self.numbers > 0, (1 + distance / CUTOFF) ** -2, 0)
        return np.where(self.numbers > 0, np.minimum(1, np.sqrt(2 / np.maximum(distance, 1e-30))), 0)

    def costs(self, state: State, size: float, loss: Loss) -> Float[np.ndarray, " W"]:
        """Sum of rho over the samples of each window."""
        distance = self.distance(state) / size
        if loss == "squares":
            rho = self.weight(state, size, loss) * distance
        elif loss == "redescending":
            rho = distance / (1 + distance / CUTOFF)
        else:
            rho = np.where(distance < 2, distance, 2 * np.sqrt(2 * np.maximum(distance, 2)) - 2)
        return np.sum(self.numbers * rho, axis=1)

    def freedom(self, state: State) -> Float[np.ndarray, "W T R"]:
        """Degrees of freedom of each residual, whose sum of squares they are the expectation of: 1 less its leverage on
        the start of its window."""
        count = len(state.residual)
        root = (np.sqrt(self.kept)[..., None] * self.seen / self.noise).reshape(count, -1, 1)
        J = np.nan_to_num(state.motion.by_start.reshape(count, root.shape[1], -1) * root)
        U, sizes, _ = np.linalg.svd(J, full_matrices=False)
        told = sizes > 1e-7 * sizes[:, :1]
        leverage = np.sum(np.where(told[:, None], U, 0) ** 2, axis=2).reshape(state.residual.shape)
        return np.where(self.kept[..., None] & self.seen, 1 - leverage, 0)

    def reduced(self, state: State, weight: Float[np.ndarray, "W T"], damping: Float[np.ndarray, " W"]) -> Reduced:
        """See `Reduced`."""
        count = len(state.residual)
        root = (np.sqrt(weight)[..., None] * self.seen / self.noise).reshape(count, -1, 1)
        J = np.nan_to_num(state.motion.by_start.reshape(count, root.shape[1], -1) * root)
        K = np.nan_to_num(state.motion.by_theta.reshape(count, root.shape[1], -1) * root)
        r = (state.residual * np.sqrt(weight)[..., None]).reshape(count, -1)
        A = np.einsum("wri,wrj->wij", J, J)
        unit = 1 / np.sqrt(np.maximum(np.einsum("wii->wi", A), 1e-300))
        A = A * unit[:, :, None] * unit[:, None, :] + (TIES + damping[:, None, None]) * np.eye(A.shape[1])
        right = np.concatenate([np.einsum("wri,wrp->wip", J, K), np.einsum("wri,wr->wi", J, r)[..., None]], axis=2)
        solved = unit[..., None] * np.linalg.solve(A, unit[..., None] * right)
        follow, own = solved[..., :-1], solved[..., -1]
        left = K - np.einsum("wri,wip->wrp", J, follow)
        rest = r - np.einsum("wri,wi->wr", J, own)
        return Reduced(np.einsum("wrp,wrq->wpq", left, left), np.einsum("wrp,wr->wp", left, rest), follow, own)


def shoot(
    shooting: Shooting,
    theta: Float[np.ndarray, " P"],
    z: Float[np.ndarray, "W 2 n d"],
    losses: Sequence[Loss],
    *,
    held: bool = False,
    still: Bool[np.ndarray, " P"] | None = None,
    each: Callable[[float], None] | None = None,
) -> State:
    """Free numbers and starts that fit best, by Gauss-Newton steps from those given.

    **Arguments:** `losses`, the loss of each step at most; `held`: the free numbers stay, starts are fitted; `still`:
    those of them that stay; `each` is called after a step with what is left after impacts, a root mean square in units
    of the noise.
    """
    learned, used = shooting.flow.learned, shooting.used | held
    scale, lower, upper = (np.asarray(part, float) for part in (learned.scale, learned.lower, learned.upper))
    prior = np.diag((WIDE * scale) ** -2.0)
    state, damping = shooting.at(theta, z), np.zeros(len(z))
    settled: Loss | None = None
    for k, loss in enumerate(losses):
        if loss == settled:
            continue
        size = shooting.size(state)
        cost = shooting.costs(state, size, loss)
        reduced = shooting.reduced(state, shooting.weight(state, size, loss), damping)
        H, g = reduced.curvature[used].sum(axis=0), reduced.gradient[used].sum(axis=0)
        change = np.zeros_like(g)
        if not held and len(g):
            ends = np.maximum(lower - state.theta, -MOST * scale), np.minimum(upper - state.theta, MOST * scale)
            if still is not None:
                ends = tuple(np.where(still, 0.0, end) for end in ends)
            change = newton_step(H, g, prior, change, change, *ends)
        directions, curvature, _ = spectrum(H, prior)
        error = np.sqrt(np.sum(directions**2 / curvature, axis=1) * size)
        small = bool(np.all(np.abs(change) < SETTLED * error))
        for share in 0.25 ** np.arange(4):
            move = -(share * reduced.own + reduced.follow @ (share * change))
            there = shooting.at(state.theta + share * change, state.z + move.reshape(state.z.shape))
            now = shooting.costs(there, size, loss)
            # At first starts have not been fitted to what comes after impacts. At last a window that no longer fits
            # counts for more than what a step wins.
            if now[used].sum() < cost[used].sum() or k == 0 or (small and not held):
                break
        else:
            settled = loss
            continue
        worse = now > cost
        damping = np.where(worse, np.maximum(10 * damping, 1e-3), np.where(damping > 1e-6, damping / 10, 0))
        fallen = 1 - now[used].sum() / max(cost[used].sum(), 1e-300)
        state = there
        if each is not None:
            each(float(np.sqrt(shooting.size(state))))
        if small and (not held or fallen < SETTLED):
            settled = loss
    return state
