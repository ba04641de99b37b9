"""The friction-cone solver: optimality on random and degenerate problems, derivatives, padding. Arrays only.

`benchmarks/battery.py` does the same on 200,000 problems.
"""

import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cone_problems import FAMILIES, TINY, apply, clarabel_solution, generate, kkt_residual, objective, problem_scale

import carom
from carom.contact.cones import solve_cone_problem

SOLVE = jax.jit(solve_cone_problem)


def problems_of(family, seed, batch, room, d, **kwargs):
    p = generate(np.random.default_rng(seed), family, batch, room, d, **kwargs)
    return p.A, p.v, p.friction, p.lower


def solved(arrays, dtype=jnp.float64):
    """The problems in the precision that the solver gets, and its impulses, as NumPy in double."""
    arrays = [np.asarray(a, dtype) for a in arrays]
    f = SOLVE(*map(jnp.asarray, arrays)).impulse
    assert f.dtype == dtype
    return [np.asarray(a, np.float64) for a in (*arrays, f)]


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_optimality_on_random_and_degenerate_problems(family, d):
    """The promises: 1e-8 in double precision, 1e-4 in single, judged from data and impulse alone."""
    for room, dtype, promise in ((4, jnp.float64, 1e-8), (4, jnp.float32, 1e-4)):
        *data, f = solved(problems_of(family, 7, 512, room, d), dtype)
        assert np.isfinite(f).all()
        assert kkt_residual(*data, f).max() <= promise


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.parametrize("d", [2, 3])
def test_optimality_with_twenty_contacts(d):
    for family in FAMILIES:
        *data, f = solved(problems_of(family, 8, 64, 20, d))
        assert kkt_residual(*data, f).max() <= 1e-8, family


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("family", FAMILIES)
def test_objective_equals_that_of_another_solver(family, d):
    A, v, friction, lower, f = solved(problems_of(family, 7, 512, 4, d))
    some = slice(0, 25)
    A, v, friction, lower, f = (a[some] for a in (A, v, friction, lower, f))
    _, other, status = zip(*(clarabel_solution(*p) for p in zip(A, v, friction, lower, strict=True)), strict=True)
    own = objective(A, v, f)
    scale = np.maximum(problem_scale(A, v, friction, lower) ** 2, np.abs(own))
    excess = (own - np.array(other)) / np.where(scale > TINY, scale, 1)
    good = np.isin(status, ["Solved", "AlmostSolved"])
    assert good.mean() > 0.8
    assert np.max(excess[good]) < 1e-8


@jax.jit
def velocity_jump(J, weight, w, u, friction, e, u_star):
    """Of contacts as functions of inverse masses `w` and velocities `u`: `A = J diag(w) J^T`, `v = J u`; weighted."""
    batch, k, d, n = J.shape
    rows = J.reshape(batch, k * d, n)
    A = jnp.einsum("bxi,bi,byi->bxy", rows, w, rows)
    v, v_star = (jnp.einsum("bkdi,bi->bkd", J, x) for x in (u, u_star))
    fc, fr = carom.contact_impulse(A, v, friction, e, v_star)
    change = jnp.einsum("bij,bj->bi", A, (fc + fr).reshape(batch, k * d)).reshape(v.shape)
    return jnp.sum(weight * change, axis=(1, 2))


@jax.jit
def jump_gradient(*arrays):
    return jax.grad(lambda *a: velocity_jump(*a).sum(), argnums=(2, 3, 4, 5, 6))(*arrays)


@jax.jit
def jump_derivative(arrays, tangents):
    return jax.jvp(functools.partial(velocity_jump, *arrays[:2]), arrays[2:], tangents)[1]


