"""Explicit time steps: diffrax solvers, stepped by hand at the contact time step."""

from collections.abc import Callable

import diffrax
import jax
import numpy as np

from carom.checks import require

_A_LOWER = (np.array([1 / 3]), np.array([-1 / 3, 1.0]), np.array([1.0, -1.0, 1.0]))
_B = np.array([1 / 8, 3 / 8, 3 / 8, 1 / 8])


class RK4(diffrax.AbstractERK):
    """Fourth-order Runge-Kutta in Kutta's 3/8 form, with a fixed step. carom's default.

    Nodes 0, 1/3, 2/3, 1; weights 1/8, 3/8, 3/8, 1/8 (Kutta, 1901; Hairer, Norsett, Wanner, *Solving Ordinary
    Differential Equations I*, table II.1.2). It has no error estimate.
    """

    tableau = diffrax.ButcherTableau(
        c=np.array([1 / 3, 2 / 3, 1.0]), a_lower=_A_LOWER, b_sol=_B, b_error=np.zeros_like(_B)
    )
    interpolation_cls = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms):
        return 4


def check_solver(solver) -> None:
    """Raise `CaromError` unless `solver` is an explicit one-step Runge-Kutta method, or `None` for the default."""
    explicit = isinstance(solver, diffrax.AbstractERK) and isinstance(solver.tableau, diffrax.ButcherTableau)
    require(
        solver is None or explicit or isinstance(solver, diffrax.Euler),
        "solver must be an explicit Runge-Kutta method of diffrax, such as diffrax.Tsit5(), or carom.RK4(); it was "
        f"{type(solver).__name__}.",
    )


def flow(solver: diffrax.AbstractSolver, field: Callable, state, dt):
    """`state` after one step of length `dt` (s) under `state' = field(state)`.

    Explicit Runge-Kutta methods are written out from the solver's own tableau: `solver.step` runs the stages in a
    checkpointed loop, which makes the backward pass of a learned potential about three times as slow
    (`benchmarks/bench_integrators.py`). diffrax's Euler, which has none, goes through `solver.step`.
    """
    tableau = getattr(solver, "tableau", None)
    if isinstance(solver, diffrax.AbstractERK) and isinstance(tableau, diffrax.ButcherTableau):
        stages = []
        for row in ((), *tableau.a_lower):
            stages.append(field(_combine(state, dt, row, stages)))
        return _combine(state, dt, tableau.b_sol, stages)
    term = diffrax.ODETerm(lambda t, y, args: field(y))
    carry = solver.init(term, 0.0, dt, state, None)
    return solver.step(term, 0.0, dt, state, None, carry, made_jump=False)[0]


def _combine(state, dt, weights, stages):
    """`state + dt sum_i weights_i stages_i`, without the terms whose weight is zero."""
    pairs = [(float(w), k) for w, k in zip(weights, stages, strict=True) if w != 0]
    if not pairs:
        return state
    return jax.tree.map(
        lambda y, *ks: y + dt * sum(w * k for (w, _), k in zip(pairs, ks, strict=True)), state, *(k for _, k in pairs)
    )
