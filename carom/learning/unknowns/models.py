"""What is learned: a neural potential, masses and contact properties, assembled into a System (CLNN and CHNN)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax.projections
from jaxtyping import Array, Float, PRNGKeyArray

from carom.contact.impulses import ContactModel
from carom.contact.limits import StretchLimit
from carom.mechanics.bodies import RigidBody
from carom.mechanics.potentials import Potential
from carom.recordings.recording import Recording
from carom.system import StepModel, System


class SegmentEnergy(eqx.Module):
    """Elastic energy of the segments of chains that may stretch: for each a polynomial of its length, to be learned,

        V = energy sum_k c_k q^k,   k = 1, ..., 4,   q = (length - mean) / spread.

    The highest powers may be left out. A segment stretches by little of its length, so that the energy's curvature
    along it is a thousand times that along other directions. A network of the points' coordinates learns such a
    curvature last, if at all.
    """

    ends: tuple[tuple[int, int], ...] = eqx.field(static=True)  # points; -1: the anchor
    coefficients: Float[Array, "s degree"]
    # Of the data and the geometry: not learned.
    anchors: Float[Array, "s 2"]  # m
    mean: Float[Array, " s"]  # m
    spread: Float[Array, ""]  # m
    energy: Float[Array, ""]  # J

    @classmethod
    def of(cls, skeleton: System, recording: Recording | None) -> "SegmentEnergy | None":
        """Of all segments with a `StretchLimit`, scaled to the recorded motion; None if there are none."""
        ends, anchors = [], []
        for contact in skeleton.contacts:
            if isinstance(contact, StretchLimit):
                center, anchor = skeleton.table.center, contact.chain.anchor
                ends += [tuple(-1 if b < 0 else center[b] for b in run) for run in contact.chain.windows(2)]
                anchors += [np.zeros(2) if anchor is None else np.asarray(anchor)] * len(contact.property_index)
        if not ends:
            return None
        floats, count = skeleton.friction.dtype, len(ends)
        unit, zero = jnp.ones((), floats), jnp.zeros(count, floats)
        new = cls(tuple(ends), jnp.zeros((count, 4), floats), jnp.asarray(np.array(anchors), floats), zero, unit, unit)
        if recording is None:
            return new
        length = np.asarray(jax.vmap(new.lengths)(jnp.asarray(recording.x[recording.valid], floats)))
        # At least a thousandth of the length, where nothing stretches.
        spread = max(float(length.std(axis=0).max()), 1e-3 * float(length.mean()))
        # The mean kinetic energy of a point.
        energy = 0.5 * float(skeleton.masses[0]) * float(np.mean(np.sum(recording.v[recording.valid] ** 2, axis=-1)))
        values = length.mean(axis=0), spread, energy if energy > 0 else 1.0
        return eqx.tree_at(lambda s: (s.mean, s.spread, s.energy), new, tuple(jnp.asarray(a, floats) for a in values))

    def lengths(self, x: Float[Array, "n 2"]) -> Float[Array, " s"]:
        """Lengths of the segments (m)."""
        first, second = np.array(self.ends).T
        start = jnp.where((first < 0)[:, None], self.anchors.astype(x.dtype), x[first])
        return jnp.linalg.norm(x[second] - start, axis=1)

    def __call__(self, x: Float[Array, "n 2"]) -> Float[Array, ""]:
        mean, spread, energy = (a.astype(x.dtype) for a in jax.lax.stop_gradient((self.mean, self.spread, self.energy)))
        q = (self.lengths(x) - mean) / spread
        powers = jnp.stack([q, q**2, q**3, q**4][: self.coefficients.shape[1]], axis=1)
        return energy * jnp.sum(self.coefficients.astype(x.dtype) * powers)


class NeuralPotential(Potential):
    """A potential energy learned as a multi-layer perceptron of all points, with softplus units, and a linear term.

    The linear term, `sum slope * x`, is a uniform field: what it explains, such as gravity, also holds where there were
    no data, which is not so of a network. Where chains may stretch, the elastic energy of their segments is added: see
    `SegmentEnergy`. `network` is None where the data need none: what is not there costs no time.

    **Arguments:** `n_points`, `dim`: of the system; `width`, `depth`: units of a hidden layer, number of hidden layers;
    `key`: random key of the initial weights; `dtype`: of the network's weights and of its evaluation (single precision
    by default, also inside of simulations in double); `segments`: elastic energy of segments, or `None`.
    """

    network: eqx.nn.MLP | None
    slope: Float[Array, "n d"]  # N
    segments: SegmentEnergy | None

    def __init__(
        self,
        n_points: int,
        dim: int,
        *,
        width: int = 256,
        depth: int = 3,
        key: PRNGKeyArray,
        dtype=jnp.float32,
        segments: SegmentEnergy | None = None,
    ):
        self.network = eqx.nn.MLP(
            n_points * dim, "scalar", width, depth, activation=jax.nn.softplus, key=key, dtype=dtype
        )
        self.slope = jnp.zeros((n_points, dim))
        self.segments = segments

    @classmethod
    def of(
        cls, skeleton: System, recording: Recording | None, *, key: PRNGKeyArray, dtype=jnp.float32, **sizes: int
    ) -> "NeuralPotential":
        """An untrained potential of a system, scaled to `recording` where there is one; `sizes`: width and depth."""
        segments = SegmentEnergy.of(skeleton, recording)
        return cls(skeleton.n_points, skeleton.dim, key=key, dtype=dtype, segments=segments, **sizes)

    def __call__(self, x, mass_matrix):
        value = jnp.sum(self.slope.astype(x.dtype) * x)
        if self.network is not None:
            inputs = x.reshape(-1).astype(self.network.layers[0].weight.dtype)
            value = self.network(inputs).astype(x.dtype) + value
        return value if self.segments is None else value + self.segments(x)

    def linear_weights(self) -> tuple[Any, ...]:
        """The parameters in which the potential is linear: the output layer's weights, if there is a network, then the
        linear term's and those of the segments.

        Arrays, or what `equinox.tree_at` puts in their place.
        """
        output = () if self.network is None else (self.network.layers[-1].weight,)
        segments = () if self.segments is None else (self.segments.coefficients,)
        return *output, self.slope, *segments

    def with_linear_weights(self, weights: tuple[Any, ...]) -> "NeuralPotential":
        """The potential with other values of `linear_weights`."""
        return eqx.tree_at(lambda p: p.linear_weights(), self, weights)

    def simpler(self) -> list["NeuralPotential"]:
        """Potentials with fewer parameters, the simplest first: without network, and with linear springs at first."""
        if self.network is None:
            return []
        bare = eqx.tree_at(lambda p: p.network, self, None)
        if self.segments is None:
            return [bare]
        linear = eqx.tree_at(lambda p: p.segments.coefficients, bare, self.segments.coefficients[:, :2])
        return [linear, bare]

    def extended(self, full: "NeuralPotential") -> "NeuralPotential":
        """The same energy with all parameters that `full` has: its hidden layers, and zeros."""
        out = self
        if self.network is None and full.network is not None:
            network = eqx.tree_at(lambda n: n.layers[-1].weight, full.network, replace_fn=jnp.zeros_like)
            out = eqx.tree_at(lambda p: p.network, out, network, is_leaf=lambda part: part is None)
        if self.segments is not None and full.segments is not None:
            there = self.segments.coefficients
            missing = full.segments.coefficients.shape[1] - there.shape[1]
            padded = jnp.pad(there, ((0, 0), (0, missing)))
            out = eqx.tree_at(lambda p: p.segments.coefficients, out, padded)
        return out

    def pruned(self) -> "NeuralPotential":
        """The same forces, without a network that makes none."""
        idle = self.network is not None and not np.any(np.asarray(self.network.layers[-1].weight))
        return eqx.tree_at(lambda p: p.network, self, None) if idle else self


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
