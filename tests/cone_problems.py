"""Friction-cone problems for the tests and `benchmarks/battery.py`: generators and independent judges. NumPy only.

Every family builds a mechanism: rows `J` of contact velocities (normal first) in the mechanism's free velocities, with
the inverse mass of these. With `A = J M^-1 J^T` and velocities `J u` the objective is bounded below, as it is in
mechanics. What a problem then draws for itself (approach, friction, restitution, bounds, units, padding) is common to
all families.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np


class ContactProblems(NamedTuple):
    """A batch of problems with room for K contacts each; see `carom.contact_impulse`."""

    A: np.ndarray  # (B, K d, K d)
    v: np.ndarray  # (B, K, d)
    friction: np.ndarray  # (B, K)
    restitution: np.ndarray  # (B, K)
    v_star: np.ndarray  # (B, K, d)
    lower: np.ndarray  # (B, K): bounds of a problem of their own, unrelated to the restitution


class Mechanism(NamedTuple):
    J: np.ndarray  # (B, K, d, D)
    inverse_mass: np.ndarray  # (B, D): of D independent velocities
    arranged: bool = False  # the order and sign of contacts are the family's point: leave them


Family = Callable[[np.random.Generator, int, int, int], Mechanism]
"""(rng, batch, K, d) -> Mechanism."""


# --- Families ---------------------------------------------------------------------------------------------------


def frames(rng, *shape_and_dim):
    """Random orthonormal frames, rows normal then tangents."""
    *shape, d = shape_and_dim
    q, r = np.linalg.qr(rng.normal(size=(*shape, d, d)))
    return q * np.sign(np.diagonal(r, axis1=-2, axis2=-1))[..., None, :]


def _gaussian(rng, batch, k, d):
    """Rows without structure, as many velocities as rows: A is regular, if not well."""
    return Mechanism(rng.normal(size=(batch, k, d, k * d)), np.ones((batch, k * d)))


def _low_rank(rng, batch, k, d):
    """Fewer velocities than rows: A is singular."""
    rank = max(1, k * d // 3)
    return Mechanism(rng.normal(size=(batch, k, d, rank)), np.ones((batch, rank)))


def _balls(rng, batch, k, d):
    """Contacts among about k / 2 point masses and walls, mass ratios up to 1e4."""
    count = k // 2 + 2
    frame = frames(rng, batch, k, d)
    first = rng.integers(0, count, (batch, k))
    second = (first + rng.integers(1, count, (batch, k))) % count  # ball 0 is a wall
    body = np.arange(count)
    incidence = (body == first[..., None]).astype(float) - (body == second[..., None])
    J = frame[:, :, :, None, :] * incidence[:, :, None, :, None]
    inverse_mass = 10 ** rng.uniform(-2, 2, (batch, count))
    inverse_mass[:, 0] = 0
    inverse_mass = np.repeat(inverse_mass, d, axis=1)
    return Mechanism(J.reshape(batch, k, d, count * d), inverse_mass)


def _duplicates(rng, batch, k, d):
    """As `balls`, every second contact the copy of the one before."""
    J, inverse_mass, _ = _balls(rng, batch, k, d)
    J[:, 1::2] = J[:, 0 : 2 * (k // 2) : 2]
    return Mechanism(J, inverse_mass)


def _opposite(rng, batch, k, d):
    """As `balls`, every second contact squeezes from the other side."""
    J, inverse_mass, _ = _balls(rng, batch, k, d)
    J[:, 1::2] = J[:, 0 : 2 * (k // 2) : 2]
    J[:, 1::2, 0] *= -1
    return Mechanism(J, inverse_mass, arranged=True)


def _boxes(rng, batch, k, d):
    """A stack of rigid boxes (rectangles), touching at their corners: 4 (2) contacts a level."""
    spin = 1 if d == 2 else 3
    dof = d + spin
    corners = 2 ** (d - 1)
    levels = -(-k // corners)
    half = rng.uniform(0.2, 1, (batch, d))  # the same for all levels, so that corners meet; normal axis first
    mass = 10 ** rng.uniform(-2, 2, (batch, levels))
    J = np.zeros((batch, k, d, levels, dof))
    for i in range(k):
        level, corner = divmod(i, corners)
        signs = np.array([(corner >> axis) % 2 * 2 - 1 for axis in range(d - 1)])
        for body, side, sign in ((level, -1.0, 1.0), (level - 1, 1.0, -1.0)):
            if body >= 0:
                arm = half * np.concatenate([[side], signs])
                J[:, i, :, body] = sign * np.concatenate([np.tile(np.eye(d), (batch, 1, 1)), _spin_rows(arm)], axis=-1)
    inertia = mass[..., None] * (_box_inertia(half)[:, None] if spin == 3 else (half**2).sum(-1)[:, None, None] / 3)
    inverse = np.concatenate([np.repeat(1 / mass[..., None], d, -1), 1 / inertia], axis=-1)
    return Mechanism(J.reshape(batch, k, d, levels * dof), inverse.reshape(batch, -1), arranged=True)


def _ball_joint(rng, batch, k, d):
    """Points of a rigid body that turns about a fixed joint: rank 2 for one contact in 3D, rank 1 in 2D."""
    arm = rng.normal(size=(batch, k, d))
    rows = frames(rng, batch, k, d) @ _spin_rows(arm)
    return Mechanism(rows, 10 ** rng.uniform(-1, 1, (batch, rows.shape[-1])))


def _chain(rng, batch, k, d):
    """A chain hung from a fixed point; its masses touch one plane."""
    links = rng.normal(size=(batch, k, d))
    links /= np.linalg.norm(links, axis=-1, keepdims=True)
    masses = 10 ** rng.uniform(-1, 1, (batch, k))
    constraint = np.zeros((batch, k, k, d))
    for i in range(k):
        constraint[:, i, i] = links[:, i]
        if i:
            constraint[:, i, i - 1] = -links[:, i]
    root = np.repeat(masses**-0.5, d, axis=1)
    scaled = constraint.reshape(batch, k, k * d) * root[:, None]
    _, _, vt = np.linalg.svd(scaled)
    free = vt[:, k:]  # velocities that obey the links, orthonormal in the metric of the mass
    plane = frames(rng, batch, 1, d)
    J = np.einsum("bij,xy->bxiyj", plane[:, 0], np.eye(k)).reshape(batch, k, d, k * d)
    return Mechanism(np.einsum("bkdi,bi,bri->bkdr", J, root, free), np.ones(free.shape[:2]))


def _spin_rows(arm):
    """Velocity of a point at `arm` per angular velocity: (..., d, 1 or 3)."""
    if arm.shape[-1] == 2:
        return np.stack([-arm[..., 1], arm[..., 0]], axis=-1)[..., None]
    zero = np.zeros_like(arm[..., 0])
    x, y, z = arm[..., 0], arm[..., 1], arm[..., 2]
    rows = [[zero, z, -y], [-z, zero, x], [y, -x, zero]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _box_inertia(half):
    square = half**2 / 3
    return np.sum(square, axis=-1, keepdims=True) - square


FAMILIES: dict[str, Family] = {
    "gaussian": _gaussian,
    "low rank": _low_rank,
    "balls, mass ratio 1e4": _balls,
    "duplicate contacts": _duplicates,
    "opposite contacts": _opposite,
    "stacked boxes": _boxes,
    "ball joint": _ball_joint,
    "chain": _chain,
}


# --- What a problem draws for itself ----------------------------------------------------------------------------

FRICTIONS = (0.0, 0.1, 0.5, 1.0, 1.5)


def generate(rng: np.random.Generator, family: str, batch: int, room: int, d: int, contacts: int | None = None):
    """`batch` problems of a family with 1 to `room` contacts (or exactly `contacts`) and the rest padding."""
    J, inverse_mass, arranged = FAMILIES[family](rng, batch, room, d)
    speed = rng.normal(size=inverse_mass.shape)
    approach = rng.choice(["any", "any", "any", "separating", "rest", "slow", "kink"], batch)
    velocity = np.einsum("bkdi,bi->bkd", J, speed)
    if not arranged:
        # A contact that closes, or opens, is the other with its normal turned.
        away = np.where(approach == "separating", 1.0, np.where(rng.random(batch) < 0.5, -1.0, 0.0))
        flip = np.where(away[:, None] * velocity[:, :, 0] < 0, -1.0, 1.0)
        J[:, :, 0] *= flip[..., None]
        velocity[:, :, 0] *= flip
    speed = speed * np.select([approach == "rest", approach == "slow"], [0.0, 1e-8], 1.0)[:, None]
    velocity = np.einsum("bkdi,bi->bkd", J, speed)
    friction = _draw_friction(rng, batch, room)
    if family == "gaussian":  # any velocity is possible: also those exactly between two cases
        slip = np.linalg.norm(velocity[:, :, 1:], axis=-1)
        edge = rng.choice([-1.0, 0.0, 1.0], (batch, room)) * friction * slip
        velocity[:, :, 0] = np.where((approach == "kink")[:, None], edge, velocity[:, :, 0])
    v_star = np.einsum("bkdi,bi->bkd", J, rng.normal(size=speed.shape) * (rng.random((batch, 1)) < 0.5) * 0.1)
    A = np.einsum("bxi,bi,byi->bxy", J.reshape(batch, room * d, -1), inverse_mass, J.reshape(batch, room * d, -1))
    A = (A + A.swapaxes(1, 2)) / 2
    restitution = np.where(
        rng.random((batch, 1)) < 0.6,
        rng.choice([0.0, 0.0, 1.0, 0.5], (batch, 1)),
        rng.choice([0.0, 1.0, 0.3, 0.8], (batch, room)),
    )
    normal = np.einsum("bkk->bk", A.reshape(batch, room, d, room, d)[:, :, 0, :, 0])
    reach = np.abs(velocity[:, :, 0]) / np.where(normal > 0, normal, 1)
    lower = reach * rng.choice([0.0, 0.3, 1.0, 2.0], (batch, room))
    # Other units of mass and of velocity.
    mass, unit = 10 ** (rng.uniform(-3, 3, (2, batch)) * (rng.random(batch) < 0.3))
    A = A / mass[:, None, None]
    velocity, v_star = velocity * unit[:, None, None], v_star * unit[:, None, None]
    lower = lower * (mass * unit)[:, None]
    used = rng.integers(1, room + 1, batch) if contacts is None else np.full(batch, contacts)
    problems = ContactProblems(A, velocity, friction, restitution, v_star, lower)
    return _pad(rng, problems, used)


def _draw_friction(rng, batch, room):
    single = rng.choice(FRICTIONS, (batch, 1))
    mixed = np.where(
        rng.random((batch, room)) < 0.7, rng.choice(FRICTIONS, (batch, room)), rng.uniform(0, 1.5, (batch, room))
    )
    return np.where(rng.random((batch, 1)) < 0.5, single, mixed)


def _pad(rng, problems: ContactProblems, used):
    """Make all but `used` contacts padding: behind the others or among them, rows of zeros or a separating contact."""
    A, v, friction, restitution, v_star, lower = (x.copy() for x in problems)
    batch, room, d = v.shape
    place = np.where(rng.random((batch, 1)) < 0.7, np.arange(room), np.argsort(rng.random((batch, room)), axis=1))
    padding = place >= used[:, None]
    row = np.repeat(padding, d, axis=1)
    A[row[:, :, None] | row[:, None, :]] = 0
    v[padding] = v_star[padding] = 0
    lower[padding] = 0
    separating = (rng.random((batch, 1)) < 0.3) & padding
    index = np.arange(room * d)
    A[:, index, index] += np.repeat(separating, d, axis=1)
    v[:, :, 0] += separating
    return ContactProblems(A, v, friction, restitution, v_star, lower)


TINY = 1e-100
"""Data below this are zero: nothing can be said relative to them."""


# --- Judges -----------------------------------------------------------------------------------------------------


def apply(A, f):
    """`A f` for f (B, K, d)."""
    return np.einsum("bxy,by->bx", A, f.reshape(f.shape[0], -1)).reshape(f.shape)


def contact_scale(A, d):
    """sqrt(A_nn) of each contact: f sqrt(A_nn) and v / sqrt(A_nn) are both roots of an energy."""
    batch, n, _ = A.shape
    diagonal = np.einsum("bkk->bk", A.reshape(batch, n // d, d, n // d, d)[:, :, 0, :, 0])
    return np.sqrt(diagonal)


def problem_scale(A, v, friction, lower):
    """The largest datum, as root of an energy: velocities over, bounds times `contact_scale`; by problem.

    Tangential velocities count as friction sees them, times mu: a frictionless contact has none.
    """
    c = contact_scale(A, v.shape[-1])
    present = c > 0
    speed = np.maximum(np.abs(v[..., 0]), friction * np.max(np.abs(v[..., 1:]), axis=-1))
    speed = speed / np.where(present, c, np.inf)
    return np.max(np.maximum(speed, np.maximum(lower, 0) * c), axis=1)


def objective(A, v, f):
    return np.sum(0.5 * f * apply(A, f) + f * v, axis=(1, 2))


def kkt_residual(A, v, friction, lower, f, reference=None):
    """Largest violation of the optimality conditions by `f`, relative to the problem's scales, (B,).

    From the data and the impulse alone. With the velocity after, `g = A f + v`, the optimum has

        |f_t| <= mu f_n,   f_n >= lower,   g_n - w >= mu |g_t|,
        (g_n - w) f_n + g_t . f_t = 0,   w (f_n - lower) = 0

    for a `w >= 0`, the bound's multiplier. The largest that the third condition allows satisfies the
    others if any does: `w = max(g_n - mu |g_t|, 0)`.

    Velocities are taken over sqrt(A_nn), impulses times it, so that both are roots of an energy and
    comparable, whatever the masses. Velocities are then relative to `problem_scale` (or to that of
    `reference`, the velocities before the impact, if larger: of a contact that stuck, compression
    leaves rounding), impulses to that or to the largest impulse, and products to both.

    Velocities are relative to the largest sum of terms `|A| |f|` too: of a sum of rounded terms that cancel, no more
    can be asked.
    """
    c = contact_scale(A, v.shape[-1])
    present = c > 0
    c = np.where(present, c, 1)[..., None]
    unit = problem_scale(A, v, friction, lower)
    if reference is not None:
        unit = np.maximum(unit, problem_scale(A, reference, friction, lower))
    unit = np.where(unit > TINY, unit, 1)[:, None, None]
    y, g = f * c / unit, (apply(A, f) + v) / c / unit
    terms = np.maximum(np.max(apply(np.abs(A), np.abs(f)) / c / unit, axis=(1, 2)), 1)[:, None]
    low = np.maximum(lower, 0) * c[..., 0] / unit[..., 0]
    slip, push = np.linalg.norm(g[..., 1:], axis=-1), np.linalg.norm(y[..., 1:], axis=-1)
    largest = np.maximum(np.max(np.abs(y), axis=(1, 2)), 1)[:, None]
    dual = g[..., 0] - friction * slip
    w = np.maximum(dual, 0)
    violations = [
        (push - friction * y[..., 0]) / largest,
        (low - y[..., 0]) / largest,
        -dual / terms,
        np.abs((g[..., 0] - w) * y[..., 0] + np.sum(g[..., 1:] * y[..., 1:], axis=-1)) / largest / terms,
        np.abs(w * (y[..., 0] - low)) / largest / terms,
    ]
    violation = np.max(violations, axis=0)
    # Padding takes no impulse.
    violation = np.where(present, violation, np.max(np.abs(f), axis=-1))
    violation = np.where(np.isfinite(f).all(axis=-1), violation, np.inf)
    return np.max(violation, axis=1)


def clarabel_solution(A, v, friction, lower, *, least_norm: bool = False):
    """One problem solved by Clarabel in the scaled quantities: `(impulse, objective)`; objective in physical units.

    With `least_norm`, a second problem then finds the smallest impulse among those of the same velocity change.
    """
    import clarabel
    from scipy import sparse

    k, d = v.shape
    c = contact_scale(A[None], d)[0]
    unit = problem_scale(A[None], v[None], friction[None], lower[None])[0]
    keep = np.flatnonzero(c > 0)
    f = np.zeros((k, d))
    if not keep.size or unit <= TINY:
        return f, 0.0, "Solved"
    scale = np.repeat(1 / c[keep], d)
    rows = (keep[:, None] * d + np.arange(d)).reshape(-1)
    P = A[np.ix_(rows, rows)] * scale[:, None] * scale
    q = v[keep].reshape(-1) * scale / unit
    low = np.maximum(lower[keep], 0) * c[keep] / unit
    n = rows.size

    eye = np.eye(n)
    blocks, right, cones = [-eye[::d]], [-low], [clarabel.NonnegativeConeT(len(keep))]
    for i, mu in enumerate(friction[keep]):
        block = -eye[i * d : (i + 1) * d].copy()
        block[0] *= mu
        if mu > 0:
            cones.append(clarabel.SecondOrderConeT(d))
        else:
            block = block[1:]
            cones.append(clarabel.ZeroConeT(d - 1))
        blocks.append(block)
        right.append(np.zeros(len(block)))
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    # Two orders below what is compared; Clarabel ends earlier, with its best, where rounding allows no more.
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10

    def solve(P, q, blocks, right, cones):
        matrix = sparse.csc_matrix(np.concatenate(blocks))
        P = sparse.csc_matrix(np.triu(P))
        return clarabel.DefaultSolver(P, q, matrix, np.concatenate(right), cones, settings).solve()

    solution = solve(P, q, blocks, right, cones)
    x = np.array(solution.x)
    if least_norm:
        values, vectors = np.linalg.eigh(P)
        free = vectors[:, values > 1e-11 * values[-1]].T
        solution_2 = solve(
            np.diag(scale**2 / np.max(scale**2)),
            np.zeros(n),
            [free, *blocks],
            [free @ x, *right],
            [clarabel.ZeroConeT(len(free)), *cones],
        )
        x = np.array(solution_2.x)
    f[keep] = (x * scale * unit).reshape(-1, d)
    return f, solution.obj_val * unit**2, str(solution.status)


def rigid_bodies(rng: np.random.Generator, batch: int, room: int, d: int, contacts: int):
    """Contacts among rigid bodies and walls, mass ratios up to 100, friction up to 2: many are redundant."""
    count, dof = (contacts + 1) // 2, d * (d + 1) // 2
    J = np.zeros((batch, contacts, d, count, dof))
    first = rng.integers(count, size=(batch, contacts))
    second = (first + 1 + rng.integers(max(count - 1, 1), size=(batch, contacts))) % count
    alone = (rng.random((batch, contacts)) < 0.4) | (first == second)
    frame, index = frames(rng, batch, contacts, d), np.indices((batch, contacts))
    for body, sign in ((first, np.ones((batch, contacts))), (second, np.where(alone, 0, -1))):
        arm = rng.normal(size=(batch, contacts, d))
        if d == 2:
            turn = np.stack([-arm[..., 1], arm[..., 0]], -1)[..., None]
        else:
            turn = -np.cross(np.eye(3), arm[..., None, :]).swapaxes(-1, -2)
        moves = np.concatenate([np.broadcast_to(np.eye(d), (*arm.shape[:2], d, d)), turn], axis=-1)
        J[index[0], index[1], :, body] += sign[..., None, None] * (frame @ moves)
    J = J.reshape(batch, contacts * d, count * dof)
    mass = 10 ** rng.uniform(-1, 1, (batch, count, 1))
    inverse = np.concatenate(
        [np.repeat(1 / mass, d, axis=2), 1 / (mass * rng.uniform(0.1, 0.6, (batch, count, dof - d)))], axis=2
    ).reshape(batch, -1)
    A = np.einsum("bri,bi,bsi->brs", J, inverse, J)
    v = np.einsum("bri,bi->br", J, rng.normal(size=inverse.shape)).reshape(batch, contacts, d)
    pad = room - contacts
    A = np.pad(A, ((0, 0), (0, pad * d), (0, pad * d)))
    return A, np.pad(v, ((0, 0), (0, pad), (0, 0))), np.pad(rng.uniform(0, 2, (batch, contacts)), ((0, 0), (0, pad)))


def law(A, v, mu, f):
    """By how much impulses miss Coulomb's law (gaps, approach, cones, friction against the sliding) in scaled units."""
    normal = contact_scale(A, v.shape[2])
    size = np.where(normal > 0, 1 / np.sqrt(np.where(normal > 0, normal, 1)), 0)[..., None]
    u = (A @ f.reshape(len(f), -1, 1)).reshape(v.shape) + v
    unit = np.maximum(np.abs(size * v).max((1, 2), keepdims=True), 1e-300)
    u, f = u * size / unit, f / np.where(size > 0, size * unit, np.inf)
    largest = np.maximum(np.abs(f).max((1, 2)), 1)[:, None]
    slip, friction = np.linalg.norm(u[..., 1:], axis=-1), np.linalg.norm(f[..., 1:], axis=-1)
    work = np.sum(f[..., 1:] * u[..., 1:], axis=-1) + mu * f[..., 0] * slip
    parts = [np.maximum(-u[..., 0], 0), np.abs(np.minimum(f[..., 0], u[..., 0])), friction - mu * f[..., 0]]
    parts.append(np.minimum(np.abs(work), slip))
    return (np.max(parts, axis=0) / largest).max(1)
