"""Joints as things with coordinates: how a body can move against its parent, and how far it has.

A rigid body hangs on its parent, another rigid body or space, by joints in a row: its frame is the parent's, moved to
where it is at rest, and then by each joint in turn,

    T_child = T_parent T_0 E_1(q_1) ... E_k(q_k),

where `E` of a hinge turns about an axis through an anchor, that of a slide shifts along an axis, and that of a ball
turns about an anchor by a rotation vector, all in the child's frame. (MuJoCo's are so.) The coordinates are functions
of the points in closed form: their rates, and the forces that torques on them are, are derivatives.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation
from jaxtyping import Array, Float

from carom.checks import as_floats, at_once_if_known, require, require_values, whole
from carom.mechanics.constraints import Constraint

JointKind = Literal["hinge", "slide", "ball", "free"]
JOINT_KINDS = get_args(JointKind)
_SMALL = 1e-5
"""Squares of angles below which series are exact to rounding."""


class Joints(Constraint):
    """The joints between a rigid body and its parent, in order: slides and hinges, or slides and a ball; or a free one.

    **Arguments:** (`k` joints with `q` coordinates)

    - `i`, `j`: first points of the body and of its parent; `j` is `None` for space.
    - `kinds` (k,): `"hinge"`, `"slide"`, `"ball"`, or `"free"` alone. None at all: the body is held.
    - `axes` (k, d): of hinges (in 3D) and slides, in the body's frame, of any length; of others nothing.
    - `anchors` (k, d): a point of each axis in the body's frame (m). The first is at `place` (d,) of the parent's frame
      at rest (m); without joints that is where the centre of mass is.
    - `rotation` (d, d): the body's axes at rest, as columns, in the parent's frame; by default they are alike.
    - `rest` (q,): coordinates at rest, 0 by default; `near` (q,): angles are told within half a turn of these, by
      default of `rest`.
    - `frame` (d, d): axes, as rows in the body's frame, of the frame that rotation vectors are told in; its own by
      default.
    - `names` of the joints; by default their kinds, with the first point of the body.

    Coordinates of a ball are a rotation vector (rad) and its rates the angular velocity against the parent (rad/s);
    those of what is free are a place and a rotation vector.

    **Raises:** `CaromError` for other kinds, shapes that do not fit, axes that are zero or not independent.
    """

    i: int = eqx.field(static=True)
    j: int | None = eqx.field(static=True)
    kinds: tuple[JointKind, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    meet: bool = eqx.field(static=True)
    axes: Float[Array, "k d"]
    anchors: Float[Array, "k d"]
    place: Float[Array, " d"]
    rotation: Float[Array, "d d"]
    rest: Float[Array, " q"]
    near: Float[Array, " q"]
    frame: Float[Array, "d d"]

    def __init__(
        self,
        i: int,
        j: int | None,
        kinds: Sequence[JointKind],
        axes,
        anchors,
        place,
        rotation=None,
        rest=None,
        near=None,
        frame=None,
        names: Sequence[str] | None = None,
    ):
        self.i, self.j = whole("Joints i", i), None if j is None else whole("Joints j", j)
        require(i != j, f"Joints are between two different bodies; the first point of both was {i}.")
        self.kinds, self.place = tuple(kinds), as_floats(place)
        d = self.place.shape[0]
        _check_kinds(self.kinds, d, j)
        shape = (len(self.kinds), d)
        self.anchors, axes = (as_floats(np.asarray(a, float).reshape(shape)) for a in (anchors, axes))
        self.axes = _unit(self.kinds, axes)
        self.meet = _meet(self.kinds, np.asarray(self.anchors))
        self.rotation, self.frame = (as_floats(np.eye(d) if a is None else a) for a in (rotation, frame))
        self.rest = as_floats(np.zeros(self.count) if rest is None else rest)
        self.near = self.rest if near is None else as_floats(near)
        for name, wanted in (("rotation", (d, d)), ("frame", (d, d)), ("rest", (self.count,)), ("near", (self.count,))):
            value = getattr(self, name)
            require(value.shape == wanted, f"Joints {name} must have the shape {wanted}; it had {value.shape}.")
            require_values(f"Joints {name}", value, np.isfinite, "finite numbers")
        given = [f"{kind} {i}" for kind in self.kinds] if names is None else names
        self.names = tuple(given)
        require(len(self.names) == shape[0], f"Joints names must be {shape[0]}, one a joint; they were {self.names}.")

    # --- coordinates ------------------------------------------------------------------------------------------

    @property
    def dim(self) -> int:
        """The dimension of space."""
        return self.place.shape[0]

    @property
    def sizes(self) -> tuple[int, ...]:
        """How many coordinates each joint has."""
        turns = 3 if self.dim == 3 else 1
        size = {"hinge": 1, "slide": 1, "ball": turns, "free": self.dim + turns}
        return tuple(size[kind] for kind in self.kinds)

    @property
    def count(self) -> int:
        """Number of coordinates q."""
        return sum(self.sizes)

    def coordinate_names(self) -> tuple[str, ...]:
        """Names of the coordinates: the joint's, and with `:0`, `:1`, ... where it has several."""
        named = zip(self.names, self.sizes, strict=True)
        return tuple(name if size == 1 else f"{name}:{k}" for name, size in named for k in range(size))

    def coordinates(self, x: Float[Array, "n d"]) -> Float[Array, " q"]:
        """Angles and rotation vectors (rad), amounts of slides and places (m) of one state."""
        turn, place = self._relative(x)
        moved = self.rotation.T @ turn
        if self.kinds == ("free",):
            way = place + turn @ self.anchors[0] - self.place
            return self.rest + jnp.concatenate([way, self._rotation_vector(moved)])
        angles = self._angles(moved)
        amounts, _ = self._slid(turn, place, moved, angles)
        parts = []
        for kind in self.kinds:
            if kind == "ball":
                parts.append(self._rotation_vector(moved))
            else:
                parts.append((angles if kind == "hinge" else amounts).pop(0)[None])
        q = self.rest + (jnp.concatenate(parts) if parts else jnp.zeros(0, x.dtype))
        turns = 2 * jnp.pi * jnp.round((q - self.near) / (2 * jnp.pi))
        return q - jnp.where(np.array(self.is_hinge()), jax.lax.stop_gradient(turns), 0)

    def rates(self, x: Float[Array, "n d"], v: Float[Array, "n d"]) -> Float[Array, " q"]:
        """How fast coordinates change (rad/s, m/s); of balls and what is free, the angular velocity in the frame that
        rotation vectors are told in. Linear in `v`."""
        rates = jax.jvp(self.coordinates, (x,), (v,))[1]
        if self.dim == 2 or not set(self.kinds) & {"ball", "free"}:
            return rates
        (turn, _), (change, _) = jax.jvp(self._relative, (x,), (v,))
        spin = self.frame @ _vector(turn.T @ change)
        free = self.kinds == ("free",)
        first = self.dim if free else sum(self.sizes[: self.kinds.index("ball")])
        return jnp.concatenate([rates[:first], spin, rates[first + 3 :]])

    def pose(
        self, q: Float[Array, " q"], turn: Float[Array, "d d"], place: Float[Array, " d"], change: Float[Array, " q"]
    ) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
        """The body's axes, as columns, and its centre of mass (m), from those of its parent and the coordinates.

        `change` is what coordinates have changed by since, as their rates are meant: a small one turns `q` of a ball
        further.
        """
        q = q - self.rest
        if self.kinds == ("free",):
            d = self.dim
            moved = self.rotation @ self._turned(q[d:]) @ self._turned(change[d:])
            return moved, self.place + q[:d] + change[:d] - moved @ self.anchors[0]
        own = self.rotation
        at = self.place - (own @ self.anchors[0] if len(self.kinds) else 0)
        first = 0
        for k, (kind, size) in enumerate(zip(self.kinds, self.sizes, strict=True)):
            here, more = q[first : first + size], change[first : first + size]
            first += size
            if kind == "slide":
                at = at + (here + more)[0] * (own @ self.axes[k])
                continue
            by = self._turned(here) @ self._turned(more) if kind == "ball" else self._about(k, (here + more)[0])
            at = at + own @ (self.anchors[k] - by @ self.anchors[k])
            own = own @ by
        return turn @ own, place + turn @ at

    # --- equations --------------------------------------------------------------------------------------------

    def __call__(self, x):
        if self.kinds == ("free",):
            return jnp.zeros(0, x.dtype)
        turn, place = self._relative(x)
        moved = self.rotation.T @ turn
        angles = [] if self.meet else self._angles(moved)  # else they say where the body can be
        _, held = self._slid(turn, place, moved, angles)
        return jnp.concatenate([self._turn_equations(moved), held])

    def points(self):
        d = self.place.shape[0]
        return tuple(p for first in (self.i, self.j) if first is not None for p in range(first, first + d + 1))

    def size(self, length):
        turns = 0 if self.kinds == ("free",) else len(self._turn_equations(np.eye(self.dim)))
        shifts = 0 if self.kinds == ("free",) else self.dim - self.kinds.count("slide")
        arm = jnp.max(jnp.linalg.norm(self.anchors, axis=1), initial=0)
        one = jnp.ones_like(length)
        return jnp.concatenate([jnp.broadcast_to(one, (turns,)), jnp.broadcast_to(jnp.maximum(length, arm), (shifts,))])

    # --- parts ------------------------------------------------------------------------------------------------

    def is_hinge(self) -> list[bool]:
        """Of each coordinate, whether it is the angle of a hinge."""
        return [kind == "hinge" for kind, size in zip(self.kinds, self.sizes, strict=True) for _ in range(size)]

    def _of(self, kind: JointKind) -> list[int]:
        return [k for k, this in enumerate(self.kinds) if this == kind]

    def _relative(self, x: Float[Array, "n d"]) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
        """The body's axes, as columns, and its centre of mass in the frame of the parent."""
        axes, place = _frame(x, self.i, self.dim)
        if self.j is None:
            return axes.T, place
        parent, origin = _frame(x, self.j, self.dim)
        return parent @ axes.T, parent @ (place - origin)

    def _about(self, k: int, angle: Float[Array, ""]) -> Float[Array, "d d"]:
        """The turn of hinge `k` by an angle (Rodrigues)."""
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        if self.dim == 2:
            return jnp.array([[cos, -sin], [sin, cos]])
        a = self.axes[k]
        return cos * jnp.eye(3, dtype=a.dtype) + sin * _cross(a) + (1 - cos) * jnp.outer(a, a)

    def _turned(self, vector: Float[Array, " w"]) -> Float[Array, "d d"]:
        """The turn by a rotation vector in `frame`."""
        if self.dim == 2:
            return self._about(0, vector[0])
        return turn_by(self.frame.T @ vector)

    def _rotation_vector(self, moved: Float[Array, "d d"]) -> Float[Array, " w"]:
        if self.dim == 2:
            return _angle_2d(moved)[None]
        return self.frame @ rotation_vector(moved)

    def _angles(self, moved: Float[Array, "d d"]) -> list[Float[Array, ""]]:
        """Angles of the hinges, in order, that together are the turn `moved`."""
        hinges = self._of("hinge")
        if not hinges:
            return []
        if self.dim == 2:
            return [_angle_2d(moved)]
        a, c = self.axes[hinges[0]], self.axes[hinges[-1]]
        if len(hinges) == 1:
            return [jnp.arctan2(a @ _vector(moved), (jnp.trace(moved) - 1) / 2)]
        if len(hinges) == 2:
            return [_angle_about(a, c, moved @ c), _angle_about(c, a @ moved, a)]
        b = self.axes[hinges[1]]
        # a . S c = a . E_b(q) c = A + B cos q + C sin q, and of both solutions that which is 0 at rest.
        A, C = (a @ b) * (b @ c), a @ jnp.cross(b, c)
        B = a @ c - A
        middle = jnp.arctan2(C, B)
        half = jnp.arccos(jnp.clip((a @ moved @ c - A) / jnp.sqrt(B**2 + C**2), -1, 1))
        angle = middle - jnp.sign(C) * half
        turned, back = self._about(hinges[1], angle) @ c, a @ self._about(hinges[1], angle)
        return [_angle_about(a, turned, moved @ c), angle, _angle_about(c, a @ moved, back)]

    def _turn_equations(self, moved) -> Float[Array, " e"]:
        """What holds the rotation: zero where the hinges alone have turned the body."""
        hinges = self._of("hinge")
        if "ball" in self.kinds or len(hinges) == 3 or (self.dim == 2 and hinges):
            return jnp.zeros(0)
        if not hinges:
            return jnp.atleast_1d((moved[1, 0] - moved[0, 1]) / 2) if self.dim == 2 else _vector(moved)
        a = self.axes[hinges[0]]
        if len(hinges) == 1:
            return across(a) @ moved @ a
        c = self.axes[hinges[1]]
        return (a @ moved @ c - a @ c)[None]

    def _slid(self, turn, place, moved, angles) -> tuple[list[Float[Array, ""]], Float[Array, " e"]]:
        """Amounts of the slides, and what is left of the way from rest that these are not: zero where joints hold."""
        own, ways = self.rotation, []
        if self.meet:
            anchor = self.anchors[0] if len(self.kinds) else jnp.zeros_like(self.place)
            left = place + turn @ anchor - self.place
            ways = [own @ self.axes[k] for k in self._of("slide")]
            first = own
        else:
            at, angle, first = self.place - own @ self.anchors[0], iter(angles), own
            for k, kind in enumerate(self.kinds):
                if kind == "slide":
                    first = own if not ways else first
                    ways.append(own @ self.axes[k])
                    continue
                by = moved if kind == "ball" else self._about(k, next(angle))
                at = at + own @ (self.anchors[k] - by @ self.anchors[k])
                own = own @ by
            left = place - at
        if not ways:
            return [], left
        A = jnp.stack(ways, axis=1)
        amounts = jnp.linalg.solve(A.T @ A, A.T @ left)
        if len(ways) == self.dim:
            free = jnp.zeros((0, self.dim), left.dtype)
        elif len(ways) == 2:
            free = jnp.cross(A[:, 0], A[:, 1])[None]
            free = free / jnp.linalg.norm(free)
        else:
            free = (first @ across(self.axes[self._of("slide")[0]]).T).T
        return [amounts[k] for k in range(len(ways))], free @ left


