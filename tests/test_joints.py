"""Joints against MuJoCo's: coordinates, rates and poses, accelerations with all forces, limits and dry friction."""

import importlib.util
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.cli.systems import choose
from carom.mjcf.bodies import groups_of, joints_of, placed, state_of

mujoco = pytest.importorskip("mujoco")

ROUNDING = 1e-12


@pytest.fixture(autouse=True)
def _where_logs_may_be_left(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into MUJOCO_LOG.TXT, where it is."""
    monkeypatch.chdir(tmp_path)


def files(package: str, folder: str, names: tuple[str, ...]) -> list:
    """Models that a package brings; skipped where it is not there."""
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        return [pytest.param("", marks=pytest.mark.skip(reason=f"needs the package {package}"), id=package)]
    at = Path(found.origin).parent / folder
    return [pytest.param(str(at / f"{name}.xml"), id=f"{package}-{name}") for name in names]


MADE = """<mujoco><option density="1.2" viscosity="0.4"/><default>
  <geom type="capsule" size=".05 .2" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="trunk" pos="0 0 1"><joint name="x" type="slide" axis="1 0 0"/><joint name="t" axis="0 1 .2"/>
      <joint name="z" type="slide" axis="0 .1 1" damping="2"/><geom pos=".1 0 0"/>
      <body name="arm" pos=".3 0 0" euler="10 20 30" gravcomp=".3"><joint name="a" axis="1 0 0" pos="0 0 .1"
          damping="1 .5 .2" armature=".3"/><joint name="b" axis=".2 1 0" stiffness="3 .5 .1" springref="20"/><geom/>
        <body name="hand" pos="0 .2 .1"><joint name="c" type="ball" damping=".2" stiffness="2"/>
          <geom pos="0 0 .2"/></body>
        <body name="leg" pos="0 -.2 .1"><joint name="d" axis="1 0 0"/><joint name="e" axis="0 1 0"/>
          <joint name="f" axis=".1 .2 1"/><geom pos="0 0 .2"/></body></body></body>
    <body name="ball" pos="1 1 1"><freejoint name="free"/><geom pos=".1 0 0"/></body></worldbody>
  <tendon><fixed name="u" stiffness="5" springlength="-.1 .2" damping=".3" armature=".05"><joint joint="a" coef="1"/>
    <joint joint="d" coef="-2"/></fixed></tendon>
  <actuator><motor name="m" joint="a" gear="3" ctrlrange="-1 1"/><position name="p" joint="b" kp="20" kv="2"/>
    <velocity name="v" tendon="u" kv="4" forcerange="-3 3"/><damper name="w" joint="e" kv="2" ctrlrange="0 1"/>
    <motor name="y" joint="c" gear="1 2 3"/><intvelocity name="i" joint="f" kp="5" actrange="-2 2"/>
    <general name="g" joint="d" gainprm="2 1 .5" gaintype="affine" biastype="affine" biasprm=".1 -.2 .3"
      dyntype="filter" dynprm=".2"/></actuator></mujoco>"""
"""Slides after hinges, hinges that do not meet, a ball, what is free, and one of each force."""


class Random:
    """States of MuJoCo's: `qpos`, `qvel`, and carom's points there."""

    def __init__(self, model, seed: int):
        rng = np.random.default_rng(seed)
        self.qpos, self.qvel = np.array(model.qpos0), rng.normal(size=model.nv)
        mujoco.mj_integratePos(model, self.qpos, 0.5 * rng.normal(size=model.nv), 1.0)
        self.control = rng.uniform(-1.5, 1.5, model.nu)
        reference = placed(mujoco, model, model.qpos0)
        groups = groups_of(model, reference)
        self.joints = joints_of(model, reference, groups)
        self.x, self.v = map(jnp.asarray, state_of(mujoco, model, reference, groups, self.qpos, self.qvel))


def coordinates_of(model, qpos) -> np.ndarray:
    """MuJoCo's positions with rotation vectors in place of quaternions."""
    found = []
    for at, kind in zip(model.jnt_qposadr, model.jnt_type, strict=True):
        if kind >= 2:
            found.append(qpos[at : at + 1])
            continue
        if kind == 0:
            found.append(qpos[at : at + 3])
        start = at + (3 if kind == 0 else 0)
        back, turn, vector = np.zeros(4), np.zeros(4), np.zeros(3)
        mujoco.mju_negQuat(back, model.qpos0[start : start + 4])
        mujoco.mju_mulQuat(turn, back, qpos[start : start + 4])
        mujoco.mju_quat2Vel(vector, turn, 1.0)
        found.append(vector)
    return np.concatenate(found)


def test_coordinates_rates_and_poses_are_those_of_mujoco():
    model = mujoco.MjModel.from_xml_string(MADE)
    system = carom.load_mujoco(MADE).system
    assert system.coordinate_names[:5] == ("x", "t", "z", "a", "b")
    for seed in range(3):
        state = Random(model, seed)
        q = system.joint_positions(state.x)
        np.testing.assert_allclose(q, coordinates_of(model, state.qpos), atol=ROUNDING)
        np.testing.assert_allclose(system.joint_velocities(state.x, state.v), state.qvel, atol=10 * ROUNDING)
        np.testing.assert_allclose(system.constraints(state.x), 0, atol=ROUNDING)
        for back, there in zip(system.state_from_joints(q, state.qvel), (state.x, state.v), strict=True):
            np.testing.assert_allclose(back, there, atol=10 * ROUNDING)


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(MADE, id="made"),
        *files("gymnasium", "envs/mujoco/assets", ("ant", "half_cheetah", "swimmer")),
        *files("dm_control", "suite", ("walker", "point_mass", "fish")),
    ],
)
def test_accelerations_are_those_of_mujoco(source):
    """With all forces and controls; without contacts, limits and dry friction, which are not of one kind in both."""
    model = mujoco.MjModel.from_xml_string(source) if source == MADE else mujoco.MjModel.from_xml_path(source)
    for name in ("CONTACT", "LIMIT", "FRICTIONLOSS", "EULERDAMP"):
        model.opt.disableflags |= int(mujoco.mjtDisableBit.__members__[f"mjDSBL_{name}"])
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    data = mujoco.MjData(model)
    system = carom.load_mujoco(source).system

    @jax.jit
    def accelerations(x, v, control):
        return system.joint_accelerations(x, v, system.acceleration(x, v, control if model.nu else None))

    for seed in range(5):
        state = Random(model, seed)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = state.qpos, state.qvel, state.control
        for k in np.flatnonzero(model.actuator_actadr >= 0):
            low, high = model.actuator_ctrlrange[k] if model.actuator_ctrllimited[k] else (-np.inf, np.inf)
            data.act[model.actuator_actadr[k]] = np.clip(state.control[k], low, high)
        mujoco.mj_forward(model, data)
        found = accelerations(state.x, state.v, jnp.asarray(state.control))
        np.testing.assert_allclose(found, data.qacc, atol=1e-8 * np.abs(data.qacc).max(), rtol=0)


