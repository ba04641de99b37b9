"""Systems from MJCF and URDF: they move as MuJoCo's own do, and what cannot be represented is refused by name."""

import re
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom
from carom.mechanics.bodies import recover_pose

mujoco = pytest.importorskip("mujoco")

ROUNDING = 1e-10  # of a few hundred operations on numbers up to 1e2
SAME_ORDER = 1e-7
"""Both integrate to fourth order, by other formulas in other coordinates: 2e-9 apart after 100 steps of 2 ms."""


@pytest.fixture(autouse=True)
def _where_logs_may_be_left(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into MUJOCO_LOG.TXT, where it is."""
    monkeypatch.chdir(tmp_path)


def world(content: str, *, more: str = "", option: str = "", contact: bool = False) -> str:
    """A model with `content` in its world; contact off unless it is what the test is about."""
    flag = "" if contact else '<flag contact="disable" energy="enable"/>'
    return (
        f'<mujoco><option timestep="0.002" integrator="RK4" {option}>{flag}</option>'
        f"<worldbody>{content}</worldbody>{more}</mujoco>"
    )


class Own(NamedTuple):
    """MuJoCo's motion: origins and rotations of the frames of moving bodies, at the start and after every step."""

    place: np.ndarray  # (steps + 1, bodies, 3)
    turn: np.ndarray  # (steps + 1, bodies, 3, 3)
    velocity: np.ndarray  # (nv,), at the end


def own_motion(xml: str, steps: int, keyframe: bool = False) -> Own:
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    if keyframe:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    moving = np.flatnonzero((model.body_weldid == np.arange(model.nbody)) & (model.body_weldid > 0))
    place, turn = [], []
    for k in range(steps + 1):
        if k > 0:
            mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)  # a step leaves the places as they were within it
        place.append(data.xpos[moving])
        turn.append(data.xmat[moving].reshape(-1, 3, 3))
    return Own(np.array(place), np.array(turn), data.qvel.copy())


def compare(xml: str, steps: int = 100, keyframe: bool = False):
    """How far apart the frames of bodies are: origins (m) and rotations, largest of all. Also carom's model, motion."""
    loaded = carom.load_mujoco(xml, keyframe=0 if keyframe else None)
    motion = carom.simulate(loaded.system, loaded.x0, loaded.v0, dt=loaded.dt, steps=steps)
    own = own_motion(xml, steps, keyframe)
    center, rotation = recover_pose(motion.x.reshape(steps + 1, len(loaded.bodies), 4, 3))
    # carom's points are the centre of mass and the principal axes: the frames are where the start says, from there.
    since = np.einsum("tbij,bkj->tbik", rotation, rotation[0])
    place = np.asarray(center) + np.einsum("tbij,bj->tbi", since, own.place[0] - np.asarray(center[0]))
    turned = np.einsum("tbij,bkj->tbik", own.turn, own.turn[0])
    return np.abs(place - own.place).max(), np.abs(since - turned).max(), loaded, motion


# --- motion without contact ----------------------------------------------------------------------

