"""Random systems at an impact: what must hold whatever the bodies, masses, joints, contacts and speeds.

Structures are few, because each is compiled; all numbers are drawn: mass ratios up to 1e4, friction in [0, 2],
restitution in [0, 1], depths, poses and velocities, with the ends of their ranges and zero speeds among them.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cone_problems import apply, kkt_residual
from hypothesis import Phase, given, settings
from hypothesis.extra import numpy as hnp
from jaxtyping import Array, Bool, Float, Int
from systems import PAPER, disk, sphere

import carom
from carom.contact.cone_algebra import ConeSettings
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.mechanics.dynamics import saddle_point
from carom.simulation.impact import Stepper, contact_jump

BATCH = 8
NO_SHRINK = [Phase.explicit, Phase.generate]  # shrinking a batch takes minutes, and tells little
NUMBERS = 48
"""Numbers that a system with its state is made from."""


class Numbers:
    """Numbers in [0, 1], taken one after the other."""

    def __init__(self, values: np.ndarray):
        self.rest = values

    def take(self, low: float, high: float) -> float:
        value, self.rest = self.rest[0], self.rest[1:]
        return float(low + (high - low) * value)

    def mass(self) -> float:
        return 10 ** self.take(-2, 2)

    def radius(self) -> float:
        return self.take(0.05, 0.5)

    def vector(self, dim: int, size: float = 3.0) -> np.ndarray:
        """Half of the numbers stand for 0 velocity or so: bodies at rest are where solvers divide by zero."""
        signed = np.array([self.take(-1, 1) for _ in range(dim)])
        return size * np.where(np.abs(signed) < 0.1, 0.0, signed)

    def direction(self, dim: int, spread: float = np.pi) -> np.ndarray:
        """A unit vector at most so far from the second axis."""
        polar, around = self.take(-spread, spread), self.take(0, 2 * np.pi)
        if dim == 2:
            return np.array([np.sin(polar), np.cos(polar)])
        return np.array([np.sin(polar) * np.cos(around), np.cos(polar), np.sin(polar) * np.sin(around)])

    def depth(self, radius: float) -> float:
        return radius * self.take(1e-4, 0.2)  # at least 5e-6 m, which single precision resolves at these distances

    def rotation(self, dim: int) -> np.ndarray:
        angles = [self.take(-np.pi, np.pi) for _ in range(1 if dim == 2 else 3)]
        turns = []
        for axis, angle in enumerate(angles):
            turn = np.eye(dim)
            i, j = (axis + 1) % 3 if dim == 3 else 0, (axis + 2) % 3 if dim == 3 else 1
            turn[[i, j], [i, j]], turn[i, j], turn[j, i] = np.cos(angle), -np.sin(angle), np.sin(angle)
            turns.append(turn)
        return functools.reduce(np.matmul, turns)

    def properties(self, count: int) -> dict[str, list[float]]:
        return {
            "friction": [self.take(0, 2) for _ in range(count)],
            "restitution": [self.take(0, 1) for _ in range(count)],
        }

    def motion(self, body: carom.RigidBody | carom.PointMass, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Points and their velocities of a body whose centre is there."""
        dim, velocity = len(center), self.vector(len(center))
        if isinstance(body, carom.PointMass):
            return center[None], velocity[None]
        rotation, omega = self.rotation(dim), self.vector(1 if dim == 2 else 3, 10.0)
        points = embed_pose(jnp.asarray(center), jnp.asarray(rotation))
        return np.asarray(points), np.asarray(embed_velocity(*map(jnp.asarray, (rotation, velocity, omega))))


class Case(NamedTuple):
    system: carom.System
    x: np.ndarray
    v: np.ndarray


def _case(numbers: Numbers, bodies, centers, **parts) -> Case:
    motions = [numbers.motion(body, center) for body, center in zip(bodies, centers, strict=True)]
    x, v = (np.concatenate(part) for part in zip(*motions, strict=True))
    # What is tested are the paper's two convex programs and its target velocity.
    return Case(carom.System(bodies=bodies, dim=len(centers[0]), **PAPER, **parts), x, v)


