"""The complementarity solver: conditions, known impacts, derivatives, degenerate and unsolvable problems."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cone_problems import FAMILIES, generate

import carom
from carom.contact.lcp import solve_lcp_impulse

ROOM = 6
BATCH = 200  # of the smaller problems, with room for two contacts: one shape, which is compiled once


IN_3D = pytest.param(3, marks=pytest.mark.slow)
"""For tests whose point is the same in each dimension: another compilation."""


@jax.jit
def _solve(*arrays):
    return solve_lcp_impulse(*arrays)


@jax.jit
def _gradient(weight, *arrays):
    def pull(*arrays):
        return jnp.sum(weight * solve_lcp_impulse(*arrays).impulse)

    return jax.grad(pull, argnums=(0, 1, 2, 3, 4))(*arrays)


@jax.jit
def _push(point, step):
    return jax.jvp(lambda *x: solve_lcp_impulse(*x).impulse, point, step)[1]


def solved(A, v, friction, rebound, target=None):
    target = np.zeros_like(v[..., 1:]) if target is None else target
    return tuple(map(np.asarray, _solve(A, v, friction, rebound, target)))


def in_room(A, v, friction, rebound):
    """A single problem of one or two contacts as the first of a batch of that shape."""
    d, room = v.shape[1], 2
    out = np.zeros((BATCH, room * d, room * d)), np.zeros((BATCH, room, d)), *np.zeros((2, BATCH, room))
    for whole, part in zip(out, (A, v, friction, rebound), strict=True):
        whole[(0, *map(slice, part.shape))] = part
    return out


def battery(d, batch=64, room=ROOM):
    """Every family, 1 to `room` contacts and padding: A, v, friction, Newton's rebound, v_star."""
    parts = [generate(np.random.default_rng(11), family, batch, room, d) for family in FAMILIES]
    A, v, friction, restitution, v_star, _ = (np.concatenate(x) for x in zip(*parts, strict=True))
    rebound = np.maximum(-restitution * np.minimum(v[..., 0], 0), v_star[..., 0])
    return A, v, friction, rebound, v_star


def velocity_change(A, f):
    return np.einsum("...xy,...y->...x", A, np.reshape(f, (*A.shape[:-2], -1))).reshape(f.shape)


def directions(d, facets=4):
    angle = 2 * np.pi * np.arange(facets) / facets
    return np.array([[1.0], [-1.0]]) if d == 2 else np.stack([np.cos(angle), np.sin(angle)], axis=1)


def lcp_violation(A, v, friction, rebound, f, target=0.0, facets=4):
    """Largest violation of `0 <= z, 0 <= w, z w = 0`, written out, with the beta and lambda that go best with `f`.

    Scaled as `cone_problems.kkt_residual` is: velocities over, impulses times sqrt(A_nn), by the largest datum.
    """
    _, k, d = v.shape
    D = directions(d, facets)
    c = np.sqrt(np.einsum("bkk->bk", A.reshape(-1, k, d, k, d)[:, :, 0, :, 0]))
    present, c = c > 0, np.where(c > 0, c, 1)[..., None]
    data = v.copy()
    data[..., 0] -= rebound
    data[..., 1:] -= target
    w = (data + velocity_change(A, f)) / c
    weight = np.concatenate([np.ones((*friction.shape, 1)), np.repeat(friction[..., None], d - 1, axis=-1)], axis=-1)
    unit = np.max(np.where(present[..., None], np.abs(data) / c * np.minimum(weight, 1), 0), axis=(1, 2))[:, None, None]
    unit = np.where(unit > 0, unit, 1)
    y, w = f * c / unit, w / unit
    # beta: f_t in terms of the two directions to its sides.
    pairs = [(j, (j + 1) % len(D)) for j in range(len(D))] if d == 3 else [(0,), (1,)]
    beta = np.zeros((*v.shape[:2], len(D)))
    for pair in pairs:
        part = y[..., 1:] @ np.linalg.inv(D[list(pair)])
        inside = (part >= 0).all(axis=-1, keepdims=True)
        beta[..., pair] = np.where(inside, part, beta[..., pair])
    assert np.allclose(beta @ D, y[..., 1:], rtol=1e-12, atol=1e-12 * np.abs(y).max())  # rounding
    along = w[..., 1:] @ D.T
    slip = np.maximum(np.max(-along, axis=-1), 0)  # lambda
    spare = friction * y[..., 0] - beta.sum(axis=-1)
    largest = np.maximum(np.abs(y).max(axis=(1, 2)), 1)[:, None]
    rubs = (friction > 0)[..., None]  # without friction beta is 0, and tangential velocities have no scale
    violations = [
        -y[..., 0] / largest,
        -w[..., 0],
        np.abs(y[..., 0] * w[..., 0]) / largest,
        -spare / largest,
        np.abs(slip * spare) / largest,
        np.max(np.where(rubs, np.abs(beta * (along + slip[..., None])), beta), axis=-1) / largest,
    ]
    violation = np.where(present, np.max(violations, axis=0), np.abs(f).max(axis=-1))
    return np.where(np.isfinite(f).all(axis=(1, 2)), np.max(violation, axis=1), np.inf)