CHAIN = """
<body name="upper" pos="0 0 1"><joint name="shoulder" type="{0}" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 .4 0 .1" size=".03"/>
  <body name="middle" pos=".4 0 .1"><joint name="elbow" type="{0}" axis=".2 1 .3"/>
    <geom type="capsule" fromto="0 0 0 .3 .1 0" size=".03"/>
    <body name="lower" pos=".3 .1 0" euler="20 0 10"><joint name="wrist" type="{0}" axis="1 1 0" pos=".01 0 0"/>
      <geom type="box" size=".05 .02 .1" pos=".1 0 0" euler="0 30 0"/>
    </body>
  </body>
</body>"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("hinge", marks=pytest.mark.ci_budget), "ball"])
def test_a_chain_moves_as_in_mujoco(kind):
    place, turn, loaded, _ = compare(world(CHAIN.format(kind)))
    assert loaded.bodies == ("upper", "middle", "lower")
    assert loaded.dt == 0.002
    assert place < SAME_ORDER
    assert turn < SAME_ORDER


@pytest.mark.slow
def test_a_free_body_with_spin_moves_as_in_mujoco():
    """Two boxes welded at an angle, about an axis that is not principal; the frame is not at the centre of mass."""
    body = """<body name="thrown" pos="0 0 1" euler="10 20 30"><freejoint/><geom type="box" size=".1 .05 .2"/>
        <body pos=".2 0 .1" euler="0 40 0"><geom type="box" size=".05 .1 .02"/></body></body>"""
    key = '<keyframe><key qpos=".1 .2 .3 .8 .6 0 0" qvel="1 -2 3 4 -5 6"/></keyframe>'
    place, turn, loaded, motion = compare(world(body, more=key), keyframe=True)
    assert place < SAME_ORDER
    assert turn < SAME_ORDER
    energy = loaded.system.energy(motion.x, motion.v)
    np.testing.assert_allclose(energy, energy[0], rtol=SAME_ORDER)


STACKS = {
    "free": "<freejoint/>",
    "ball": '<joint type="ball" pos=".1 0 0"/>',
    "hinge": '<joint type="hinge" axis="1 2 3" pos=".1 0 .2"/>',
    "slide": '<joint type="slide" axis="1 2 3"/>',
    "slide and ball": '<joint type="slide" axis="1 2 3"/><joint type="ball" pos="0 .1 0"/>',
    "plane": '<joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/><joint type="hinge" axis="0 1 0"/>',
    "translation": "".join(f'<joint type="slide" axis="{a}"/>' for a in ("1 0 0", "0 1 0", "0 1 1")),
    "universal": '<joint axis="1 0 0"/><joint axis=".5 1 0"/>',
    "three hinges": "".join(f'<joint axis="{a}" pos=".1 0 0"/>' for a in ("1 0 0", "0 1 0", "0 0 1")),
}


@pytest.mark.parametrize("joints", STACKS.values(), ids=STACKS)
def test_joints_leave_the_freedom_of_mujoco(joints):
    """In random states: constraints hold and are independent, as many as MuJoCo's freedom leaves; energies agree."""
    geom = '<geom type="box" size=".1 .2 .3" pos=".1 .05 0" euler="10 20 30"/>'
    inner = "" if "free" in joints else f'<body pos=".3 0 .1" euler="0 50 0">{joints}{geom}</body>'
    content = f'<body pos="0 .1 .2" euler="40 0 0">{joints}{geom}{inner}</body>'
    plain = mujoco.MjModel.from_xml_string(world(content))
    data = mujoco.MjData(plain)
    random = np.random.default_rng(3)
    mujoco.mj_integratePos(plain, data.qpos, random.normal(size=plain.nv), 1.0)
    data.qvel[:] = random.normal(size=plain.nv)
    qpos, qvel = (" ".join(f"{value:.17g}" for value in part) for part in (data.qpos, data.qvel))
    more = f'<keyframe><key name="there" qpos="{qpos}" qvel="{qvel}"/></keyframe>'
    loaded = carom.load_mujoco(world(content, more=more), keyframe="there")
    system, x, v = loaded.system, loaded.x0, loaded.v0
    value, rate = jax.jvp(system.constraints, (x,), (v,))
    np.testing.assert_allclose(value, 0, atol=ROUNDING)
    np.testing.assert_allclose(rate, 0, atol=ROUNDING)
    jacobian = np.asarray(jax.jacrev(system.constraints)(x)).reshape(len(value), -1)
    assert np.linalg.svd(jacobian)[1].min() > 1e-2
    assert x.size - len(value) == plain.nv
    mujoco.mj_kinematics(plain, data)
    mujoco.mj_comPos(plain, data)
    mujoco.mj_comVel(plain, data)
    mujoco.mj_makeM(plain, data)
    mujoco.mj_energyPos(plain, data)
    mujoco.mj_energyVel(plain, data)
    energies = float(system.potential_energy(x)), float(system.kinetic_energy(v))
    np.testing.assert_allclose(energies, data.energy, rtol=ROUNDING)