def three_disks(numbers: Numbers) -> Case:
    """In a row that is bent so that all three may touch, without walls: a point mass between disks that turn."""
    bodies = [
        disk(numbers.mass(), numbers.radius()),
        carom.PointMass(numbers.mass(), numbers.radius()),
        disk(numbers.mass(), numbers.radius()),
    ]
    r = [float(body.radius) for body in bodies]
    first = np.zeros(2)
    second = first + (r[0] + r[1] - numbers.depth(min(r))) * numbers.direction(2)
    along = (second - first) / np.linalg.norm(second - first)
    turn = numbers.take(-2, 2)  # at pi, the third would be on the first
    along = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ along
    third = second + (r[1] + r[2] - numbers.depth(min(r))) * along
    contacts = [carom.DiskDisk([(0, 1), (0, 2), (1, 2)], property=[0, 1, 2])]
    return _case(numbers, bodies, [first, second, third], contacts=contacts, **numbers.properties(3))


def pendulum_on_the_ground(numbers: Numbers) -> Case:
    """Two links hung from the origin, in 2D; the ground is where at least one body touches it."""
    bodies = [carom.PointMass(numbers.mass(), numbers.radius()) for _ in range(2)]
    lengths = [numbers.take(0.2, 1), numbers.take(0.2, 1)]
    first = lengths[0] * -numbers.direction(2)
    second = first + lengths[1] * -numbers.direction(2)
    low = min(c[1] - float(body.radius) for c, body in zip((first, second), bodies, strict=True))
    ground = low + numbers.depth(min(float(body.radius) for body in bodies))
    return _case(
        numbers,
        bodies,
        [first, second],
        constraints=[carom.Tether(0, (0.0, 0.0), lengths[0]), carom.Distance(0, 1, lengths[1])],
        contacts=[carom.DiskPlane([0, 1], (0.0, ground), (0.0, 1.0), property=[0, 1])],
        **numbers.properties(2),
    )


def ball_and_dumbbell(numbers: Numbers) -> Case:
    """In 3D, without walls: a ball that turns touches one end of a dumbbell, or both."""
    bodies = [
        carom.PointMass(numbers.mass(), numbers.radius()),
        carom.PointMass(numbers.mass(), numbers.radius()),
        sphere(numbers.mass(), numbers.radius()),
    ]
    r = [float(body.radius) for body in bodies]
    length = numbers.take(0.2, 1)
    first, second = np.zeros(3), length * numbers.direction(3)
    ball = (r[0] + r[2] - numbers.depth(min(r))) * numbers.direction(3)
    return _case(
        numbers,
        bodies,
        [first, second, ball],
        constraints=[carom.Distance(0, 1, length)],
        contacts=[carom.DiskDisk([(0, 2), (1, 2)], property=[0, 1])],
        **numbers.properties(2),
    )


def ball_in_a_corner(numbers: Numbers) -> Case:
    """One ball in 3D that turns, between two walls at any angle, with a point mass on it."""
    bodies = [sphere(numbers.mass(), numbers.radius()), carom.PointMass(numbers.mass(), numbers.radius())]
    r = [float(body.radius) for body in bodies]
    up, side = numbers.direction(3, 0.5), numbers.direction(3, 2.0)
    other = (r[0] + r[1] - numbers.depth(min(r))) * numbers.direction(3)
    walls = [
        carom.DiskPlane([0], (numbers.depth(r[0]) - r[0]) * normal, normal, property=k)
        for k, normal in enumerate((up, side))
    ]
    contacts = [*walls, carom.DiskDisk([(0, 1)], property=2)]
    return _case(numbers, bodies, [np.zeros(3), other], contacts=contacts, **numbers.properties(3))


WITHOUT_WALLS = (three_disks, ball_and_dumbbell)
STRUCTURES = (*WITHOUT_WALLS, pendulum_on_the_ground, ball_in_a_corner)


class Impact(NamedTuple):
    """What is known of an impact, see `carom.contact.impulses.ContactState`; `joints` is J_E, `mass` M."""

    v: Float[Array, "*b n d"]
    after: Float[Array, "*b n d"]
    impulse: Float[Array, "*b 2 K d"]
    velocity: Float[Array, "*b K d"]
    target: Float[Array, "*b K d"]
    delassus: Float[Array, "*b r r"]
    response: Float[Array, "*b r n d"]
    friction: Float[Array, "*b K"]
    restitution: Float[Array, "*b K"]
    active: Bool[Array, "*b K"]
    overflow: Int[Array, "*b"]
    joints: Float[Array, "*b E n d"]
    mass: Float[Array, "*b n n"]


