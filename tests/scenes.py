"""Random scenes of every contact type, each in any frame, unit and labelling of the bodies' axes."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from systems import random_rotations

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.simulation.projection import project_state


class Frame(NamedTuple):
    """How a scene is written down: turned, mirrored, shifted, in other units, with other axes of its bodies."""

    turn: jax.Array  # (d, d), orthogonal
    shift: jax.Array  # (d,), in the unit of lengths
    length: jax.Array
    mass: jax.Array
    time: jax.Array
    axes: jax.Array  # (d, d), a permutation: of the axes of every body

    @classmethod
    def plain(cls, dim: int, **other) -> "Frame":
        one = jnp.ones(())
        return cls(jnp.eye(dim), jnp.zeros(dim), one, one, one, jnp.eye(dim))._replace(**other)

    def place(self, point):
        return self.length * (self.turn @ (point + self.shift))

    def way(self, vector):
        return self.turn @ vector

    def within(self, point):
        """A point of a body, in its own axes."""
        return self.length * (self.axes @ point)

    def weights(self, point):
        return carom.place_weights(self.within(point))

    def acceleration(self, vector):
        return self.length / self.time**2 * (self.turn @ vector)

    def body(self, mass, moments, radius=0.0) -> carom.RigidBody:
        return carom.RigidBody(
            self.mass * mass, self.mass * self.length**2 * (self.axes @ moments), self.length * radius
        )

    def state(self, place, turn, velocity, spin):
        """Points and velocities of a rigid body."""
        x, v = embed_pose(place, turn), embed_velocity(turn, velocity, spin)
        axes, rates = (self.axes @ (part[1:] - part[:1]) @ self.turn.T for part in (x, v))
        center = self.place(place)
        speed = self.length / self.time * self.way(velocity)
        return jnp.concatenate([center[None], center + axes]), jnp.concatenate([speed[None], speed + rates / self.time])

    def back(self, v, points_of_body: list[int]):
        """Velocities, and rates of the bodies' axes, as they are in the plain frame."""
        out, first = [], 0
        for count in points_of_body:
            own = v[first : first + count] @ self.turn * self.time
            out.append(own[:1] / self.length)
            if count > 1:
                out.append(self.axes.T @ (own[1:] - own[:1]))
            first += count
        return jnp.concatenate(out)


class Scene(NamedTuple):
    system: carom.System
    x: jax.Array
    v: jax.Array


def _draw(key, **shapes):
    keys = jax.random.split(key, len(shapes))
    return [jax.random.uniform(k, shape) for k, shape in zip(keys, shapes.values(), strict=True)]


def _unit(vector):
    return vector / jnp.linalg.norm(vector)


def _turn2(angle):
    return jnp.array([[jnp.cos(angle), -jnp.sin(angle)], [jnp.sin(angle), jnp.cos(angle)]])


def _turn3(angles):
    def about(axis, angle):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        c, s = jnp.cos(angle), jnp.sin(angle)
        return jnp.eye(3).at[j, j].set(c).at[k, k].set(c).at[j, k].set(-s).at[k, j].set(s)

    return about(0, angles[0]) @ about(1, angles[1]) @ about(2, angles[2])


def _laws(key):
    """Friction up to 2, none in a fifth; restitutions."""
    friction, without, restitution = _draw(key, friction=(3,), without=(), restitution=(3,))
    return {"friction": jnp.where(without > 0.2, 2 * friction, 0), "restitution": restitution}


def _scene(frame: Frame, bodies, links, contacts, key, states, potential=None) -> Scene:
    gravity = carom.Gravity(frame.acceleration(jnp.array([0.3, -9.81] if len(frame.shift) == 2 else [0.3, 0.1, -9.81])))
    potential = gravity if potential is None else carom.Sum(gravity, potential)
    system = carom.System(bodies, links, contacts, potential, **_laws(key))
    return Scene(system, *(jnp.concatenate(part) for part in zip(*states, strict=True)))


