"""Limits and dry friction of a MuJoCo model's joints and fixed tendons, as carom's contacts."""

from typing import Any

import numpy as np

from carom.contact.candidates import Contact
from carom.contact.joint_limits import DryFriction, JointLimit
from carom.mechanics.joints import Joints, those_of
from carom.mjcf.bodies import is_off, name_of, tendon_gears

BALL = 1  # mjtJoint


def limits_of(mujoco: Any, model: Any, joints: list[Joints], property: int) -> list[Contact]:
    """Limits, all with one contact property; by the joints of each body, as these are computed together."""
    if is_off(mujoco, model, "LIMIT") or is_off(mujoco, model, "CONSTRAINT"):
        return []
    found: list[Contact] = []
    first = 0
    for joint in joints:
        rows, bounds, sides, margins, names = [], [], [], [], []
        span = np.arange(first, first + joint.count)
        first += joint.count
        for j in np.flatnonzero(np.isin(model.jnt_dofadr, span) & np.asarray(model.jnt_limited, bool)):
            at, name = int(model.jnt_dofadr[j]) - int(span[0]), name_of(model, "joint", int(j)).replace("'", "")
            low, high = (float(bound) for bound in model.jnt_range[j])
            margin = float(model.jnt_margin[j])
            if model.jnt_type[j] == BALL:
                row = np.isin(np.arange(joint.count), range(at, at + 3))[None].astype(float)
                found.append(JointLimit(joint, row, [max(low, high)], [-1], margin, property, [name], ball=at))
                continue
            for bound, side, what in ((low, 1, "lower"), (high, -1, "upper")):
                rows.append(np.eye(joint.count)[at])
                bounds.append(bound)
                sides.append(side)
                margins.append(margin)
                names.append(f"{name} {what} limit")
        if rows:
            found.append(JointLimit(joint, rows, bounds, sides, margins, property, names))
    gears = tendon_gears(model)
    for k in np.flatnonzero(np.asarray(model.tendon_limited, bool)):
        if gears[k].any():
            used, row = those_of(joints, gears[k][None])
            low, high = (float(bound) for bound in model.tendon_range[k])
            name = name_of(model, "tendon", int(k)).replace("'", "")
            names = [f"{name} lower limit", f"{name} upper limit"]
            found.append(
                JointLimit(
                    used,
                    np.repeat(row, 2, axis=0),
                    [low, high],
                    [1, -1],
                    float(model.tendon_margin[k]),
                    property,
                    names,
                )
            )
    return found


def dry_friction_of(mujoco: Any, model: Any, joints: list[Joints], property: int) -> list[Contact]:
    """Dry friction of joints and fixed tendons."""
    if is_off(mujoco, model, "FRICTIONLOSS") or is_off(mujoco, model, "CONSTRAINT"):
        return []
    found: list[Contact] = []
    first = 0
    for joint in joints:
        loss = np.asarray(model.dof_frictionloss[first : first + joint.count])
        first += joint.count
        there = np.flatnonzero(loss)
        if len(there):
            names = [f"{joint.coordinate_names()[k]} dry friction" for k in there]
            found.append(DryFriction(joint, np.eye(joint.count)[there], loss[there], property, names))
    gears = tendon_gears(model)
    for k in np.flatnonzero(model.tendon_frictionloss):
        used, row = those_of(joints, gears[k][None])
        name = name_of(model, "tendon", int(k)).replace("'", "")
        found.append(DryFriction(used, row, [float(model.tendon_frictionloss[k])], property, [f"{name} dry friction"]))
    return found