def impact(case, stepper: Stepper, structure: carom.System) -> Impact:
    """The impact of one case, its velocities brought onto the joints before."""
    leaves, x, v = case
    system = eqx.combine(leaves, structure)
    inverse_mass = system.inverse_mass_matrix()
    if system.links:
        saddle = saddle_point(system.constraints, x, inverse_mass)
        v = saddle.project(saddle.project(v[None]))[0]  # twice: the first leaves rounding times the condition
    contacts, jump = contact_jump(system, x, v, inverse_mass, stepper)
    assert jump.impulse is not None
    return Impact(
        v=v,
        after=v + jump.velocity,
        impulse=jump.impulse,
        velocity=contacts.velocity,
        target=contacts.target,
        delassus=contacts.delassus,
        response=contacts.response,
        friction=contacts.friction,
        restitution=contacts.restitution,
        active=contacts.active.active,
        overflow=contacts.active.overflow,
        joints=jax.jacrev(system.constraints)(x),
        mass=system.mass_matrix(),
    )


@eqx.filter_jit
def impacts(batch, towards, stepper: Stepper, structure: carom.System) -> tuple[Impact, Array]:
    """The impacts of a batch, and the derivative of the velocities after them by all numbers of system and state."""

    def one(case, tangent):
        found, slope = jax.jvp(lambda c: impact(c, stepper, structure), (case,), (tangent,))
        return found, slope.after

    return jax.vmap(one)(batch, towards)


@eqx.filter_jit
def single_impact(case, stepper: Stepper, structure: carom.System) -> Impact:
    return impact(case, stepper, structure)


def made(make: Callable, values: np.ndarray, dtype):
    """A batch of cases from a row of numbers each, and the structure they share."""

    def cast(leaf):
        return jnp.asarray(leaf, dtype) if eqx.is_inexact_array(leaf) else leaf

    cases = [make(Numbers(row)) for row in values]
    parts = [eqx.partition(jax.tree.map(cast, tuple(case)), eqx.is_inexact_array) for case in cases]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(part for part, _ in parts)), parts[0][1][0]


