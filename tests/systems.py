"""Small systems that several test files use, random poses of rigid bodies, and how a user's mistakes are tested."""

import contextlib
import re

import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity

GRAVITY = 9.81

PAPER = {"contact_model": "cm", "compensation": "paper"}
"""The rules of the paper, from which the closed forms here are; test_lasting_contact.py tests the default ones."""


@contextlib.contextmanager
def refused(message: str):
    """Expect a `CaromError` of one line that says `message`, as a user sees it.

    The tests' run-time type checks are off meanwhile: they would complain before carom does.
    """
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        with pytest.raises(carom.CaromError, match=re.escape(message)) as error:
            yield error
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    assert "\n" not in str(error.value)


def ball_on_floor(*, friction=0.0, restitution=0.0, gravity=GRAVITY, mass=1.0, radius=0.1) -> carom.System:
    """A point mass above the floor y = 0. Systems that differ in numbers alone share one compiled program."""
    return carom.System(
        bodies=[carom.PointMass(mass, radius)],
        contacts=[carom.DiskPlane([0], (0.0, 0.0), (0.0, 1.0))],
        potential=carom.Gravity((0.0, -gravity)),
        friction=friction,
        restitution=restitution,
        **PAPER,
    )


def disk(mass=1.0, radius=0.1) -> carom.RigidBody:
    """A uniform disk: its moment of inertia is m r^2 / 2."""
    return carom.RigidBody(mass, (mass * radius**2 / 4,) * 2, radius)


def sphere(mass=1.0, radius=0.1) -> carom.RigidBody:
    """A uniform ball in 3D: its moment of inertia is 2/5 m r^2."""
    return carom.RigidBody(mass, (mass * radius**2 / 5,) * 3, radius)


def round_body_on_floor(dim: int, *, friction=0.0, restitution=0.0, mass=1.0, radius=0.1) -> carom.System:
    """A disk (2D) or sphere (3D) that can turn, above the plane where the second coordinate is 0; no gravity."""
    up = np.eye(dim)[1]
    return carom.System(
        bodies=[disk(mass, radius) if dim == 2 else sphere(mass, radius)],
        contacts=[carom.DiskPlane([0], jnp.zeros(dim), up)],
        friction=friction,
        restitution=restitution,
        **PAPER,
    )


def two_bodies(*, friction=0.0, restitution=1.0, masses=(1.0, 1.0), radii=(0.1, 0.1), rigid=False) -> carom.System:
    """Two round bodies in the plane, free but for their contact."""
    kind = disk if rigid else carom.PointMass
    return carom.System(
        bodies=[kind(m, r) for m, r in zip(masses, radii, strict=True)],
        contacts=[carom.DiskDisk([(0, 1)])],
        friction=friction,
        restitution=restitution,
        **PAPER,
        dim=2,
    )


def pendulum(length=0.7, mass=0.3) -> carom.System:
    """A point mass on a rod, hung from the origin; no contact."""
    return carom.System(
        bodies=[carom.PointMass(mass)],
        constraints=[carom.Tether(0, (0.0, 0.0), length)],
        potential=carom.Gravity((0.0, -GRAVITY)),
    )


def oscillator_pair() -> carom.System:
    """Three point masses in 3D without links or forces, to hold a potential of a test's own."""
    return carom.System(bodies=[carom.PointMass(m) for m in (0.5, 1.0, 2.0)], dim=3)


MOMENTS = {2: (0.02, 0.05), 3: (0.02, 0.05, 0.11)}
"""Second moments (kg m^2) of an asymmetric rigid body."""


def free_body(dim: int, mass=0.8) -> carom.System:
    """An asymmetric rigid body without forces."""
    return carom.System(bodies=[carom.RigidBody(mass, MOMENTS[dim])])


def heavy_top(mass=0.8, arm=0.3) -> carom.System:
    """A rigid body in 3D on a ball joint at the origin; its centre of mass is at `arm` along its third axis."""
    return carom.System(
        bodies=[carom.RigidBody(mass, MOMENTS[3])],
        constraints=[carom.Joint(0, (1 + arm, 0.0, 0.0, -arm), (0.0, 0.0, 0.0))],
        potential=carom.Gravity((0.0, 0.0, -GRAVITY)),
    )


def inertia_about_axes(moments) -> np.ndarray:
    """Principal moments of inertia in 3D from second moments: I_xx = mu_y + mu_z, and so on."""
    return np.sum(moments) - np.asarray(moments)


def random_rotations(rng: np.random.Generator, count: int, dim: int) -> jnp.ndarray:
    """Rotations (count, d, d), uniformly distributed."""
    q, r = np.linalg.qr(rng.standard_normal((count, dim, dim)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    q[:, :, 0] *= np.linalg.det(q)[:, None]
    return jnp.asarray(q)


def random_motions(rng: np.random.Generator, count: int, dim: int):
    """Random poses and velocities of a rigid body: rotations, omegas (world frame), points x and their velocities v."""
    rotation = random_rotations(rng, count, dim)
    omega = jnp.asarray(rng.standard_normal((count, 1 if dim == 2 else 3)))
    x = embed_pose(jnp.asarray(rng.standard_normal((count, dim))), rotation)
    v = embed_velocity(rotation, jnp.asarray(rng.standard_normal((count, dim))), omega)
    return rotation, omega, x, v
