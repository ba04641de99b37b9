"""What a MuJoCo model may have that carom cannot represent: found, and refused by name."""

from collections.abc import Callable, Collection, Iterable
from typing import Any, NamedTuple

import numpy as np

from carom.checks import require
from carom.mjcf.bodies import name_of

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


def _joints(model: Any, *fields) -> np.ndarray:
    """The same for joints, with fields of degrees of freedom."""
    return np.bincount(model.dof_jntid[_nonzero(*fields)], minlength=model.njnt) > 0


def _equalities(mujoco: Any, model: Any) -> Refused:
    kinds = {int(value): name.removeprefix("mjEQ_").lower() for name, value in mujoco.mjtEq.__members__.items()}
    other = (np.asarray(model.eq_type) != int(mujoco.mjtEq.mjEQ_CONNECT)) & np.asarray(model.eq_active0, bool)
    names = tuple(_equality(mujoco, model, kinds[int(model.eq_type[k])], int(k)) for k in np.flatnonzero(other))
    return Refused("equality", names, "use connect, or weld bodies by nesting them")


def _equality(mujoco: Any, model: Any, kind: str, k: int) -> str:
    """An equality by its name, or else by what it couples."""
    site = model.eq_objtype[k] == mujoco.mjtObj.mjOBJ_SITE
    what = {"weld": "site" if site else "body", "joint": "joint", "tendon": "tendon"}.get(kind)
    if model.equality(k).name or what is None:
        return f"{kind} {name_of(model, 'equality', k)}"
    ends = [name_of(model, what, int(end[k])) for end in (model.eq_obj1id, model.eq_obj2id) if end[k] >= 0]
    return f"{kind} equality of {what} {' and '.join(ends)}"


def _options(mujoco: Any, model: Any) -> Refused:
    names = ["density and viscosity"] if model.opt.density or model.opt.viscosity else []
    return Refused("fluid", tuple(names), "set both to 0")


def _override(mujoco: Any, model: Any) -> Refused:
    on = bool(model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE)
    return Refused("override", ("flag override",) if on else (), "set friction by geom or pair")


def _count(kind: str, field: str, advice: str):
    def find(mujoco: Any, model: Any) -> Refused:
        number = int(getattr(model, field))
        return Refused(kind, (f"{number} of them",) if number else (), advice)

    return find


RULES: dict[str, Callable[[Any, Any], Refused]] = {
    "actuators": _of("actuators", "actuator", "carom's simulate takes `force`", lambda m: np.ones(m.nu)),
    "tendons": _of("tendons", "tendon", "remove them", lambda m: np.ones(m.ntendon)),
    "limits": _of("limits", "joint", 'set limited="false"', lambda m: m.jnt_limited),
    "stiffness": _of(
        "stiffness",
        "joint",
        "set it to 0, or use carom.Springs",
        lambda m: _nonzero(m.jnt_stiffness, m.jnt_stiffnesspoly),
    ),
    "damping": _of(
        "damping",
        "joint",
        "set it to 0",
        lambda m: _joints(m, m.dof_damping, m.dof_dampingpoly),
    ),
    "armature": _of("armature", "joint", "set it to 0", lambda m: _joints(m, m.dof_armature)),
    "frictionloss": _of("frictionloss", "joint", "set it to 0", lambda m: _joints(m, m.dof_frictionloss)),
    "gravcomp": _of("gravcomp", "body", "set it to 0", lambda m: m.body_gravcomp),
    "mocap": _of("mocap", "body", 'set mocap="false"', lambda m: np.asarray(m.body_mocapid) >= 0),
    "equality": _equalities,
    "fluid": _options,
    "override": _override,
    "flex": _count("flex", "nflex", "remove deformable bodies"),
    "plugins": _count("plugins", "nplugin", "remove them"),
}


CONTACT_KINDS = ("contacts", "rolling", "anisotropic", "margin", "adhesion", "surfacevel")
"""Kinds that `contacts.py` finds."""
KINDS = (*RULES, *CONTACT_KINDS)


URDF_ADVICE = {
    "limits": "leave out lower and upper in its <limit>",
    "damping": "set damping of its <dynamics> to 0",
    "frictionloss": "set friction of its <dynamics> to 0",
    "equality": "leave out <mimic>",
}
"""What to do in a URDF file, which has other words than MJCF."""


def refusals(mujoco: Any, model: Any, *, urdf: bool = False) -> list[Refused]:
    """All that is in the model, without contacts; `urdf`, whether the advice is for such a file."""
    found = [rule(mujoco, model) for rule in RULES.values()]
    if urdf:
        found = [refused._replace(advice=URDF_ADVICE.get(refused.kind, refused.advice)) for refused in found]
    off, flags = model.opt.disableflags, mujoco.mjtDisableBit
    # What MuJoCo itself is told to leave out does nothing.
    silent = {
        "limits": flags.mjDSBL_LIMIT | flags.mjDSBL_CONSTRAINT,
        "frictionloss": flags.mjDSBL_FRICTIONLOSS | flags.mjDSBL_CONSTRAINT,
        "equality": flags.mjDSBL_EQUALITY | flags.mjDSBL_CONSTRAINT,
        "stiffness": flags.mjDSBL_SPRING,
        "damping": flags.mjDSBL_DAMPER,
        "actuators": flags.mjDSBL_ACTUATION,
        "gravcomp": flags.mjDSBL_GRAVITY,
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