HINGE = """<mujoco><option timestep="0.01" gravity="0 0 {}"/><worldbody><body>
  <joint name="h" type="hinge" axis="0 1 0" {}/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/></body>
  </worldbody><actuator><motor name="m" joint="h"/></actuator></mujoco>"""


def test_dry_friction_holds_slows_and_stops():
    """Closed forms: torques below it move nothing, above it what is left of them; alone it stops what turns."""
    system = carom.load_mujoco(HINGE.format(0, 'frictionloss="0.5"')).system
    torques = jnp.array([0.499, -0.3, 0.6, 0.0])
    rates = jnp.array([0.0, 0.0, 0.0, 4.0])
    x, v = system.state_from_joints(jnp.full((4, 1), 0.3), rates[:, None])
    ease = 1 / float(system.joint_accelerations(x[0], 0 * v[0], system.acceleration(x[0], 0 * v[0], jnp.ones(1)))[0])
    motion = carom.simulate(system, x, v, dt=0.01, steps=60, control=jnp.tile(torques[:, None, None], (1, 60, 1)))
    q, w = system.joint_positions(motion.x)[..., 0], jax.vmap(jax.vmap(system.joint_velocities))(motion.x, motion.v)
    assert np.abs(q[:2] - 0.3).max() < 1e-12
    np.testing.assert_allclose(q[2, -1] - 0.3, 0.1 / ease * 0.6**2 / 2, rtol=1e-6)
    stop = 4 * ease / 0.5
    assert 0 < stop < 0.6
    np.testing.assert_allclose(q[3, -1] - 0.3, 4 * stop / 2, atol=0.5 / ease * 0.01**2)
    assert np.abs(w[3, -5:]).max() < 1e-12
    energy = system.energy(motion.x[3], motion.v[3])
    assert np.diff(energy).max() < 1e-12 * energy[0]


