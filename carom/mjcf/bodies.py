"""Bodies and joints of a MuJoCo model: rigid bodies in their principal axes, and what holds them together.

`model` and `data` are MuJoCo's own `MjModel` and `MjData`; `data` is at the model's reference position (`qpos0`), where
the joints' anchors meet.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from carom.checks import require
from carom.mechanics.bodies import RigidBody, embed_pose, embed_velocity
from carom.mechanics.joints import JointKind, Joints

KINDS: tuple[JointKind, ...] = ("free", "ball", "slide", "hinge")  # mjtJoint
MEET = 1e-6
"""Axes that are nearer to each other than this (m) go through one point."""
SPHERE, BOX = 2, 6  # mjtGeom
WRAP_JOINT = 1  # mjtWrap
POINTS = 4
"""Points of a rigid body in 3D."""
NEAR = 1e-9
"""Lengths (m) and sines that are nothing but rounding."""
THINNEST = 1e-8
"""The least ratio of second moments that double precision can tell from zero."""


class Group(NamedTuple):
    """A MuJoCo body with all that is welded to it, at the reference position: one rigid body.

    `number` among carom's bodies, or `None` for the world; `place` of the centre of mass (m); `axes`, columns are the
    principal axes; `moments` about their planes (kg m^2).
    """

    number: int | None
    root: int
    name: str
    mass: float
    place: Float[np.ndarray, " 3"]
    axes: Float[np.ndarray, "3 3"]
    moments: Float[np.ndarray, " 3"]

    @property
    def first(self) -> int | None:
        """The index of its first point."""
        return None if self.number is None else POINTS * self.number

    def local(self, point: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
        """Coordinates of a point of space in the frame of the body (m)."""
        return self.axes.T @ (point - self.place)

    def directions(self, rows: Float[np.ndarray, "e 3"]) -> Float[np.ndarray, "e 3"]:
        """The same for directions."""
        return np.asarray(rows) @ self.axes


def name_of(model: Any, kind: str, index: int) -> str:
    """The name of a `body`, `geom`, `joint` and so on in quotes, or where to find one that has none."""
    name = getattr(model, kind)(index).name
    if name:
        return f"'{name}'"
    if kind == "body":
        return f"number {index}"
    owner = {"geom": "geom_bodyid", "joint": "jnt_bodyid"}.get(kind)
    where = "" if owner is None else f" of body {name_of(model, 'body', int(getattr(model, owner)[index]))}"
    return f"number {index}{where}"


def is_off(mujoco: Any, model: Any, flag: str) -> bool:
    """Whether MuJoCo itself is told to leave something out: `"LIMIT"`, `"SPRING"` and so on."""
    return bool(model.opt.disableflags & int(mujoco.mjtDisableBit.__members__[f"mjDSBL_{flag}"]))


def tendon_gears(model: Any) -> Float[np.ndarray, "t nv"]:
    """How far each tendon moves with each coordinate; zeros for tendons that go through space."""
    gears = np.zeros((model.ntendon, model.nv))
    for k in range(model.ntendon):
        for w in range(int(model.tendon_adr[k]), int(model.tendon_adr[k] + model.tendon_num[k])):
            if model.wrap_type[w] == WRAP_JOINT:
                gears[k, int(model.jnt_dofadr[int(model.wrap_objid[w])])] += model.wrap_prm[w]
    return gears


def placed(mujoco: Any, model: Any, qpos, qvel=0.0) -> Any:
    """MuJoCo's `MjData` with the places and velocities of all bodies; no more, as the rest may be singular."""
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = qpos, qvel
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    return data


def groups_of(model: Any, data: Any) -> dict[int, Group]:
    """The rigid bodies by their MuJoCo body, that is the root of what is welded together; 0 is the world.

    **Raises:** `CaromError` for bodies without extent in all three directions.
    """
    world = Group(None, 0, "world", 0.0, np.zeros(3), np.eye(3), np.zeros(3))
    groups = {0: world}
    for body in range(1, model.nbody):
        root = int(model.body_weldid[body])
        if root == body:
            groups[body] = _group(model, data, body, len(groups) - 1)
    return groups


def _group(model: Any, data: Any, root: int, number: int) -> Group:
    parts = np.flatnonzero(model.body_weldid == root)
    masses = np.array(model.body_mass[parts])
    name = name_of(model, "body", root).replace("'", "")
    require(masses.sum() > 0, f"body '{name}' has no mass: give it an <inertial> or a geom with a mass.")
    place = masses @ data.xipos[parts] / masses.sum()
    inertia = np.zeros((3, 3))
    for part, mass in zip(parts, masses, strict=True):
        turn, arm = data.ximat[part].reshape(3, 3), data.xipos[part] - place
        inertia += turn @ np.diag(model.body_inertia[part]) @ turn.T
        inertia += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    axes = _principal_axes(model, data, parts, inertia)
    principal = np.diag(axes.T @ inertia @ axes)
    moments = principal.sum() / 2 - principal  # I_x = mu_y + mu_z and so on
    shown = ", ".join(f"{value:.3g}" for value in principal)
    require(
        bool(moments.min() > THINNEST * moments.max()),
        f"body '{name}' has the principal moments of inertia ({shown}) kg m^2, of which one is not smaller than the "
        "sum of the two others: its mass is all on a line or a plane. carom's bodies extend in all three directions: "
        "give its geoms some thickness, or raise the smaller two values of its <inertial> a little (1e-4 of the "
        "largest).",
    )
    return Group(number, root, name, float(masses.sum()), place, axes, moments)


