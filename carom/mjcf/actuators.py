"""Actuators of a MuJoCo model: motors, servos, dampers and other affine ones, on joints and fixed tendons."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from carom.mechanics.forces import Actuators, Dynamics
from carom.mjcf.bodies import is_off, name_of, tendon_gears

DYNAMICS: dict[int, Dynamics] = {0: "none", 1: "integrator", 2: "filter", 3: "filter"}  # mjtDyn
JOINT, IN_PARENT, TENDON = 0, 1, 3  # mjtTrn
SCALAR = (2, 3)  # mjtJoint: slides and hinges


def unknown_actuators(model: Any) -> Bool[np.ndarray, " u"]:
    """Which actuators carom cannot represent: muscles, those of sites, of space, with a delay, and so on."""
    kinds = np.array([_gear(model, k) is not None for k in range(model.nu)], bool)
    fine = kinds & np.isin(model.actuator_dyntype, list(DYNAMICS)) & (model.actuator_gaintype <= 1)
    fine &= (model.actuator_biastype <= 1) & ~model.actuator_actearly.astype(bool) & (model.actuator_delay == 0)
    fine &= (model.actuator_damping == 0) & (model.actuator_armature == 0) & ~model.actuator_dampingpoly.any(axis=1)
    fine &= model.opt.disableactuator == 0
    if np.any(model.tendon_actfrclimited):
        fine &= model.actuator_trntype != TENDON
    return ~fine


def _gear(model: Any, k: int) -> Float[np.ndarray, " nv"] | None:
    """How far an actuator moves with each coordinate, if that is always the same."""
    kind, target, gear = int(model.actuator_trntype[k]), int(model.actuator_trnid[k, 0]), model.actuator_gear[k]
    if kind == TENDON:
        row = tendon_gears(model)[target] * gear[0]
        return row if row.any() else None
    if kind not in (JOINT, IN_PARENT):
        return None
    row, at, joint = np.zeros(model.nv), int(model.jnt_dofadr[target]), int(model.jnt_type[target])
    if joint in SCALAR:
        row[at] = gear[0]
    elif joint == 1 and kind == JOINT and not model.actuator_biasprm[k, 1]:
        row[at : at + 3] = gear[:3]
    else:
        return None
    return row


def actuators_of(mujoco: Any, model: Any) -> list[Actuators]:
    """All that carom can represent; nothing where actuation is off."""
    if is_off(mujoco, model, "ACTUATION"):
        return []
    chosen = np.flatnonzero(~unknown_actuators(model))
    if not len(chosen):
        return []
    gears = np.stack([row for k in chosen if (row := _gear(model, int(k))) is not None])

    def terms(numbers: np.ndarray, kind: np.ndarray, first: bool) -> np.ndarray:
        """Of an affine law three numbers, of a fixed one the first, of none nothing."""
        found = np.array(numbers[chosen, :3])
        found[kind[chosen] == 0, 0 if not first else 1 :] = 0
        return found

    def ranges(numbers: np.ndarray, limited: np.ndarray) -> np.ndarray:
        return np.where(np.asarray(limited, bool)[chosen, None], numbers[chosen], [-np.inf, np.inf])

    clamps = not is_off(mujoco, model, "CLAMPCTRL")
    limited = model.jnt_actfrclimited.astype(bool)
    torque = np.tile([-np.inf, np.inf], (model.nv, 1))
    for j in np.flatnonzero(limited):
        torque[int(model.jnt_dofadr[j])] = model.jnt_actfrcrange[j]
    return [
        Actuators(
            gears,
            terms(model.actuator_gainprm, model.actuator_gaintype, first=True),
            terms(model.actuator_biasprm, model.actuator_biastype, first=False),
            ranges(model.actuator_ctrlrange, model.actuator_ctrllimited & clamps),
            ranges(model.actuator_forcerange, model.actuator_forcelimited),
            ranges(model.actuator_actrange, model.actuator_actlimited),
            [DYNAMICS[int(model.actuator_dyntype[k])] for k in chosen],
            np.maximum(model.actuator_dynprm[chosen, 0], 1e-15),
            [name_of(model, "actuator", int(k)).replace("'", "") for k in chosen],
            torque if limited.any() else None,
        )
    ]
