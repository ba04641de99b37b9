"""Robust generalised least squares with honest standard errors. Arrays only.

Residuals come in blocks `u_k` (q numbers with unit covariance when all is well) with Jacobians `J_k`. The estimator
minimises `sum_k rho(|u_k|^2)` with Geman and McClure's redescending loss `rho(s) = s / (1 + s / (c q))`, whose weights
`w = (1 + s / (c q))^-2` leave out blocks that fit under no parameters, such as a step whose contact was mistaken.
Huber's loss, which is convex, comes first (Maronna, Martin, Yohai, Salibian-Barrera, *Robust Statistics*, 2019,
chapters 2 and 5). Its asymptotic covariance is the sandwich `H^-1 S H^-1` (Huber, 1967; White, 1982) with

    H = sum_k (w_k + 2 w'_k |u_k|^2 / q) J_k^T J_k
    S = G / (G - 1) sum_g s_g s_g^T,   s_g = sum of w_k J_k^T u_k over the blocks of cluster g   (Liang, Zeger, 1986)

H takes the directions of `u_k` as equally likely. With few clusters S comes out too small; so the variance reported is,
for each parameter, the greater of the sandwich and of the same with `S = sum_k E[w^2 |u|^2 / q] J_k^T J_k`, the
expectation over the blocks of one kind.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

CUTOFF = 4.0
"""c: blocks with a mean squared residual of c have a quarter of the weight."""


class Blocks(NamedTuple):
    """Whitened residuals and Jacobians; each block's cluster and kind (0, 1, ...: kinds differ in size of errors)."""

    residual: Float[np.ndarray, "n q"]
    jacobian: Float[np.ndarray, "n q p"]
    cluster: Int[np.ndarray, " n"]
    kind: Int[np.ndarray, " n"]


class Solution(NamedTuple):
    """Change of the parameters, its standard error, and each block's weight (1 where it fits)."""

    change: Float[np.ndarray, " p"]
    standard_error: Float[np.ndarray, " p"]
    weight: Float[np.ndarray, " n"]


def solve(
    blocks: Blocks,
    prior: Float[np.ndarray, "p p"],
    pull: Float[np.ndarray, " p"],
    lower: Float[np.ndarray, " p"],
    upper: Float[np.ndarray, " p"],
    *,
    redescend: bool,
    rounds: int = 20,
) -> Solution:
    """Iteratively reweighted least squares on one linearisation `u + J change`, within bounds on the change.

    A weak prior decides where the data do not: `prior` is its precision, `pull` its gradient where nothing changes.
    """
    change = np.zeros(len(pull))
    for k in range(rounds):
        u = blocks.residual + blocks.jacobian @ change
        distance, size = _distance(u, blocks.kind)
        weight = _redescending(distance) if redescend and k >= rounds // 3 else _huber(distance)
        weighted = weight / size
        H, g = _normal_equations(blocks, weighted, u)
        target = newton_step(H, g, prior, pull + prior @ change, change, lower, upper)
        moved, change = np.abs(target - change).max(initial=0.0), target
        if moved < 1e-8 and k > rounds // 3:
            break
    u = blocks.residual + blocks.jacobian @ change
    distance, size = _distance(u, blocks.kind)
    return Solution(change, _standard_errors(blocks, u, distance, size, prior), _redescending(distance))


def _distance(u, kind):
    """`|u|^2 / q` over its robust size for the block's kind, and that size.

    The size is the median over its value for normal errors (Wilson and Hilferty's approximation).
    """
    square = np.mean(u**2, axis=1)
    normal = (1 - 2 / (9 * u.shape[1])) ** 3
    size = np.ones(len(u))
    for k in np.unique(kind):
        size[kind == k] = max(np.median(square[kind == k]) / normal, 1e-30)
    return square / size, size


def _huber(distance):
    return np.minimum(1, np.sqrt(2 / np.maximum(distance, 1e-30)))


def _redescending(distance):
    return (1 + distance / CUTOFF) ** -2


def _normal_equations(blocks: Blocks, weight, u):
    n, q, p = blocks.jacobian.shape
    root = np.sqrt(weight)[:, None]
    J = (blocks.jacobian * root[..., None]).reshape(n * q, p)
    return J.T @ J, J.T @ (u * root).reshape(n * q)


_LOST = 1e-14
"""Curvature below this share of the largest, times the number of parameters, is lost in rounding."""


def spectrum(H, prior):
    """Directions (columns, not of unit length) in which `H + prior` is diagonal, its curvatures, and where H is lost.

    There the prior decides alone: rounding of data that are almost exact is greater than all that it says.
    """
    if not len(H):
        return np.zeros((0, 0)), np.zeros(0), np.zeros(0, bool)
    scale = 1 / np.sqrt(np.diag(H + prior))
    values, vectors = np.linalg.eigh(scale[:, None] * (H + prior) * scale)
    directions = scale[:, None] * vectors
    lost = values <= _LOST * len(values) * values[-1]
    alone = np.einsum("ik,ij,jk->k", directions, prior, directions)
    return directions, np.where(lost, np.maximum(alone, 1e-300), values), lost


def newton_step(H, g, prior, pull, change, lower, upper):
    """Minimiser of the quadratic model, with those that would leave their bounds held there."""
    held: Bool[np.ndarray, " p"] = np.zeros(len(g), bool)
    target = change
    for _ in range(5):
        fixed = np.where(held, np.clip(target, lower, upper) - change, 0)
        free = ~held
        directions, curvature, lost = spectrum(H[np.ix_(free, free)], prior[np.ix_(free, free)])
        told, asked = ((slope + matrix @ fixed)[free] for slope, matrix in ((g, H), (pull, prior)))
        delta = fixed.copy()
        delta[free] = -directions @ ((np.where(lost, 0, told @ directions) + asked @ directions) / curvature)
        target = change + delta
        outside = ~held & ((target < lower) | (target > upper))
        if not outside.any():
            break
        held |= outside
        if held.all():
            break
    return np.clip(target, lower, upper)


def _standard_errors(blocks: Blocks, u, distance, size, prior):
    q = u.shape[1]
    weight = _redescending(distance)
    bread = np.maximum(weight - 4 * distance / (CUTOFF * q) * (1 + distance / CUTOFF) ** -3, 0) / size
    directions, curvature, lost = spectrum(_normal_equations(blocks, bread, u)[0], prior)
    inverse, told = ((directions / part) @ directions.T for part in (curvature, np.where(lost, np.inf, curvature)))
    influence = np.einsum("nqp,nq->np", blocks.jacobian, u * (weight / size)[:, None]) @ told
    clusters, index = np.unique(blocks.cluster, return_inverse=True)
    total = np.zeros((len(clusters), influence.shape[1]))
    np.add.at(total, index, influence)
    sandwich = np.sum(total**2, axis=0) * len(clusters) / max(len(clusters) - 1, 1)
    spread = np.zeros(len(u))
    for k in np.unique(blocks.kind):
        same = blocks.kind == k
        spread[same] = np.mean(weight[same] ** 2 * distance[same]) / size[same]
    expected = told @ _normal_equations(blocks, spread, u)[0] @ told + inverse @ prior @ inverse
    return np.sqrt(np.maximum(sandwich, np.diag(expected)))
