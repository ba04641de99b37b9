"""The two phases of an impact as convex programs: impulses from the Delassus matrix and velocities (S.12 to S.15)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.checks import is_known, not_negative, require, require_values
from carom.contact.cones import ConeSettings, solve_cone_problem
from carom.contact.coulomb import solve_coulomb_problem


def solve_impulse(
    A: Float[Array, "*b n n"],
    v: Float[Array, "*b K d"],
    friction: Float[Array, "*b K"],
    lower: Float[Array, "*b K"],
    *,
    smoothing: float = 0.0,
) -> Float[Array, "*b K d"]:
    """Impulses `f` that minimise `1/2 f^T A f + f^T v` with `|f_t| <= mu f_n` and `f_n >= lower` for each contact.

    **Arguments:** `A` (..., K d, K d), Delassus matrix (1/kg), positive semi-definite, contacts stacked with the normal
    first; `v` (..., K, d), velocities before (m/s); `friction` (..., K), mu >= 0; `lower` (..., K), least normal
    impulses (N s) >= 0; `smoothing`, final value of the complementarity products relative to the problem's scale: above
    0 it smooths the derivative across stick, slip and separation.

    **Returns:** `f` (..., K, d) in N s: the one of least norm where it is not unique. Batch axes and `jax.vmap` both
    become one batch. Differentiable once, in both modes.

    **Raises:** `CaromError` if shapes do not match, or values that are known (not traced) are out of range or give a
    problem without a solution. Where values are traced, NaN data give NaN impulses.

    **Source:** paper, eqs. 5 and 7.
    """
    _check_problem(A, v, friction=friction, lower=lower)
    solution = _solve(A, v, friction, lower, smoothing)
    _check_solved(solution, v.dtype)
    return solution.impulse


def contact_impulse(
    A: Float[Array, "*b n n"],
    v: Float[Array, "*b K d"],
    friction: Float[Array, "*b K"],
    restitution: Float[Array, "*b K"],
    v_star: Float[Array, "*b K d"],
    *,
    smoothing: float = 0.0,
) -> tuple[Float[Array, "*b K d"], Float[Array, "*b K d"]]:
    """Compression and restitution impulses of the contact model CM, by Poisson's hypothesis.

    **Arguments:** as `solve_impulse`; `restitution` (..., K), Poisson's e in [0, 1]; `v_star` (..., K, d), target
    velocity after the impact (m/s), see `target_velocity`.

    **Returns:** `(f_compression, f_restitution)`, each (..., K, d) in N s; the velocity jump is that of their sum.

    **Raises:** `CaromError`, as `solve_impulse`.

    **Source:** paper, S.14 and S.15.
    """
    _check_problem(A, v, friction=friction, restitution=restitution, v_star=v_star)
    require_values("restitution", restitution, lambda e: e <= 1, "between 0 and 1")
    compression, rebound = two_phases(A, v, friction, restitution, v_star, smoothing=smoothing)
    _check_solved(compression, v.dtype)
    _check_solved(rebound, v.dtype)
    return compression.impulse, rebound.impulse


class Phase(NamedTuple):
    """Impulses (N s) of one phase of an impact, and by how much they miss its law, relative to the problem's scale."""

    impulse: Float[Array, "*b K d"]
    residual: Float[Array, "*b"]


def two_phases(
    A,
    v,
    friction,
    restitution,
    v_star,
    *,
    diagonal: Array | None = None,
    smoothing: float = 0.0,
    coulomb: bool = False,
    reference: Array | None = None,
    rebounds: Bool[Array, ""] | None = None,
) -> tuple[Phase, Phase]:
    """`contact_impulse` without its checks, with the solver's residuals.

    `diagonal` (..., K d) is added to that of A in the convex programs alone, not where velocities are computed.
    `coulomb`: each phase obeys Coulomb's law, in place of the convex programs (see `Coulomb`). `reference` (..., K, d):
    velocities (m/s) beside which others are rounding; `v` itself by default. Where `rebounds` is false the second
    phase is nothing, and costs nothing.
    """
    reference = v if reference is None else reference
    program = A if diagonal is None else A + diagonal[..., None] * jnp.eye(A.shape[-1], dtype=A.dtype)

    # The phases differ in their data alone, so that they are one compiled solve, done twice.
    def phase(state, is_rebound):
        velocity, lower = state
        velocity = velocity - jnp.where(is_rebound, v_star, 0)
        least = jnp.where(is_rebound, lower, -jnp.inf)
        none = False if rebounds is None else is_rebound & ~rebounds
        matrix = jnp.where(none, 0, program)  # zeros are no contacts
        solution = _solve(matrix, velocity, friction, least, smoothing, reference=reference, coulomb=coulomb)
        change = (A @ solution.impulse.reshape(*v.shape[:-2], -1, 1)).reshape(v.shape)
        lower = restitution * jnp.maximum(solution.impulse[..., 0], 0)
        return (velocity + change, lower), solution

    _, solutions = jax.lax.scan(phase, (v, jnp.zeros_like(friction)), jnp.array([False, True]))
    return jax.tree.map(lambda s: s[0], solutions), jax.tree.map(lambda s: s[1], solutions)


def _solve(A, v, friction, lower, smoothing, reference=None, coulomb: bool = False) -> Phase:
    batch = v.shape[:-2]

    def flat(x: Array, rank: int) -> Array:
        return x.reshape(-1, *x.shape[x.ndim - rank :])

    arrays = (flat(A, 2), flat(v, 2), flat(friction, 1), flat(lower, 1))
    reference = None if reference is None else flat(reference, 2)
    if coulomb:
        out = solve_coulomb_problem(*arrays, reference=reference)
    else:
        out = solve_cone_problem(*arrays, reference=reference, smoothing=smoothing)
    return Phase(out.impulse.reshape(v.shape), out.residual.reshape(batch))


def _check_problem(A, v, *, friction, **others):
    require(
        v.ndim >= 2 and v.shape[-1] in (2, 3),
        f"v must have the shape (..., contacts, d) with d = 2 or 3; it was {v.shape}.",
    )
    *batch, k, d = v.shape
    shapes = {"A": (A, (*batch, k * d, k * d)), "friction": (friction, (*batch, k))}
    for name, value in others.items():
        shapes[name] = (value, (*batch, k, d) if name == "v_star" else (*batch, k))
    for name, (value, shape) in shapes.items():
        require(
            value.shape == shape, f"{name} must have the shape {shape} to go with v {v.shape}; it was {value.shape}."
        )
    for name, value in {"A": A, "v": v, "friction": friction, **others}.items():
        require_values(name, value, np.isfinite, "finite")
        if name not in ("A", "v", "v_star"):
            require_values(name, value, not_negative, "at least 0")


def _check_solved(solution: Phase, dtype):
    if is_known(solution.residual):
        worst = float(jnp.max(solution.residual, initial=0))
        tolerance = 100 * ConeSettings.for_dtype(dtype).tolerance
        require(
            worst <= tolerance,
            f"the impulse was not found: the optimality conditions are off by {worst:.1e} (allowed {tolerance:.0e}). "
            "Either A is not positive semi-definite, or the contacts squeeze a body from both sides and v cannot be "
            "met by any impulse. Check A = J M^-1 J^T and that v and v_star are in the range of J.",
        )
