"""The graph of an interaction network: bodies, and who can act on whom (contacts and constraints)."""

import itertools

import equinox as eqx
import numpy as np

from carom.mechanics.constraints import Rigid
from carom.system import System

WORLD = -1
"""Sender of what is fixed: walls, anchors."""


class Graph(eqx.Module):
    """Objects are the bodies; a relation leads from one body (or the fixed world) to another. All of it is static.

    Relations come from contact candidates and constraints, both ways between every two bodies that one refers to, and
    from the world to a body that one refers to alone.

    - `points` (bodies, p): the points that describe a body, see `BodyTable.stencil`.
    - `owner`, `slot` (n,): of each point, its body and its place in the body's `points`.
    - `sender`, `receiver` (relations,): bodies; `WORLD` sends only.
    - `kind` (relations,), below `n_kinds`: one for each family of contacts and each type of constraint.
    - `candidate` (relations,): the contact candidate, or their number for a constraint, which is never closed.
    - `radius` (bodies,): the geometry of a body, in m.
    """

    points: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    owner: tuple[int, ...] = eqx.field(static=True)
    slot: tuple[int, ...] = eqx.field(static=True)
    sender: tuple[int, ...] = eqx.field(static=True)
    receiver: tuple[int, ...] = eqx.field(static=True)
    kind: tuple[int, ...] = eqx.field(static=True)
    n_kinds: int = eqx.field(static=True)
    candidate: tuple[int, ...] = eqx.field(static=True)
    radius: tuple[float, ...] = eqx.field(static=True)

    @classmethod
    def of(cls, system: System) -> "Graph":
        """The graph of a system's contacts and constraints."""
        points = system.table.stencil(np.arange(len(system.bodies)))
        place: dict[int, tuple[int, int]] = {}
        for body, row in enumerate(points.tolist()):
            for slot, point in enumerate(row):
                place.setdefault(point, (body, slot))
        owner, slot = zip(*(place[point] for point in range(system.n_points)), strict=True)
        # (kind, candidate, bodies) of everything that relates bodies.
        ties = [(kind, bodies) for kind, contact in enumerate(system.contacts) for bodies in contact.bodies_of()]
        named = [(kind, candidate, bodies) for candidate, (kind, bodies) in enumerate(ties)]
        links = [link for link in system.links if not isinstance(link, Rigid)]  # a rigid body is one object
        types = sorted({type(link).__name__ for link in links})
        for link in links:
            bodies = tuple(sorted({owner[point] for point in link.points()}))
            named.append((len(system.contacts) + types.index(type(link).__name__), len(ties), bodies))
        relations = [
            (kind, candidate, a, b)
            for kind, candidate, bodies in named
            for a, b in (itertools.permutations(bodies, 2) if len(bodies) > 1 else ((WORLD, k) for k in bodies))
        ]
        kind, candidate, sender, receiver = list(zip(*relations, strict=True)) or [()] * 4
        return cls(
            points=tuple(map(tuple, points.tolist())),
            owner=owner,
            slot=slot,
            sender=sender,
            receiver=receiver,
            kind=kind,
            n_kinds=len(system.contacts) + len(types),
            candidate=candidate,
            radius=tuple(np.asarray(system.radii, float).tolist()),
        )
