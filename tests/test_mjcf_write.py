"""Values written back into the file that a system came from: read again they are the same, and all else stays."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from systems import refused

import carom

pytest.importorskip("mujoco")

ARM = """<?xml version="1.0"?>
<!-- an arm -->
<mujoco model="arm">
  <compiler angle="{angle}"/>
  <worldbody>
    <body name="upper"> <!-- of steel -->
      <joint name="shoulder" axis="0 1 0" damping=".5" range="{low} {high}" limited="true" frictionloss=".1"/>
      <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" contype="0" conaffinity="0"/>
      <body name="lower" pos=".3 0 0">
        <joint name="elbow" axis="0 1 0" stiffness="2" springref="{rest}" armature=".01"/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" contype="0" conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="lift" joint="shoulder" gear="3 0 0 0 0 0"/></actuator>
</mujoco>
"""


@pytest.fixture(autouse=True)
def _where_logs_may_be_left(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def changed(system):
    """Every number that has a place in the file, changed."""
    spring, damping, motors = system.forces
    spring = eqx.tree_at(lambda f: (f.stiffness, f.rest), spring, (spring.stiffness * 1.5, spring.rest * 0.5))
    damping = eqx.tree_at(lambda f: f.viscous, damping, damping.viscous * 2)
    motors = eqx.tree_at(lambda f: f.gain, motors, motors.gain * 1.25)
    limit, dry = system.contacts
    limit = eqx.tree_at(lambda c: c.bounds, limit, limit.bounds * 0.75)
    dry = eqx.tree_at(lambda c: c.loss, dry, dry.loss * 3)
    return eqx.tree_at(
        lambda s: (s.forces, s.contacts, s.rotors.inertia, s.potential.acceleration),
        system,
        ((spring, damping, motors), (limit, dry), system.rotors.inertia * 4, jnp.array([0.0, 0.0, -1.62])),
    )


@pytest.mark.parametrize("angle", ["degree", "radian"])
def test_what_is_written_is_read_again_and_all_else_stays(tmp_path, angle):
    unit = 180 / np.pi if angle == "degree" else 1.0
    source, out = tmp_path / "arm.xml", tmp_path / "learned.xml"
    source.write_text(ARM.format(angle=angle, low=-0.5 * unit, high=1.0 * unit, rest=0.3 * unit))
    wanted = changed(carom.load_mujoco(source).system)
    carom.save_mujoco(wanted, out, source=source)
    found = carom.load_mujoco(out).system
    state = wanted.state_from_joints([0.2, -0.3], [1.0, 2.0])
    control = jnp.array([0.7])
    np.testing.assert_allclose(found.acceleration(*state, control), wanted.acceleration(*state, control), atol=1e-9)
    np.testing.assert_allclose(found.gaps(state[0]), wanted.gaps(state[0]), rtol=1e-9)
    np.testing.assert_allclose(found.contacts[1].loss, [0.3])
    text = out.read_text()
    for kept in ('<?xml version="1.0"?>\n<!-- an arm -->\n<mujoco model="arm">', "<!-- of steel -->", 'gear="3.75 0 0'):
        assert kept in text
    before = source.read_text()
    carom.save_mujoco(carom.load_mujoco(source).system, source)  # nothing has changed
    assert sorted(before.split()) == sorted(source.read_text().replace(" />", "/>").split())


def test_what_has_no_place_is_told_and_nothing_is_written(tmp_path):
    source, out = tmp_path / "arm.xml", tmp_path / "learned.xml"
    source.write_text(ARM.format(angle="radian", low=-0.5, high=1.0, rest=0.3))
    system = carom.load_mujoco(source).system
    heavier = eqx.tree_at(lambda s: s.bodies[0].mass, system, system.bodies[0].mass * 2)
    with refused("bodies[0].mass differ from the file's, and have no place in it"):
        carom.save_mujoco(heavier, out, source=source)
    with refused("system must be of the structure of"):
        carom.save_mujoco(carom.System([carom.PointMass(1.0)], dim=3), out, source=source)
    source.write_text(source.read_text().replace('name="elbow" ', ""))
    nameless = carom.load_mujoco(source).system
    other = eqx.tree_at(lambda s: s.rotors.inertia, nameless, nameless.rotors.inertia * 2)
    with refused("has no element of its own called"):
        carom.save_mujoco(other, out, source=source)
    assert not out.exists()


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ('<motor name="lift" joint="shoulder" gear="3 0 0 0 0 0"/>', '<position name="lift" joint="shoulder" kp="3"/>'),
        ("<worldbody>", '<default><motor gear="100"/></default><worldbody>'),
    ],
)
def test_what_would_be_read_as_another_system_is_not_written(tmp_path, before, after):
    """A servo's gain is its stiffness too; a gear of a class is not that of the element."""
    source, out = tmp_path / "arm.xml", tmp_path / "learned.xml"
    text = ARM.format(angle="radian", low=-0.5, high=1.0, rest=0.3).replace(before, after)
    source.write_text(text.replace(' gear="3 0 0 0 0 0"', "") if "default" in after else text)
    system = carom.load_mujoco(source).system
    spring, damping, motors = system.forces
    motors = eqx.tree_at(lambda f: f.gain, motors, motors.gain.at[:, 0].multiply(1.1))
    with refused("cannot be written into"):
        carom.save_mujoco(eqx.tree_at(lambda s: s.forces, system, (spring, damping, motors)), out, source=source)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.xml"]
