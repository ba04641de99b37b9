"""What a MuJoCo model may have that carom cannot represent: found, and refused by name."""

from collections.abc import Callable, Collection, Iterable
from typing import Any, NamedTuple

import numpy as np

from carom.checks import require
from carom.mjcf.actuators import unknown_actuators
from carom.mjcf.bodies import WRAP_JOINT, name_of

SHOWN = 3
"""How many names of one kind an error gives."""


class Refused(NamedTuple):
    """Elements of one kind that cannot be represented, and what to do about them."""

    kind: str
    names: tuple[str, ...]
    advice: str

    def __str__(self) -> str:
        more = "" if len(self.names) <= SHOWN else f" and {len(self.names) - SHOWN} more"
        return f"{self.kind} ({', '.join(self.names[:SHOWN])}{more}; {self.advice})"


def _of(kind: str, element: str, advice: str, which: Callable[[Any], Any]):
    """A rule: the elements (`joint`, `body`, ...) where `which(model)` is true."""

    def find(mujoco: Any, model: Any) -> Refused:
        chosen = np.flatnonzero(np.asarray(which(model)))
        return Refused(kind, tuple(f"{element} {name_of(model, element, int(k))}" for k in chosen), advice)

    return find


def _nonzero(*fields) -> np.ndarray:
    """Whether an element has a value that is not zero in one of these fields, (elements,) or (elements, values)."""
    return np.any(np.column_stack(fields), axis=1)


def _spatial(model: Any) -> np.ndarray:
    """Tendons that go through space, or plastic ones."""
    found = np.array(model.tendon_springyield, float) != 0
    for k in range(model.ntendon):
        wraps = slice(int(model.tendon_adr[k]), int(model.tendon_adr[k] + model.tendon_num[k]))
        found[k] |= bool(np.any(model.wrap_type[wraps] != WRAP_JOINT))
    return found


def _equalities(mujoco: Any, model: Any) -> Refused:
    kinds = {int(value): name.removeprefix("mjEQ_").lower() for name, value in mujoco.mjtEq.__members__.items()}
    known = [int(mujoco.mjtEq.__members__[f"mjEQ_{name}"]) for name in ("CONNECT", "WELD", "JOINT", "TENDON")]
    other = ~np.isin(model.eq_type, known) & np.asarray(model.eq_active0, bool)
    names = tuple(_equality(mujoco, model, kinds[int(model.eq_type[k])], int(k)) for k in np.flatnonzero(other))
    return Refused("equality", names, "carom has connect, weld, and those of joints and fixed tendons")


def _equality(mujoco: Any, model: Any, kind: str, k: int) -> str:
    """An equality by its name, or else by what it couples."""
    site = model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE
    what = {"weld": "site" if site else "body", "joint": "joint", "tendon": "tendon"}.get(kind)
    if model.equality(k).name or what is None:
        return f"{kind} {name_of(model, 'equality', k)}"
    ends = [name_of(model, what, int(end[k])) for end in (model.eq_obj1id, model.eq_obj2id) if end[k] >= 0]
    return f"{kind} equality of {what} {' and '.join(ends)}"


def _options(mujoco: Any, model: Any) -> Refused:
    if not (model.opt.density or model.opt.viscosity):
        return Refused("fluid", (), "")
    shaped = np.flatnonzero(np.asarray(model.geom_fluid)[:, 0])
    names = [f"geom {name_of(model, 'geom', int(g))}" for g in shaped] + ["wind"] * bool(np.any(model.opt.wind))
    return Refused("fluid", tuple(names), "carom has a medium at rest that acts on inertia boxes: leave out fluidshape")


def _override(mujoco: Any, model: Any) -> Refused:
    on = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    return Refused("override", ("flag override",) if on else (), "set friction by geom or pair")


def _count(kind: str, field: str, advice: str):
    def find(mujoco: Any, model: Any) -> Refused:
        number = int(getattr(model, field))
        return Refused(kind, (f"{number} of them",) if number else (), advice)

    return find


def _springs(mujoco: Any, model: Any) -> np.ndarray:
    """Joints whose springs carom has not: those of what is free, balls that rest elsewhere, and those that yield."""
    there = _nonzero(model.jnt_stiffness, model.jnt_stiffnesspoly)
    kind, start = np.asarray(model.jnt_type), np.asarray(model.jnt_qposadr)
    moved = [
        k == BALL_JOINT and not np.array_equal(model.qpos_spring[a : a + 4], model.qpos0[a : a + 4])
        for k, a in zip(kind, start, strict=True)
    ]
    curved = (kind == BALL_JOINT) & _nonzero(model.jnt_stiffnesspoly)
    return there & ((kind == FREE_JOINT) | curved | np.array(moved, bool) | (np.asarray(model.jnt_springyield) != 0))


FREE_JOINT, BALL_JOINT = 0, 1
"""mjtJoint"""

RULES: dict[str, Callable[[Any, Any], Refused]] = {
    "actuators": _of(
        "actuators",
        "actuator",
        "carom has those with an affine law on joints and fixed tendons",
        unknown_actuators,
    ),
    "tendons": _of("tendons", "tendon", "carom has fixed tendons; remove those that go through space", _spatial),
    "stiffness": _of(
        "stiffness",
        "joint",
        "of a free joint, of a ball that is slack elsewhere or not linear, or one that yields: set it to 0",
        lambda m: _springs(None, m),
    ),
    "mocap": _of("mocap", "body", 'set mocap="false"', lambda m: np.asarray(m.body_mocapid) >= 0),
    "equality": _equalities,
    "fluid": _options,
    "override": _override,
    "flex": _count("flex", "nflex", "remove deformable bodies"),
    "plugins": _count("plugins", "nplugin", "remove them"),
}


CONTACT_KINDS = ("contacts", "rolling", "anisotropic", "margin", "adhesion", "surfacevel")
"""Kinds that `contacts.py` finds."""
LEFT_OUT = ("limits", "damping", "armature", "frictionloss", "gravcomp")
"""Kinds that carom has, and can leave out."""
KINDS = (*RULES, *CONTACT_KINDS, *LEFT_OUT)


def refusals(mujoco: Any, model: Any) -> list[Refused]:
    """All that is in the model, without contacts."""
    found = [rule(mujoco, model) for rule in RULES.values()]
    off, flags = model.opt.disableflags, mujoco.mjtDisableBit
    # What MuJoCo itself is told to leave out does nothing.
    silent = {
        "equality": flags.mjDSBL_EQUALITY | flags.mjDSBL_CONSTRAINT,
        "stiffness": flags.mjDSBL_SPRING,
        "actuators": flags.mjDSBL_ACTUATION,
    }
    return [refused for refused in found if refused.names and not off & int(silent.get(refused.kind, 0))]


def check_ignore(ignore: Collection[str]) -> None:
    """Raise `CaromError` for kinds that there are not."""
    unknown = sorted(set(ignore) - set(KINDS))
    require(not unknown, f"ignore may name {', '.join(KINDS)}; it named {', '.join(map(repr, unknown))}.")


def refuse(found: Iterable[Refused], ignore: Collection[str]) -> None:
    """Raise `CaromError` with all that was found, but for the kinds that are to be ignored."""
    left = [refused for refused in found if refused.kind not in ignore]
    kinds = [f'"{kind}"' for kind in dict.fromkeys(refused.kind for refused in left)]
    wanted = kinds[0] if len(kinds) == 1 else f"({', '.join(kinds)})"
    require(
        not left,
        f"the model has what carom cannot represent: {'; '.join(map(str, left))}. Change the model, or leave these out "
        f"knowingly: load_mujoco(..., ignore={wanted}).",
    )
