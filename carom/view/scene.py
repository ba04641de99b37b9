"""What pictures of a system in motion consist of: bodies, links, walls, contacts, and from where they are seen."""

from collections.abc import Iterator
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection, LineCollection
from matplotlib.colors import to_rgb, to_rgba
from matplotlib.patches import Polygon

from carom.contact.balls import BallBall, BallPlane
from carom.contact.boxes import CornerPlane
from carom.contact.candidates import DiskDisk, DiskPlane, RimPlane
from carom.mechanics.bodies import RigidBody
from carom.mechanics.constraints import Distance, Joint, Pivot, Tether, Track
from carom.mechanics.joints import Joints
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.view.balls import ball_lines, ball_reach, ball_touches
from carom.view.style import BLUE, HATCH, INK, MUTED, ORANGE, PAPER, SOLID, TINT, TINT_EDGE, VERMILLION

FAR = 1e6
"""What is farther away (m) is lost."""
RIM = 24
"""Lines around a wheel."""
RING_FRAMES = 10
"""For how many frames a new contact flashes."""
AZIMUTH, ELEVATION = np.radians(-60), np.radians(20)
"""From where a system in 3D is seen; the third axis is up."""

# --- what there is to draw -----------------------------------------------------------------------


def camera_of(dim: int) -> np.ndarray:
    """(d, 2), columns are the picture's axes."""
    if dim == 2:
        return np.eye(2)
    (sa, ca), (se, ce) = ((np.sin(a), np.cos(a)) for a in (AZIMUTH, ELEVATION))
    return np.array([[-sa, -se * ca], [ca, -se * sa], [0, ce]])


def positions_of(trajectory: Trajectory, far: float) -> np.ndarray:
    """Points (time, n, d), NaN where they are farther than `far` (m) from the origin."""
    x = np.asarray(trajectory.x, float)
    return np.where(np.abs(x) < far, x, np.nan)


class Lines(NamedTuple):
    """Lines between points that move with the system: their ends are `weights @ x + offset`."""

    weights: np.ndarray  # (lines, 2, n)
    offset: np.ndarray  # (lines, 2, d)
    anchors: np.ndarray  # (anchors, d)


def lines_of(system: System) -> Lines:
    """Rods, the edges of boxes, and a line from the center of each other rigid body along its axes to its rim."""
    n, dim = system.n_points, system.dim
    unit, zero = np.eye(n), np.zeros(dim)
    weights, offset, anchors = [], [], []
    for link in system.links:
        if isinstance(link, Distance):
            weights.append([unit[link.i], unit[link.j]])
            offset.append([zero, zero])
        elif isinstance(link, Tether | Joint):
            weights.append([unit[link.i if isinstance(link, Tether) else link.first], 0 * unit[0]])
            anchors.append(np.asarray(link.anchor, float))
            offset.append([zero, anchors[-1]])
        elif isinstance(link, Joints) and link.kinds and link.kinds != ("free",):
            weights += _to_joints(link, unit)
            offset += [[zero, zero]] * (len(weights) - len(offset))
        elif isinstance(link, Pivot | Track):
            weights += _arms(link, unit)
            offset += [[zero, zero]] * (len(weights) - len(offset))
    boxes = _boxes(system)
    for index, (half, middle) in boxes.items():
        center, axes = system.table.center[index], list(system.table.axes[index])
        for signs in _edges(dim):
            corners = [middle + sign * half for sign in signs]
            ends = [unit[center] * (1 - np.sum(corner)) + corner @ unit[axes] for corner in corners]
            weights.append(ends)
            offset.append([zero, zero])
    for index in _wheels(system):
        center, (first, second) = system.table.center[index], list(system.table.axes[index])[:2]
        radius, turn = float(system.bodies[index].radius), np.linspace(0, 2 * np.pi, RIM + 1)
        rim = [
            unit[center] * (1 - radius * (c + s)) + radius * (c * unit[first] + s * unit[second])
            for c, s in zip(np.cos(turn), np.sin(turn), strict=True)
        ]
        weights += [list(pair) for pair in pairwise(rim)]
        offset += [[zero, zero]] * RIM
    for index, (body, center) in enumerate(zip(system.bodies, system.table.center, strict=True)):
        if isinstance(body, RigidBody) and index not in boxes:
            # A turning disk shows one spoke, a body in 3D its three axes.
            for axis in range(1 if dim == 2 else 3):
                reach = float(body.radius) or 0.1
                rim = (1 - reach) * unit[center] + reach * unit[center + 1 + axis]
                weights.append([unit[center], rim])
                offset.append([zero, zero])
    rings = ball_lines(system)
    weights, offset = weights + rings[0], offset + rings[1]
    return Lines(
        np.reshape(weights, (-1, 2, n)),
        np.reshape(offset, (-1, 2, dim)),
        np.reshape(anchors, (-1, dim)),
    )


