"""Forces of a MuJoCo model: springs, damping, armature, gravity compensation, fluids, and what fixed tendons do."""

from typing import Any

import numpy as np

from carom.mechanics.forces import Force, InertiaBoxFluid, JointDamping, JointSpring, PointForce, Rotors
from carom.mjcf.bodies import Group, is_off, tendon_gears

BALL, SLIDE = 1, 2  # mjtJoint


def springs_of(mujoco: Any, model: Any) -> list[Force]:
    """Springs and damping of joints and of fixed tendons."""
    found: list[Force] = []
    if not is_off(mujoco, model, "SPRING"):
        stiffness, rest = np.zeros(model.nv), np.zeros(model.nv)
        more = np.zeros((2, model.nv))
        for j in range(model.njnt):
            if model.jnt_type[j] >= SLIDE or model.jnt_type[j] == BALL:
                width = 3 if model.jnt_type[j] == BALL else 1
                at = slice(int(model.jnt_dofadr[j]), int(model.jnt_dofadr[j]) + width)
                stiffness[at], more[:, at] = model.jnt_stiffness[j], model.jnt_stiffnesspoly[j][:, None]
                rest[at] = 0 if width == 3 else model.qpos_spring[model.jnt_qposadr[j]]
        if stiffness.any() or more.any():
            found.append(JointSpring(stiffness, rest, 0.0, more[0], more[1]))
        some = np.flatnonzero(np.any([model.tendon_stiffness, *model.tendon_stiffnesspoly.T], axis=0))
        if len(some):
            low, high = model.tendon_lengthspring[some].T
            more = model.tendon_stiffnesspoly[some].T
            gears = tendon_gears(model)[some]
            found.append(
                JointSpring(model.tendon_stiffness[some], (low + high) / 2, (high - low) / 2, more[0], more[1], gears)
            )
    if not is_off(mujoco, model, "DAMPER"):
        if model.dof_damping.any() or model.dof_dampingpoly.any():
            found.append(JointDamping(model.dof_damping, model.dof_dampingpoly[:, 0], model.dof_dampingpoly[:, 1]))
        some = np.flatnonzero(np.any([model.tendon_damping, *model.tendon_dampingpoly.T], axis=0))
        if len(some):
            more = model.tendon_dampingpoly[some].T
            found.append(JointDamping(model.tendon_damping[some], more[0], more[1], tendon_gears(model)[some]))
    return found


def rotors_of(model: Any) -> Rotors | None:
    """Armature of joints and of fixed tendons."""
    gears, inertia = [*np.eye(model.nv)[model.dof_armature > 0]], [*model.dof_armature[model.dof_armature > 0]]
    for k in np.flatnonzero(model.tendon_armature):
        gears.append(tendon_gears(model)[k])
        inertia.append(model.tendon_armature[k])
    return Rotors(np.array(gears), np.array(inertia)) if gears else None


def carried(mujoco: Any, model: Any, data: Any, groups: dict[int, Group]) -> list[Force]:
    """What carries the bodies with gravity compensation; `data` is at the reference position."""
    if is_off(mujoco, model, "GRAVITY"):
        return []
    found: list[Force] = []
    for body in np.flatnonzero(model.body_gravcomp):
        group = groups[int(model.body_weldid[body])]
        if group.first is not None:
            force = -model.body_mass[body] * model.body_gravcomp[body] * np.array(model.opt.gravity)
            found.append(PointForce(group.first, group.local(data.xipos[body]), force))
    return found


def fluid_of(model: Any, data: Any, groups: dict[int, Group]) -> list[Force]:
    """Forces of the medium on each body that moves."""
    density, viscosity = float(model.opt.density), float(model.opt.viscosity)
    if not (density or viscosity):
        return []
    found: list[Force] = []
    for body in range(1, model.nbody):
        group, mass = groups[int(model.body_weldid[body])], float(model.body_mass[body])
        if group.first is None or mass < 1e-15:
            continue
        moments = np.array(model.body_inertia[body])
        box = np.sqrt(np.maximum(moments.sum() - 2 * moments, 1e-15) / mass * 6)
        axes = data.ximat[body].reshape(3, 3).T @ group.axes
        place = group.local(data.xipos[body])
        found.append(InertiaBoxFluid(group.first, place, axes, box, density, viscosity))
    return found
