"""What is learned: a neural potential, masses and contact properties, assembled into a System (CLNN and CHNN)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax.projections
from jaxtyping import Array, Float, PRNGKeyArray

from carom.contact.impulses import ContactModel
from carom.mechanics.bodies import RigidBody
from carom.mechanics.potentials import Potential
from carom.system import StepModel, System


class NeuralPotential(Potential):
    """A potential energy learned as a multi-layer perceptron of all points, with softplus units.

    **Arguments:** `n_points`, `dim`: of the system; `width`, `depth`: units of a hidden layer, number of hidden layers;
    `key`: random key of the initial weights; `dtype`: of the weights and of the evaluation (single precision by
    default, also inside of simulations in double).
    """

    network: eqx.nn.MLP

    def __init__(
        self,
        n_points: int,
        dim: int,
        *,
        width: int = 256,
        depth: int = 3,
        key: PRNGKeyArray,
        dtype=jnp.float32,
    ):
        self.network = eqx.nn.MLP(
            n_points * dim, "scalar", width, depth, activation=jax.nn.softplus, key=key, dtype=dtype
        )

    def __call__(self, x, mass_matrix):
        dtype = self.network.layers[0].weight.dtype
        return self.network(x.reshape(-1).astype(dtype)).astype(x.dtype)


class Unknowns(eqx.Module):
    """Everything that is learned of a system; `None` for what is known and stays the skeleton's.

    Masses are learned as ratios to that of the first body, `mass_i = mass_0 exp(log_mass_ratio_i)`: motion does not
    tell the unit of mass, since masses and potential can be scaled together. A rigid body's moments scale with its
    mass. `contact_model` and `step_model` are networks of the baselines.
    """

    log_mass_ratio: Float[Array, " bodies_after_first"] | None
    friction: Float[Array, " P"] | None
    restitution: Float[Array, " P"] | None
    potential: NeuralPotential | None
    log_epsilon: Float[Array, ""] | None = None  # of the contact model CMr: its epsilon is positive, of any magnitude
    contact_model: ContactModel | None = None
    step_model: StepModel | None = None

    def assemble(self, skeleton: System) -> System:
        """The system with these unknowns filled in."""
        system = skeleton
        if self.log_mass_ratio is not None:
            ratio = jnp.concatenate([jnp.zeros(1, self.log_mass_ratio.dtype), self.log_mass_ratio])
            masses = skeleton.bodies[0].mass * jnp.exp(ratio)
            bodies = tuple(_with_mass(body, mass) for body, mass in zip(skeleton.bodies, masses, strict=True))
            system = eqx.tree_at(lambda s: s.bodies, system, bodies)
        for name in ("friction", "restitution", "potential", "contact_model", "step_model"):
            value = getattr(self, name)
            if value is not None:
                system = eqx.tree_at(lambda s, name=name: getattr(s, name), system, value, is_leaf=lambda p: p is None)
        if self.log_epsilon is not None:
            system = eqx.tree_at(lambda s: s.contact_model.epsilon, system, jnp.exp(self.log_epsilon))
        return system

    def project(self) -> "Unknowns":
        """The nearest admissible values: mu >= 0, 0 <= e <= 1. Both ends can be reached exactly, and left again."""
        out = self
        if self.friction is not None:
            friction = optax.projections.projection_non_negative(self.friction)
            out = eqx.tree_at(lambda u: u.friction, out, friction)
        if self.restitution is not None:
            restitution = optax.projections.projection_box(self.restitution, 0.0, 1.0)
            out = eqx.tree_at(lambda u: u.restitution, out, restitution)
        return out


def _with_mass(body, mass):
    """`body` with another mass and the same shape: moments keep their ratio to the mass."""
    if isinstance(body, RigidBody):
        scaled = body.moments * (mass / body.mass)
        return eqx.tree_at(lambda b: (b.mass, b.moments), body, (mass, scaled))
    return eqx.tree_at(lambda b: b.mass, body, mass)


def mass_ratios(system: System) -> np.ndarray:
    """Masses of the bodies over that of the first."""
    masses = np.asarray(system.masses)
    return masses / masses[0]