@st.composite
def batches(draw) -> np.ndarray:
    """Numbers of a batch: half of the rows with the odd values that hypothesis likes, the others uniform."""
    odd = draw(hnp.arrays(float, (BATCH // 2, NUMBERS), elements=st.floats(0, 1), fill=st.nothing()))
    uniform = np.random.default_rng(draw(st.integers(0, 2**32 - 1))).random((BATCH - BATCH // 2, NUMBERS))
    return np.concatenate([odd, uniform])


def impacts_of(make: Callable, values: np.ndarray, dtype, compensation: float):
    """What the impacts of drawn numbers come to, in double precision, and their derivatives."""
    batch, structure = made(make, values, dtype)
    rng = np.random.default_rng(0)
    towards = jax.tree.map(lambda leaf: jnp.asarray(rng.standard_normal(leaf.shape), dtype), batch)
    stepper = Stepper(dt=jnp.asarray(0.01, dtype), compensation_steps=compensation)
    found, slope = impacts(batch, towards, stepper, structure)
    assert all(leaf.dtype == dtype for leaf in (found.after, found.impulse, slope))
    doubles = Impact(*(np.asarray(leaf, np.float64 if leaf.dtype == dtype else None) for leaf in found))
    return doubles, np.asarray(slope), (batch, stepper, structure)


def assert_optimal(found: Impact, dtype) -> None:
    """Both phases: normal impulses at least their bound (0, or e times what was compressed), in the friction cone, and
    what makes them the solution of their convex program."""
    compression, rebound = found.impulse[:, 0], found.impulse[:, 1]
    bounds = np.full_like(found.friction, -np.inf), found.restitution * np.maximum(compression[..., 0], 0)
    between = found.velocity + apply(found.delassus, compression) - found.target
    tolerance = ConeSettings.for_dtype(dtype).tolerance  # at which the solver stops
    # Residuals are relative to the largest velocity, but cannot be less than what rounding makes of the speeds: a ball
    # that is held between the ends of a dumbbell neither approaches them nor leaves.
    speed = np.max(np.abs(found.v), axis=(1, 2)) * float(jnp.finfo(dtype).eps) / tolerance
    known = np.maximum(np.abs(found.velocity), speed[:, None, None])
    first = kkt_residual(found.delassus, found.velocity, found.friction, bounds[0], compression, reference=known)
    second = kkt_residual(found.delassus, between, found.friction, bounds[1], rebound, reference=known)
    assert max(first.max(), second.max()) < tolerance
    assert not np.any(found.impulse[~np.broadcast_to(found.active[:, None], found.impulse.shape[:3])])


def kinetic_energy(found: Impact, v: np.ndarray) -> np.ndarray:
    return np.einsum("bid,bij,bjd->b", v, found.mass, v) / 2


def assert_mechanics(found: Impact, eps: float, *, walls: bool, compensated: bool) -> None:
    """Joints hold; without walls momentum is kept; without compensation no energy is gained."""
    # What velocities after are the sum of, and so what their rounding is relative to.
    terms = np.abs(found.v) + np.einsum(
        "brid,br->bid", np.abs(found.response), np.abs(found.impulse).sum(1).reshape(len(found.v), -1)
    )
    off = np.abs(np.einsum("beid,bid->be", found.joints, found.after))
    lengths = np.linalg.norm(found.joints, axis=(2, 3)) * np.linalg.norm(terms, axis=(1, 2))[:, None]
    assert (off <= 10 * eps * lengths).all()  # a sum of up to 24 rounded terms, whose errors are of either sign
    if not walls:
        change = np.einsum("bij,bjd->bd", found.mass, found.after - found.v)
        # A momentum is such a sum too.
        allowed = 10 * eps * np.einsum("bij,bj->b", np.abs(found.mass), np.linalg.norm(terms, axis=2))
        assert (np.abs(change) <= allowed[:, None]).all()
    if not compensated:
        # With T the change of kinetic energy, T(f) = f A f / 2 + f v. Compression f_c has f_c (v + A f_c) = 0 contact
        # by contact, so T(f_c) = -f_c A f_c / 2. Of all rebounds allowed, f_c itself is one for e <= 1 and gives
        # it back; the one of least energy gives back no more.
        gained = kinetic_energy(found, found.after) - kinetic_energy(found, found.v)
        assert (gained <= 10 * eps * kinetic_energy(found, terms)).all()


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("make", STRUCTURES)
def test_what_holds_at_every_impact(make, dtype):
    holds_at_every_impact(make, dtype, examples=100)


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.parametrize(
    ("make", "dtype"),
    [
        (three_disks, jnp.float64),
        (ball_and_dumbbell, jnp.float64),
        (pendulum_on_the_ground, jnp.float64),
        (pendulum_on_the_ground, jnp.float32),
    ],
)
def test_what_holds_at_some_impacts(make, dtype):
    holds_at_every_impact(make, dtype, examples=10)


def holds_at_every_impact(make, dtype, examples: int) -> None:
    eps = float(jnp.finfo(dtype).eps)

    @given(values=batches(), compensation=st.sampled_from([np.inf, 8.0, 1.0]))
    @settings(max_examples=examples, deadline=None, phases=NO_SHRINK, database=None, derandomize=True)
    def holds(values, compensation):
        found, slope, _ = impacts_of(make, values, dtype, compensation)
        for name, value in (*found._asdict().items(), ("slope", slope)):
            assert np.isfinite(value).all(), name
        assert not found.overflow.any()
        assert found.active.any(axis=1).all()
        n, d = found.v.shape[1:]
        k = found.friction.shape[1]
        assert found.after.shape == slope.shape == (BATCH, n, d)
        assert found.impulse.shape == (BATCH, 2, k, d)
        assert_optimal(found, dtype)
        assert_mechanics(found, eps, walls=make not in WITHOUT_WALLS, compensated=bool(np.isfinite(compensation)))

    holds()


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.parametrize("make", [pendulum_on_the_ground])
def test_a_batch_is_its_single_impacts(make):
    @given(values=batches(), compensation=st.sampled_from([np.inf, 8.0]))
    @settings(max_examples=5, deadline=None, database=None, derandomize=True)
    def equal(values, compensation):
        found, _, (batch, stepper, structure) = impacts_of(make, values, jnp.float64, compensation)
        for k in range(BATCH):
            alone = single_impact(jax.tree.map(lambda leaf, k=k: leaf[k], batch), stepper, structure)
            assert alone.after.shape == found.after.shape[1:]
            # Solved to 1e-8, from data that are rounded otherwise in another program.
            scale = np.abs(found.v[k]).max() + np.abs(found.after[k]).max()
            assert np.abs(np.asarray(alone.after) - found.after[k]).max() <= 1e-7 * scale

    equal()
