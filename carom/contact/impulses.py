"""Contact models: from the closed contacts to the velocity jump (paper, appendices C to G)."""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from carom.checks import is_known, require, require_values
from carom.contact.candidates import Active
from carom.contact.cones import ConeSettings, ConeSolution, solve_cone_problem


class ContactState(NamedTuple):
    """All that a contact model may look at: the state before the jump and the closed contacts. SI units."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    active: Active
    response: Float[Array, "r n d"]  # `M^^-1 J_C^T`, rows r = K d by contact, normal first: velocity per impulse
    delassus: Float[Array, "r r"]  # A
    velocity: Float[Array, "K d"]  # of the contacts, `J_C v`
    target: Float[Array, "K d"]  # v_C*, see `target_velocity`
    friction: Float[Array, " K"]
    restitution: Float[Array, " K"]


class Jump(NamedTuple):
    """What a contact model answers: the change of the points' velocities, and its relative residual.

    `impulse` (N s): of each contact in the contact frame, in compression and rebound or at once, if the model has any.
    """

    velocity: Float[Array, "n d"]
    residual: Float[Array, ""]
    impulse: Float[Array, "phases K d"] | None = None


class ContactModel(eqx.Module):
    """How closed contacts change the velocity."""

    @abc.abstractmethod
    def __call__(self, state: ContactState, *, smoothing: float = 0.0) -> Jump:
        """The velocity jump. Nothing changes where no contact is active."""


class CM(ContactModel):
    """Friction cones and Poisson's restitution in two phases, with the Delassus matrix as it is (S.12 to S.15)."""

    def __call__(self, state, *, smoothing=0.0):
        compression, rebound = two_phases(
            state.delassus, state.velocity, state.friction, state.restitution, state.target, smoothing=smoothing
        )
        impulse = jnp.stack([compression.impulse, rebound.impulse])
        return Jump(
            jnp.einsum("rid,r->id", state.response, impulse.sum(axis=0).reshape(-1)),
            jnp.maximum(compression.residual, rebound.residual),
            impulse,
        )


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
    require_values("restitution", restitution, restitution <= 1, "between 0 and 1")
    compression, rebound = two_phases(A, v, friction, restitution, v_star, smoothing=smoothing)
    _check_solved(compression, v.dtype)
    _check_solved(rebound, v.dtype)
    return compression.impulse, rebound.impulse


def two_phases(A, v, friction, restitution, v_star, *, smoothing: float = 0.0) -> tuple[ConeSolution, ConeSolution]:
    """`contact_impulse` without its checks, with the solver's residuals."""

    # The phases differ in their data alone, so that they are one compiled solve, done twice.
    def phase(state, is_rebound):
        velocity, lower = state
        velocity = velocity - jnp.where(is_rebound, v_star, 0)
        solution = _solve(A, velocity, friction, jnp.where(is_rebound, lower, -jnp.inf), smoothing, reference=v)
        change = (A @ solution.impulse.reshape(*v.shape[:-2], -1, 1)).reshape(v.shape)
        lower = restitution * jnp.maximum(solution.impulse[..., 0], 0)
        return (velocity + change, lower), solution

    _, solutions = jax.lax.scan(phase, (v, jnp.zeros_like(friction)), jnp.array([False, True]))
    return jax.tree.map(lambda s: s[0], solutions), jax.tree.map(lambda s: s[1], solutions)


def target_velocity(
    contact_jacobian: Float[Array, "K d n d"],
    depth: Float[Array, " K"],
    constraint_jacobian: Float[Array, "E n d"],
    *,
    time: float | Float[Array, ""],
) -> Float[Array, "K d"]:
    """Velocity after impact that undoes the penetration `depth` (m) within `time` (s), consistent with the joints.

    `v* = J_C (I - J_E^T (J_E J_E^T)^-1 J_E) J_C^+ v_d` (S.23 with its misprint mended), `v_d = depth / time` along
    normals.
    The pseudo-inverse of S.24 is taken as the limit of `J_C^T (J_C J_C^T + delta)^-1`, which covers both its cases,
    redundant contacts, and the zero rows of contacts that are not active. No gradient flows through it.
    """
    k, d = contact_jacobian.shape[:2]
    JC = jax.lax.stop_gradient(contact_jacobian).reshape(k * d, -1)
    JE = jax.lax.stop_gradient(constraint_jacobian).reshape(constraint_jacobian.shape[0], JC.shape[1])
    depth = jax.lax.stop_gradient(depth)
    desired = jnp.zeros((k, d), JC.dtype).at[:, 0].set(depth / time).reshape(-1)
    eps = jnp.finfo(JC.dtype).eps ** 0.6  # 4e-10 in double precision, 7e-5 in single
    v = JC.T @ _solve_regular(JC @ JC.T, desired, eps)
    if JE.shape[0]:
        v = v - JE.T @ _solve_regular(JE @ JE.T, JE @ v, 0.0)
    return (JC @ v).reshape(k, d)


def _solve_regular(matrix, rhs, relative):
    size = jnp.max(jnp.diag(matrix))
    diagonal = jnp.where(size > 0, relative * size, 1)
    matrix = matrix + diagonal * jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)


def _solve(A, v, friction, lower, smoothing, reference=None) -> ConeSolution:
    batch = v.shape[:-2]

    def flat(x: Array, rank: int) -> Array:
        return x.reshape(-1, *x.shape[x.ndim - rank :])

    out = solve_cone_problem(
        *(flat(A, 2), flat(v, 2), flat(friction, 1), flat(lower, 1)),
        reference=None if reference is None else flat(reference, 2),
        smoothing=smoothing,
    )
    return ConeSolution(out.impulse.reshape(v.shape), out.residual.reshape(batch), out.iterations.reshape(batch))


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
        require_values(name, value, jnp.isfinite(value), "finite")
        if name not in ("A", "v", "v_star"):
            require_values(name, value, value >= 0, "at least 0")


def _check_solved(solution: ConeSolution, dtype):
    if is_known(solution.residual):
        worst = float(jnp.max(solution.residual, initial=0))
        tolerance = 100 * ConeSettings.for_dtype(dtype).tolerance
        require(
            worst <= tolerance,
            f"the impulse was not found: the optimality conditions are off by {worst:.1e} (allowed {tolerance:.0e}). "
            "Either A is not positive semi-definite, or the contacts squeeze a body from both sides and v cannot be "
            "met by any impulse. Check A = J M^-1 J^T and that v and v_star are in the range of J.",
        )
