"""Contacts of a MuJoCo model: which pairs of geoms can touch, with which friction, and carom's contacts for them."""

from itertools import combinations, product
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from carom.contact.balls import BallBall, BallPlane
from carom.contact.boxes import CornerPlane
from carom.contact.candidates import Contact
from carom.mjcf.bodies import Group, name_of
from carom.mjcf.refusals import Refused

PLANE, SPHERE, CAPSULE, BOX = 0, 2, 3, 6  # mjtGeom
NAMES = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")
UNMOVED = 1e-9
"""Sines of angles and lengths (m) that are nothing but rounding."""


class Touching(NamedTuple):
    """Two geoms that MuJoCo lets touch, the first of the lower type: sliding friction (2,), and what else acts.

    `condim` is the number of rows of a contact: 1 without friction, 3 sliding, 4 and 6 with torsional and rolling.
    """

    geoms: tuple[int, int]
    friction: Float[np.ndarray, " 2"]
    condim: int
    margin: float
    adhesion: float
    pair: int | None = None

    def name(self, model: Any) -> str:
        """As in `sphere 'ball' and plane 'floor'`."""
        return " and ".join(f"{NAMES[int(model.geom_type[g])]} {name_of(model, 'geom', g)}" for g in self.geoms[::-1])


def touching_pairs(mujoco: Any, model: Any) -> list[Touching]:
    """The pairs of geoms that MuJoCo would test, by its own rules.

    Dynamic pairs: `contype` and `conaffinity` agree one way, not of one rigid body, not of parent and child (unless the
    parent is fixed, or `filterparent` is off), not excluded. Explicit pairs go before, unfiltered.
    """
    flags = mujoco.mjtDisableBit
    if model.opt.disableflags & (flags.mjDSBL_CONTACT | flags.mjDSBL_CONSTRAINT):
        return []
    explicit = {}
    for k in range(model.npair):
        key = _ordered(model, int(model.pair_geom1[k]), int(model.pair_geom2[k]))
        explicit[frozenset(key)] = Touching(
            key,
            np.array(model.pair_friction[k, :2]),
            int(model.pair_dim[k]),
            float(model.pair_margin[k]),
            float(model.pair_adhesion[k]),
            k,
        )
    excluded = {frozenset((int(s) >> 16, int(s) & 0xFFFF)) for s in model.exclude_signature}
    filter_parent = not model.opt.disableflags & flags.mjDSBL_FILTERPARENT
    dynamic = [
        _combined(model, _ordered(model, a, b))
        for a, b in combinations(range(model.ngeom), 2)
        if frozenset((a, b)) not in explicit and _may_touch(model, a, b, excluded, filter_parent)
    ]
    return [*explicit.values(), *dynamic]


def _ordered(model: Any, a: int, b: int) -> tuple[int, int]:
    return (a, b) if model.geom_type[a] <= model.geom_type[b] else (b, a)


def _may_touch(model: Any, a: int, b: int, excluded, filter_parent: bool) -> bool:
    bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
    welds = [int(model.body_weldid[body]) for body in bodies]
    parents = [int(model.body_weldid[model.body_parentid[weld]]) for weld in welds]
    agree = (model.geom_contype[a] & model.geom_conaffinity[b]) | (model.geom_contype[b] & model.geom_conaffinity[a])
    related = filter_parent and 0 not in welds and (welds[0] == parents[1] or welds[1] == parents[0])
    return bool(agree) and welds[0] != welds[1] and not related and frozenset(bodies) not in excluded


def _combined(model: Any, geoms: tuple[int, int]) -> Touching:
    """MuJoCo's rule: the geom of higher priority, or the larger friction of the two."""
    pair = list(geoms)
    priority = model.geom_priority[pair]
    chosen = pair if priority[0] == priority[1] else [pair[int(np.argmax(priority))]]
    slide = float(np.max(model.geom_friction[chosen, 0]))
    return Touching(
        geoms,
        np.array([slide, slide]),
        int(np.max(model.geom_condim[chosen])),
        float(np.max(model.geom_margin[pair])),
        float(np.abs(model.geom_adhesion[pair]).sum()),
    )


def fix_mocap(model: Any, touching: list[Touching]) -> list[Touching]:
    """Make mocap bodies, with what is welded to them, part of the world; returns the pairs that then can touch."""
    mocap = np.flatnonzero(np.asarray(model.body_mocapid) >= 0)
    model.body_weldid[np.isin(model.body_weldid, mocap)] = 0
    return [t for t in touching if model.body_weldid[model.geom_bodyid[list(t.geoms)]].any()]


def contact_refusals(model: Any, touching: list[Touching], *, urdf: bool = False) -> list[Refused]:
    """What of these contacts carom cannot represent; `urdf`, whether the advice is for such a file."""

    def some(kind: str, advice: str, which) -> Refused:
        return Refused(kind, tuple(t.name(model) for t in touching if which(t)), advice)

    found = [
        some(
            "contacts",
            "carom has spheres, capsules and boxes on planes, and spheres on spheres: "
            + ("leave out a <collision>" if urdf else "exclude the pair with <exclude> or contype and conaffinity")
            + ", or use other geoms",
            lambda t: not _known(model, t),
        ),
        some("rolling", "torsional and rolling friction: set condim to 3", lambda t: t.condim > 3),
        some("anisotropic", "give both directions one friction", lambda t: t.friction[0] != t.friction[1]),
        some("margin", "below 0: set it to 0", lambda t: t.margin < 0),
        some("adhesion", "set it to 0", lambda t: t.adhesion != 0),
        some("surfacevel", "set it to 0", lambda t: bool(model.geom_surfacevel[list(t.geoms)].any())),
    ]
    return [refused for refused in found if refused.names]