class Coupling(Constraint):
    """Coordinates of joints that hang on each other: a gear, a belt, a mimic joint.

    `first (q - zeros_0) = c_0 + c_1 s + ... + c_4 s^4`, `s = second q - zeros_1`, in rad or m.

    **Arguments:** `joints`, as they stand in the system's constraints; `first`, `second` (q,) over their coordinates,
    one after the other; `coefficients` (c,); `zeros` (2,).

    Angles are known up to full turns. A linear coupling of two hinges whose ratio is a simple fraction, a gear, holds
    over turns; others hold within half a turn of where the joints are at rest.
    """

    joints: tuple[Joints, ...]
    first: Float[Array, " q"]
    second: Float[Array, " q"]
    coefficients: Float[Array, " c"]
    zeros: Float[Array, " 2"]
    period: float | None = eqx.field(static=True)

    def __init__(self, joints: Sequence[Joints], first, second, coefficients, zeros=(0.0, 0.0)):
        self.joints = tuple(joints)
        self.first, self.second, self.coefficients = as_floats(first), as_floats(second), as_floats(coefficients)
        self.zeros, count = as_floats(zeros), sum(joint.count for joint in self.joints)
        for name, value in (("first", self.first), ("second", self.second)):
            require(
                value.shape == (count,),
                f"Coupling {name} must be {count} numbers, one a coordinate; its shape was {value.shape}.",
            )
        self.period = self._period()

    def _period(self) -> float | None:
        """What the equation is known up to, as angles are known up to full turns: of gears, whose ratio is rational."""
        hinges = np.array([is_hinge for joint in self.joints for is_hinge in joint.is_hinge()], bool)
        rows = np.stack([np.asarray(self.first), np.asarray(self.second)])
        unit = np.isin(rows, (0.0, 1.0)).all() and (rows.sum(axis=1) <= 1).all() and not rows[:, ~hinges].any()
        linear = np.asarray(self.coefficients, float)
        if not unit or np.any(linear[2:] != 0):
            return None
        ratio = float(linear[1]) if len(linear) > 1 and rows[1].any() else 0.0
        near = Fraction(ratio).limit_denominator(64)
        return 2 * np.pi / near.denominator if abs(float(near) - ratio) < 1e-9 else None

    @classmethod
    def of(cls, joints: Sequence[Joints], first, second, coefficients, zeros=(0.0, 0.0)) -> "Coupling":
        """The same with all joints of a system, of which those that it does not hang on are left out."""
        used, rows = those_of(joints, np.stack([first, second]))
        return cls(used, rows[0], rows[1], coefficients, zeros)

    def __call__(self, x):
        q = jnp.concatenate([joint.coordinates(x) for joint in self.joints])
        s = self.second @ q - self.zeros[1]
        off = self.first @ q - self.zeros[0] - jnp.polyval(self.coefficients[::-1], s)
        if self.period is not None:
            off = off - jax.lax.stop_gradient(self.period * jnp.round(off / self.period))
        return off[None]

    def points(self):
        return tuple(dict.fromkeys(p for joint in self.joints for p in joint.points()))

    def size(self, length):
        return jnp.ones_like(length)