# --- The conditions ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_every_plastic_impact_is_solved(d):
    """Without restitution a solution always exists, whatever is redundant, jammed, light, heavy, slow or absent.

    So it does where the velocity to come to is one that the mechanism can have (`v_star`).
    """
    A, v, friction, _, v_star = battery(d, batch=256)
    for wanted in (0 * v_star, v_star):
        f, residual = solved(A, v, friction, wanted[..., 0], wanted[..., 1:])
        violation = lcp_violation(A, v, friction, wanted[..., 0], f, wanted[..., 1:])
        # What the solver promises; nearly all are at rounding.
        assert violation.max() <= 1e-8
        assert np.max(residual) <= 1e-8


@pytest.mark.parametrize("d", [2, IN_3D])
def test_restitution_is_solved_or_the_residual_says_that_it_was_not(d):
    A, v, friction, rebound, _ = battery(d, batch=256)
    f, residual = solved(A, v, friction, rebound)
    assert np.isfinite(f).all()
    judged = lcp_violation(A, v, friction, rebound, f)
    good = residual <= 1e-8
    # The judge's gauge differs from the solver's own by rounding and by the factor 2 of splitting a sum in two.
    assert np.all(judged[good] <= 3e-8)
    assert np.all(judged[~good] >= 0.3e-8)
    # Where impulses are free to produce any velocity, or press bodies apart, there is always a solution.
    family = np.repeat(np.array(list(FAMILIES)), 256)
    assert good[np.isin(family, ["gaussian", "stacked boxes"])].all()
    assert good.mean() > 0.8  # of the others some have none: see the squeezed body below


