"""Systems from MJCF and URDF files, read by the optional package `mujoco`."""

import importlib
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from carom.checks import as_floats, require
from carom.errors import CaromError
from carom.mechanics.potentials import Gravity
from carom.simulation.mujoco_bodies import bodies_of, connects_of, groups_of, joints_of, loops_of, placed, state_of
from carom.simulation.mujoco_checks import check_ignore, refusals, refuse
from carom.simulation.mujoco_contacts import contact_refusals, contacts_of, touching_pairs
from carom.system import System


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
    ignore: Collection[str] = (),
    restitution: float = 0.0,
) -> MujocoModel:
    """The system of an MJCF or URDF file, in 3D. Needs the package mujoco: `pip install 'carom[mujoco]'`.

    **Arguments:**

    - `source`: path of the file, or its XML.
    - `keyframe`: name or number of the keyframe to start from; by default, MuJoCo's reference position at rest.
    - `ignore`: kinds of elements that carom cannot represent and that are to be left out, such as `("damping",)`.
    - `restitution`: Poisson's e in [0, 1] of all contacts: MuJoCo has none.

    Bodies with free, ball, hinge and slide joints, welded bodies (merged), `connect` equalities, gravity; contacts of
    spheres, capsules and boxes with planes, and of spheres with spheres, with sliding friction. See docs/mujoco.md.

    **Raises:** `CaromError` if mujoco is missing, for files that it cannot read, an unknown keyframe, and for
    everything that carom cannot represent, by name.
    """
    check_ignore(ignore)
    mujoco = _package()
    model = _read(mujoco, source)
    reference = placed(mujoco, model, model.qpos0)
    touching = touching_pairs(mujoco, model)
    refuse([*refusals(mujoco, model), *contact_refusals(model, touching)], ignore)
    require(model.nv > 0, "the model has no joints: nothing in it moves. Give a body a freejoint, for one.")
    qpos, qvel = _start(model, keyframe)
    groups = groups_of(model, reference)
    links = joints_of(model, reference, groups)
    links += connects_of(mujoco, model, reference, groups, loops_of(mujoco, model), qpos)
    found = contacts_of(model, reference, groups, touching)
    weightless = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    system = System(
        bodies_of(model, reference, groups),
        links,
        found.contacts,
        Gravity(np.zeros(3) if weightless else np.array(model.opt.gravity)),
        found.friction or 0.0,
        restitution,
        dim=3,
    )
    x0, v0 = state_of(mujoco, model, reference, groups, qpos, qvel)
    names = tuple(group.name for group in groups.values() if group.number is not None)
    return MujocoModel(
        system, as_floats(jnp.asarray(x0)), as_floats(jnp.asarray(v0)), float(model.opt.timestep), names, found.names
    )


def _package() -> Any:
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        raise CaromError(
            "load_mujoco needs the package mujoco, which is not installed: pip install 'carom[mujoco]'."
        ) from None


def _read(mujoco: Any, source: str | os.PathLike[str]) -> Any:
    text = os.fspath(source)
    inline = "<" in text
    what = "the XML" if inline else f"the file {text}"
    require(inline or Path(text).is_file(), f"{what} is not there. Give a path to an MJCF or URDF file, or its XML.")
    try:
        return mujoco.MjModel.from_xml_string(text) if inline else mujoco.MjModel.from_xml_path(text)
    except ValueError as error:
        raise CaromError(f"MuJoCo cannot read {what}: {' '.join(str(error).split())}") from None


def _start(model: Any, keyframe: int | str | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities in MuJoCo's coordinates."""
    if keyframe is None:
        return np.array(model.qpos0), np.zeros(model.nv)
    names = [model.key(k).name for k in range(model.nkey)]
    index = names.index(keyframe) if isinstance(keyframe, str) and keyframe in names else keyframe
    require(
        isinstance(index, int | np.integer) and 0 <= index < model.nkey,
        f"keyframe must be one of {', '.join(map(repr, names)) or 'none'} or a number below {model.nkey}; it was "
        f"{keyframe!r}.",
    )
    return np.array(model.key_qpos[index]), np.array(model.key_qvel[index])
