"""Impacts that recorded motion shows (`motion_events.py`), and which bodies met, as far as geometry tells.

Breaks of several bodies at one time are one impact. Which contact closed is told by the gaps of the system at that
time, to which each point is led from the samples before and after it: the contact that is nearest, if it is nearer than
what the bodies move between the two samples.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from carom.recordings.motion_events import Breaks, motion_breaks
from carom.recordings.observations import Observations
from carom.system import System

SAME = 3.0
"""Breaks that are no more standard errors of their times apart may be of one impact."""


class Impact(NamedTuple):
    """An impact between the samples `before` and `after` of `trajectory`, at about `time` (s).

    `bodies`, whose velocities jumped; `size`, the largest jump in units of its error; `contact`, the candidate of the
    system that closed, None where geometry does not tell.
    """

    trajectory: int
    before: int
    after: int
    time: float
    bodies: tuple[int, ...]
    size: float
    contact: int | None = None


def body_points(system: System) -> list[tuple[int, ...]]:
    """The points of each body: one, or the centre and the ends of the axes."""
    table = system.table
    return [(c,) if set(axes) == {c} else (c, *axes) for c, axes in zip(table.center, table.axes, strict=True)]


def motion_impacts(observations: Observations, system: System) -> list[Impact]:
    """Impacts that the motion of a system's bodies shows, in the order of trajectories and times."""
    found = _grouped(motion_breaks(observations, body_points(system)))
    return _with_contacts(found, observations, system) if system.contacts and found else found


def impact_counts(impacts: Sequence[Impact], system: System) -> dict[str, int]:
    """How many impacts were between which: "0-1", "0-wall"; "not told" where geometry does not say."""
    names = [name for contact in system.contacts for name in contact.names()]
    short = [name.partition(" ")[0] if name[:1].isdigit() else name for name in names]
    counts = Counter("not told" if impact.contact is None else short[impact.contact] for impact in impacts)
    return {name: counts[name] for name in dict.fromkeys([*short, "not told"]) if counts[name]}


def _grouped(breaks: Breaks) -> list[Impact]:
    """Breaks, which are in the order of time, of different bodies at one time as one impact."""
    out: list[Impact] = []
    error = 0.0
    for k in range(len(breaks.time)):
        own = Impact(
            int(breaks.trajectory[k]),
            int(breaks.before[k]),
            int(breaks.after[k]),
            float(breaks.time[k]),
            (int(breaks.body[k]),),
            float(breaks.size[k]),
        )
        last = out[-1] if out else None
        if last is not None and last.trajectory == own.trajectory and own.bodies[0] not in last.bodies:
            at_once = own.before < last.after and last.before < own.after
            apart = abs(own.time - last.time)
            if at_once or apart <= SAME * float(np.hypot(error, breaks.time_error[k])):
                first, second = (last, own) if last.size >= own.size else (own, last)
                out[-1] = first._replace(bodies=tuple(sorted(first.bodies + second.bodies)))
                error = min(error, float(breaks.time_error[k]))
                continue
        out.append(own)
        error = float(breaks.time_error[k])
    return out


def _with_contacts(impacts: list[Impact], observations: Observations, system: System) -> list[Impact]:
    """With the contact that geometry tells."""
    bodies = [set(own) for contact in system.contacts for own in contact.bodies_of()]
    points, seen = body_points(system), observations.seen
    states, ways = zip(*(_at(impact, observations, seen, points) for impact in impacts), strict=True)
    gaps = np.asarray(system.gaps(jnp.asarray(np.stack(states))))
    out = []
    for impact, gap, way in zip(impacts, gaps, ways, strict=True):
        moved = set(impact.bodies)
        near = [c for c in range(len(gap)) if bodies[c] & moved and abs(gap[c]) <= way]  # NaN is never near
        # Two bodies that jump at once have met rather than that each has met a wall.
        near.sort(key=lambda c: (bodies[c] != moved if len(moved) > 1 else False, abs(gap[c])))
        out.append(impact._replace(contact=near[0] if near else None))
    return out


def _at(
    impact: Impact, observations: Observations, seen: np.ndarray, points: list[tuple[int, ...]]
) -> tuple[Float[np.ndarray, "n d"], float]:
    """Where all points were at the time of an impact (NaN if that was not seen); and the way of its bodies (m)."""
    time, x = observations.time[impact.trajectory], observations.x[impact.trajectory]
    state, way = np.full(x.shape[1:], np.nan), 0.0
    own = {p for body in impact.bodies for p in points[body]}
    for p in range(x.shape[1]):
        there = np.flatnonzero(seen[impact.trajectory, :, p])
        sides = there[there <= impact.before][-2:], there[there >= impact.after][:2]
        ends = [_line(time[side], x[side, p], impact.time) for side in sides if len(side)]
        if ends:
            state[p] = np.mean(ends, axis=0)
        if p in own and len(sides[0]) and len(sides[1]):
            before, after = sides[0][-1], sides[1][0]
            lines = [np.linalg.norm(state[p] - x[s, p]) for s in (before, after)]
            way = max(way, float(np.linalg.norm(x[after, p] - x[before, p])), *map(float, lines))
    return state, way


def _line(time: Float[np.ndarray, " m"], x: Float[np.ndarray, "m d"], at: float) -> Float[np.ndarray, " d"]:
    """Where the straight line through one or two samples is at a time."""
    if len(time) == 1:
        return x[0]
    return x[0] + (x[1] - x[0]) * (at - time[0]) / (time[1] - time[0])
