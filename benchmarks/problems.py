"""Random collisions of boxes as friction-cone problems. NumPy only.

    minimise  1/2 f^T A f + f^T v    subject to    |f_t,i| <= mu_i f_n,i

with `f = (f_n, f_t)` stacked by contact, normal first (paper, eq. 5), in 3D.
"""

from typing import NamedTuple

import numpy as np

DIM = 3


class Problems(NamedTuple):
    """A batch of B problems with K contacts, and the loss whose gradient is timed. Double precision."""

    A: np.ndarray  # (B, 3 K, 3 K), Delassus matrix, 1/kg
    v: np.ndarray  # (B, K, 3), velocities before (m/s), normal first; normals approach
    friction: np.ndarray  # (B, K)
    weight: np.ndarray  # (B, K, 3); the loss is sum(weight * f)

    def first(self, count):
        return Problems(*(x[:count] for x in self))


def collisions(contacts, batch, seed=0):
    """`batch` collisions with `contacts` simultaneous contacts of as many solid boxes.

    A corner of each box touches a face of a box before it or of a fixed obstacle. So `J` has full row rank,
    `A = J M^-1 J^T` is positive definite and the impulses are unique. Masses (0.1 to 1 kg) and half sides (0.05 to
    0.2 m) are log-uniform, orientations random, velocities and spins normal, friction uniform in [0.1, 1].
    """
    rng = np.random.default_rng([seed, contacts])
    rows = np.arange(batch)
    mass = np.exp(rng.uniform(np.log(0.1), np.log(1.0), (batch, contacts)))
    side = np.exp(rng.uniform(np.log(0.05), np.log(0.2), (batch, contacts, 3)))
    axes = np.linalg.qr(rng.normal(size=(batch, contacts, 3, 3)))[0]  # columns: a box's axes
    square = side**2
    inertia = mass[..., None] / 3 * (square.sum(-1, keepdims=True) - square)

    # Twists are (velocity in world axes, spin in the box's axes), in which the mass matrix is diagonal.
    inverse_mass = np.concatenate([np.repeat(1 / mass[..., None], 3, -1), 1 / inertia], axis=-1)
    J = np.zeros((batch, contacts, DIM, contacts, 6))
    for i in range(contacts):
        other = rng.integers(-1, i, batch)
        touches = other >= 0
        face, sign = rng.integers(0, 3, batch), rng.choice([-1.0, 1.0], batch)
        obstacle = np.linalg.qr(rng.normal(size=(batch, 3, 3)))[0]
        faces = np.where(touches[:, None, None], axes[rows, other], obstacle)
        # Rows: outward normal of the touched face, then the face's two other axes.
        frame = faces.swapaxes(-1, -2)[rows[:, None], (face[:, None] + np.arange(3)) % 3]
        frame[:, 0] *= sign[:, None]
        normal = np.einsum("bij,bi->bj", axes[:, i], frame[:, 0])
        corner = -np.sign(normal) * side[:, i]  # the corner that reaches deepest
        J[:, i, :, i] = _point_velocity(frame, axes[:, i], corner)
        point = rng.uniform(-1, 1, (batch, 3)) * side[rows, other]
        point[rows, face] = sign * side[rows, other, face]
        other_velocity = _point_velocity(frame, axes[rows, other], point)
        J[rows[touches], i, :, other[touches]] = -other_velocity[touches]
    J = J.reshape(batch, DIM * contacts, 6 * contacts)
    A = (J * inverse_mass.reshape(batch, 1, -1)) @ J.swapaxes(-1, -2)

    twist = rng.normal(size=(batch, 6 * contacts, 1))
    v = (J @ twist).reshape(batch, contacts, DIM)
    v[..., 0] = -np.abs(v[..., 0])  # some motion has this v too, as J has full row rank
    friction = rng.uniform(0.1, 1.0, (batch, contacts))
    return Problems(A, v, friction, rng.normal(size=v.shape))


def _point_velocity(frame, axes, point):
    """(B, 3, 6): maps a box's twist to the velocity, in `frame`, of `point` (in the box's axes, from its centre)."""
    cross = np.cross(np.eye(3), point[:, None])  # rows e_k x point: spin about axis k
    return np.concatenate([frame, frame @ axes @ cross.swapaxes(-1, -2)], axis=-1)


def objective(problems, f):
    y = f.reshape(f.shape[0], -1)
    linear = np.einsum("bi,bi->b", y, problems.v.reshape(y.shape))
    return np.einsum("bi,bij,bj->b", y, problems.A, y) / 2 + linear


def violation(problems, f, *, pyramid=False):
    """Largest violation of the friction limits, relative to the problem's largest impulse."""
    tangent = np.linalg.norm(f[..., 1:], ord=1 if pyramid else 2, axis=-1)
    excess = np.maximum(tangent - problems.friction * f[..., 0], 0).max(-1)
    return excess / np.abs(f).max((-2, -1))