def _to_joints(link: Joints, unit: np.ndarray) -> list[list[np.ndarray]]:
    """From the centre of the body, and of its parent, to where its first joint is at rest."""
    ends = [(link.i, np.asarray(link.anchors[0], float))]
    if link.j is not None:
        ends.append((link.j, np.asarray(link.place, float)))
    own = [(i, np.concatenate([[1 - place.sum()], place])) for i, place in ends]
    return [[unit[i], weights @ unit[i : i + len(weights)]] for i, weights in own]


def _arms(link: Pivot | Track, unit: np.ndarray) -> list[list[np.ndarray]]:
    """From the centers of the bodies to the point that a joint holds."""
    if isinstance(link, Pivot):
        ends = [(link.i, link.weights_i), (link.j, link.weights_j)]
    else:
        ends = [(link.i, link.weights)]
    return [[unit[i], np.asarray(w, float) @ unit[i : i + len(w)]] for i, w in ends]


def _boxes(system: System) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Half widths of the bodies that are boxes, and their middles along the body's axes."""
    corners = (contact for contact in system.contacts if isinstance(contact, CornerPlane))
    return {
        body: (np.asarray(contact.half_widths, float), np.asarray(contact.center, float))
        for contact in corners
        for body in contact.bodies
    }


def _wheels(system: System) -> list[int]:
    """The bodies that touch with a rim, about their third axis."""
    return sorted({body for contact in system.contacts if isinstance(contact, RimPlane) for body in contact.bodies})


