"""What of a MuJoCo or URDF file is refused, in which words, and what may be ignored."""

import re

import numpy as np
import pytest
from systems import refused
from test_mjcf_load import OTHER, ROUNDING, arm

import carom

mujoco = pytest.importorskip("mujoco")


@pytest.fixture(autouse=True)
def _where_logs_may_be_left(tmp_path, monkeypatch):
    """MuJoCo writes what it warns of into MUJOCO_LOG.TXT, where it is."""
    monkeypatch.chdir(tmp_path)


def test_one_kind_may_be_a_string_and_the_advice_can_be_pasted():
    xml = arm('damping="1"')
    with refused('load_mujoco(..., ignore="damping").'):
        carom.load_mujoco(xml)
    assert carom.load_mujoco(xml, ignore="damping").bodies == ("arm",)


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


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (('lower="-1" upper="1"',), "limits (joint 'a'; leave out lower and upper in its <limit>)"),
        (("", '<dynamics damping="1"/>'), "damping (joint 'a'; set damping of its <dynamics> to 0)"),
        (("", '<dynamics friction="1"/>'), "frictionloss (joint 'a'; set friction of its <dynamics> to 0)"),
        (("", "", '<mimic joint="a"/>'), "equality (joint equality of joint 'b' and 'a'; leave out <mimic>)"),
    ],
)
def test_a_urdf_gets_advice_in_its_own_words(tmp_path, parts, message):
    path = tmp_path / "robot.urdf"
    path.write_text('<?xml version="1.0"?><!-- not <mujoco> -->' + two_links(*parts))
    with refused(message):
        carom.load_mujoco(path)
    assert carom.load_mujoco(two_links("")).bodies == ("one", "two")


def test_equalities_without_a_name_are_told_by_what_they_couple():
    two = arm(before=OTHER.format("box").replace("<freejoint/>", '<joint name="k"/>'))
    for equality, text in (
        ('<joint joint1="k" joint2="j"/>', "joint equality of joint 'k' and 'j'"),
        ('<joint joint1="k"/>', "joint equality of joint 'k'; use connect"),
        ('<weld body1="arm" body2="other"/>', "weld equality of body 'arm' and 'other'"),
    ):
        with refused(f"equality ({text}"):
            carom.load_mujoco(two.replace("</worldbody>", f"</worldbody><equality>{equality}</equality>"))


def test_wrong_arguments_are_told_before_what_the_model_has():
    with refused("restitution must be between 0 and 1; it was 2.0."):
        carom.load_mujoco("nothing.xml", restitution=2.0)
    with refused("the model has no keyframes: keyframe must be None; it was 'nope'."):
        carom.load_mujoco(arm('damping="1"'), keyframe="nope")