def _known(model: Any, touching: Touching) -> bool:
    types = tuple(int(model.geom_type[g]) for g in touching.geoms)
    welds = {int(model.body_weldid[model.geom_bodyid[g]]) for g in touching.geoms}
    return len(welds) == 2 and (types == (SPHERE, SPHERE) or (types[0] == PLANE and types[1] in (SPHERE, CAPSULE, BOX)))


# --- carom's contacts -----------------------------------------------------------------------------


class Contacts(NamedTuple):
    """carom's contacts, and friction (P,) and names of their properties: one a pair of geoms."""

    contacts: list[Contact]
    friction: list[float]
    names: tuple[str, ...]


def contacts_of(model: Any, data: Any, groups: dict[int, Group], touching: list[Touching]) -> Contacts:
    """Contacts for the pairs that carom knows; `data` is at the reference position."""
    known = [t for t in touching if _known(model, t)]
    found: list[Contact] = []
    planes = [(t.geoms[0], t.margin) for t in known if model.geom_type[t.geoms[0]] == PLANE]
    for floor, margin in dict.fromkeys(planes):
        on = [(k, t) for k, t in enumerate(known) if t.geoms[0] == floor and t.margin == margin]
        found += _on_plane(model, data, groups, floor, margin, on)
    balls = [(k, t) for k, t in enumerate(known) if model.geom_type[t.geoms[0]] == SPHERE]
    if balls:
        found.append(_between(model, data, groups, balls))
    friction = [0.0 if t.condim == 1 else float(t.friction[0]) for t in known]
    return Contacts(found, friction, tuple(t.name(model) for t in known))


def _group_of(model: Any, groups: dict[int, Group], geom: int) -> Group:
    return groups[int(model.body_weldid[model.geom_bodyid[geom]])]


def _on_plane(model: Any, data: Any, groups: dict[int, Group], floor: int, margin: float, on: list) -> list[Contact]:
    """Boxes along their bodies' axes by their corners; all else as balls. `margin` (m) keeps them off the plane."""
    normal = data.geom_xmat[floor].reshape(3, 3)[:, 2].copy()
    point = data.geom_xpos[floor] + margin * normal
    boxes: list[Contact] = []
    bodies, centers, radii, index = [], [], [], []
    for k, touching in on:
        geom = touching.geoms[1]
        group = _group_of(model, groups, geom)
        assert group.number is not None
        half = _aligned(data, group, geom, model) if model.geom_type[geom] == BOX else None
        if half is not None and not any(group.number in box.bodies for box in boxes if isinstance(box, CornerPlane)):
            middle = group.local(data.geom_xpos[geom])
            boxes.append(CornerPlane([group.number], half, point, normal, property=k, center=middle))
            continue
        places, radius = _balls(model, data, geom)
        bodies += [group.number] * len(places)
        centers += [group.local(place) for place in places]
        radii += [radius] * len(places)
        index += [k] * len(places)
    balls = [BallPlane(bodies, np.array(centers), np.array(radii), point, normal, index)] if bodies else []
    return [*boxes, *balls]


def _aligned(data: Any, group: Group, geom: int, model: Any) -> Float[np.ndarray, " 3"] | None:
    """Half widths of a box along the body's axes, if its edges are along them."""
    turn = np.abs(group.axes.T @ data.geom_xmat[geom].reshape(3, 3))
    if np.abs(turn - turn.round()).max() > UNMOVED:
        return None
    return turn.round() @ model.geom_size[geom]


def _balls(model: Any, data: Any, geom: int) -> tuple[list[np.ndarray], float]:
    """The balls that stand for a geom on a plane: places (m) and their radius."""
    place, turn, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    if model.geom_type[geom] == SPHERE:
        return [place.copy()], float(size[0])
    if model.geom_type[geom] == CAPSULE:
        return [place + side * size[1] * turn[:, 2] for side in (-1, 1)], float(size[0])
    return [place + turn @ (np.array(signs) * size) for signs in product((-1.0, 1.0), repeat=3)], 0.0


def _between(model: Any, data: Any, groups: dict[int, Group], on: list) -> BallBall:
    pairs, centers, radii = [], [], []
    for _, touching in on:
        # The first moves; the second may be of the world.
        geoms = sorted(touching.geoms, key=lambda g: _group_of(model, groups, g).number is None)
        owners = [_group_of(model, groups, g) for g in geoms]
        pairs.append(tuple(owner.number for owner in owners))
        centers.append([owner.local(data.geom_xpos[g]) for owner, g in zip(owners, geoms, strict=True)])
        radii.append([float(model.geom_size[g, 0]) for g in geoms])
    return BallBall(pairs, np.array(centers), np.array(radii), [k for k, _ in on], np.array([t.margin for _, t in on]))