LINKAGE = """
<body name="left"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .3" size=".02"/>
  <body name="coupler" pos="0 0 .3"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 .1" size=".02"/></body>
</body>
<body name="right" pos=".5 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 .4" size=".02"/></body>"""
CLOSED = '<equality><connect name="pin" body1="{}" body2="{}" anchor=".5 0 .1"/></equality>'


@pytest.mark.slow
def test_a_linkage_closes_in_its_plane():
    """Three hinges and a `connect`, of which one equation follows: one freedom is left, and energy is kept."""
    loaded = carom.load_mujoco(world(LINKAGE, more=CLOSED.format("coupler", "right")))
    system = loaded.system
    assert isinstance(system.links[6], carom.Track)
    jacobian = np.asarray(jax.jacrev(system.constraints)(loaded.x0)).reshape(-1, loaded.x0.size)
    assert loaded.x0.size - np.linalg.matrix_rank(jacobian) == 1
    assert len(jacobian) == np.linalg.matrix_rank(jacobian)
    push = jnp.zeros((100, *loaded.x0.shape)).at[:10, 0, 0].set(5.0)
    motion = carom.simulate(system, loaded.x0, loaded.v0, dt=loaded.dt, steps=100, force=push)
    assert np.abs(system.constraints(motion.x)).max() < 1e-9
    energy = np.asarray(system.energy(motion.x, motion.v))[11:]
    np.testing.assert_allclose(energy, energy[0], rtol=1e-8)
    assert np.abs(motion.x[-1] - motion.x[0]).max() > 0.02


@pytest.mark.parametrize("ends", [("coupler", "right"), ("right", "coupler"), ("coupler", "world")])
def test_connect_of_balls_is_a_pivot(ends):
    content = LINKAGE.replace('<joint axis="0 1 0"/>', '<joint type="ball"/>')
    anchor = CLOSED.format(*ends) if ends[0] == "coupler" else CLOSED.format(*ends).replace(".5 0 .1", "0 0 .4")
    system, x0 = carom.load_mujoco(world(content, more=anchor))[:2]
    assert isinstance(system.links[3], carom.Joint if "world" in ends else carom.Pivot)
    np.testing.assert_allclose(system.links[3](x0), 0, atol=ROUNDING)


def test_a_connect_that_holds_nothing_new_is_refused():
    arm = '<body name="arm"><joint axis="0 1 0"/><geom type="box" size=".1 .1 .1"/></body>'
    more = '<equality><connect name="pin" body1="arm" anchor="0 .1 0"/></equality>'
    with refused("connect 'pin' holds what is held already"):
        carom.load_mujoco(world(arm, more=more))


# --- contacts ------------------------------------------------------------------------------------

BALL = '<geom name="thing" size=".1" friction=".2"/>'
BOX = '<geom name="thing" type="box" size=".1 .15 .1" friction=".2"/>'
DROP, CONSTANT, GRAVITY = 0.02, 0.02, 9.81
"""Height of the fall (m), MuJoCo's default time constant of contacts (s), gravity (m/s^2)."""


def fall_on_floor(geom: str) -> str:
    return f"""<mujoco><option timestep="0.002" cone="elliptic" impratio="10"/><worldbody>
        <geom name="floor" type="plane" size="1 1 1" friction=".3"/>
        <body name="thing" pos="0 0 .1"><freejoint/>{geom}</body></worldbody>
        <keyframe><key name="go" qpos="0 0 .12 1 0 0 0" qvel="1 .3 0 0 0 0"/></keyframe></mujoco>"""