def three_disks(key, t: Frame) -> Scene:
    """Three rigid disks that overlap in a corner of two planes."""
    keys = jax.random.split(key, 3)
    r, mass, moments, depth, ways = _draw(keys[0], r=(3,), mass=(3,), moments=(3, 2), depth=(4,), ways=(4,))
    turns, v, w = _draw(keys[1], turns=(3,), v=(3, 2), w=(3, 1))
    r, mass, depth = 0.2 + 0.3 * r, 10 ** (2 * mass - 1), 1e-3 + 0.02 * depth
    moments = mass[:, None] * r[:, None] ** 2 * (0.1 + 0.3 * moments)
    along = _turn2(6 * ways[0]) @ jnp.array([1.0, 0.0])
    beside = _turn2(1.2 + 0.5 * ways[1]) @ along
    places = jnp.stack([jnp.zeros(2), (r[0] + r[1] - depth[0]) * along, (r[0] + r[2] - depth[1]) * beside])
    floor, wall = _unit(jnp.array([0.1 * ways[2], 1.0])), _unit(jnp.array([1.0, 0.5 * ways[3]]))
    low, left = jnp.min(places @ floor - r) + depth[2], jnp.min(places @ wall - r) + depth[3]
    return _scene(
        t,
        [t.body(mass[i], moments[i], r[i]) for i in range(3)],
        [],
        [
            carom.DiskDisk([(0, 1), (0, 2), (1, 2)], property=[0, 1, 2]),
            carom.DiskPlane([0, 1, 2], t.place(low * floor), t.way(floor), property=0),
            carom.DiskPlane([0, 1, 2], t.place(left * wall), t.way(wall), property=1),
        ],
        keys[2],
        [t.state(places[i], _turn2(6 * turns[i]), 4 * v[i] - 2, 8 * w[i] - 4) for i in range(3)],
    )


def two_boxes(key, t: Frame) -> Scene:
    """Two boxes on a pivot, their rounded corners on a floor; balls on both, and one that is fixed."""
    keys = jax.random.split(key, 3)
    mass, half, moments, pins, turns = _draw(keys[0], mass=(2,), half=(2,), moments=(2, 2), pins=(2, 2), turns=(2,))
    tilt, depth, rounded, more, v, w = _draw(keys[1], tilt=(), depth=(), rounded=(), more=(), v=(2, 2), w=(2, 1))
    mass, half, rounded = 10 ** (2 * mass - 1), 0.2 + 0.3 * half, 0.05 * rounded
    moments = mass[:, None] * half[:, None] ** 2 * (0.2 + 0.3 * moments)
    turn, pins = [_turn2(6 * a) for a in turns], jnp.stack([0.4 * pins[0], -0.5 * pins[1] - 0.2])
    places = [jnp.zeros(2), turn[0] @ pins[0] - turn[1] @ pins[1]]
    floor = _unit(jnp.array([0.2 * tilt, 1.0]))
    signs = jnp.array([[-1, -1], [-1, 1], [1, -1], [1, 1.0]])
    corners = jnp.concatenate([places[i] + signs * (half[i] - rounded) @ turn[i].T for i in range(2)])
    at = t.place((jnp.min(corners @ floor) - rounded + 1e-3 + 0.02 * depth) * floor)
    balls = jnp.array([[0.1, 0.05], [-0.07, 0.1]])
    apart = jnp.linalg.norm(places[0] + turn[0] @ balls[0] - places[1] - turn[1] @ balls[1])
    fixed = places[1] + turn[1] @ balls[0] + 0.3 * jnp.array([0.6, 0.8])
    radii = t.length * jnp.array([[0.4 * apart, 0.6 * apart + 0.01 * more], [0.16, 0.141]])
    where = jnp.stack([jnp.stack([t.within(b) for b in balls]), jnp.stack([t.within(balls[0]), t.place(fixed)])])
    return _scene(
        t,
        [t.body(mass[i], moments[i], half[i]) for i in range(2)],
        [carom.Pivot(0, t.weights(pins[0]), 3, t.weights(pins[1]))],
        [
            *(
                carom.CornerPlane(
                    [i], t.length * jnp.full(2, half[i]), at, t.way(floor), t.length * rounded, property=i
                )
                for i in range(2)
            ),
            carom.BallBall([(0, 1), (1, None)], where, radii, property=[2, 1]),
        ],
        keys[2],
        [t.state(places[i], turn[i], 4 * v[i] - 2, 8 * w[i] - 4) for i in range(2)],
    )