def _principal_axes(model: Any, data: Any, parts, inertia: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    """Principal axes: those of a box or of the body's own frame, if they are principal, else of the inertia alone."""
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, parts))
    boxes = [geom for geom in geoms if model.geom_type[geom] == BOX]
    frames = [data.geom_xmat[geom] for geom in boxes] + [data.xmat[parts[0]], data.ximat[parts[0]]]
    for frame in frames:
        turn = frame.reshape(3, 3)
        turned = turn.T @ inertia @ turn
        if np.abs(turned - np.diag(np.diag(turned))).max() < NEAR * np.trace(inertia):
            return turn.copy()
    axes = np.linalg.eigh(inertia)[1]
    return axes * np.array([1, 1, np.linalg.det(axes)])


def bodies_of(model: Any, data: Any, groups: dict[int, Group]) -> list[RigidBody]:
    """carom's bodies, with the radius of a sphere at their centre of mass, if there is one."""
    return [
        RigidBody(group.mass, jnp.asarray(group.moments), _radius(model, data, group))
        for group in groups.values()
        if group.number is not None
    ]


def _radius(model: Any, data: Any, group: Group) -> float:
    own = np.flatnonzero((model.body_weldid[model.geom_bodyid] == group.root) & (model.geom_type == SPHERE))
    centered = [g for g in own if np.linalg.norm(data.geom_xpos[g] - group.place) < NEAR]
    return max((float(model.geom_size[g, 0]) for g in centered), default=0.0)


def state_of(
    mujoco: Any, model: Any, reference: Any, groups: dict[int, Group], qpos, qvel
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Positions and velocities of carom's points where MuJoCo has `qpos` and `qvel`."""
    data = placed(mujoco, model, qpos, qvel)
    x, v, rates = [], [], np.zeros(6)
    for group in groups.values():
        if group.number is None:
            continue
        before, now = (part.xmat[group.root].reshape(3, 3) for part in (reference, data))
        turn = now @ before.T
        arm = turn @ (group.place - reference.xpos[group.root])
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, group.root, rates, 0)
        omega, velocity = rates[:3].copy(), rates[3:] + np.cross(rates[:3], arm)
        axes = jnp.asarray(turn @ group.axes)
        x.append(embed_pose(jnp.asarray(data.xpos[group.root] + arm), axes))
        v.append(embed_velocity(axes, jnp.asarray(velocity), jnp.asarray(omega)))
    return np.concatenate(x), np.concatenate(v)


# --- joints ---------------------------------------------------------------------------------------


def joints_of(model: Any, data: Any, groups: dict[int, Group]) -> list[Joints]:
    """The joints between each body and its parent, in the order of MuJoCo's degrees of freedom.

    **Raises:** `CaromError` for joints of one body that are not up to three slides and three hinges, or a ball.
    """
    found = []
    for group in groups.values():
        if group.number is not None:
            parent = groups[int(model.body_weldid[model.body_parentid[group.root]])]
            start = int(model.body_jntadr[group.root])
            found.append(_joints(model, data, group, parent, range(start, start + int(model.body_jntnum[group.root]))))
    return found


def _joints(model: Any, data: Any, group: Group, parent: Group, joints: Sequence[int]) -> Joints:
    assert group.first is not None
    kinds: list[JointKind] = [KINDS[int(model.jnt_type[joint])] for joint in joints]
    hinges, balls = (kinds.count(kind) for kind in ("hinge", "ball"))
    for kind, most in (("hinge", 3), ("slide", 3), ("ball", 1)):
        rows = np.array([data.xaxis[j] for j, k in zip(joints, kinds, strict=True) if k == kind])
        require(
            len(rows) <= most
            and (kind == "ball" or len(rows) < 2 or np.linalg.matrix_rank(rows, tol=1e-6) == len(rows)),
            f"body '{group.name}' has {len(rows)} {kind}s whose axes are not independent. Remove those that add no "
            "freedom.",
        )
    require(
        not (balls and hinges),
        f"body '{group.name}' has a ball joint and other joints that turn it. Remove these: a ball joint "
        "allows all rotations.",
    )
    turning = [data.xanchor[j] for j, kind in zip(joints, kinds, strict=True) if kind != "slide"]
    point = turning[0] if turning else group.place
    meet = bool(np.ptp(turning, axis=0).max() < MEET) if turning else True
    anchors = [point if kind == "slide" or meet else data.xanchor[j] for j, kind in zip(joints, kinds, strict=True)]
    rest, near = [], []
    for joint, kind in zip(joints, kinds, strict=True):
        at = int(model.jnt_qposadr[joint])
        if kind in ("hinge", "slide"):
            rest.append(float(model.qpos0[at]))
            near.append(float(np.mean(model.jnt_range[joint])) if model.jnt_limited[joint] else rest[-1])
        else:
            values = [0.0] * 3 if kind == "ball" else [*map(float, model.qpos0[at : at + 3]), 0.0, 0.0, 0.0]
            rest, near = rest + values, near + values
    return Joints(
        group.first,
        parent.first,
        kinds,
        group.directions(data.xaxis[list(joints)]),
        [group.local(anchor) for anchor in anchors],
        parent.local(anchors[0]),
        parent.axes.T @ group.axes,
        rest,
        near,
        data.xmat[group.root].reshape(3, 3).T @ group.axes,
        [name_of(model, "joint", joint).replace("'", "") for joint in joints],
    )