@pytest.mark.slow
@pytest.mark.parametrize("geom", [pytest.param(BALL, marks=pytest.mark.ci_budget), BOX], ids=["ball", "box"])
def test_a_body_falls_on_a_plane_and_slides_as_in_mujoco(geom):
    """MuJoCo's contact is a critically damped spring: a fall at `u` goes in by `u T / e`, friction is late by `T`.

    carom's is hard. So heights differ by `u T / e` at most, and ways by `mu u T`, as the impact's friction acts late.
    """
    loaded = carom.load_mujoco(fall_on_floor(geom), keyframe="go")
    motion = carom.simulate(loaded.system, loaded.x0, loaded.v0, dt=loaded.dt, steps=200)
    own = own_motion(fall_on_floor(geom), 200, keyframe=True)
    impact = np.sqrt(2 * GRAVITY * DROP)
    differ = np.abs(np.asarray(motion.x[:, 0]) - own.place[:, 0]).max(axis=0)
    assert differ[2] < 1.1 * impact * CONSTANT / np.e
    assert differ[:2].max() < 0.3 * impact * CONSTANT
    assert motion.contact.any()
    # A ball rolls in the end, at 5/7 of its speed; a box rests. MuJoCo's friction creeps by its softness.
    expected = (5 / 7 if geom == BALL else 0.0) * np.array([1.0, 0.3])
    np.testing.assert_allclose(motion.v[-1, 0, :2], expected, atol=2e-3)
    np.testing.assert_allclose(own.velocity[:2], expected, atol=5e-3)


def pile(random) -> str:
    """Spheres and planes that all overlap, in bodies of all relations, with random filters and frictions."""

    def filters():
        kind, affinity, priority = random.integers(0, 4), random.integers(0, 4), random.integers(0, 2)
        return f'contype="{kind}" conaffinity="{affinity}" priority="{priority}" friction="{random.uniform():.3f}"'

    def ball(name):
        place = " ".join(f"{value:.3f}" for value in random.uniform(-0.1, 0.1, 3))
        return f'<geom name="{name}" size=".5" pos="{place}" {filters()}/>'

    return f"""<mujoco><worldbody>
        <geom name="floor" type="plane" size="1 1 1" {filters()}/>{ball("post")}
        <geom name="wall" type="plane" size="1 1 1" euler="90 0 0" condim="1" {filters()}/>
        <body name="a"><joint axis="0 1 0"/>{ball("a1")}{ball("a2")}
          <body name="b">{ball("b1")}<body name="c"><joint axis="1 0 0"/>{ball("c1")}
            <body name="d"><joint axis="0 1 0"/>{ball("d1")}</body></body></body>
        </body>
        <body name="e"><freejoint/>{ball("e1")}</body></worldbody>
        <contact><exclude body1="b" body2="e"/><exclude body1="world" body2="d"/>
        <pair geom1="a2" geom2="c1" friction=".25 .25" condim="1"/><pair geom1="e1" geom2="floor" friction=".75 .75"/>
        </contact></mujoco>"""


@pytest.mark.parametrize("seed", range(3))
def test_which_geoms_touch_with_what_friction_is_as_in_mujoco(seed):
    """All geoms overlap, so that MuJoCo's own list has every pair that it would let touch."""
    xml = pile(np.random.default_rng(seed))
    loaded = carom.load_mujoco(xml)
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    expected = {}
    for contact in data.contact:
        names = frozenset(model.geom(int(g)).name for g in contact.geom)
        expected[names] = 0.0 if contact.dim == 1 else contact.friction[0]
    found = {
        frozenset(name.split("'")[1::2]): float(mu)
        for name, mu in zip(loaded.properties, loaded.system.friction, strict=True)
    }
    assert len(expected) > 5
    assert found == pytest.approx(expected)
    gaps = np.sort(np.asarray(loaded.system.gaps(loaded.x0)))
    np.testing.assert_allclose(gaps, np.sort([contact.dist for contact in data.contact]), atol=ROUNDING)


