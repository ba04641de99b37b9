r"""Smooth constrained dynamics in Cartesian coordinates (paper, appendix B): Lagrangian and Hamiltonian fields.

Notation: `G = J_E M^-1 J_E^T`, with `J_E = D_x Phi` from automatic differentiation.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Float

from carom.checks import require

Formulation = Literal["lagrangian", "hamiltonian"]


def _spd(matrix: Float[Array, "E E"]) -> lx.MatrixLinearOperator:
    return lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)


class SaddlePoint(eqx.Module):
    """The constraints at one state, with `G` factored once: every use of the multipliers goes through here.

    Solutions of `[M, J^T; J, 0]` reduce to `G`: symmetric positive definite where the constraints are independent.

    Rotors of inertia `a` that turn at the rate `J_a v` are rows too, that yield: `[M, J^T; J, -1/a]`, so that
    `M + J_a^T a J_a` is never formed. `yielding` (E,) is `1/a` of these and zero of constraints.
    """

    jacobian: Float[Array, "E n d"]
    inverse_mass: Float[Array, "n n"]
    yielding: Float[Array, " E"] | None
    matrix: Float[Array, "E E"]
    factor: Any

    def __init__(
        self,
        jacobian: Float[Array, "E n d"],
        inverse_mass: Float[Array, "n n"],
        yielding: Float[Array, " E"] | None = None,
    ):
        self.jacobian, self.inverse_mass, self.yielding = jacobian, inverse_mass, yielding
        G = self.to_rows(self.from_impulses(jnp.eye(jacobian.shape[0], dtype=jacobian.dtype)))
        self.matrix = (G + G.T) / 2 + (0 if yielding is None else jnp.diag(yielding))
        self.factor = lx.Cholesky().init(_spd(jax.lax.stop_gradient(self.matrix)), {})

    def solve(self, rhs: Float[Array, " E"]) -> Float[Array, " E"]:
        """`G^-1 rhs`. Its derivative comes from the equation `G y = rhs` and uses the same factor."""

        def solve(_, b):
            operator = _spd(jax.lax.stop_gradient(self.matrix))
            return lx.linear_solve(operator, b, lx.Cholesky(), state=self.factor, throw=False).value

        # Not lineax's own derivative: that stops the program at the first number that is not finite, where a training
        # should leave the step out and go on.
        return jax.lax.custom_linear_solve(lambda y: self.matrix @ y, rhs, solve, symmetric=True)

    def to_rows(self, velocity: Float[Array, "k n d"]) -> Float[Array, "E k"]:
        """`J_E v` for several velocities."""
        return jnp.einsum("eid,kid->ek", self.jacobian, velocity)

    def from_impulses(self, impulse: Float[Array, "k E"]) -> Float[Array, "k n d"]:
        """`M^-1 J_E^T f` for several sets of constraint impulses."""
        return jnp.einsum("ij,ejd,ke->kid", self.inverse_mass, self.jacobian, impulse)

    def project(self, velocity: Float[Array, "k n d"]) -> Float[Array, "k n d"]:
        """The nearest velocities, in the metric of the mass, that obey the constraints (S.12 for `M^-1 p`).

        With rotors: what velocities a force gives that would give these without rotors and constraints.
        """
        multipliers = jax.vmap(self.solve)(self.to_rows(velocity).T)
        return velocity - self.from_impulses(multipliers)

    def project_exactly(self, velocity: Float[Array, "k n d"]) -> Float[Array, "k n d"]:
        """`project`, and once more of what it has left: the rounding of the first is an error that the second takes
        away."""
        multipliers = jax.vmap(self.solve)(self.to_rows(velocity).T)
        first = velocity - self.from_impulses(multipliers)
        left = self.to_rows(first).T - (0 if self.yielding is None else self.yielding * multipliers)
        return first - self.from_impulses(jax.vmap(self.solve)(left))


RotorTerms = tuple[Callable, Float[Array, " r"]]
"""How fast rotors turn, a function of `x` and `v` that is linear in `v`, and their inertias."""


def saddle_point(
    constraints: Callable, x: Float[Array, "n d"], inverse_mass: Float[Array, "n n"], rotors: RotorTerms | None = None
) -> SaddlePoint:
    """The saddle-point problem of the constraints, and of rotors if there are some, at `x`."""
    jacobian = jax.jacrev(constraints)(x)
    if rotors is None:
        return SaddlePoint(jacobian, inverse_mass)
    rates, inertia = rotors
    rows = jax.jacrev(lambda v: rates(x, v))(jnp.zeros_like(x))
    yielding = jnp.concatenate([jnp.zeros(jacobian.shape[0], x.dtype), 1 / inertia])
    return SaddlePoint(jnp.concatenate([jacobian, rows]), inverse_mass, yielding)


def has_equations(constraints: Callable, x: Float[Array, "n d"]) -> bool:
    """Whether there is any constraint at all."""
    return jax.eval_shape(constraints, x).shape[0] > 0


def lagrangian_field(
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    *,
    force: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    constraints: Callable,
    rotors: RotorTerms | None = None,
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
    """Time derivatives of `x` and `v` under S.2, with `force = -grad V + u` (N).

    `v' = M^-1 (F - J^T lambda)`, `G lambda = J M^-1 F + (D_x (J v)) v`; rows of `rotors` yield, see `SaddlePoint`.
    """
    free = inverse_mass @ force
    if rotors is None and not has_equations(constraints, x):
        return v, free
    saddle = saddle_point(constraints, x, inverse_mass, rotors)

    def rate(x):  # J(x) v
        held = jax.jvp(constraints, (x,), (v,))[1]
        return held if rotors is None else jnp.concatenate([held, rotors[0](x, v)])

    _, curvature = jax.jvp(rate, (x,), (v,))
    multipliers = saddle.solve(saddle.to_rows(free[None])[:, 0] + curvature)
    return v, free - saddle.from_impulses(multipliers[None])[0]


def hamiltonian_field(
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    *,
    force: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    constraints: Callable,
    rotors: RotorTerms | None = None,
) -> tuple[Float[Array, "n d"], Float[Array, "n d"]]:
    """Time derivatives of `x` and `v` under S.4 and S.7, with `force = -grad V + u` (N).

    The two constraints `Psi = (Phi, Phi')` give a matrix `[0, G; -G, S]`, so that S.4 needs `G` alone:
    `G beta = J v`, `G alpha = S beta - B v - J M^-1 F`, `x' = v - M^-1 J^T beta`,
    `v' = M^-1 (F + J^T alpha + B^T beta)`, with `B = D_x (J v)` and `S = B M^-1 J^T - J M^-1 B^T`. Where the
    constraints hold, `beta = 0` and this is the Lagrangian field.
    """
    require(rotors is None, 'formulation must be "lagrangian" for a system with rotors (armature).')
    free = inverse_mass @ force
    if not has_equations(constraints, x):
        return v, free
    saddle = saddle_point(constraints, x, inverse_mass)

    def rate(x):  # J(x) v, so that B = D_x rate
        return jax.jvp(constraints, (x,), (v,))[1]

    jv, B_transposed = jax.vjp(rate, x)
    beta = saddle.solve(jv)
    drift = saddle.from_impulses(beta[None])[0]
    (B_beta,) = B_transposed(beta)
    _, B_velocity = jax.jvp(rate, (x,), (v - drift,))  # B v - B M^-1 J^T beta
    push = free + inverse_mass @ B_beta
    alpha = saddle.solve(-B_velocity - saddle.to_rows(push[None])[:, 0])
    return v - drift, push + saddle.from_impulses(alpha[None])[0]


FIELDS: dict[Formulation, Callable] = {"lagrangian": lagrangian_field, "hamiltonian": hamiltonian_field}
