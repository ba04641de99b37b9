"""Equalities of a MuJoCo model: ends that stay together, bodies that are welded, and coordinates that are coupled."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from carom.checks import require
from carom.mechanics.constraints import Angles, Constraint, Joint, Pivot, Track, place_weights
from carom.mechanics.joints import Coupling, Joints
from carom.mjcf.bodies import Group, is_off, name_of, placed, tendon_gears


def across_rows(rows: Float[np.ndarray, "k 3"]) -> Float[np.ndarray, "e 3"]:
    """Unit directions at right angles to `rows` and to each other."""
    return np.eye(3) if len(rows) == 0 else np.linalg.svd(rows)[2][len(rows) :]


def _active(mujoco: Any, model: Any, kind: str) -> list[int]:
    """The equalities of a kind that act at the start."""
    if is_off(mujoco, model, "EQUALITY") or is_off(mujoco, model, "CONSTRAINT"):
        return []
    wanted = int(mujoco.mjtEq.__members__[f"mjEQ_{kind}"])
    return [k for k in range(model.neq) if model.eq_type[k] == wanted and model.eq_active0[k]]


def couplings_of(mujoco: Any, model: Any, joints: list[Joints]) -> list[Constraint]:
    """`joint` and `tendon` equalities: one coordinate, or length, as a polynomial of another."""
    found: list[Constraint] = []
    rest = np.concatenate([np.asarray(joint.rest) for joint in joints])
    for kind in ("JOINT", "TENDON"):
        rows = np.eye(model.nv)[model.jnt_dofadr] if kind == "JOINT" else tendon_gears(model)
        for k in _active(mujoco, model, kind):
            first, second = rows[model.eq_obj1id[k]], np.zeros(model.nv)
            other = int(model.eq_obj2id[k])
            if other >= 0:
                second = rows[other]
            if not (first.any() or second.any()):
                continue  # of tendons that are left out
            zeros = first @ rest, second @ rest
            found.append(Coupling.of(joints, first, second, model.eq_data[k, :5], zeros))
    return found


def welds_of(mujoco: Any, model: Any, reference: Any, groups: dict[int, Group]) -> list[Constraint]:
    """`weld` equalities: two bodies as one."""
    found: list[Constraint] = []
    for k in _active(mujoco, model, "WELD"):
        ends = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        name = name_of(model, "equality", k)
        if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
            bodies = [int(model.site_bodyid[s]) for s in ends]
            frames = [(reference.xmat[b].reshape(3, 3), reference.xpos[b]) for b in bodies]
            turns, places = [], []
            for site, (turn, place) in zip(ends, frames, strict=True):
                own = np.zeros(9)
                mujoco.mju_quat2Mat(own, model.site_quat[site])
                turns.append(turn @ own.reshape(3, 3))
                places.append(place + turn @ model.site_pos[site])
        else:
            # The frame of the second in the first: `relpose`; the anchor is a point of the second.
            bodies = list(ends)
            (first, origin), (second, at) = ((reference.xmat[b].reshape(3, 3), reference.xpos[b]) for b in bodies)
            own, data = np.zeros(9), np.array(model.eq_data[k])
            mujoco.mju_quat2Mat(own, data[6:10])
            turns = [first @ own.reshape(3, 3), second]
            places = [origin + first @ (data[3:6] + own.reshape(3, 3) @ data[:3]), at + second @ data[:3]]
        welded = [groups[int(model.body_weldid[b])] for b in bodies]
        if welded[0].first is None:
            welded, turns, places = welded[::-1], turns[::-1], places[::-1]
        body, other = welded
        require(
            body.first is not None and body is not other,
            f"weld {name} holds what is held already. Remove it.",
        )
        assert body.first is not None
        # Where the frames are one: directions of the first in the frame of each body.
        own, others = body.directions(turns[0].T), other.directions(np.roll(turns[1].T, -1, axis=0))
        weights = place_weights(body.local(places[0]))
        if other.first is None:
            found.append(Joint(body.first, weights, places[1]))
        else:
            found.append(Pivot(body.first, weights, other.first, place_weights(other.local(places[1]))))
        found.append(Angles(body.first, own, others, 0.0, other.first))
    return found


class Loop(NamedTuple):
    """A `connect` equality: MuJoCo bodies, and where it holds each in its own frame (m)."""

    name: str
    bodies: tuple[int, int]
    places: tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]


def loops_of(mujoco: Any, model: Any) -> list[Loop]:
    """The `connect` equalities that act at the start."""
    found = []
    for k in _active(mujoco, model, "CONNECT"):
        ends = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        if model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE:
            first, second = (np.array(model.site_pos[s]) for s in ends)
            ends = int(model.site_bodyid[ends[0]]), int(model.site_bodyid[ends[1]])
        else:
            first, second = np.array(model.eq_data[k, :3]), np.array(model.eq_data[k, 3:6])
        if model.body_weldid[ends[0]] == 0:  # the world, if any, comes second
            ends, first, second = (ends[1], ends[0]), second, first
        found.append(Loop(name_of(model, "equality", k), ends, (first, second)))
    return found


def connects_of(
    mujoco: Any, model: Any, reference: Any, groups: dict[int, Group], loops: list[Loop], qpos
) -> list[Constraint]:
    """`connect` equalities, without the equations that follow from the others.

    In a plane linkage of hinges, a loop closes in the plane alone: the third equation of a pivot would follow. Which
    do is seen in MuJoCo's joint coordinates, at the start and near it.

    **Raises:** `CaromError` where the ends are apart, nothing is left, or the start is a position of its own kind.
    """
    moved = np.array(qpos)
    mujoco.mj_integratePos(model, moved, np.random.default_rng(0).uniform(0.01, 0.02, model.nv), 1.0)
    start, near = placed(mujoco, model, qpos), placed(mujoco, model, moved)
    rows, rows_near, found = np.zeros((0, model.nv)), np.zeros((0, model.nv)), []
    for loop in loops:
        welds = [groups[int(model.body_weldid[b])] for b in loop.bodies]
        places = [
            reference.xpos[b] + reference.xmat[b].reshape(3, 3) @ c
            for b, c in zip(loop.bodies, loop.places, strict=True)
        ]
        mine, normals, gap = _relative(mujoco, model, start, loop, rows)
        require(
            gap < 1e-5,
            f"connect {loop.name} is open by {gap:.3g} m at the start: give a keyframe at which its ends meet.",
        )
        mine_near, normals_near, _ = _relative(mujoco, model, near, loop, rows_near)
        left_out = across_rows(normals)
        require(
            len(normals) > 0 and bool(np.abs(normals_near @ left_out.T).max(initial=0) < 1e-6),
            f"connect {loop.name} holds what is held already, or the start is a singular position of its loop (a "
            "linkage that is stretched out, say). Remove it, or start elsewhere with a keyframe.",
        )
        rows, rows_near = np.concatenate([rows, mine]), np.concatenate([rows_near, mine_near])
        found.append(_closed(welds, places, normals, loop, reference))
    return found


def _relative(mujoco: Any, model: Any, data: Any, loop: Loop, rows):
    """What a `connect` adds to the equations `rows` (k, nv): its own, their directions in the frame of the second body.

    Also how far its ends are apart (m).
    """
    ends, jacobians = [], []
    for body, place in zip(loop.bodies, loop.places, strict=True):
        ends.append(data.xpos[body] + data.xmat[body].reshape(3, 3) @ place)
        jacobians.append(np.zeros((3, model.nv)))
        mujoco.mj_jac(model, data, jacobians[-1], None, ends[-1], body)
    frame = data.xmat[loop.bodies[1]].reshape(3, 3)
    mine = frame.T @ (jacobians[0] - jacobians[1])
    left = mine - mine @ np.linalg.pinv(rows, rcond=1e-7) @ rows
    directions, sizes, _ = np.linalg.svd(left)
    kept = directions.T[: len(sizes)][sizes > 1e-7 * max(float(np.abs(mine).max()), 1e-12)]
    return kept @ mine, kept, float(np.linalg.norm(ends[0] - ends[1]))


def _closed(welds: list[Group], places, normals, loop: Loop, reference: Any) -> Constraint:
    body, other = welds
    assert body.first is not None
    weights = place_weights(body.local(places[0]))
    if len(normals) == 3:
        if other.first is None:
            return Joint(body.first, weights, places[1])
        return Pivot(body.first, weights, other.first, place_weights(other.local(places[1])))
    turn = reference.xmat[loop.bodies[1]].reshape(3, 3)
    return Track(body.first, weights, other.directions(normals @ turn.T), other.local(places[1]), other.first)