def squeezed(speed):
    """A point mass between two walls, both of which ask for a rebound: no velocity is away from both."""
    J = np.array([[[1.0, 0.0], [0.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]]).reshape(4, 2)
    v = (J @ np.array([-speed, 0.3])).reshape(2, 2)
    return J @ J.T, v, np.array([0.5, 0.2]), np.array([speed, speed])


def test_a_body_squeezed_by_two_rebounds_is_reported_and_stays_finite():
    problem = in_room(*squeezed(1.0))
    f, residual = solved(*problem)
    assert residual[0] > 0.1  # half of the demanded velocities cannot be had
    # As if each contact gave way by 1 % of what it resists: no impulse of 1e9.
    assert np.abs(f[0]).max() < 1e3
    gradient = _gradient(np.ones_like(f), *problem, np.zeros_like(f[..., 1:]))
    assert all(np.isfinite(g).all() and np.abs(g).max() < 1e6 for g in gradient)


@pytest.mark.parametrize("d", [2, IN_3D])
def test_padding_and_batches_change_nothing(d):
    A, v, friction, _, _ = battery(d, batch=BATCH // len(FAMILIES), room=2)
    rebound = np.zeros_like(friction)
    f, _ = solved(A, v, friction, rebound)
    if d == 2:  # vmap knows no dimension
        mapped = jax.jit(jax.vmap(solve_lcp_impulse))(A, v, friction, rebound)
        np.testing.assert_array_equal(f, mapped.impulse)
    # The same problems with the contacts, and so the padding (zero normal entry), in the other order.
    rows = np.arange(2 * d).reshape(2, d)[::-1].reshape(-1)
    turned, _ = solved(A[:, rows][:, :, rows], v[:, ::-1], friction[:, ::-1], rebound)
    padding = np.einsum("bkk->bk", A)[:, ::d] == 0
    assert padding.any()
    assert not f[padding].any()
    # What the solver promises.
    assert lcp_violation(A, v, friction, rebound, turned[:, ::-1]).max() <= 1e-8


def test_a_batch_without_contacts_gives_zeros_and_bad_data_speak():
    A, v, friction, _, _ = battery(2, batch=BATCH // len(FAMILIES), room=2)
    rebound = np.zeros_like(friction)
    f, residual = solved(0 * A, v, friction, rebound)
    assert not np.any(f)
    assert not np.any(residual)
    v[3] = np.nan
    good = np.arange(len(v)) != 3
    f, residual = solved(A, v, friction, rebound)
    assert np.isnan(f[3]).all()
    assert residual[3] == np.inf
    assert np.max(residual[good]) <= 1e-8  # what the solver promises


@pytest.mark.parametrize("facets", [2, 3, 5])
def test_facets_must_be_even_and_at_least_four(facets):
    with pytest.raises(carom.CaromError, match="facets"):
        solve_lcp_impulse(jnp.eye(3), jnp.ones((1, 3)), jnp.ones(1), jnp.ones(1), facets=facets)


def test_single_precision():
    """The search runs in double precision; what is left is the rounding of the data and of the result."""
    A, v, friction, rebound = (x.astype(np.float32) for x in battery(2, batch=8, room=2)[:4])
    f, residual = solved(A, v, friction, 0 * rebound)
    assert f.dtype == residual.dtype == np.float32
    # A matrix rounded to single precision is semi-definite to 6e-8; 1e-4 is the promise of the cone solver.
    assert np.quantile(residual, 0.95) <= 1e-4
    assert np.isfinite(f).all()


# --- Known impacts ----------------------------------------------------------------------------------------------


@jax.jit
def _cone_model(A, v, friction, restitution):
    return sum(carom.contact_impulse(A, v, friction, restitution, jnp.zeros_like(v)))


@pytest.mark.parametrize("d", [2, IN_3D])
def test_frictionless_plastic_impacts_are_those_of_the_cone_solver(d):
    A, v, friction, _, _ = battery(d, batch=BATCH // len(FAMILIES), room=2)
    zero = np.zeros_like(friction)
    f, _ = solved(A, v, zero, zero)
    change = velocity_change(A, f)[..., 0]
    other = velocity_change(A, np.asarray(_cone_model(A, v, zero, zero)))[..., 0]
    c = np.sqrt(np.einsum("bkk->bk", A)[:, ::d])
    c = np.where(c > 0, c, 1)
    unit = np.maximum(np.max(np.abs(v[..., 0]) / c, axis=1, keepdims=True), 1e-30)
    difference = np.max(np.abs(change - other) / c / unit, axis=1)
    # The cone solver meets its conditions to 1e-8 or better, its velocities at kinks to the root of that.
    assert difference.max() <= 1e-4
    assert np.median(difference) <= 1e-9


@pytest.mark.parametrize("d", [2, IN_3D])
def test_a_point_mass_bounces_as_by_poissons_hypothesis(d):
    """Frictionless or sticking. (Where it slides, the convex model CM lifts it off by mu times the slip.)"""
    rng = np.random.default_rng(2)
    A = np.zeros((BATCH, 2 * d, 2 * d))
    A[:, :d, :d] = 10 ** rng.uniform(-2, 2, (BATCH, 1, 1)) * np.eye(d)
    v = rng.normal(size=(BATCH, 2, d)) * [[1], [0]]
    friction, restitution = rng.choice([0.0, 0.8], (BATCH, 1)), rng.choice([0.0, 0.4, 1.0], (BATCH, 1))
    friction, restitution = (np.repeat(x, 2, axis=1) for x in (friction, restitution))
    held = friction[..., None] > 0
    v[..., :1] = np.where(held, -np.abs(v[..., :1]) - 0.1, v[..., :1]) * [[1], [0]]
    v[..., 1:] = np.where(held, 0.35 * v[..., :1] * rng.uniform(-1, 1, (BATCH, 2, d - 1)), v[..., 1:])
    f, _ = solved(A, v, friction, -restitution * np.minimum(v[..., 0], 0))
    g = np.asarray(_cone_model(A, v, friction, restitution))
    # 1e-6 of v: as close as the interior point method comes to an impulse that vanishes.
    np.testing.assert_allclose(velocity_change(A, f), velocity_change(A, g), atol=1e-6)
    assert held.any()
    assert not held.all()


def test_friction_in_the_pyramid():
    """Oblique sliding: f_t is on the edge, mu f_n / 2 (1, 1); with many facets it comes to oppose the sliding."""
    one = np.ones(1)
    f, _ = solved(*in_room(np.eye(3), np.array([[-1.0, 3.0, 3.0]]), 0.5 * one, 0.5 * one))
    np.testing.assert_allclose(f[0, 0], [1.5, -0.375, -0.375], rtol=1e-14)  # rounding
    v = np.array([[-1.0, 4.0, 3.0]])
    conveyor = np.tile([1.0, 2.0], (BATCH, 2, 1))
    f, _ = solved(*in_room(np.eye(3), v, 9 * one, 0 * one), conveyor)
    np.testing.assert_allclose(f[0, 0], [1.0, -3.0, -1.0], rtol=1e-14)  # sticks to what moves; rounding
    many = jax.jit(functools.partial(solve_lcp_impulse, facets=32))
    f = np.asarray(many(np.eye(3), v, 0.5 * one, 0 * one).impulse)[0]
    # A direction of the pyramid, or an edge's middle, is at most pi / 32 off, and on an edge f_t is 0.5 % shorter.
    np.testing.assert_allclose(f, [1.0, -0.4, -0.3], atol=0.05)
    assert np.linalg.norm(f[1:]) == pytest.approx(0.5, rel=5e-3)


# --- Derivatives ------------------------------------------------------------------------------------------------


def smooth_problems(d):
    """Regular problems of two contacts, with a direction in which each differs."""
    k = 2
    p = generate(np.random.default_rng(5), "gaussian", BATCH, k, d, contacts=k)
    rng = np.random.default_rng(6)
    scale = np.maximum(np.abs(np.einsum("bkk->bk", p.A)).max(axis=1), 1e-30)
    A = p.A / scale[:, None, None]
    v = rng.normal(size=p.v.shape)
    rebound = -p.restitution * np.minimum(v[..., 0], 0)
    friction = np.where(p.friction == 0, 0.3, p.friction)
    point = (A, v, friction, rebound, 0.1 * rng.normal(size=v[..., 1:].shape))
    step = [rng.normal(size=x.shape) for x in point]
    step[0] = (step[0] + step[0].swapaxes(1, 2)) / 20
    return point, tuple(step)


@pytest.mark.parametrize("d", [2, 3])
def test_derivative_is_that_of_differences(d):
    point, step = smooth_problems(d)
    h = 1e-7

    def at(t):
        return solved(*(x + t * dx for x, dx in zip(point, step, strict=True)))[0]

    before, here, after = at(-h), at(0.0), at(h)
    size = np.maximum(np.abs(here).max(axis=(1, 2)), 1)
    derivative = np.asarray(_push(point, step))
    ahead, behind = (after - here) / h, (here - before) / h
    scale = size + np.abs(derivative).max(axis=(1, 2))
    # Kinks (a contact that changes between open, stick, slip) are where the two one-sided differences differ.
    smooth = np.abs(ahead - behind).max(axis=(1, 2)) <= 1e-4 * scale
    assert smooth.mean() > 0.9
    error = np.abs((ahead + behind) / 2 - derivative).max(axis=(1, 2)) / scale
    assert error[smooth].max() <= 1e-5  # rounding / h, and h squared times a third derivative


@pytest.mark.parametrize("d", [2, 3])
def test_forward_equals_reverse(d):
    point, step = smooth_problems(d)
    forward = np.asarray(_push(point, step))
    weight = np.random.default_rng(7).normal(size=forward.shape)
    pulled = _gradient(weight, *point)
    both = [np.sum(np.asarray(g) * dx, axis=tuple(range(1, dx.ndim))) for g, dx in zip(pulled, step, strict=True)]
    scale = np.sum([np.abs(x) for x in both], axis=0) + 1
    difference = np.abs(np.sum(weight * forward, axis=(1, 2)) - np.sum(both, axis=0))
    assert np.max(difference / scale) <= 1e-10  # one linear rule, transposed: rounding


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3])
def test_gradients_are_finite_on_all_problems(d):
    A, v, friction, rebound, v_star = battery(d, batch=768, room=4)
    gradient = _gradient(np.ones_like(v), A, v, friction, rebound, v_star[..., 1:])
    assert all(np.isfinite(g).all() for g in gradient)
    assert all(np.any(g != 0) for g in gradient)
    still = _gradient(np.ones_like(v), A, 0 * v, friction, 0 * rebound, 0 * v_star[..., 1:])
    assert all(np.isfinite(g).all() for g in still)


def test_friction_can_leave_zero():
    """At mu = 0 the derivative is that for a growing mu: friction against the sliding, and what that does to others."""
    rng = np.random.default_rng(8)
    root = rng.normal(size=(BATCH, 4, 4))
    A = root @ root.swapaxes(1, 2) + np.eye(4)
    v = rng.normal(size=(BATCH, 2, 2)) - [1.0, 0.0]
    zero, grow = np.zeros((BATCH, 2)), rng.uniform(0.5, 1, (BATCH, 2))
    nothing = (np.zeros_like(A), np.zeros_like(v), grow, np.zeros_like(zero), np.zeros_like(v[..., 1:]))
    derivative = np.asarray(_push((A, v, zero, zero, np.zeros_like(v[..., 1:])), nothing))
    h = 1e-7
    difference = (solved(A, v, h * grow, zero)[0] - solved(A, v, zero, zero)[0]) / h
    # First-order differences: an error of h times the second derivative, and rounding / h.
    np.testing.assert_allclose(derivative, difference, rtol=1e-4, atol=1e-5)
    assert np.abs(derivative[..., 1]).max() > 0.1
    # At rest along the tangent friction does nothing, whatever its mu.
    still = in_room(np.eye(2), np.array([[-1.0, 0.0]]), np.zeros(1), np.zeros(1))
    assert not np.any(_gradient(np.ones_like(v), *still, np.zeros_like(v[..., 1:]))[2])


def test_derivative_where_the_impulse_does_not_tell_the_mode():
    """A ball that hits a wall head on sticks, although nothing is there for friction to do."""
    slips = np.array([[0.0, 0.0], [0.2, 0.0], [0.0, -0.3]])
    point = in_room(np.eye(3), np.array([[-1.0, 0.0, 0.0]]), np.ones(1), np.zeros(1))
    point = (*(np.repeat(x[:1], BATCH, axis=0) for x in point), np.zeros((BATCH, 2, 2)))
    step = tuple(np.zeros_like(x) for x in point)
    for i in range(9):
        point[1][i, 0, 1:] = slips[i // 3]
        step[1][i, 0, i % 3] = 1
    derivative = np.asarray(_push(point, step))[:9, 0].reshape(3, 3, 3)
    np.testing.assert_allclose(derivative, np.tile(-np.eye(3), (3, 1, 1)), atol=1e-9)  # the ridge's trace


@pytest.mark.slow
def test_derivative_with_redundant_contacts():
    """A box that lands flat on its four corners comes to rest, also after any small change of its motion."""
    corners = np.array([[x, y] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
    # Rows of each corner's velocity (up, two tangents) in the box's velocity and spin, corners one below its centre.
    J = []
    for cx, cy in corners:
        arm = np.array([cx, cy, -1.0])
        for axis in (np.array([0, 0, 1.0]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0])):
            J.append(np.concatenate([axis, np.cross(arm, axis)]))
    J = np.array(J)
    A = J @ np.diag([1, 1, 1, 1.5, 1.5, 1.5]) @ J.T
    twist = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])

    def after(u):
        v = jnp.asarray(J) @ u
        f = solve_lcp_impulse(jnp.asarray(A), v.reshape(4, 3), jnp.full(4, 0.8), jnp.zeros(4)).impulse
        return v + A @ f.reshape(-1)

    at = jax.jit(jax.jacobian(after))(jnp.asarray(twist))
    np.testing.assert_allclose(at, 0, atol=1e-8)  # the ridge's trace, at the weight of unloaded contacts


def test_second_derivatives_are_refused():
    def total(v):
        return jnp.sum(solve_lcp_impulse(jnp.eye(2), v, jnp.ones(1), jnp.zeros(1)).impulse)

    with pytest.raises(NotImplementedError, match="first derivatives"):
        jax.hessian(total)(jnp.array([[-1.0, 0.5]]))