def chain(key, t: Frame) -> Scene:
    """Four point masses that hang on springs, at limits of bend and stretch, the last one on a floor: singular."""
    keys = jax.random.split(key, 3)
    mass, first, sides, sharp, long, more, v = _draw(
        keys[0], mass=(4,), first=(1,), sides=(3,), sharp=(3,), long=(4,), more=(4,), v=(4, 2)
    )
    angles = jnp.cumsum(jnp.concatenate([2 * first - 1, 0.4 * jnp.sign(sides - 0.5) * (1 + 0.1 * sharp)]))
    lengths = jnp.where(long > 0.5, 0.56, 0.44) + 0.01 * (2 * more - 1)
    places = jnp.cumsum(lengths[:, None] * jnp.stack([jnp.sin(angles), -jnp.cos(angles)], 1), 0)
    anchor, up = t.place(jnp.zeros(2)), jnp.array([0.0, 1.0])
    return _scene(
        t,
        [carom.PointMass(t.mass * 10 ** (2 * m - 1), 0.05 * t.length) for m in mass],
        [],
        [
            carom.BendLimit([0, 1, 2, 3], 0.4, anchor, property=0),
            carom.StretchLimit([0, 1, 2, 3], 0.45 * t.length, 0.55 * t.length, anchor, property=1),
            carom.DiskPlane([3], t.place(places[3] - 0.045 * up), t.way(up), property=2),
        ],
        keys[2],
        [(t.place(p)[None], t.length / t.time * t.way(4 * u - 2)[None]) for p, u in zip(places, v, strict=True)],
        carom.Springs([0, 1, 2, 3], 30 * t.mass / t.time**2, 0.5 * t.length, anchor),
    )


def spheres(key, t: Frame) -> Scene:
    """Two rigid spheres that touch, a capsule on one of them, all on a floor."""
    keys = jax.random.split(key, 3)
    r, mass, moments, turns, way = _draw(keys[0], r=(2,), mass=(3,), moments=(3, 3), turns=(3, 3), way=(4,))
    tilt, depth, v, w = _draw(keys[1], tilt=(3,), depth=(3,), v=(3, 3), w=(3, 3))
    r, mass, depth = 0.2 + 0.3 * r, 10 ** (2 * mass - 1), 1e-3 + 0.02 * depth
    moments = 0.1 * mass[:, None] * (0.1 + 0.3 * moments)
    to, turn = _turn3(6 * way[:3]), [_turn3(6 * a) for a in turns]
    end, thin = jnp.array([0.0, 0.0, 0.3]), 0.1
    beside = to @ _unit(jnp.array([jnp.cos(1.5), jnp.sin(1.5), 0.3 * way[3]]))
    places = [jnp.zeros(3), (r[0] + r[1] - depth[0]) * to[:, 0]]
    places.append((r[0] + thin - depth[1]) * beside - turn[2] @ end)
    up = _turn3(0.3 * tilt)[:, 2]
    lowest = [places[i] @ up - r[i] for i in range(2)] + [(places[2] + s * turn[2] @ end) @ up - thin for s in (1, -1)]
    at = t.place((jnp.min(jnp.stack(lowest)) + depth[2]) * up)
    tip = t.within(end)
    return _scene(
        t,
        [t.body(mass[i], moments[i], r[i]) for i in range(2)] + [t.body(mass[2], moments[2])],
        [],
        [
            carom.DiskDisk([(0, 1)], property=2),
            carom.DiskPlane([0, 1], at, t.way(up), property=[0, 1]),
            carom.BallPlane([2, 2], jnp.stack([tip, -tip]), t.length * thin, at, t.way(up), property=1),
            carom.BallBall([(2, 0)], jnp.stack([tip, 0 * tip])[None], t.length * jnp.array([[thin, r[0]]]), property=0),
        ],
        keys[2],
        [t.state(places[i], turn[i], 4 * v[i] - 2, 8 * w[i] - 4) for i in range(3)],
    )