@pytest.mark.slow
def test_derivatives_by_dry_friction_are_differences():
    system = carom.load_mujoco(HINGE.format(0, 'frictionloss="0.5"')).system
    x, v = system.state_from_joints([0.3], [4.0])

    def end(loss):
        other = eqx.tree_at(lambda s: s.contacts[0].loss, system, loss[None])
        motion = carom.simulate(other, x, v, dt=0.01, steps=20, throw=False)
        return other.joint_positions(motion.x[-1])[0]

    end = jax.jit(end)
    differences = (end(jnp.asarray(0.5 + 1e-6)) - end(jnp.asarray(0.5 - 1e-6))) / 2e-6
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(end)(jnp.asarray(0.5)), differences, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("impact", ["step", "event"])
def test_a_limit_stops_and_holds(impact):
    system = carom.load_mujoco(HINGE.format(-9.81, 'range="-20 30" limited="true"')).system
    x, v = system.state_from_joints([0.0], [1.0])
    motion = carom.simulate(system, x, v, dt=0.01, steps=150, impact=impact)
    q, w = system.joint_positions(motion.x)[:, 0], jax.vmap(system.joint_velocities)(motion.x, motion.v)
    most = np.deg2rad(30)
    assert abs(q[-1] - most) < 1e-6
    beyond = 1e-9 if impact == "event" else 0.01 * np.abs(w).max()
    assert q.max() < most + beyond


def test_controls_are_told_by_name_and_checked():
    system = carom.load_mujoco(HINGE.format(0, "")).system
    x, v = system.state_from_joints([0.3])
    column = np.linspace(0, 1, 10)
    by_name = carom.simulate(system, x, v, dt=0.01, steps=10, control={"m": column})
    by_number = carom.simulate(system, x, v, dt=0.01, steps=10, control=column[:, None])
    np.testing.assert_array_equal(by_name.x, by_number.x)
    for control, message in (
        ({"n": column}, "control names ['n'], which is no actuator of the system: it has m."),
        ({"m": column[1:]}, "control of 'm' must have the shape (10,)"),
        (column, "control must have the shape (10, 1)"),
        (np.full((10, 1), np.nan), "control must be finite numbers"),
    ):
        with refused(message):
            carom.simulate(system, x, v, dt=0.01, steps=10, control=control)
    ball = carom.System([carom.PointMass(1.0)], dim=3)
    with refused("control must be None for a system without actuators."):
        carom.simulate(ball, jnp.zeros((1, 3)), jnp.zeros((1, 3)), dt=0.01, steps=10, control=column)


def test_angles_go_on_over_turns():
    system = carom.load_mujoco(HINGE.format(0, "")).system
    x, v = system.state_from_joints([0.3], [5.0])
    motion = carom.simulate(system, x, v, dt=0.01, steps=300)
    q = system.joint_positions(motion.x)[:, 0]
    np.testing.assert_allclose(q, 0.3 + 5 * motion.time, atol=1e-6)


WRONG = {
    "kinds": ({"kinds": ("hinge", "wheel")}, "Joints kinds must be of hinge, slide, ball, free"),
    "too many": ({"kinds": ("ball", "hinge")}, "Joints of one body are at most 3 slides and 3 hinges"),
    "no axis": ({"kinds": ("hinge",), "axes": np.zeros((1, 3))}, "axes of hinges and slides must have a length"),
    "alike": ({"kinds": ("slide", "slide"), "axes": np.ones((2, 3))}, "axes of slides must be independent"),
    "rest": ({"kinds": ("hinge",), "rest": np.zeros(2)}, "Joints rest must have the shape (1,)"),
    "names": ({"kinds": ("hinge",), "names": ("a", "b")}, "Joints names must be 1, one a joint"),
    "itself": ({"kinds": ("hinge",), "j": 0}, "Joints are between two different bodies"),
}


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG)
def test_joints_that_cannot_be(change, message):
    count = len(change["kinds"])
    given = {"i": 0, "j": None, "axes": np.eye(3)[:count], "anchors": np.zeros((count, 3)), "place": np.zeros(3)}
    with refused(message):
        carom.Joints(**{**given, **change})