def test_capsules_and_boxes_are_balls_and_corners():
    xml = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" pos="0 0 -1" euler="0 10 0"/>
        <body><freejoint/><geom type="capsule" size=".1 .2" pos=".1 0 0" euler="30 0 0"/></body>
        <body><freejoint/><geom type="box" size=".1 .2 .3" euler="0 45 0" contype="2"/></body>
        <body><freejoint/><geom type="box" size=".1 .2 .3" contype="2"/>
          <geom type="box" size=".1 .1 .1" pos=".3 0 0" euler="0 45 0" contype="2"/></body>
        </worldbody></mujoco>"""
    loaded = carom.load_mujoco(xml, ignore=("contacts",))
    types = [type(contact) for contact in loaded.system.contacts]
    assert types == [carom.CornerPlane, carom.CornerPlane, carom.BallPlane]
    assert loaded.system.n_candidates == 8 + 8 + 2 + 8
    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    normal, gaps = data.geom_xmat[0].reshape(3, 3)[:, 2], []
    for geom in range(1, model.ngeom):
        turn, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        if geom == 1:
            ends, radius = [(0, 0, size[1]), (0, 0, -size[1])], size[0]
        else:
            ends, radius = size * np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T, 0.0
        gaps.append((data.geom_xpos[geom] + np.asarray(ends) @ turn.T - data.geom_xpos[0]) @ normal - radius)
    np.testing.assert_allclose(np.sort(loaded.system.gaps(loaded.x0)), np.sort(np.concatenate(gaps)), atol=ROUNDING)


# --- files and what is refused -------------------------------------------------------------------

URDF = """<?xml version="1.0"?><robot name="arm">
  <link name="base"/>
  <link name="rod"><inertial><origin xyz="0 0 -.2"/><mass value="2"/>
    <inertia ixx=".03" iyy=".03" izz=".005" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="bob"><inertial><mass value="1"/>
    <inertia ixx=".01" iyy=".01" izz=".01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="rod"/>
    <origin xyz="0 0 1"/><axis xyz="0 1 0"/></joint>
  <joint name="weld" type="fixed"><parent link="rod"/><child link="bob"/><origin xyz="0 0 -.4"/></joint>