def those_of(joints: Sequence[Joints], rows: Float[np.ndarray, "r q"]) -> tuple[list[Joints], Float[np.ndarray, "r p"]]:
    """Those of some joints that rows over the coordinates of all of them have a part in, and the rows over theirs."""
    parts = np.split(rows, np.cumsum([joint.count for joint in joints])[:-1], axis=1)
    used = [k for k, part in enumerate(parts) if part.any()]
    return [joints[k] for k in used], np.concatenate([parts[k] for k in used], axis=1)


def _check_kinds(kinds: Sequence[str], d: int, j: int | None) -> None:
    wrong = [kind for kind in kinds if kind not in JOINT_KINDS]
    require(not wrong, f"Joints kinds must be of {', '.join(JOINT_KINDS)}; they were {', '.join(map(str, kinds))}.")
    hinges, slides, balls, free = (kinds.count(kind) for kind in JOINT_KINDS)
    require(
        hinges <= (3 if d == 3 else 1)
        and slides <= d
        and balls <= (d == 3)
        and not (balls and hinges)
        and (not free or (len(kinds) == 1 and j is None)),
        f"Joints of one body are at most {d} slides and {3 if d == 3 else 1} hinges, or slides and a ball (in 3D), or "
        f"one that is free in space; they were {', '.join(kinds)}.",
    )