def machine(key, t: Frame) -> Scene:
    """A box with rounded corners on a floor, hinged to a wheel whose rim is on a ramp; a ball on the box, one fixed."""
    keys = jax.random.split(key, 3)
    mass, half, moments, turns, depth = _draw(keys[0], mass=(2,), half=(3,), moments=(2, 3), turns=(4,), depth=(2,))
    rounded, tilts, v, w = _draw(keys[1], rounded=(), tilts=(2, 3), v=(2, 3), w=(2, 3))
    mass, half, depth, rounded = 10 ** (2 * mass - 1), 0.2 + 0.2 * half, 1e-3 + 0.02 * depth, 0.05 * rounded
    moments = mass[:, None] * jnp.stack([half**2 / 3 * (0.5 + moments[0]), 0.05 * (0.5 + moments[1])])
    box = _turn3(6 * turns[:3])
    wheel, rim = box @ _turn3(jnp.array([6 * turns[3], 0.0, 0.0])), 0.35
    hinge, other = jnp.array([0.5, 0.1, 0.0]), jnp.array([-0.1, 0.0, 0.0])
    places = [jnp.zeros(3), box @ hinge - wheel @ other]
    floor, ramp = _turn3(0.3 * tilts[0])[:, 2], _turn3(0.3 * tilts[1] + jnp.array([0.4, 0.2, 0.0]))[:, 2]
    signs = jnp.array(np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), -1).reshape(-1, 3))
    low = jnp.min((signs * (half - rounded)) @ box.T @ floor) - rounded + depth[0]
    lean = jnp.linalg.norm(wheel[:, :2].T @ ramp)
    ball = jnp.array([0.1, -0.1, 0.05])
    fixed = box @ ball + 0.3 * jnp.array([0.0, 0.6, 0.8])
    first, second = (t.axes @ axis for axis in jnp.eye(3)[1:])
    axis = t.axes @ jnp.eye(3)[0]
    return _scene(
        t,
        [t.body(mass[0], moments[0]), t.body(mass[1], moments[1], rim)],
        [
            carom.Pivot(0, t.weights(hinge), 4, t.weights(other)),
            carom.Angles(4, jnp.stack([axis, axis]), jnp.stack([first, second]), 0.0, 0),
        ],
        [
            carom.CornerPlane([0], t.within(half), t.place(low * floor), t.way(floor), t.length * rounded, property=0),
            carom.RimPlane([1], t.place((places[1] @ ramp - rim * lean + depth[1]) * ramp), t.way(ramp), property=1),
            carom.BallBall(
                [(0, None)],
                jnp.stack([t.within(ball), t.place(fixed)])[None],
                t.length * jnp.array([[0.16, 0.145]]),
                property=2,
            ),
        ],
        keys[2],
        [t.state(p, q, 4 * v[i] - 2, 8 * w[i] - 4) for i, (p, q) in enumerate(zip(places, (box, wheel), strict=True))],
    )


SCENES: dict[str, tuple[Callable[..., Scene], list[int]]] = {
    "three_disks": (three_disks, [3, 3, 3]),
    "two_boxes": (two_boxes, [3, 3]),
    "chain": (chain, [1, 1, 1, 1]),
    "spheres": (spheres, [4, 4, 4]),
    "machine": (machine, [4, 4]),
}


def dim_of(name: str) -> int:
    return 3 if SCENES[name][1][0] == 4 else 2


def frames_of(rng: np.random.Generator, name: str, count: int) -> dict[str, Frame]:
    """Frames, each for `count` scenes."""
    dim = dim_of(name)
    turns, shifts = random_rotations(rng, count, dim), jnp.asarray(rng.normal(size=(count, dim)))
    mirror = turns.at[:, :, 0].multiply(-1)
    axes = np.roll(np.eye(dim), 1, axis=0)
    plain = Frame.plain(dim)
    one = {
        "plain": plain,
        "small": plain._replace(length=jnp.asarray(1e-3), mass=jnp.asarray(1e-6)),
        "large": plain._replace(length=jnp.asarray(1e3), mass=jnp.asarray(1e6)),
        "slow": plain._replace(time=jnp.asarray(37.0)),
    }
    if name != "machine":  # the axis of a rim is the body's third
        one["axes"] = plain._replace(axes=jnp.asarray(axes))
    out = {key: jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), frame) for key, frame in one.items()}
    out["turned"] = out["plain"]._replace(turn=turns)
    out["shifted"] = out["plain"]._replace(shift=shifts)
    out["mirrored"] = out["plain"]._replace(turn=mirror)
    out["all"] = out["small"]._replace(turn=mirror, shift=shifts, time=out["slow"].time)
    return out


def made(name: str, key, frame: Frame, **options) -> Scene:
    """A scene whose state keeps its joints; `options` are `System.with_...`'s, by name."""
    system, x, v = SCENES[name][0](key, frame)
    for option, value in options.items():
        system = getattr(system, f"with_{option}")(value)
    return Scene(system, *project_state(system.constraints, x, v, system.inverse_mass_matrix()))
