"""Constraints: values, independence, and what velocities they leave free."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import free_body, heavy_top, random_motions, refused

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.mechanics.constraints import Rigid

ROUNDING = 1e-12  # of a few dozen operations on numbers of order 1
ORIGIN = (0.0, 0.0)


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.mark.parametrize(
    ("constraint", "expected"),
    [
        (carom.Distance(0, 1, 2.0), [25 - 4]),
        (carom.Distance(1, 0, 5.0), [0]),
        (carom.Tether(1, (1.0, 1.0), 3.0), [9 + 16 - 9]),
        (carom.Joint(0, (0.25, 0.75), (3.0, 3.0)), [0.25, 1]),
        (carom.Joint(1, (1.0,), (4.0, 5.0)), [0, 0]),
        (carom.Pivot(0, (1.0,), 1, (1.0,)), [-3, -4]),
        (carom.Track(1, (1.0,), [(0.6, 0.8)], (1.0, 0.0)), [0.6 * 3 + 0.8 * 5]),
    ],
    ids=["distance", "distance that holds", "tether", "joint", "joint of a point", "pivot", "track"],
)
def test_values_by_hand(constraint, expected):
    x = jnp.array([[1.0, 1.0], [4.0, 5.0]])
    np.testing.assert_allclose(constraint(x), expected, atol=ROUNDING)


@pytest.mark.parametrize(("dim", "equations"), [(2, 3), (3, 6)])
def test_rigid_bodies_obey_their_constraints(rng, dim, equations):
    system = free_body(dim)
    _, _, x, v = random_motions(rng, 10, dim)
    assert system.constraints(x).shape == (10, equations)
    np.testing.assert_allclose(system.constraints(x), 0, atol=ROUNDING)
    rate = jax.vmap(lambda x, v: jax.jvp(system.constraints, (x,), (v,))[1])(x, v)
    np.testing.assert_allclose(rate, 0, atol=ROUNDING)  # motions of a rigid body are free


@pytest.mark.parametrize("dim", [2, 3])
def test_rigid_bodies_are_held_in_every_other_way(rng, dim):
    _, _, x, _ = random_motions(rng, 1, dim)
    jacobian = jax.jacrev(Rigid(0, dim))(x[0]).reshape(-1, x[0].size)
    singular = np.linalg.svd(jacobian)[1]
    assert np.all(singular > 0.1)  # independent: the saddle-point matrix can be factored
    assert x[0].size - len(singular) == {2: 3, 3: 6}[dim]  # the freedom of a rigid body


def test_a_joint_holds_a_material_point(rng):
    system = heavy_top(arm=0.3)
    rotation, omega, _, _ = random_motions(rng, 5, 3)
    center = 0.3 * rotation[:, :, 2]
    x, v = embed_pose(center, rotation), embed_velocity(rotation, jnp.cross(omega, center), omega)
    np.testing.assert_allclose(system.constraints(x), 0, atol=ROUNDING)
    rate = jax.vmap(lambda x, v: jax.jvp(system.constraints, (x,), (v,))[1])(x, v)
    np.testing.assert_allclose(rate, 0, atol=ROUNDING)
    # 9 equations for 12 coordinates, all independent.
    assert np.linalg.matrix_rank(jax.jacrev(system.constraints)(x[0]).reshape(9, 12)) == 9


@pytest.mark.parametrize("dim", [2, 3])
def test_joints_between_bodies_in_their_frames(rng, dim):
    """`Pivot`, `Angles` and `Track` say of two bodies what they say of one body and space, seen from the second."""
    rotation, _, x, _ = random_motions(rng, 2, dim)
    points = x.reshape(-1, dim)
    second = dim + 1
    place, anchor, direction, other, normal = (jnp.asarray(rng.normal(size=dim)) for _ in range(5))
    weights = carom.place_weights(place)
    there = x[0, 0] + rotation[0] @ place
    held = x[1, 0] + rotation[1] @ anchor
    pivot = carom.Pivot(0, weights, second, carom.place_weights(anchor))
    np.testing.assert_allclose(pivot(points), there - held, atol=ROUNDING)
    turned = rotation[1] @ other
    for others, j in ((other, second), (turned, None)):
        angles = carom.Angles(0, direction[None], others[None], 0.5, j)
        np.testing.assert_allclose(angles(points), [(rotation[0] @ direction) @ turned - 0.5], atol=ROUNDING)
    for normals, point, j in ((normal, anchor, second), (rotation[1] @ normal, held, None)):
        track = carom.Track(0, weights, normals[None], point, j)
        np.testing.assert_allclose(track(points), [(rotation[1] @ normal) @ (there - held)], atol=ROUNDING)
    assert pivot.points() == tuple(range(2 * second))


def test_a_system_lists_links_first_and_rigid_bodies_last():
    body = carom.RigidBody(1.0, (0.1, 0.1))
    links = [carom.Distance(0, 4, 1.0), carom.Tether(1, ORIGIN, 1.0)]
    system = carom.System([carom.PointMass(1.0), body, carom.PointMass(1.0)], links)
    assert [type(link).__name__ for link in system.links] == ["Distance", "Tether", "Rigid"]
    assert system.links[2].points() == (1, 2, 3)
    assert system.constraints(jnp.ones((5, 2))).shape == (5,)


BAD_CONSTRAINTS = {
    "one point twice": (lambda: carom.Distance(1, 1, 1.0), "Distance joins two different points"),
    "negative length": (lambda: carom.Distance(0, 1, -1.0), "length must be a positive number"),
    "no length": (lambda: carom.Tether(0, ORIGIN, 0.0), "length must be a positive number"),
    "NaN length": (lambda: carom.Tether(0, ORIGIN, np.nan), "length must be a positive number"),
    "pivot of one": (lambda: carom.Pivot(0, (1.0,), 0, (1.0,)), "Pivot joins two different bodies"),
    "pivot weights": (lambda: carom.Pivot(0, (1.0,), 1, (0.5,)), "weights_j must be numbers that sum to 1"),
    "angles of one": (lambda: carom.Angles(0, [ORIGIN], [ORIGIN], 0.0, 0), "Angles are between two different bodies"),
    "angles shape": (lambda: carom.Angles(0, [ORIGIN], ORIGIN), "Angles directions and others must be as many vectors"),
    "angles count": (lambda: carom.Angles(0, [ORIGIN], [ORIGIN], (0.0, 0.0)), "Angles cosines must be one number or 1"),
    "no angle": (lambda: carom.Angles(0, [ORIGIN], [ORIGIN], 1.0), "cosines must be between -1 and 1"),
    "track of one": (lambda: carom.Track(0, (1.0,), [ORIGIN], ORIGIN, 0), "Track joins two different bodies"),
    "track shape": (lambda: carom.Track(0, (1.0,), ORIGIN, ORIGIN), "Track normals must be vectors (e, d) and anchor"),
    "weights": (lambda: carom.Joint(0, (0.5, 0.1, 0.1), ORIGIN), "weights must be numbers that sum to 1"),
}


@pytest.mark.parametrize(("make", "message"), BAD_CONSTRAINTS.values(), ids=BAD_CONSTRAINTS)
def test_bad_constraints_are_refused(make, message):
    with refused(message):
        make()
