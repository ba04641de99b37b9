"""Contact models: from the closed contacts to the velocity jump (paper, appendices C to G)."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from carom.checks import as_floats, is_known, require, require_values
from carom.contact.candidates import Active
from carom.contact.cones import ConeSettings, ConeSolution, solve_cone_problem
from carom.contact.lcp import solve_lcp_impulse


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
    """How closed contacts change the velocity. A model of your own is a subclass, given as `contact_model`."""

    @abc.abstractmethod
    def __call__(self, state: ContactState, *, smoothing: float = 0.0) -> Jump:
        """The velocity jump. Nothing changes where no contact is active."""


class CM(ContactModel):
    """Friction cones and Poisson's restitution in two phases, with the Delassus matrix as it is (S.12 to S.15)."""

    def __call__(self, state, *, smoothing=0.0):
        return _two_phase_jump(state, smoothing)


class CMr(ContactModel):
    """CM with `A + epsilon I` in place of `A` in the two convex programs (listing S.3).

    Impulses are then unique and smaller than those of CM, so that contacts yield: one with `A = a` keeps the share
    `epsilon / (a + epsilon)` of its approach after compression. The programs alone see epsilon. The velocity that the
    restitution phase starts from (S.14) and the jump are what the impulses found do to the real system, by `A`:
    the supplement has no other difference between CM and CMr than the matrix of the program.

    **Arguments:** `epsilon`, in 1/kg, at least 0 (which is CM); the paper takes 0.01 and tries 0.001 to 0.1. It is a
    leaf of the pytree and can be learned (`LearnConfig(epsilon="learn")`).

    **Raises:** `CaromError` for an epsilon that is negative, not finite, or not one number.
    """

    epsilon: Float[Array, ""]

    def __init__(self, epsilon: ArrayLike = 0.01):
        epsilon = as_floats(epsilon)
        require(epsilon.ndim == 0, f"epsilon must be one number; its shape was {epsilon.shape}.")
        require_values("epsilon", epsilon, (epsilon >= 0) & jnp.isfinite(epsilon), "a finite number of at least 0")
        self.epsilon = epsilon

    def __call__(self, state, *, smoothing=0.0):
        d = state.velocity.shape[1]
        # Padding has zero rows in A, by which the solver knows it, and keeps them.
        present = jnp.repeat(state.active.active, d)
        return _two_phase_jump(state, smoothing, jnp.where(present, self.epsilon.astype(state.delassus.dtype), 0))