def test_what_is_not_turned_has_derivatives():
    """At the reference position: a ball and a free body that are not turned, springs that are slack, a limited ball."""
    body = """<body><joint name="c" type="ball" damping=".2" stiffness="2" range="0 40" limited="true"/>
      <geom pos="0 0 .2" contype="0" conaffinity="0"/></body>"""
    world = f"<worldbody>{body}</worldbody>"
    system = carom.load_mujoco(f"<mujoco><default><geom size='.1'/></default>{world}</mujoco>").system
    x, _ = system.state_from_joints(np.zeros(3), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(system.gaps(x), np.deg2rad(40))
    turned, _ = system.state_from_joints([0.3, 0.0, 0.4])
    np.testing.assert_allclose(system.gaps(turned), np.deg2rad(40) - 0.5, atol=ROUNDING)

    def pull(q):
        at, _ = system.state_from_joints(q)
        return system.joint_accelerations(at, 0 * at, system.acceleration(at, 0 * at))

    slope = jax.jacfwd(pull)(jnp.zeros(3))
    assert np.isfinite(slope).all()
    gravity_less = (pull(jnp.array([0.0, 0.0, 1e-6])) - pull(jnp.array([0.0, 0.0, -1e-6]))) / 2e-6
    np.testing.assert_allclose(slope[:, 2], gravity_less, rtol=1e-6, atol=1e-6)
    assert slope[2, 2] < -1


def test_dry_friction_needs_coulombs_law():
    system = carom.load_mujoco(HINGE.format(0, 'frictionloss="0.5"')).system
    with refused('DryFriction needs the contact model "coulomb"'):
        system.with_contact_model("cm")


def test_a_robot_file_is_a_system_of_the_command_line(tmp_path):
    """Its start and time step are its own; the copy that a run folder keeps is one file and the same system."""
    for name, text in (("hinge.xml", HINGE.format(-9.81, 'damping="0.5"')), ("copy.xml", None)):
        path = tmp_path / name
        path.write_bytes(chosen.source if text is None else text.encode())
        before, chosen = None if text else chosen, choose(str(path))
        assert (chosen.own, chosen.stem, chosen.truth, chosen.start.dt) == (True, path.stem, None, 0.01)
    np.testing.assert_array_equal(before.start.x, chosen.start.x)
    np.testing.assert_array_equal(before.system.forces[0].viscous, chosen.system.forces[0].viscous)
    with refused("task is the file 'gone.urdf', which does not exist."):
        choose("gone.urdf")


def test_a_slide_may_follow_a_ball():
    xml = """<mujoco><worldbody><body><joint name="b" type="ball" damping=".2"/>
      <joint name="s" type="slide" axis="1 0 0" damping="1"/><geom size=".1" pos="0 0 .2"/></body></worldbody>
      </mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    state, system = Random(model, 0), carom.load_mujoco(xml).system
    np.testing.assert_allclose(system.joint_velocities(state.x, state.v), state.qvel, atol=10 * ROUNDING)


@pytest.mark.parametrize("ratio", [2.0, -0.5, 1.0])
def test_gears_hold_over_turns(ratio):
    def wheel(i):
        return carom.Joints(i, None, ("hinge",), [[0.0, 0.0, 1.0]], np.zeros((1, 3)), np.array([float(i), 0.0, 0.0]))

    wheels = [wheel(0), wheel(4)]
    gear = carom.Coupling(wheels, [1.0, 0.0], [0.0, 1.0], [0.1, ratio])
    body = carom.RigidBody(1.0, jnp.ones(3))
    system = carom.System([body, body], [*wheels, gear])
    angles = np.linspace(-9, 9, 37)
    x, _ = system.state_from_joints(np.stack([0.1 + ratio * angles, angles], axis=1))
    np.testing.assert_allclose(jax.vmap(gear)(x), 0, atol=ROUNDING)


def test_a_force_names_the_first_point_of_a_body():
    bodies = [carom.RigidBody(1.0, jnp.ones(3))] * 2
    with refused("BodyDrag names the point 1, which is no rigid body's first: those are [0, 4]."):
        carom.System(bodies, forces=[carom.BodyDrag(1, 1.0)])
    with refused("a body has two Joints: give all its joints in one."):
        held = carom.Joints(0, None, (), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(3))
        carom.System(bodies, [held, held])
