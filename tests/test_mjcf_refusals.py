"""What of a MuJoCo or URDF file is refused, in which words, and what may be ignored."""

import re

import numpy as np
import pytest
from systems import refused
from test_mjcf_load import ROUNDING, arm

import carom

mujoco = pytest.importorskip("mujoco")


@pytest.fixture(autouse=True)
def _where_logs_may_be_left(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into MUJOCO_LOG.TXT, where it is."""
    monkeypatch.chdir(tmp_path)


def test_one_kind_may_be_a_string_and_the_advice_can_be_pasted():
    xml = arm(more='<actuator><muscle name="m" joint="j" lengthrange="0 1"/></actuator>')
    with refused('load_mujoco(..., ignore="actuators").'):
        carom.load_mujoco(xml)
    assert carom.load_mujoco(xml, ignore="actuators").bodies == ("arm",)


MOCAP = """<mujoco><option timestep="0.002"/><worldbody><geom name="floor" type="plane" size="1 1 1"/>
    <body name="hand" mocap="true" pos="0 0 1"><geom name="palm" size=".1"/>
      <body name="finger" pos="0 0 .1"><geom name="tip" size=".1"/></body>
      <body name="bob" pos="0 0 -.4"><joint name="j" axis="0 1 0" pos="0 0 .4"/><geom name="b" size=".05"/></body>
    </body>
    <body name="ball" pos="1 0 .1"><freejoint/><geom name="g" size=".1"/></body></worldbody>
    <keyframe><key name="moved" mpos="0 .5 2" mquat="1 0 0 1" qpos=".3 1 0 .1 1 0 0 0"/></keyframe></mujoco>"""


@pytest.mark.parametrize("keyframe", [None, "moved"])
def test_a_mocap_body_that_is_ignored_stays_where_it_is(keyframe):
    """As in MuJoCo, where nobody moves it: places, the joint on it, and which geoms can touch."""
    loaded = carom.load_mujoco(MOCAP, ignore="mocap", keyframe=keyframe)
    assert loaded.bodies == ("bob", "ball")
    model = mujoco.MjModel.from_xml_string(MOCAP)
    data = mujoco.MjData(model)
    if keyframe is not None:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(loaded.x0[::4], data.xipos[[3, 4]], atol=ROUNDING)
    np.testing.assert_allclose(loaded.system.constraints(loaded.x0), 0, atol=ROUNDING)
    large = mujoco.MjModel.from_xml_string(re.sub(r'size="\.\d+"', 'size="3"', MOCAP))
    data = mujoco.MjData(large)  # all geoms overlap: its contacts are all that can be
    mujoco.mj_forward(large, data)
    pairs = {frozenset(large.geom(int(g)).name for g in contact.geom) for contact in data.contact}
    assert pairs == {frozenset(name.split("'")[1::2]) for name in loaded.properties}
    assert frozenset(("b", "palm")) not in pairs  # parent and child


def two_links(limit: str, dynamics: str = "", mimic: str = "") -> str:
    """A URDF of two links."""
    link = """<link name="{}"><inertial><mass value="1"/>
        <inertia ixx=".03" iyy=".03" izz=".03" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    return f"""<robot name="r"><link name="base"/>{link.format("one")}{link.format("two")}
        <joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
          <limit {limit} effort="1" velocity="1"/>{dynamics}</joint>
        <joint name="b" type="continuous"><parent link="base"/><child link="two"/><axis xyz="0 1 0"/>{mimic}</joint>
        </robot>"""


def test_a_urdf_has_limits_damping_friction_and_mimic(tmp_path):
    path = tmp_path / "robot.urdf"
    dynamics, mimic = '<dynamics damping="2" friction="3"/>', '<mimic joint="a" multiplier="2" offset=".1"/>'
    path.write_text('<?xml version="1.0"?><!-- not <mujoco> -->' + two_links('lower="-1" upper=".5"', dynamics, mimic))
    system = carom.load_mujoco(path).system
    limit, dry = system.contacts
    np.testing.assert_allclose(limit.bounds, [-1, 0.5])
    np.testing.assert_allclose(dry.loss, [3])
    np.testing.assert_allclose(system.forces[0].viscous, [2, 0])
    np.testing.assert_allclose(system.constraints(system.state_from_joints([0.3, 0.7])[0]), 0, atol=ROUNDING)
    assert np.abs(system.constraints(system.state_from_joints([0.3, 0.6])[0])).max() > 0.05


def test_wrong_arguments_are_told_before_what_the_model_has():
    with refused("restitution must be between 0 and 1; it was 2.0."):
        carom.load_mujoco("nothing.xml", restitution=2.0)
    with refused("the model has no keyframes: keyframe must be None; it was 'nope'."):
        carom.load_mujoco(arm(), keyframe="nope")