</robot>"""


def test_a_urdf_file(tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    loaded = carom.load_mujoco(path)
    assert loaded.bodies == ("rod",)
    assert len(loaded.system.bodies) == 1
    np.testing.assert_allclose(loaded.system.masses, [3.0])
    np.testing.assert_allclose(loaded.x0[0], [0, 0, 1 - 0.8 / 3], atol=ROUNDING)
    # A pendulum's inertia about its shoulder, by Steiner: turned by a rate w about y, 1/2 I w^2.
    inertia = 0.03 + 2 * 0.2**2 + 0.01 + 1 * 0.4**2
    spun = jnp.cross(jnp.array([0.0, 1.0, 0.0]), loaded.x0 - jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(loaded.system.kinetic_energy(spun), inertia / 2, rtol=ROUNDING)
    np.testing.assert_allclose(loaded.system.constraints(loaded.x0), 0, atol=ROUNDING)


def test_restitution_gravity_and_the_time_step():
    body = '<body name="ball" pos="0 0 1"><freejoint/><geom size=".1"/></body><geom type="plane" size="1 1 1"/>'
    loaded = carom.load_mujoco(world(body, option='gravity="1 2 3"', contact=True), restitution=0.5)
    np.testing.assert_allclose(loaded.system.restitution, [0.5])
    np.testing.assert_allclose(loaded.system.potential.acceleration, [1, 2, 3])
    np.testing.assert_allclose(loaded.system.gaps(loaded.x0), [0.9])
    np.testing.assert_allclose(loaded.system.radii, [0.1])
    off = carom.load_mujoco(world(body).replace("<flag", '<flag gravity="disable"'))
    np.testing.assert_allclose(off.system.potential.acceleration, 0)
    assert off.system.contacts == ()


ARM = '<body name="arm"><joint name="j" {}/><geom name="g" type="{}" size=".1 .1 .1" {}/>{}</body>'
FLOOR = '<geom name="floor" type="plane" size="1 1 1"/>'


def arm(joint="", geom="box", attributes="", inner="", more="", contact=False, before="", option=""):
    return world(before + ARM.format(joint, geom, attributes, inner), more=more, contact=contact, option=option)


OTHER = '<body name="other" pos="1 0 0"><freejoint/><geom name="h" type="{}" size=".1 .1 .1"/></body>'
REFUSED = {
    "actuators": (
        arm(more='<actuator><muscle name="m" joint="j" lengthrange="0 1"/></actuator>'),
        "actuators (actuator 'm'; carom has those with an affine law on joints and fixed tendons)",
    ),
    "tendons": (
        arm(
            inner='<site name="here"/>',
            before='<site name="there"/>',
            more='<tendon><spatial name="t"><site site="here"/><site site="there"/></spatial></tendon>',
        ),
        "tendons (tendon 't'; carom has fixed tendons; remove those that go through space)",
    ),
    "stiffness": (
        world('<body name="ball"><joint name="j" type="free" stiffness="1"/><geom size=".1"/></body>'),
        "stiffness (joint 'j'; of a free joint, of a ball that is slack elsewhere or not linear, or one that yields:",
    ),
    "mocap": (arm(before='<body name="hand" mocap="true"/>'), "mocap (body 'hand'; set mocap=\"false\")"),
    "fluid": (
        arm(attributes='fluidshape="ellipsoid"', option='density="1000"'),
        "fluid (geom 'g'; carom has a medium at rest that acts on inertia boxes: leave out fluidshape)",
    ),
    "wind": (arm(option='density="1000" wind="1 0 0"'), "fluid (wind; carom has a medium at rest"),
    "box on box": (
        arm(before=OTHER.format("box"), contact=True),
        "contacts (box 'g' and box 'h'; carom has spheres, capsules and boxes on planes, and spheres on spheres",
    ),
    "cylinder": (arm(geom="cylinder", before=FLOOR, contact=True), "contacts (cylinder 'g' and plane 'floor'"),
    "ellipsoid": (arm(geom="ellipsoid", before=FLOOR, contact=True), "contacts (ellipsoid 'g' and plane 'floor'"),
    "mesh": (
        arm(geom="mesh", attributes='mesh="m"', before=FLOOR, contact=True)
        .replace("<worldbody>", '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>')
        .replace('size=".1 .1 .1" mesh', "mesh"),
        "contacts (mesh 'g' and plane 'floor'",
    ),
    "condim": (
        arm(geom="sphere", attributes='condim="4"', before=FLOOR, contact=True),
        "rolling (sphere 'g' and plane 'floor'; torsional and rolling friction: set condim to 3)",
    ),
    "adhesion": (
        arm(geom="sphere", attributes='adhesion="1"', before=FLOOR, contact=True),
        "adhesion (sphere 'g' and plane 'floor'",
    ),
    "surface velocity": (
        arm(geom="sphere", attributes='surfacevel="1 0 0 0 0 0"', before=FLOOR, contact=True),
        "surfacevel (sphere 'g' and plane 'floor'",
    ),
    "anisotropic": (
        arm(
            geom="sphere",
            before=FLOOR,
            contact=True,
            more='<contact><pair geom1="g" geom2="floor" friction="1 .5 0 0 0"/></contact>',
        ),
        "anisotropic (sphere 'g' and plane 'floor'; give both directions one friction)",
    ),
    "override": (
        arm(geom="sphere", before=FLOOR, contact=True).replace("></option>", '><flag override="enable"/></option>'),
        "override (flag override",
    ),
    "no names": (
        world('<body><joint type="free" stiffness="1"/><geom size=".1"/></body>'),
        "stiffness (joint number 0 of body number 1; of a free joint",
    ),
    "several": (
        arm(
            option='density="1000" wind="1 0 0"',
            more='<actuator><muscle name="m" joint="j" lengthrange="0 1"/></actuator>',
        ),
        'load_mujoco(..., ignore=("actuators", "fluid")).',
    ),
    "nothing moves": (world('<geom size=".1"/>'), "the model has no joints: nothing in it moves"),
    "a rod without width": (
        world(
            '<body name="rod"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia=".1 .1 .2"/></body>',
        ),
        "body 'rod' has the principal moments of inertia (0.1, 0.1, 0.2) kg m^2, of which one is not smaller",
    ),
    "hinges alike": (
        arm().replace("<geom", '<joint name="k" axis="0 0 1"/><geom'),
        "body 'arm' has 2 hinges whose axes are not independent",
    ),
    "ball and hinge": (
        arm().replace("<geom", '<joint type="ball"/><geom'),
        "body 'arm' has a ball joint and other joints that turn it",
    ),
    "an open loop": (
        world(LINKAGE, more=CLOSED.format("coupler", "right") + '<keyframe><key qpos="1 0 0"/></keyframe>'),
        "connect 'pin' is open by",
    ),
    "not XML": ("<mujoco", "MuJoCo cannot read the XML: "),
    "no file": ("nothing.xml", "the file nothing.xml is not there. Give a path to an MJCF or URDF file, or its XML."),
}


@pytest.mark.parametrize(("xml", "message"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_represented_is_refused_by_name(xml, message):
    with refused(message):
        carom.load_mujoco(xml, keyframe=0 if "<key " in xml else None)


def test_named_kinds_are_left_out_knowingly():
    """What carom has, too: such a model moves as MuJoCo's without it."""
    xml = arm('damping="1" stiffness="2" armature="3" frictionloss="1" range="-1 1" limited="true"')
    full = carom.load_mujoco(xml).system
    assert (len(full.forces), full.n_candidates) == (2, 3)
    kinds = ("damping", "limits", "stiffness", "armature", "frictionloss")
    bare = carom.load_mujoco(xml, ignore=kinds).system
    assert (bare.forces, bare.rotors, bare.contacts) == ((), None, ())
    for wrong in (("dampings",), "dampings"):
        with refused("ignore may name actuators, tendons, stiffness") as error:
            carom.load_mujoco(xml, ignore=wrong)
        assert str(error.value).endswith("it named 'dampings'.")


