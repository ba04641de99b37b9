"""Systems from MJCF and URDF files, read by the optional package `mujoco`."""

import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, is_share, optional_package, require, require_values
from carom.errors import CaromError
from carom.mechanics.potentials import Gravity
from carom.mjcf.actuators import actuators_of
from carom.mjcf.bodies import bodies_of, groups_of, is_off, joints_of, placed, state_of
from carom.mjcf.contacts import contact_refusals, contacts_of, fix_mocap, touching_pairs
from carom.mjcf.equalities import connects_of, couplings_of, loops_of, welds_of
from carom.mjcf.forces import carried, fluid_of, rotors_of, springs_of
from carom.mjcf.limits import dry_friction_of, limits_of
from carom.mjcf.refusals import check_ignore, refusals, refuse
from carom.system import System

ACTUATION = 1 << 11
"""mjDSBL_ACTUATION"""


class MujocoModel(NamedTuple):
    """A system from a file: `system`, its start `x0`, `v0` (n, d) in m and m/s, and the file's time step `dt` (s).

    `bodies` are the names of its bodies, `properties` those of its contact properties (two geoms each), in the order of
    `system.friction`.
    """

    system: System
    x0: Float[Array, "n d"]
    v0: Float[Array, "n d"]
    dt: float
    bodies: tuple[str, ...]
    properties: tuple[str, ...]


def load_mujoco(
    source: str | os.PathLike[str],
    *,
    keyframe: int | str | None = None,
    ignore: str | Collection[str] = (),
    restitution: float = 0.0,
) -> MujocoModel:
    """The system of an MJCF or URDF file, in 3D. Needs the package mujoco: `pip install '.[mujoco]'`.

    **Arguments:**

    - `source`: path of the file, or its XML.
    - `keyframe`: name or number of the keyframe to start from; by default, MuJoCo's reference position at rest.
    - `ignore`: a kind of elements that are to be left out, such as `"contacts"`, or several: what carom cannot
      represent, or what it can, such as `"damping"`. A mocap body that is ignored stays where it is.
    - `restitution`: Poisson's e in [0, 1] of all contacts: MuJoCo has none.

    Bodies with free, ball, hinge and slide joints, their limits, springs, damping, armature and dry friction; fixed
    tendons, actuators, equalities; gravity and fluids; contacts of spheres, capsules and boxes with planes, and of
    spheres with spheres, with sliding friction. See docs/mujoco.md.

    **Raises:** `CaromError` if mujoco is missing, for files that it cannot read, an unknown keyframe, and for
    everything that carom cannot represent, by name.
    """
    ignored = (ignore,) if isinstance(ignore, str) else tuple(ignore)
    check_ignore(ignored)
    given = as_floats(restitution)
    require_values("restitution", given, is_share, "between 0 and 1")
    mujoco = optional_package("mujoco", "load_mujoco", "mujoco")
    model = _read(mujoco, source)
    qpos, qvel = _start(model, keyframe)
    touching = touching_pairs(mujoco, model)
    if "mocap" in ignored:
        touching = fix_mocap(model, touching)
    urdf = is_urdf(source)
    refuse([*refusals(mujoco, model), *contact_refusals(model, touching, urdf=urdf)], ignored)
    free = "joint of type floating" if urdf else "freejoint"
    require(model.nv > 0, f"the model has no joints: nothing in it moves. Give a body a {free}, for one.")
    _leave_out(model, ignored)
    reference = placed(mujoco, model, model.qpos0)
    groups = groups_of(model, reference)
    joints = joints_of(model, reference, groups)
    links = [*joints, *welds_of(mujoco, model, reference, groups), *couplings_of(mujoco, model, joints)]
    links += connects_of(mujoco, model, reference, groups, loops_of(mujoco, model), qpos)
    found = contacts_of(model, reference, groups, touching)
    # Limits and dry friction have one more contact property: without friction and rebound.
    last, frictions = len(found.friction), list(found.friction)
    inner = [*limits_of(mujoco, model, joints, last), *dry_friction_of(mujoco, model, joints, last)]
    names = found.names
    if inner:
        frictions, names = [*frictions, 0.0], (*names, "limits and dry friction of joints")
    system = System(
        bodies_of(model, reference, groups),
        links,
        [*found.contacts, *inner],
        Gravity(np.zeros(3) if is_off(mujoco, model, "GRAVITY") else np.array(model.opt.gravity)),
        frictions or 0.0,
        [restitution] * last + [0.0] * bool(inner) if frictions else restitution,
        forces=[
            *springs_of(mujoco, model),
            *carried(mujoco, model, reference, groups),
            *fluid_of(model, reference, groups),
            *actuators_of(mujoco, model),
        ],
        rotors=rotors_of(model),
        dim=3,
    )
    x0, v0 = state_of(mujoco, model, reference, groups, qpos, qvel)
    bodies = tuple(group.name for group in groups.values() if group.number is not None)
    return MujocoModel(
        system, as_floats(jnp.asarray(x0)), as_floats(jnp.asarray(v0)), float(model.opt.timestep), bodies, names
    )