def physical_problem(redundant):
    """Six pairs of contacts in 3D, with the weights of their velocity jump's components, and what it depends on."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(6, 2, 3, 9))
    if redundant:
        J[:, 1] = (
            J[:, 0] + np.array([0.0, 0.1, 0.0])[:, None] * J[:, 1]
        )  # two contacts nearly at one place: rank 4 of 6
        J[:, 1, 0], J[:, 1, 2] = J[:, 0, 0], J[:, 0, 2]
    u = rng.normal(size=(6, 9))
    v = np.einsum("bkdi,bi->bkd", J, u)
    J[:, :, 0] *= -np.sign(v[:, :, 0])[..., None]  # all approach
    if redundant:
        J[:, 1, 0] = J[:, 0, 0]
    rest = rng.uniform(0.2, 0.6, (6, 2)), rng.uniform(0.2, 0.8, (6, 2)), 0.1 * rng.normal(size=(6, 9))
    weight = rng.normal(size=(6, 2, 3))
    return tuple(map(jnp.asarray, (J, weight))), tuple(map(jnp.asarray, (rng.uniform(0.5, 2, (6, 9)), u, *rest)))


@pytest.mark.parametrize("redundant", [False, True], ids=["regular", "redundant"])
def test_derivatives_agree_with_differences_and_between_modes(redundant):
    """With respect to all that A, v, friction, restitution and target velocity are made of.

    The kinks, where there is no derivative, are the transitions between sticking, sliding and separating. A problem of
    the batch that is next to one shows it by one-sided differences that disagree, and is left out; few are.
    """
    fixed, arrays = physical_problem(redundant)
    rng = np.random.default_rng(4)
    reverse = jump_gradient(*fixed, *arrays)
    compared = 0
    for k in range(5):
        direction = jnp.asarray(rng.normal(size=arrays[k].shape))
        tangents = tuple(direction if j == k else jnp.zeros_like(a) for j, a in enumerate(arrays))
        slope = jump_derivative((*fixed, *arrays), tangents)
        back = jnp.sum((reverse[k] * direction).reshape(6, -1), axis=1)
        assert np.allclose(slope, back, rtol=1e-10, atol=1e-10)

        def moved(h, k=k, direction=direction):
            return velocity_jump(*fixed, *(a + h * direction if j == k else a for j, a in enumerate(arrays)))

        # Steps of 1e-5 leave 1e-10 of curvature and 1e-9 of the solver's own 1e-14.
        ahead, back = (moved(1e-5) - moved(0.0)) / 1e-5, (moved(0.0) - moved(-1e-5)) / 1e-5
        smooth = np.abs(ahead - back) < 1e-3 * (1 + np.abs(slope))
        difference = (moved(1e-5) - moved(-1e-5)) / 2e-5
        assert np.allclose(slope[smooth], difference[smooth], rtol=1e-5, atol=1e-5)
        compared += smooth.sum()
    assert compared >= 27  # of 30


def test_where_a_contact_sticks_friction_changes_no_velocity():
    """Also where A is singular and the impulse of least norm is on the cone: its multiplier is next to zero there."""
    rng = np.random.default_rng(6)
    turn = np.linalg.qr(rng.normal(size=(512, 3, 3)))[0]
    values = np.concatenate([np.zeros((512, 1)), rng.uniform(1, 8, (512, 2))], axis=1)
    A = np.einsum("bij,bj,bkj->bik", turn, values, turn)
    A = (A + A.swapaxes(1, 2)) / 2
    angle = rng.uniform(0, 2 * np.pi, 512)
    share = np.where(np.arange(512) < 256, 0.2, 0.29)  # of an impulse that stops it, inside of the cone
    inside = np.stack([np.ones(512), share * np.cos(angle), share * np.sin(angle)], axis=1)
    v = -np.einsum("bij,bj->bi", A, inside)[:, None]
    friction = np.full((512, 1), 0.3)

    def solve(friction):
        return SOLVE(jnp.asarray(A), jnp.asarray(v), friction, jnp.zeros((512, 1))).impulse

    f, slope = jax.jvp(solve, (jnp.asarray(friction),), (jnp.ones((512, 1)),))
    on_the_cone = np.linalg.norm(f[:, 0, 1:], axis=1) > 0.3 * (1 - 1e-6) * f[:, 0, 0]
    assert on_the_cone.sum() > 50
    assert np.abs(apply(A, f) + v).max() < 1e-7
    assert np.abs(apply(A, slope)).max() < 1e-4  # the root of the diagonal, 1e-9, times A


def test_values_can_leave_their_ends():
    """Derivatives at mu = 0 and e = 0 are the one-sided ones: friction, and rebound, that set in.

    A sliding contact has `f_n = (1 + mu slip) / (1 + mu^2)` for an approach of 1 and A = 1: both components change.
    """
    A, v, v_star = jnp.eye(2), jnp.array([[-1.0, 2.0]]), jnp.zeros((1, 2))

    def after(friction, e):
        return v + sum(carom.contact_impulse(A, v, friction, e, v_star))

    slope_mu, slope_e = jax.jacobian(after, argnums=(0, 1))(jnp.zeros(1), jnp.zeros(1))
    assert np.allclose(slope_mu[0, :, 0], [2, -1], atol=1e-6)
    assert np.allclose(slope_e[0, :, 0], [1, 0], atol=1e-6)  # e times the approach


def test_padding_and_batches_without_contact_are_left_alone():
    problems = problems_of("balls, mass ratio 1e4", 1, 8, 2, 2, contacts=2)
    A, v, friction, lower = (np.repeat(a, 64, axis=0) for a in problems)  # a batch that others have compiled for
    alone = SOLVE(*map(jnp.asarray, (A, v, friction, lower))).impulse
    wide = np.zeros((512, 8, 8))
    wide[:, :4, :4] = A

    def pad(x):
        return jnp.asarray(np.pad(x, ((0, 0), (0, 2)) + ((0, 0),) * (x.ndim - 2)))

    padded = SOLVE(jnp.asarray(wide), pad(v), pad(friction), pad(lower)).impulse
    assert np.allclose(padded[:, :2], alone, atol=1e-9)
    assert not padded[:, 2:].any()
    nothing = SOLVE(jnp.zeros((512, 8, 8)), *(jnp.zeros((512, *s)) for s in ((4, 2), (4,), (4,))))
    assert not nothing.impulse.any()
    assert not nothing.iterations.any()


def test_the_impulse_of_least_norm_is_taken():
    """Four corners of a box share the load alike, whatever the solver would find first."""
    J = np.kron(np.ones((4, 1)), np.eye(2))
    f = carom.solve_impulse(
        jnp.asarray(J @ J.T), jnp.tile(jnp.array([-1.0, 0.2]), (4, 1)), jnp.full(4, 0.5), jnp.zeros(4)
    )
    assert np.allclose(f, np.tile([0.25, -0.05], (4, 1)), atol=1e-6)


def test_second_derivatives_say_that_there_are_none():
    def f(mu):
        return carom.solve_impulse(jnp.eye(2), jnp.array([[-1.0, 2.0]]), mu, jnp.zeros(1)).sum()

    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.hessian(f)(jnp.array([0.3]))


# Two boxes on a pivot, in the scales of their contacts: mobility J J^T. Contacts at a corner and between them jam: the
# impulse is 500 times what is asked for, and a step along it changes velocities by 6e-8 of its size.
JAMMED_J = np.array(
    [
        [0.2032947913, -0.3470672772, 0.7637890766, -0.5048185609],
        [-0.5996604810, 0.1671199735, -0.3405873794, 1.2783823740],
        [-0.0179461095, 0.0093383115, -0.0127529143, -0.9997140072],
        [0.1268617878, -0.0688148994, 0.0848302514, 7.3440214486],
        [0.1929515684, 0.8949885929, 0.3759403846, 0.1429473263],
        [0.6031653214, 0.0115728275, -0.7345249905, -0.1790159366],
    ]
)
JAMMED_V = JAMMED_J @ [0.1698406624, -0.2793460139, 0.5867647707, -0.1484942369]
JAMMED_FRICTION, JAMMED_RESTITUTION = np.array([0.613018, 1.098626, 0.480783]), np.array([0.685213, 0.754886, 0.642501])


def by_every_mode(Q, q, mu, lower):
    """Velocities after a program in 2D, and its impulse: of all that contacts may do the one of least energy."""
    best = (np.inf, q)
    for modes in itertools.product(("open", "sticks", "right", "left", "bound"), repeat=len(mu)):
        columns, fixed = [], np.zeros(len(q))
        for k, mode in enumerate(modes):
            normal, tangent = np.eye(len(q))[2 * k : 2 * k + 2]
            if mode in ("open", "bound"):
                fixed += lower[k] * normal
            columns += {
                "open": [],
                "sticks": [normal, tangent],
                "right": [normal + mu[k] * tangent],
                "left": [normal - mu[k] * tangent],
                "bound": [tangent],
            }[mode]
        f = fixed
        if columns:
            G = np.stack(columns, axis=1)
            f = fixed + G @ np.linalg.lstsq(G.T @ Q @ G, -G.T @ (Q @ fixed + q), rcond=1e-12)[0]
        normal, tangent = f.reshape(-1, 2).T
        if np.all(normal >= lower - 1e-9) and np.all(np.abs(tangent) <= mu * normal + 1e-9 * np.abs(f).max()):
            best = min(best, (f @ Q @ f / 2 + f @ q, tuple(f)))
    return Q @ np.array(best[1]) + q, np.array(best[1])


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_jammed_contacts_leave_as_the_program_says(scale):
    """To 1e-8 of what comes; a residual of 1e-12 of the impulse, which is large, left 2 % after the rebound."""
    Q = JAMMED_J @ JAMMED_J.T
    between, f = by_every_mode(Q, JAMMED_V, JAMMED_FRICTION, np.zeros(3))
    after, _ = by_every_mode(Q, between, JAMMED_FRICTION, JAMMED_RESTITUTION * f[::2])
    data = (Q, scale * JAMMED_V.reshape(3, 2), JAMMED_FRICTION, JAMMED_RESTITUTION, np.zeros((3, 2)))
    compression, rebound = carom.contact_impulse(*(jnp.asarray(part) for part in data))
    assert np.abs(compression).max() > 400 * scale
    for impulse, expected in ((compression, between), (compression + rebound, after)):
        found = JAMMED_V + Q @ np.asarray(impulse).ravel() / scale
        np.testing.assert_allclose(found, expected, atol=1e-8)
