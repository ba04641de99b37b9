"""Random systems at an impact: what must hold whatever the bodies, masses, joints, contacts and speeds.

Structures are few, because each is compiled; all numbers are drawn: mass ratios up to 1e4, friction in [0, 2],
restitution in [0, 1], depths, poses and velocities, with the ends of their ranges and zero speeds among them.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis.extra import numpy as hnp
from systems import disk, sphere

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.mechanics.dynamics import saddle_point
from carom.simulation.impact import Stepper, contact_jump

BATCH = 8
NUMBERS = 64
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
        return radius * self.take(1e-6, 0.2)

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
    return Case(carom.System(bodies=bodies, dim=len(centers[0]), **parts), x, v)


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
COMPENSATION = {True: 8.0, False: np.inf}
"""Steps over which a penetration is undone; in infinitely many it is not."""


def cast(tree, dtype):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), tree)


def impact(numbers_of: tuple, stepper: Stepper, structure: carom.System):
    """The impact of one case: states, impulses by phase, and how its matrices look."""
    leaves, x, v = numbers_of
    system = eqx.combine(leaves, structure)
    inverse_mass = system.inverse_mass_matrix()
    if system.links:
        v = saddle_point(system.constraints, x, inverse_mass).project(v[None])[0]
    contacts, jump = contact_jump(system, x, v, inverse_mass, stepper)
    return {
        "v": v,
        "after": v + jump.velocity,
        "impulse": jump.impulse,
        "velocity": contacts.velocity,
        "delassus": contacts.delassus,
        "friction": contacts.friction,
        "restitution": contacts.restitution,
        "active": contacts.active.active,
        "overflow": contacts.active.overflow,
        "residual": jump.residual,
        "joints": jax.jacrev(system.constraints)(x),
        "mass": system.mass_matrix(),
    }


@eqx.filter_jit
def impacts(batch, towards, stepper: Stepper, structure: carom.System):
    """The impacts of a batch of cases, and the derivative of the velocities after them."""

    def one(case, tangent):
        found, slope = jax.jvp(lambda c: impact(c, stepper, structure), (case,), (tangent,))
        return {**found, "slope": slope["after"]}

    return jax.vmap(one)(batch, towards)


@eqx.filter_jit
def single_impact(case, stepper: Stepper, structure: carom.System):
    return impact(case, stepper, structure)["after"]


def made(make: Callable, values: np.ndarray, dtype):
    """A batch of cases from a row of numbers each, and the structure they share."""
    cases = [make(Numbers(row)) for row in values]
    systems = [eqx.partition(cast_system(case.system, dtype), eqx.is_inexact_array) for case in cases]
    triples = [(leaves, jnp.asarray(c.x, dtype), jnp.asarray(c.v, dtype)) for (leaves, _), c in zip(systems, cases)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *triples), systems[0][1]


def cast_system(system: carom.System, dtype) -> carom.System:
    return jax.tree.map(lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf, system)