def _leave_out(model: Any, ignored: Collection[str]) -> None:
    """Take from the model what carom could represent, but is not to."""
    fields = {
        "stiffness": ("jnt_stiffness", "jnt_stiffnesspoly", "tendon_stiffness", "tendon_stiffnesspoly"),
        "damping": ("dof_damping", "dof_dampingpoly", "tendon_damping", "tendon_dampingpoly"),
        "armature": ("dof_armature", "tendon_armature"),
        "frictionloss": ("dof_frictionloss", "tendon_frictionloss"),
        "limits": ("jnt_limited", "tendon_limited"),
        "gravcomp": ("body_gravcomp",),
        "equality": ("eq_active0",),
    }
    for kind in ignored:
        for field in fields.get(kind, ()):
            getattr(model, field)[:] = 0
    if "margin" in ignored:
        model.geom_margin[:] = model.pair_margin[:] = 0
    if "fluid" in ignored:
        model.opt.density = model.opt.viscosity = 0.0
    if "actuators" in ignored:
        model.opt.disableflags |= ACTUATION
    if "tendons" in ignored:
        for field in ("stiffness", "stiffnesspoly", "damping", "dampingpoly", "armature", "frictionloss", "limited"):
            getattr(model, f"tendon_{field}")[:] = 0


def _read(mujoco: Any, source: str | os.PathLike[str]) -> Any:
    text = os.fspath(source)
    inline = "<" in text
    what = "the XML" if inline else f"the file {text}"
    require(inline or Path(text).is_file(), f"{what} is not there. Give a path to an MJCF or URDF file, or its XML.")
    try:
        return mujoco.MjModel.from_xml_string(text) if inline else mujoco.MjModel.from_xml_path(text)
    except ValueError as error:
        raise CaromError(f"MuJoCo cannot read {what}: {' '.join(str(error).split())}") from None


def whole_xml(path: str | os.PathLike[str]) -> bytes:
    """An MJCF or URDF file as one MJCF text, with all that it includes.

    **Raises:** `CaromError` if mujoco is missing, and for files that it cannot read.
    """
    mujoco = optional_package("mujoco", "load_mujoco", "mujoco")
    try:
        spec = mujoco.MjSpec.from_file(os.fspath(path))
        spec.compile()
        folder = Path(path).resolve().parent
        spec.meshdir, spec.texturedir = (str(folder / (own or "")) for own in (spec.meshdir, spec.texturedir))
        return spec.to_xml().encode()
    except (ValueError, RuntimeError) as error:
        raise CaromError(f"MuJoCo cannot read the file {path}: {' '.join(str(error).split())}") from None


def is_urdf(source: str | os.PathLike[str]) -> bool:
    """Whether the first element is a URDF's; MuJoCo has read it before."""
    text = os.fspath(source)
    content = text if "<" in text else Path(text).read_text(errors="replace")
    first = re.search(r"<\s*([A-Za-z]\w*)", re.sub(r"<!--.*?-->", "", content, flags=re.DOTALL))
    return first is not None and first[1] == "robot"


def _start(model: Any, keyframe: int | str | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities in MuJoCo's coordinates; mocap bodies, which have none, are put where they start."""
    if keyframe is None:
        return np.array(model.qpos0), np.zeros(model.nv)
    require(model.nkey > 0, f"the model has no keyframes: keyframe must be None; it was {keyframe!r}.")
    names = [model.key(k).name for k in range(model.nkey)]
    index = names.index(keyframe) if isinstance(keyframe, str) and keyframe in names else keyframe
    require(
        isinstance(index, int | np.integer) and 0 <= index < model.nkey,
        f"keyframe must be one of {', '.join(map(repr, names))} or a number below {model.nkey}; it was {keyframe!r}.",
    )
    mocap = np.asarray(model.body_mocapid)
    moved = mocap >= 0
    model.body_pos[moved] = model.key_mpos[index].reshape(-1, 3)[mocap[moved]]
    model.body_quat[moved] = model.key_mquat[index].reshape(-1, 4)[mocap[moved]]
    return np.array(model.key_qpos[index]), np.array(model.key_qvel[index])