class Coulomb(ContactModel):
    """Coulomb's friction with Poisson's restitution: CM without the lift of contacts that slide.

    The convex programs of CM make a contact that slides with `v_t` separate with `v_n = mu |v_t|` (they ask for
    velocities in the dual cone), as if it bounced. With `mu |v_t|` of the solution added to the normal velocity that a
    program starts from, its solution is that of Coulomb's law with `v_n >= 0` (G. De Saxce, Z.-Q. Feng 1998; V. Acary,
    F. Cadoux, C. Lemarechal, J. Malick 2011). `iterations` programs are solved in turn for it, the speeds `|v_t|` by
    secants: the third has the solution for one contact that goes on sliding in its direction, whatever mu; where
    contacts act on each other or turn, each further one takes most of the error away.

    Friction and restitution may be less in faster impacts, with the contact's speed of approach `v_n` (m/s):

        mu(v_n) = mu (1 - friction_loss (1 - exp(-v_n / loss_speed))),   and e(v_n) likewise with restitution_loss

    so that `friction` and `restitution` of the system are those of slow contact. Real bodies bounce less from faster
    impacts (W. Goldsmith, *Impact*, 1960).

    **Arguments:** `friction_loss`, `restitution_loss`, from 0 to 1, and `loss_speed` (m/s), positive: leaves of the
    pytree, which can be learned; `iterations`.

    **Raises:** `CaromError` for values that are out of range or not one number, and for less than one iteration.
    """

    friction_loss: Float[Array, ""]
    restitution_loss: Float[Array, ""]
    loss_speed: Float[Array, ""]
    iterations: int = eqx.field(static=True)

    def __init__(
        self,
        friction_loss: ArrayLike = 0.0,
        restitution_loss: ArrayLike = 0.0,
        loss_speed: ArrayLike = 0.3,
        iterations: int = 4,
    ):
        self.friction_loss, self.restitution_loss = as_floats(friction_loss), as_floats(restitution_loss)
        self.loss_speed = as_floats(loss_speed)
        for name in ("friction_loss", "restitution_loss", "loss_speed"):
            value = getattr(self, name)
            require(value.shape == (), f"{name} must be one number; its shape was {value.shape}.")
            speed = name == "loss_speed"
            good = (value > 0) & jnp.isfinite(value) if speed else (value >= 0) & (value <= 1)
            require_values(name, value, good, "a positive speed in m/s" if speed else "a share from 0 to 1")
        require(iterations >= 1, f"iterations must be at least 1; it was {iterations}.")
        self.iterations = iterations

    def __call__(self, state, *, smoothing=0.0):
        lost = 1 - jnp.exp(-jnp.maximum(-state.velocity[:, 0], 0) / self.loss_speed)
        at_speed = state._replace(
            friction=state.friction * (1 - self.friction_loss * lost),
            restitution=state.restitution * (1 - self.restitution_loss * lost),
        )
        return _two_phase_jump(at_speed, smoothing, sliding=self.iterations)


class LCP(ContactModel):
    """Friction pyramids and Newton's restitution as one linear complementarity problem (appendix J).

    The normal velocity after the impact is at least `-e v_n` of the approach (or the target's, if that is larger), and
    friction opposes sliding relative to the target. Newton's hypothesis is that of velocities, Poisson's (of CM) that
    of impulses: for one contact without friction they are the same. Unlike in CM, a contact that slides does not lift
    off. Contacts that squeeze a body and each ask for a rebound may have no solution, which the residual then tells.

    **Arguments:** `facets`, edges of the pyramid in 3D, even and at least 4; in 2D it is the cone.

    **Raises:** `CaromError` for other facets, and if a `smoothing` is asked for: this model has none.
    """

    facets: int = eqx.field(static=True)

    def __init__(self, facets: int = 4):
        require(facets >= 4 and facets % 2 == 0, f"facets must be even and at least 4; it was {facets}.")
        self.facets = facets

    def __call__(self, state, *, smoothing=0.0):
        require(smoothing == 0, f"smoothing must be 0 with the contact model LCP; it was {smoothing}.")
        bounce = -state.restitution * jnp.minimum(state.velocity[:, 0], 0)
        target = state.target[:, 0]
        # Where both are equal, as at e = 0 without compensation, the derivative is that of the bounce, for a growing e.
        rebound = jnp.where(bounce >= target, bounce, target)
        solution = solve_lcp_impulse(
            state.delassus, state.velocity, state.friction, rebound, state.target[:, 1:], facets=self.facets
        )
        return Jump(_velocity_jump(state, solution.impulse), solution.residual, solution.impulse[None])


CONTACT_MODELS: dict[str, type[ContactModel]] = {"cm": CM, "cmr": CMr, "lcp": LCP, "coulomb": Coulomb}
"""Contact models by the names under which they are chosen and saved."""


def contact_model_of(model: str | ContactModel, *, argument: str = "contact_model") -> ContactModel:
    """The contact model of this name, with its default settings; a `ContactModel` is returned as it is.

    **Raises:** `CaromError` for anything else, that names the `argument`.
    """
    if isinstance(model, ContactModel):
        return model
    names = ", ".join(map(repr, CONTACT_MODELS))
    require(
        isinstance(model, str) and model in CONTACT_MODELS,
        f"{argument} must be one of {names}, or a ContactModel; it was {model!r}.",
    )
    return CONTACT_MODELS[model]()