def _edges(dim: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Pairs of corners of a box, as signs of their coordinates, that differ in one."""
    for signs in product((-1.0, 1.0), repeat=dim):
        for axis in range(dim):
            if signs[axis] < 0:
                other = np.array(signs)
                other[axis] = 1.0
                yield np.array(signs), other


def touching(system: System, trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Where bodies can touch (time, C, d), and whether they did (time, C)."""
    points = positions_of(trajectory, FAR)
    x, radii = points[:, list(system.table.center)], np.asarray(system.radii, float)
    places, gaps = [np.zeros((len(x), 0, system.dim))], [np.zeros((len(x), 0))]
    for contact in system.contacts:
        if isinstance(contact, DiskPlane):
            body, normal = list(contact.bodies), np.asarray(contact.normal, float)
            gaps.append((x[:, body] - np.asarray(contact.point, float)) @ normal - radii[body])
            places.append(x[:, body] - radii[body, None] * normal)
        elif isinstance(contact, DiskDisk) and contact.pairs:
            a, b = np.array(contact.pairs).T
            between = x[:, b] - x[:, a]
            distance = np.linalg.norm(between, axis=-1)
            gaps.append(distance - radii[a] - radii[b])
            toward = between / np.maximum(distance, 1e-12)[..., None]
            places.append(x[:, a] + radii[a, None] * toward)
        elif isinstance(contact, BallPlane | BallBall) and contact.property_index:
            found = ball_touches(system, contact, points)
            places.append(found[0])
            gaps.append(found[1])
    # Recordings in single precision may be that far from closed.
    closed = np.concatenate(gaps, axis=1) < 1e-6
    return np.concatenate(places, axis=1), closed & np.asarray(trajectory.contact)[:, None]


class Wall(NamedTuple):
    point: np.ndarray
    normal: np.ndarray

    def gap(self, x: np.ndarray) -> float:
        return float((x - self.point) @ self.normal)


def walls_of(system: System) -> list[Wall]:
    """Each plane once."""
    found: dict[tuple, Wall] = {}
    for contact in system.contacts:
        if isinstance(contact, DiskPlane | CornerPlane | RimPlane | BallPlane):
            wall = Wall(np.asarray(contact.point, float), np.asarray(contact.normal, float))
            key = (*wall.normal.round(9), round(float(wall.point @ wall.normal), 9))
            found.setdefault(key, wall)
    return list(found.values())


def box_of(system: System, trajectory: Trajectory, anchors: np.ndarray) -> np.ndarray:
    """Lower and upper corner (2, d) of all that the trajectory reaches."""
    x = positions_of(trajectory, FAR)[:, list(system.table.center)]
    return box_of_points(system, x.reshape(-1, system.dim), anchors)


def outlined_bodies(system: System) -> set[int]:
    """The bodies whose lines are all there is to see: boxes, wheels, and those with balls beside their center."""
    beside = {body for body in ball_reach(system) if float(system.bodies[body].radius) == 0}
    return {*_boxes(system), *_wheels(system), *beside}


def box_of_points(system: System, centers: np.ndarray, anchors: np.ndarray | None = None) -> np.ndarray:
    """Lower and upper corner (2, d) of all bodies whose centers (B T, d) go through these places, body by body."""
    anchors = lines_of(system).anchors if anchors is None else anchors
    radii = np.array(system.radii, float)[:, None]
    for body, reach in ball_reach(system).items():
        radii[body] = max(float(radii[body, 0]), reach)
    for body, (half, middle) in _boxes(system).items():
        radii[body] = np.linalg.norm(half + np.abs(middle))
    x = centers.reshape(-1, len(radii), system.dim)
    reached = np.concatenate([(x - radii).reshape(-1, system.dim), (x + radii).reshape(-1, system.dim), anchors])
    reached = reached[np.isfinite(reached).all(axis=1) & (np.abs(reached) < FAR).all(axis=1)]
    return np.array([reached.min(axis=0), reached.max(axis=0)])


def extent_of(box: np.ndarray) -> float:
    return max(float(np.max(box[1] - box[0])), 1e-6)


def view_box(system, true, predicted, anchors, walls) -> np.ndarray:
    """Corners (2, d) of what is shown: the motion, and the walls that are near."""
    box = box_of(system, predicted if true is None else true, anchors)
    if true is not None:
        # A prediction that goes astray may leave the picture.
        room = 0.2 * extent_of(box)
        other = np.clip(box_of(system, predicted, anchors), box[0] - room, box[1] + room)
        box = np.array([np.minimum(box[0], other[0]), np.maximum(box[1], other[1])])
    extent = extent_of(box)
    for wall in walls:
        nearest = np.where(wall.normal > 0, box[0], box[1])
        gap = wall.gap(nearest)
        if 0 < gap <= extent:
            foot = nearest - gap * wall.normal
            box = np.array([np.minimum(box[0], foot), np.maximum(box[1], foot)])
    return box


# --- drawing -------------------------------------------------------------------------------------


class Look(NamedTuple):
    """Colors and line widths (points) of a trajectory; a higher `order` is drawn later."""

    face: str
    edge: str
    trail: tuple[str, float]
    disk_width: float
    link_width: float
    trail_width: float
    order: int


TRUE_LOOK = Look(TINT, TINT_EDGE, (BLUE, 0.5), 1.0, 4.5, 3.0, order=1)
PREDICTED_LOOK = Look("none", VERMILLION, (VERMILLION, 0.9), 1.7, 1.5, 1.1, order=4)
ALONE_LOOK = Look(TINT, BLUE, (BLUE, 0.7), 1.5, 2.0, 2.0, order=1)


class Bodies:
    """Disks, links and trails of one trajectory."""

    def __init__(self, axes, system, trajectory, lines, camera, past, look: Look):
        x = positions_of(trajectory, 1e3 * float(np.diff(axes.get_xlim())[0]))
        self.centers = x[:, list(system.table.center)] @ camera
        # A point that is not finite takes only its own lines along: 0 * NaN is not 0.
        known = np.nan_to_num(x)
        ends = np.einsum("lsn,tnd->tlsd", lines.weights, known) + lines.offset
        gone = np.einsum("lsn,tn->tls", np.abs(lines.weights), np.isnan(x).any(-1).astype(float))
        self.ends = np.where(gone[..., None] > 0, np.nan, ends) @ camera
        smallest = 0.012 * float(np.diff(axes.get_xlim())[0])
        sizes = 2 * np.maximum(np.asarray(system.radii, float), smallest)
        self.disks = EllipseCollection(
            sizes,
            sizes,
            np.zeros_like(sizes),
            units="x",
            offsets=self.centers[0],
            offset_transform=axes.transData,
            facecolors=look.face,
            # Twice, as a single style would be drawn as a marker: on whole pixels, by jerks.
            edgecolors=[look.edge] * 2,
            linewidths=look.disk_width,
            zorder=look.order + 0.1,
        )
        self.links = LineCollection(
            [], colors=look.edge, linewidths=look.link_width, capstyle="butt", zorder=look.order
        )
        self.past, self.steps = past, max(1, min(30, past))
        color, strongest = look.trail
        fade = np.linspace(0, strongest, self.steps + 1)[1:]
        colors = np.tile([(*to_rgb(color), alpha) for alpha in fade], (len(sizes), 1))
        self.trail = LineCollection(
            [],
            colors=colors,
            linewidths=look.trail_width,
            capstyle="butt",
            zorder=2 + look.order / 10,
        )
        self.artists: list[Artist] = [self.trail, self.links, self.disks]
        for artist in (self.trail, self.links, self.disks):
            axes.add_collection(artist, autolim=False)

    def update(self, frame: int, sample: int) -> None:
        self.disks.set_offsets(self.centers[sample])
        self.links.set_segments(list(self.ends[sample]))
        samples = np.linspace(sample - self.past, sample, self.steps + 1).round()
        points = self.centers[np.maximum(samples.astype(int), 0)].swapaxes(0, 1)
        pieces = np.stack([points[:, :-1], points[:, 1:]], axis=2)
        self.trail.set_segments(list(pieces.reshape(-1, 2, 2)))


class Contacts:
    """A dot where bodies touch, and a ring that spreads from where they begin to."""

    def __init__(self, axes, system, predicted, camera, frames):
        places, closed = touching(system, predicted)
        self.places = places @ camera
        edges = np.concatenate([[-1], frames])
        self.shown = [closed[a + 1 : b + 1].any(axis=0) for a, b in pairwise(edges)]
        # Contacts that only flicker, as those of a body at rest may, begin once.
        recent = np.zeros_like(closed)
        for lag in range(1, 6):
            recent[lag:] |= closed[:-lag]
        begins = np.argwhere(closed & ~recent)
        self.begin_frame = np.searchsorted(frames, begins[:, 0])
        self.begin_place = self.places[begins[:, 0], begins[:, 1]]
        self.extent = float(np.diff(axes.get_xlim())[0])
        size = np.array([0.02 * self.extent])
        common: dict[str, Any] = {"units": "x", "offset_transform": axes.transData}
        self.dots = EllipseCollection(
            size, size, [0], facecolors=ORANGE, edgecolors=INK, linewidths=0.6, zorder=6, **common
        )
        self.rings = EllipseCollection(size, size, [0], facecolors="none", linewidths=2.0, zorder=5, **common)
        self.artists: list[Artist] = [self.rings, self.dots]
        axes.add_collection(self.dots, autolim=False)
        axes.add_collection(self.rings, autolim=False)

    def update(self, frame: int, sample: int) -> None:
        self.dots.set_offsets(self.places[sample][self.shown[frame]])
        age = (frame - self.begin_frame) / RING_FRAMES
        fresh = (age >= 0) & (age < 1)
        size = self.extent * (0.03 + 0.09 * np.sqrt(age[fresh]))
        self.rings.set_offsets(self.begin_place[fresh])
        self.rings.set(widths=size, heights=size, angles=np.zeros_like(size))
        self.rings.set_edgecolor([to_rgba(ORANGE, 1 - a) for a in age[fresh]])


def framed(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower left and upper right of a frame around corners (k, 2), neither very flat nor high."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    size = np.maximum(high - low, 1e-6)
    size = size + 0.14 * size.max()
    wanted = np.maximum(size, [size[1] / 1.1, size[0] * 0.5])
    middle = (low + high) / 2
    return middle - wanted / 2, middle + wanted / 2


def _clip(polygon: np.ndarray, wall: Wall) -> np.ndarray:
    """The part of a convex polygon (k, 2) in front of a wall (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        gap_a, gap_b = wall.gap(a), wall.gap(b)
        if gap_a >= 0:
            kept.append(a)
        if gap_a * gap_b < 0:
            kept.append(a + (b - a) * gap_a / (gap_a - gap_b))
    return np.reshape(kept, (-1, 2))


def draw_walls(axes: Axes, walls: list[Wall]) -> None:
    """Hatch what no body can enter, and draw a line around what is free."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    frame = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    free = frame
    for wall in walls:
        free = _clip(free, wall)
    if not walls or len(free) < 3:
        return
    axes.add_patch(Polygon(frame, facecolor=SOLID, hatch="/////", edgecolor=HATCH, linewidth=0))
    axes.add_patch(Polygon(free, facecolor=PAPER, edgecolor="none"))
    near = 1e-9 * (right - left)
    for a, b in zip(free, np.roll(free, -1, axis=0), strict=True):
        if any(abs(wall.gap(a)) < near and abs(wall.gap(b)) < near for wall in walls):
            axes.plot(*np.array([a, b]).T, color=MUTED, linewidth=1.6, solid_capstyle="projecting")


def planes_near(walls: list[Wall], box: np.ndarray) -> list[np.ndarray]:
    """Squares (4, 3) on the planes that are near."""
    reach, middle = 0.55 * extent_of(box), box.mean(axis=0)
    squares = []
    for wall in walls:
        gap = wall.gap(middle)
        if abs(gap) < 3 * reach:
            tangents = np.linalg.svd(wall.normal[None])[2][1:]
            turns = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * reach
            squares.append(middle - gap * wall.normal + turns @ tangents)
    return squares


def draw_planes(axes: Axes, squares: list[np.ndarray]) -> None:
    """Each square (4, 2) with a grid on it."""
    for a, b, c, d in squares:
        axes.add_patch(Polygon([a, b, c, d], facecolor=SOLID, edgecolor=MUTED, linewidth=0.8))
        for k in np.linspace(0, 1, 9)[1:-1]:
            for start, end in (((a, b), (d, c)), ((a, d), (b, c))):
                line = [p + k * (q - p) for p, q in (start, end)]
                axes.plot(*np.transpose(line), color=HATCH, linewidth=0.7, zorder=1)


def draw_triad(axes: Axes, camera: np.ndarray) -> None:
    """The directions of the three axes, in the lower left corner."""
    (left, right), (bottom, _) = axes.get_xlim(), axes.get_ylim()
    length = 0.07 * (right - left)
    origin = np.array([left, bottom]) + length * np.array([0.8, 0.9])
    for name, direction in zip("xyz", camera, strict=True):
        tip = origin + length * direction
        axes.plot(*np.array([origin, tip]).T, color=MUTED, linewidth=1.2)
        x, y = origin + 1.35 * length * direction
        axes.text(x, y, name, ha="center", va="center", color=MUTED)
