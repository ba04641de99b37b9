"""Springs, damping, armature, dry friction, limits, motors and drag as quantities: by name, with right derivatives."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.learning.unknowns.force_quantities import DRAGS, UNITS, force_quantities
from carom.learning.unknowns.quantities import Learned, describe, quantities

KINDS = {*UNITS, *DRAGS}
PENDULUM = """
<mujoco><worldbody>
  <body name="upper" pos="0 0 1">
    <joint name="left shoulder" axis="0 1 0" damping=".3" stiffness="2" springref="20" armature=".05" frictionloss=".1"
           range="-90 120" limited="true"/>
    <geom type="capsule" fromto="0 0 0 .4 0 -.1" size=".03"/>
    <body name="lower" pos=".4 0 -.1">
      <joint name="elbow:bend" axis="0 1 .3" damping=".2" armature=".01"/>
      <joint name="twist" axis="1 0 0" stiffness="1.5" frictionloss=".02"/>
      <geom type="capsule" fromto="0 0 0 .3 .1 0" size=".02"/>
    </body>
  </body>
</worldbody><actuator>
  <motor name="arm motor" joint="left shoulder" gear="3"/>
  <general name="turner" joint="twist" gainprm="-2"/>
</actuator></mujoco>
"""


@functools.cache
def pendulum() -> carom.System:
    pytest.importorskip("mujoco", reason="carom.load_mujoco needs mujoco")
    return carom.load_mujoco(PENDULUM).system


def slider(stiffness=0.0, damping=(0.0, 0.0, 0.4), rest=0.1) -> carom.System:
    """A box on two slides in the plane, and a bar that is hinged to it, by the name of a slide; with drag."""
    return carom.System(
        bodies=[carom.RigidBody(2.0, (0.01, 0.02)), carom.RigidBody(1.0, (0.02, 0.001))],
        constraints=[
            carom.Joints(0, None, ["slide"] * 2, np.eye(2), np.zeros((2, 2)), (0.0, 0.0), names=["x", "y"]),
            carom.Joints(3, 0, ["hinge"], [(0.0, 0.0)], [(0.0, 0.3)], (0.0, 0.0), names=["x"]),
        ],
        forces=[
            carom.JointDamping(damping),
            carom.JointSpring(stiffness, rest),
            carom.JointDamping([0.5], gears=[[2.0, 0.0, 1.0]]),
            carom.PointDrag([0, 4], [0.1, 0.0], 0.3),
        ],
        rotors=np.array([0.7, 0.0, 0.0]),
        potential=carom.Gravity((0.0, -9.81)),
    )


SYSTEMS = {"pendulum": pendulum, "slider": slider, "sprung": lambda: slider((3.0, 0.0, 4.0), 0.2, (0.1, 0.0, -0.2))}


def values(system: carom.System) -> dict[str, tuple[float, str]]:
    return {q.name: (float(q.value(system)), q.unit) for q in quantities(system) if q.label.kind in KINDS}


# --- names ----------------------------------------------------------------------------------------------------------


def test_what_a_file_says_is_found_by_name():
    assert values(pendulum()) == {
        "damping:left shoulder": (0.3, "N m s/rad"),
        "damping:elbow:bend": (0.2, "N m s/rad"),
        "stiffness:left shoulder": (2.0, "N m/rad"),
        "stiffness:twist": (1.5, "N m/rad"),
        "rest_angle:left shoulder": (pytest.approx(np.radians(20)), "rad"),
        "rest_angle:twist": (0.0, "rad"),
        "armature:left shoulder": (0.05, "kg m^2"),
        "armature:elbow:bend": (0.01, "kg m^2"),
        "dry_friction:left shoulder": (0.1, "N m"),
        "dry_friction:twist": (0.02, "N m"),
        "gain:arm motor": (1.0, "N m"),
        "gain:turner": (-2.0, "N m"),
        "limit:left shoulder lower limit": (pytest.approx(-np.pi / 2), "rad"),
        "limit:left shoulder upper limit": (pytest.approx(np.radians(120)), "rad"),
    }
    assert {name for name, *_ in describe(pendulum())} >= set(values(pendulum()))


def test_what_is_one_number_for_all_is_one_and_slides_have_other_units():
    """Of two joints with one name, the second is told from the first."""
    assert values(slider()) == {
        "damping:x (2)": (0.4, "N m s/rad"),
        "stiffness:all": (0.0, ""),
        "damping:x+x (2)": (0.5, ""),
        "armature:x": (0.7, "kg"),
        "drag:0": (0.1, "kg/s"),
        "quadratic_drag:0,1.1": (0.3, "kg/m"),
    }
    assert values(slider(stiffness=(3.0, 0.0, 0.0), damping=0.2)) == {
        "damping:all": (0.2, ""),
        "stiffness:x": (3.0, "N/m"),
        "rest_angle:x": (0.1, "m"),
        "damping:x+x (2)": (0.5, ""),
        "armature:x": (0.7, "kg"),
        "drag:0": (0.1, "kg/s"),
        "quadratic_drag:0,1.1": (0.3, "kg/m"),
    }


def test_names_that_mean_something_else_can_be_chosen_too():
    """So can a joint that is called as a spring between points is."""
    names = ("hinge[0]", "a=b*", "0")
    links = [
        carom.Joints(4 * k, None, ["hinge"], [(0.0, 1.0, 0.0)], [(0.0, 0.0, 0.3)], (float(k), 0.0, 0.0), names=[name])
        for k, name in enumerate(names)
    ]
    system = carom.System(
        bodies=[carom.RigidBody(1.0, (0.01, 0.01, 0.01))] * 3,
        constraints=links,
        forces=[carom.JointSpring((1.0, 2.0, 3.0)), carom.BodyDrag(4, 0.1)],
        potential=carom.Springs([0, 4], 50.0, 1.0),
    )
    found = ["stiffness:hinge(0)", "stiffness:a-b+", "stiffness:0 (2)", "drag:1", "quadratic_drag:1", "angular_drag:1"]
    assert [q.name for q in force_quantities(system) if q.label.kind != "rest_angle"] == found
    for name in found:
        assert Learned.chosen(system, [name]).names == (name,)
    assert Learned.chosen(system, ["stiffness:0"]).of == ("springs 0, of the points 0, 4",)


def test_a_name_of_nothing_is_answered_with_what_there_is():
    with refused(
        "stiffness:left shoulder,twist, rest_angle:left shoulder,twist, damping:left shoulder,elbow:bend, "
        "gain:arm motor,turner, armature:left shoulder,elbow:bend, limit:left shoulder lower limit,left shoulder upper "
        "limit, dry_friction:left shoulder,twist"
    ):
        Learned.chosen(pendulum(), ["dampening:knee"])
    with refused("Did you mean 'damping'?"):
        Learned.chosen(pendulum(), ["dampning:knee"])


# --- values ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(SYSTEMS))
def test_each_is_read_as_it_was_put_and_nothing_else_changes(name):
    system = SYSTEMS[name]()
    every = quantities(system)
    read = eqx.filter_jit(lambda system: jnp.stack([q.value(system) for q in every]))
    before = np.asarray(read(system))
    assert len({q.name for q in every}) == len(every)
    for k, quantity in enumerate(every):
        hash(quantity.label), hash(jax.tree.structure(quantity))
        if quantity.label.kind not in KINDS:
            continue
        wanted = before.copy()
        wanted[k] += 0.01
        changed = quantity.put(system, jnp.asarray(wanted[k]))
        assert jax.tree.structure(changed) == jax.tree.structure(system)
        np.testing.assert_array_equal(read(changed), wanted, err_msg=quantity.name)
        assert quantity.lower <= before[k] <= quantity.upper
        assert 0 < quantity.scale < 1
        assert quantity.from_free(quantity.to_free(jnp.asarray(before[k]))) == pytest.approx(before[k])


def test_limits_stay_on_their_sides_of_the_middle():
    learned = Learned.chosen(pendulum(), ["limit"])
    lower, upper = learned.physical(learned.project(learned.free() + jnp.asarray([9.0, -9.0])))
    assert lower == upper == pytest.approx(np.radians(15))


# --- derivatives ----------------------------------------------------------------------------------------------------


def test_derivatives_of_accelerations_are_central_differences():
    system, chosen = pendulum(), ("damping", "stiffness", "rest_angle", "armature", "gain")
    learned = Learned.chosen(system, chosen)
    assert {q.label.kind for q in learned.quantities} == set(chosen)
    rng = np.random.default_rng(0)
    q, rates = rng.uniform(-0.7, 0.7, (2, system.n_coordinates))
    x, v = system.state_from_joints(q, rates)
    control = jnp.asarray([0.8, -0.6])

    def accelerations(theta):
        system = learned.assemble(theta)
        a = system.acceleration(x, v, control)
        return jnp.concatenate([a.ravel(), system.joint_accelerations(x, v, a)])

    theta, step, count = learned.free(), 1e-3, len(learned.names)
    # The same program for values and derivatives: a difference of fourth order in the step, and forward mode.
    away = step * jnp.asarray([1.0, -1.0, 2.0, -2.0])[:, None, None] * jnp.eye(count)
    both = jax.jit(jax.vmap(lambda theta, way: jax.jvp(accelerations, (theta,), (way,))))
    value, _ = both((theta + away).reshape(-1, count), jnp.tile(jnp.eye(count), (4, 1)))
    forward = both(jnp.tile(theta, (4 * count, 1)), jnp.tile(jnp.eye(count), (4, 1)))[1][:count]
    one, back, two, far_back = value.reshape(4, count, -1)
    differences = (8 * (one - back) - (two - far_back)) / (12 * step)
    size = np.abs(differences).max(axis=1, keepdims=True)
    assert np.all(size > 0), learned.names
    np.testing.assert_allclose(forward / size, differences / size, atol=1e-6)
    weights = jnp.asarray(rng.normal(size=differences.shape[1]))
    reverse = jax.jit(jax.grad(lambda theta: accelerations(theta) @ weights))(theta)
    np.testing.assert_allclose(reverse / size[:, 0], differences @ weights / size[:, 0], atol=1e-6)


def test_drag_slows_a_body_by_its_law():
    """Force `-(linear + quadratic |v|) v` and torque `-angular omega`, so that all have derivatives in closed form."""
    system = carom.System(
        bodies=[carom.RigidBody(2.0, (0.01, 0.01, 0.01))], forces=[carom.BodyDrag(0, 0.3, 0.2, 0.05)], dim=3
    )
    learned = Learned.chosen(system, ["drag", "quadratic_drag", "angular_drag"])
    assert learned.names == ("drag:0", "quadratic_drag:0", "angular_drag:0")
    speed, spin = np.array([3.0, 0.0, 4.0]), np.array([0.0, 2.0, 0.0])
    x = jnp.concatenate([jnp.zeros((1, 3)), jnp.eye(3)])
    v = jnp.concatenate([jnp.zeros((1, 3)), jnp.cross(spin, jnp.eye(3))]) + speed

    def slowed(theta):
        a = learned.assemble(theta).acceleration(x, v)
        # The end of the x axis goes along -z as the body turns about y.
        return jnp.concatenate([a[0], (a[1] - a[0])[2:]])

    theta = learned.free()
    linear, quadratic, angular = learned.physical(theta)
    assert (linear, quadratic, angular) == pytest.approx((0.3, 0.2, 0.05))
    zero = np.zeros(3)
    columns = [-linear * speed / 2, -quadratic * 5 * speed / 2, zero]  # of logarithms
    turning = [0, 0, angular * 2 / 0.02]  # moment of inertia about an axis: twice a second moment
    wanted = np.vstack([np.array(columns).T, turning])
    np.testing.assert_allclose(jax.jacfwd(slowed)(theta), wanted, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(slowed)(theta), wanted, rtol=1e-12, atol=1e-12)