def _meet(kinds: Sequence[str], anchors: Float[np.ndarray, "k d"]) -> bool:
    """Whether one point of the body is moved by the slides alone: all axes go through it, and slides come first."""
    turning = [k for k, kind in enumerate(kinds) if kind != "slide"]
    first = turning[0] if turning else len(kinds)
    return all(kind != "slide" for kind in kinds[first:]) and bool(np.all(anchors[turning] == anchors[:1]))


def _unit(kinds: Sequence[str], axes: Float[Array, "k d"]) -> Float[Array, "k d"]:
    """Axes of length one; where they mean nothing, zeros."""
    d = axes.shape[1]
    used = np.array([kind == "slide" or (kind == "hinge" and d == 3) for kind in kinds], bool)
    length = np.linalg.norm(np.asarray(axes), axis=1)
    require(bool(np.all(length[used] > 0)), "Joints axes of hinges and slides must have a length; one was zero.")
    for kind in ("hinge", "slide"):
        rows = np.asarray(axes)[[k == kind and u for k, u in zip(kinds, used, strict=True)]]
        rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        require(
            len(rows) == 0 or np.linalg.matrix_rank(rows, tol=1e-6) == len(rows),
            f"Joints axes of {kind}s must be independent; they were {rows.round(6).tolist()}.",
        )
    with at_once_if_known(axes):
        return jnp.where(used[:, None], axes / np.where(used, length, 1)[:, None], 0)