def contact_model_name(model: ContactModel) -> str | None:
    """The name of a contact model, or `None` for one that carom does not bring."""
    return next((name for name, kind in CONTACT_MODELS.items() if type(model) is kind), None)


def contact_model_settings(model: ContactModel) -> dict[str, Any]:
    """What besides arrays makes `model` what it is: the static arguments of its class."""
    return {f.name: getattr(model, f.name) for f in dataclasses.fields(model) if f.metadata.get("static", False)}


def _length(vector: Float[Array, "*b d"]) -> Float[Array, "*b"]:
    """Length, with a derivative of zero at zero."""
    square = jnp.sum(vector**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


def _two_phase_jump(
    state: ContactState, smoothing: float, diagonal: Float[Array, " r"] | None = None, sliding: int = 0
) -> Jump:
    compression, rebound = two_phases(
        state.delassus,
        state.velocity,
        state.friction,
        state.restitution,
        state.target,
        diagonal=diagonal,
        smoothing=smoothing,
        sliding=sliding,
    )
    residual = jnp.maximum(compression.residual, rebound.residual)
    velocity = _velocity_jump(state, compression.impulse + rebound.impulse)
    return Jump(velocity, residual, jnp.stack([compression.impulse, rebound.impulse]))


def _velocity_jump(state: ContactState, impulse: Float[Array, "K d"]) -> Float[Array, "n d"]:
    return jnp.einsum("rid,r->id", state.response, impulse.reshape(-1))


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


def two_phases(
    A, v, friction, restitution, v_star, *, diagonal: Array | None = None, smoothing: float = 0.0, sliding: int = 0
) -> tuple[ConeSolution, ConeSolution]:
    """`contact_impulse` without its checks, with the solver's residuals.

    `diagonal` (..., K d) is added to that of A in the convex programs alone, not where velocities are computed.
    `sliding` programs in each phase undo the lift of contacts that slide (see `Coulomb`); 0: CM, which has it.
    """
    program = A if diagonal is None else A + diagonal[..., None] * jnp.eye(A.shape[-1], dtype=A.dtype)

    # The phases differ in their data alone, so that they are one compiled solve, done twice.
    def phase(state, is_rebound):
        velocity, lower = state
        velocity = velocity - jnp.where(is_rebound, v_star, 0)
        least = jnp.where(is_rebound, lower, -jnp.inf)

        def solved(start):
            solution = _solve(program, start, friction, least, smoothing, reference=v)
            return (A @ solution.impulse.reshape(*v.shape[:-2], -1, 1)).reshape(v.shape), solution

        def without_lift(search, _):
            speed = _next_speed(search)
            change, solution = solved(velocity.at[..., 0].add(friction * speed))
            excess = _length((velocity + change)[..., 1:]) - speed
            return _Search(speed, excess, search.speed, search.excess), (change, solution)

        if sliding:
            speed = _length(velocity[..., 1:])
            start = _Search(speed, jnp.zeros_like(speed), speed, jnp.zeros_like(speed))
            _, found = jax.lax.scan(without_lift, start, length=sliding)
            change, solution = jax.tree.map(lambda s: s[-1], found)
        else:
            change, solution = solved(velocity)
        lower = restitution * jnp.maximum(solution.impulse[..., 0], 0)
        return (velocity + change, lower), solution

    _, solutions = jax.lax.scan(phase, (v, jnp.zeros_like(friction)), jnp.array([False, True]))
    return jax.tree.map(lambda s: s[0], solutions), jax.tree.map(lambda s: s[1], solutions)


class _Search(NamedTuple):
    """Speeds of sliding (..., K) that the last program was given and the one before, and how much more came out."""

    speed: Float[Array, "*b K"]
    excess: Float[Array, "*b K"]
    speed_before: Float[Array, "*b K"]
    excess_before: Float[Array, "*b K"]


def _next_speed(search: _Search) -> Float[Array, "*b K"]:
    """The speed of sliding to try next, for each contact where the excess would be zero if it were linear (secants).

    It is linear for one contact that goes on sliding in its direction: the third program is then given the solution,
    and has its derivative. Where there is no slope yet, the speed that came out.
    """
    plain = search.speed + search.excess
    step, slope = search.speed - search.speed_before, search.excess - search.excess_before
    usable = (jnp.abs(step) > 1e-12 * search.speed) & (jnp.abs(slope) > 0.1 * jnp.abs(step))
    secant = search.speed - search.excess * step / jnp.where(usable, slope, 1)
    return jnp.where(usable, jnp.clip(secant, 0, 3 * jnp.maximum(search.speed, plain)), plain)


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
    redundant contacts, and the zero rows of contacts that are not active. `J_C J_C^+` is one in the first case (no more
    contacts than points), as S.24 has it, even where contacts are redundant. No gradient flows through it.
    """
    k, d = contact_jacobian.shape[:2]
    JC = jax.lax.stop_gradient(contact_jacobian).reshape(k * d, -1)
    JE = jax.lax.stop_gradient(constraint_jacobian).reshape(constraint_jacobian.shape[0], JC.shape[1])
    depth = jax.lax.stop_gradient(depth)
    desired = jnp.zeros((k, d), JC.dtype).at[:, 0].set(depth / time).reshape(-1)
    gram = JC @ JC.T
    v = JC.T @ _solve_regular(gram, desired, _vanishing(gram))
    closed = jnp.sum(jnp.any(JC.reshape(k, -1) != 0, axis=1))
    target = jnp.where(closed * d > JC.shape[1], JC @ v, desired)
    if JE.shape[0]:
        target = target - JC @ (JE.T @ _solve_regular(JE @ JE.T, JE @ v, 0.0))
    return target.reshape(k, d)


def consistent_velocity(
    velocity: Float[Array, "K d"],
    drift: Float[Array, "K d"],
    delassus: Float[Array, "r r"],
    friction: Float[Array, " K"],
) -> Float[Array, "K d"]:
    """The contacts' velocities (m/s) less that part of their `drift` which no impulse can change.

    `drift` is what a violation of the joints by the state gives to the contacts, `J_C M^-1 J_E^T G^-1 J_E v`: all that
    can take `v_C` out of the range of `A`. Where `A` is singular, however little of it would choose among the many
    impulses of one velocity change, against the one of least norm, and jump with the drift's sign. With
    `Q = S A S`, `S = diag(1, mu, mu)` (friction's own scale: without friction tangents do not matter), the part is
    `S^-1 (1 - Q Q^+) S drift`, taken as the limit of `delta (Q + delta)^-1`.
    """
    scale = jnp.concatenate(
        [jnp.ones_like(velocity[:, :1]), jnp.broadcast_to(friction[:, None], drift[:, 1:].shape)], 1
    )
    row = scale.reshape(-1)
    matrix = row[:, None] * delassus * row
    delta = _vanishing(matrix)
    unreachable = delta * _solve_regular(matrix, row * drift.reshape(-1), delta).reshape(scale.shape)
    return velocity - jnp.where(scale > 0, unreachable / jnp.where(scale > 0, scale, 1), 0)


def _vanishing(matrix: Float[Array, "r r"]) -> Float[Array, ""]:
    """A diagonal in place of the limit of none: 4e-10 of the matrix in double precision, 7e-5 in single."""
    return jnp.finfo(matrix.dtype).eps ** 0.6 * jnp.max(jnp.diag(matrix))


def _solve_regular(matrix, rhs, diagonal):
    """`(matrix + diagonal)^-1 rhs`; a matrix of zeros counts as the identity."""
    diagonal = jnp.where(jnp.max(jnp.diag(matrix)) > 0, diagonal, 1)
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