def test_what_mujoco_is_told_to_leave_out_does_nothing():
    xml = arm('damping="1" range="-1 1" limited="true"').replace("<flag", '<flag limit="disable" damper="disable"')
    system = carom.load_mujoco(xml).system
    assert (system.forces, system.contacts) == ((), ())


@pytest.mark.parametrize("keyframe", ["gone", 1, -1])
def test_keyframes_that_there_are_not(keyframe):
    xml = arm(more='<keyframe><key name="up" qpos="1"/></keyframe>')
    with refused(f"keyframe must be one of 'up' or a number below 1; it was {keyframe!r}."):
        carom.load_mujoco(xml, keyframe=keyframe)


def test_without_mujoco_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with refused(
        "load_mujoco needs the package mujoco, which is not installed: pip install '.[mujoco]' in a checkout of carom."
    ):
        carom.load_mujoco("model.xml")


@pytest.mark.parametrize(
    "failure",
    ['ImportError("library 3.9\\n  for 4.0")', 'ModuleNotFoundError("library 3.9 for 4.0", name="mujoco._core")'],
)
def test_a_mujoco_that_cannot_be_imported_speaks_for_itself(tmp_path, monkeypatch, failure):
    (tmp_path / "mujoco").mkdir()
    (tmp_path / "mujoco" / "__init__.py").write_text(f"raise {failure}")
    monkeypatch.delitem(sys.modules, "mujoco")
    monkeypatch.syspath_prepend(str(tmp_path))
    with refused("the package mujoco, which is installed but cannot be imported: library 3.9 for 4.0"):
        carom.load_mujoco("model.xml")


@pytest.mark.slow
def test_the_example_of_the_documentation_works(capsys):
    page = (Path(__file__).parents[1] / "docs" / "mujoco.md").read_text()
    names: dict = {}
    exec(compile(re.findall(r"```python\n(.*?)```", page, re.S)[0], "mujoco.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "contacts (box 'crate' and sphere 'hand'; " in printed
    assert 'ignore="contacts"' in printed
    assert "('upper', 'lower', 'crate')" in printed
    touching = ("sphere 'hand' and plane 'floor'", "box 'crate' and plane 'floor'")
    assert names["model"].properties == (*touching, "limits and dry friction of joints")
    np.testing.assert_allclose(names["system"].friction, [0.6, 1.0, 0.0])
    assert names["system"].coordinate_names == ("shoulder", "elbow", *(f"crate:{k}" for k in range(6)))
    assert names["motion"].contact.any()
    assert 0.09 < names["crate"][-1, 2] < 0.12  # it has landed
    shoulder, elbow = names["angles"][-1]
    assert -0.3 < shoulder < 0.2  # it has been lifted
    assert elbow == pytest.approx(np.radians(30), abs=2e-3)