def _frame(x: Float[Array, "n d"], first: int, d: int) -> tuple[Float[Array, "d d"], Float[Array, " d"]]:
    """The axes of a rigid body, one a row, and its centre of mass."""
    return x[first + 1 : first + 1 + d] - x[first], x[first]


def _cross(a: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The matrix of `a x`."""
    zero = jnp.zeros_like(a[0])
    return jnp.array([[zero, -a[2], a[1]], [a[2], zero, -a[0]], [-a[1], a[0], zero]])


def _vector(matrix: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """The vector of the antisymmetric part: of a turn about `a` by `q`, `a sin q`."""
    m = matrix
    return jnp.stack([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2


def _angle_2d(moved: Float[Array, "2 2"]) -> Float[Array, ""]:
    return jnp.arctan2(moved[1, 0] - moved[0, 1], moved[0, 0] + moved[1, 1])


def _angle_about(axis, start, end) -> Float[Array, ""]:
    """The angle about a unit axis that turns `start` to `end`."""
    return jnp.arctan2(axis @ jnp.cross(start, end), start @ end - (axis @ start) * (axis @ end))


def across(axis: Float[Array, " d"]) -> Float[Array, "e d"]:
    """Unit vectors at right angles to a unit `axis` and to each other: two in 3D, one in 2D (T. Duff et al., *Building
    an Orthonormal Basis, Revisited*, 2017)."""
    if axis.shape[0] == 2:
        return jnp.stack([-axis[1], axis[0]])[None]
    x, y, z = axis
    s = jnp.where(z >= 0, 1.0, -1.0).astype(axis.dtype)
    a = -1 / (s + z)
    b = x * y * a
    return jnp.stack([jnp.stack([1 + s * x**2 * a, s * b, -s * x]), jnp.stack([b, s + y**2 * a, -y])])


def turn_by(vector: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The rotation matrix of a rotation vector (rad) (Rodrigues), with a derivative at zero."""
    square = jnp.sum(vector**2)
    small = square < _SMALL
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    sine = jnp.where(small, 1 - square / 6 + square**2 / 120, jnp.sin(angle) / angle)
    cosine = jnp.where(small, 0.5 - square / 24 + square**2 / 720, (1 - jnp.cos(angle)) / safe)
    cross = _cross(vector)
    return jnp.eye(3, dtype=vector.dtype) + sine * cross + cosine * cross @ cross


def rotation_vector(turn: Float[Array, "3 3"]) -> Float[Array, " 3"]:
    """The rotation vector (rad) of a rotation matrix, with a derivative where nothing is turned."""
    vector, cosine = _vector(turn), (jnp.trace(turn) - 1) / 2
    square = jnp.sum(vector**2)
    wide = (cosine < 0) | (square > _SMALL)
    quarter = jnp.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], turn.dtype)
    far = Rotation.from_matrix(jnp.where(wide, turn, quarter)).as_rotvec()
    near = vector * (1 + square / 6 + 3 * square**2 / 40)
    return jnp.where(wide, far, near)
