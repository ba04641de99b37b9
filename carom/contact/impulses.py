"""Contact models: from the closed contacts to the velocity jump (paper, appendices C to G)."""

import abc
import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from carom.checks import as_floats, is_share, not_negative, positive, require, require_values
from carom.contact.candidates import Active
from carom.contact.lcp import solve_lcp_impulse
from carom.contact.phases import two_phases


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
    reference: Float[Array, "K d"] | None = None  # velocities beside which others are rounding, if not `velocity`
    rebounds: Bool[Array, ""] | None = None  # if false, nothing is asked for after compression: contacts that last


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
        return _phases_jump(state, smoothing)


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
        require_values("epsilon", epsilon, not_negative, "a finite number of at least 0")
        self.epsilon = epsilon

    def __call__(self, state, *, smoothing=0.0):
        d = state.velocity.shape[1]
        # Padding has zero rows in A, by which the solver knows it, and keeps them.
        present = jnp.repeat(state.active.active, d)
        return _phases_jump(state, smoothing, jnp.where(present, self.epsilon.astype(state.delassus.dtype), 0))


class Coulomb(ContactModel):
    """Coulomb's friction with Poisson's restitution, exactly: CM without the lift of contacts that slide.

    The convex programs of CM make a contact that slides separate with `v_n = mu |v_t|` (they ask for velocities in the
    dual cone), as if it bounced. Here each phase obeys Signorini's condition and Coulomb's law themselves, a nonlinear
    complementarity problem that is solved as such (`carom/contact/coulomb.py`).

    Friction and restitution may be less in faster impacts, with the contact's speed of approach `v_n` (m/s):

        mu(v_n) = mu (1 - friction_loss (1 - exp(-v_n / loss_speed))),   and e(v_n) likewise with restitution_loss

    so that `friction` and `restitution` of the system are those of slow contact. Real bodies bounce less from faster
    impacts (W. Goldsmith, *Impact*, 1960).

    **Arguments:** `friction_loss`, `restitution_loss`, from 0 to 1, and `loss_speed` (m/s), positive: leaves of the
    pytree, which can be learned.

    **Raises:** `CaromError` for values that are out of range or not one number, and if a `smoothing` is asked for: this
    model has none.
    """

    friction_loss: Float[Array, ""]
    restitution_loss: Float[Array, ""]
    loss_speed: Float[Array, ""]

    def __init__(
        self,
        friction_loss: ArrayLike = 0.0,
        restitution_loss: ArrayLike = 0.0,
        loss_speed: ArrayLike = 0.3,
    ):
        self.friction_loss, self.restitution_loss = as_floats(friction_loss), as_floats(restitution_loss)
        self.loss_speed = as_floats(loss_speed)
        for name in ("friction_loss", "restitution_loss", "loss_speed"):
            value = getattr(self, name)
            require(value.shape == (), f"{name} must be one number; its shape was {value.shape}.")
            speed = name == "loss_speed"
            good = positive if speed else is_share
            require_values(name, value, good, "a positive speed in m/s" if speed else "a share from 0 to 1")

    def __call__(self, state, *, smoothing=0.0):
        require(smoothing == 0, f"smoothing must be 0 with the contact model Coulomb; it was {smoothing}.")
        lost = 1 - jnp.exp(-jnp.maximum(-state.velocity[:, 0], 0) / self.loss_speed)
        at_speed = state._replace(
            friction=state.friction * (1 - self.friction_loss * lost),
            restitution=state.restitution * (1 - self.restitution_loss * lost),
        )
        return _phases_jump(at_speed, smoothing, coulomb=True)


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
        bounce = bounce if state.rebounds is None else jnp.where(state.rebounds, bounce, 0)
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


def _phases_jump(
    state: ContactState, smoothing: float, diagonal: Float[Array, " r"] | None = None, coulomb: bool = False
) -> Jump:
    phases = two_phases(
        state.delassus,
        state.velocity,
        state.friction,
        state.restitution,
        state.target,
        diagonal=diagonal,
        smoothing=smoothing,
        coulomb=coulomb,
        reference=state.reference,
        rebounds=state.rebounds,
    )
    impulse = jnp.stack([phase.impulse for phase in phases])
    residual = jnp.maximum(*(phase.residual for phase in phases))
    return Jump(_velocity_jump(state, jnp.sum(impulse, axis=0)), residual, impulse)


def _velocity_jump(state: ContactState, impulse: Float[Array, "K d"]) -> Float[Array, "n d"]:
    return jnp.einsum("rid,r->id", state.response, impulse.reshape(-1))


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
    v = JC.T @ _solve_regular(gram, desired, _vanishing(gram, d))
    closed = jnp.sum(jnp.any(JC.reshape(k, -1) != 0, axis=1))
    target = jnp.where(closed * d > JC.shape[1], JC @ v, desired)
    if JE.shape[0]:
        target = target - JC @ (JE.T @ _solve_regular(JE @ JE.T, JE @ v, jnp.zeros(JE.shape[0], JE.dtype)))
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
    delta = _vanishing(matrix, velocity.shape[1])
    unreachable = (delta * _solve_regular(matrix, row * drift.reshape(-1), delta)).reshape(scale.shape)
    return velocity - jnp.where(scale > 0, unreachable / jnp.where(scale > 0, scale, 1), 0)


def _vanishing(matrix: Float[Array, "r r"], d: int) -> Float[Array, " r"]:
    """A diagonal in place of the limit of none: 4e-10 of each contact's normal entry (7e-5 in single precision)."""
    return jnp.finfo(matrix.dtype).eps ** 0.6 * jnp.repeat(jnp.diag(matrix)[::d], d)


def _solve_regular(matrix, rhs, diagonal):
    """`(matrix + diagonal)^-1 rhs`; rows of zeros count as those of the identity."""
    diagonal = jnp.asarray(jnp.where(diagonal > 0, diagonal, jnp.where(jnp.diag(matrix) > 0, 0, 1)), matrix.dtype)
    matrix = matrix + jnp.diag(diagonal)
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix, lower=True), rhs)
