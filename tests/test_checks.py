"""What is refused by name; and that functions work under jit with any of their arguments traced alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor, refused

import carom
from carom.checks import as_floats

FLOOR = ((0.0, 0.0), (0.0, 1.0))
X, V = jnp.array([[0.0, 0.11]]), jnp.array([[1.0, -2.0]])


def simulated(**changed):
    """The end of a bounce, of which every argument can be another."""
    given = {"mass": 1.0, "radius": 0.1, "friction": 0.3, "restitution": 0.5, "point": FLOOR[0], "normal": FLOOR[1]}
    given |= {"x": X, "v": V, "dt": 0.01, "force": jnp.zeros((3, 1, 2)), "gravity": (0.0, -9.81), "steps": 8.0}
    given |= {"epsilon": 0.0} | changed
    system = carom.System(
        bodies=[carom.PointMass(given["mass"], given["radius"])],
        contacts=[carom.DiskPlane([0], given["point"], given["normal"])],
        potential=carom.Gravity(given["gravity"]),
        friction=given["friction"],
        restitution=given["restitution"],
        contact_model=carom.CMr(given["epsilon"]),
    )
    out = carom.simulate(
        system,
        given["x"],
        given["v"],
        dt=given["dt"],
        steps=3,
        force=given["force"],
        compensation_steps=given["steps"],
    )
    return out.x[-1]


@pytest.fixture(scope="module")
def wanted():
    return simulated()


ARGUMENTS = {
    "mass": 1.0,
    "radius": 0.1,
    "friction": 0.3,
    "restitution": 0.5,
    "point": np.array([0.0, 0.0]),
    "normal": np.array([0.0, 1.0]),
    "gravity": np.array([0.0, -9.81]),
    "x": X,
    "v": V,
    "dt": 0.01,
    "force": np.zeros((3, 1, 2)),
    "steps": 8.0,
    "epsilon": 0.0,
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_simulate_under_jit_with_one_argument_traced(name):
    """To trace it is what fails where a value is looked at that is not known."""
    end = jax.eval_shape(lambda value: simulated(**{name: value}), jnp.asarray(ARGUMENTS[name]))
    assert end.shape == (1, 2)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_simulate_under_jit_with_all_arguments_traced(wanted):
    end = jax.jit(lambda values: simulated(**values))(jax.tree.map(jnp.asarray, ARGUMENTS))
    assert np.allclose(end, wanted, atol=1e-12)


def test_simulate_under_jit_with_nothing_traced(wanted):
    """Where everything is known, so is what is wrong."""
    assert jax.eval_shape(simulated).shape == wanted.shape
    with refused("mass must be a positive number of kilograms; it was -1.0"):
        jax.eval_shape(lambda: simulated(mass=-1.0))
    with refused("body 0 is inside a wall"):
        below = jnp.array([[0.0, -0.3]])
        jax.eval_shape(lambda force: simulated(x=below, force=force), jnp.zeros((3, 1, 2)))


def test_derivatives_under_jit_of_what_is_known_otherwise():
    """`x = F t^2 / 2` for a mass of 1 that touches nothing, so that `dx/dF` over equal forces is `t^2 / 2`."""
    system = ball_on_floor(gravity=0.0)

    @jax.jit
    @jax.grad
    def slope(force):
        force = jnp.zeros((4, 1, 2)).at[:, 0, 0].set(force)
        x0 = jnp.array([[0.0, 1.0]])
        return carom.simulate(system, x0, jnp.zeros((1, 2)), dt=0.5, steps=4, force=force).x[-1, 0, 0]

    assert float(slope(0.3)) == pytest.approx(2.0, abs=1e-12)


@pytest.mark.parametrize("name", ["smoothing", "steps", "max_events"])
def test_what_must_be_known_is_refused_where_it_is_traced(name):
    given = {"dt": 0.01, "steps": 3}

    with refused(name):
        jax.eval_shape(lambda value: carom.simulate(ball_on_floor(), X, V, **given | {name: value}).x, 2)


PROBLEM = {
    "A": jnp.eye(4),
    "v": jnp.array([[-1.0, 0.2], [0.5, 0.0]]),
    "friction": jnp.array([0.5, 0.1]),
    "lower": jnp.zeros(2),
    "restitution": jnp.full(2, 0.5),
    "v_star": jnp.zeros((2, 2)),
}


@pytest.mark.parametrize("name", PROBLEM)
def test_impulses_under_jit_with_one_argument_traced(name):
    for function, names in (
        (carom.solve_impulse, ("A", "v", "friction", "lower")),
        (lambda *a: sum(carom.contact_impulse(*a)), ("A", "v", "friction", "restitution", "v_star")),
    ):
        if name in names:
            known = {k: PROBLEM[k] for k in names}
            found = jax.eval_shape(lambda value, f=function, k=known: f(*(k | {name: value}).values()), PROBLEM[name])
            assert found.shape == (2, 2)


def other_makers():
    box = {"half_widths": 0.1, "corner_radius": 0.01, "point": FLOOR[0], "normal": FLOOR[1], "center": (0.0, 0.0)}
    ball = {"centers": [[0.0, 0.1]], "radii": 0.1, "point": FLOOR[0], "normal": FLOOR[1]}
    pair = {"centers": np.ones((1, 2, 2)), "radii": np.ones((1, 2))}
    chain = {"shortest": 0.5, "longest": 1.0, "anchor": (0.0, 0.0)}
    place = np.array([0.5, 0.3, 0.2])
    makers = {
        "corner": (lambda **k: carom.CornerPlane([0], **k), box),
        "ball": (lambda **k: carom.BallPlane([0], **k), ball),
        "pair": (lambda **k: carom.BallBall([(0, 1)], **k), pair),
        "stretch": (lambda **k: carom.StretchLimit([0, 1], **k), chain),
        "bend": (lambda **k: carom.BendLimit([0, 1], **k), {"limit": 0.5, "anchor": (0.0, 0.0)}),
        "rigid": (carom.RigidBody, {"mass": 1.0, "moments": (1.0, 1.0), "radius": 0.1}),
        "springs": (lambda **k: carom.Springs([0, 1], **k), {"stiffness": 1.0, "rest_length": 1.0}),
        "distance": (lambda **k: carom.Distance(0, 1, **k), {"length": 1.0}),
        "tether": (lambda **k: carom.Tether(0, **k), {"anchor": (0.0, 0.0), "length": 1.0}),
        "joint": (lambda **k: carom.Joint(0, **k), {"weights": place, "anchor": (0.0, 0.0)}),
        "pivot": (lambda weights_i, weights_j: carom.Pivot(0, weights_i, 3, weights_j), dict.fromkeys(
            ("weights_i", "weights_j"), place)),
        "angles": (lambda **k: carom.Angles(0, **k), {
            "directions": np.eye(2)[:1], "others": np.eye(2)[1:], "cosines": 0.0}),
        "track": (lambda **k: carom.Track(0, **k), {
            "weights": place, "normals": np.eye(2)[:1], "anchor": (0.0, 0.0)}),
        "coulomb": (carom.Coulomb, {"friction_loss": 0.1, "restitution_loss": 0.1, "loss_speed": 0.3}),
    }  # fmt: skip
    return [
        pytest.param(make, given, name, id=f"{kind}-{name}") for kind, (make, given) in makers.items() for name in given
    ]


@pytest.mark.parametrize(("make", "given", "name"), other_makers())
def test_parts_are_the_same_with_one_argument_traced(make, given, name):
    known = make(**given)
    traced = jax.eval_shape(lambda value: make(**given | {name: value}), jnp.asarray(given[name], float))
    assert jax.tree.map(jnp.shape, known) == jax.tree.map(jnp.shape, traced)
    with refused(" must be "):
        make(**given | {name: np.full(np.shape(given[name]), np.nan)})


def test_indices_are_whole_numbers():
    with refused("DiskPlane bodies must be whole numbers; one was 0.7"):
        carom.DiskPlane([0.7], *FLOOR)  # pyright: ignore[reportArgumentType]
    with refused("DiskDisk pairs must be whole numbers; one was 1.0"):
        carom.DiskDisk([(0, 1.0)])  # pyright: ignore[reportArgumentType]
    with refused("DiskPlane property must be whole numbers; one was 0.5"):
        carom.DiskPlane([0], *FLOOR, property=0.5)  # pyright: ignore[reportArgumentType]
    with refused("Tether i must be whole numbers; one was 'a'"):
        carom.Tether("a", (0.0, 0.0), 1.0)  # pyright: ignore[reportArgumentType]
    with refused("Springs points must be whole numbers; one was traced"):
        jax.jit(lambda i: carom.Springs([0, i], 1.0, 1.0).stiffness)(1)
    assert carom.DiskPlane(range(2), *FLOOR, property=[0, 1]).property_index == (0, 1)


def test_nothing_is_counted_twice():
    with refused("DiskDisk pairs two bodies once; (1, 0) was there twice"):
        carom.DiskDisk([(0, 1), (1, 0)])
    with refused("DiskPlane bodies must be different from each other; 2 was there twice"):
        carom.DiskPlane([2, 0, 2], *FLOOR)


def test_infinite_values_are_refused():
    with refused("friction must be at least 0 (Coulomb's mu), and finite; it was [inf]"):
        ball_on_floor(friction=np.inf)
    with refused("mass must be a positive number of kilograms; it was inf"):
        carom.PointMass(np.inf)


def test_a_property_that_is_not_there_is_refused_for_traced_values_too():
    def made(friction):
        floor = carom.DiskPlane([0], *FLOOR, property=3)
        return carom.System([carom.PointMass(1.0)], contacts=[floor], friction=friction).friction

    with refused("a contact's property index must be below the number of friction values (1); one was 3"):
        jax.jit(made)(0.3)


EMPTY = {
    "DiskDisk": lambda: carom.DiskDisk([]),
    "DiskPlane": lambda: carom.DiskPlane([], *FLOOR),
    "BallPlane": lambda: carom.BallPlane([], [], [], *FLOOR),
    "BallBall": lambda: carom.BallBall([], np.zeros((0, 2, 2)), np.zeros((0, 2))),
    "CornerPlane": lambda: carom.CornerPlane([], 0.1, *FLOOR),
}


@pytest.mark.parametrize("name", EMPTY)
def test_a_family_without_a_contact_is_nothing(name):
    empty, falls = EMPTY[name](), carom.Gravity((0.0, -10.0))
    alone = carom.System([carom.PointMass(1.0, 0.1)], contacts=[empty], potential=falls)
    assert alone.n_candidates == 0
    out = carom.simulate(alone, X, V, dt=0.1, steps=2, impact="event")
    assert np.allclose(out.x[-1], X + 0.2 * V + np.array([[0, -10 * 0.2**2 / 2]]))
    beside = ball_on_floor()
    both = carom.System(beside.bodies, contacts=[empty, *beside.contacts])
    assert np.array_equal(both.gaps(X), beside.gaps(X))


@pytest.mark.parametrize("half", [jnp.float16, jnp.bfloat16])
def test_half_precision_becomes_single(half):
    assert as_floats(jnp.ones(2, half)).dtype == jnp.float32
