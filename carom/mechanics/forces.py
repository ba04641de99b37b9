"""Generalised forces beside the potential: springs, damping and drag, actuators, fluids.

Forces of joints are torques on their coordinates (N m on angles, N on slides); the system turns them into forces on
points. Forces of bodies are such already. Dry friction of joints is none of these: what holds is found together with
the contacts (`carom.contact.joint_limits`). A new kind of force is one class.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from carom.checks import as_floats, not_negative, require, require_values, whole
from carom.mechanics.constraints import place_weights

Numbers = ArrayLike | Sequence[float]


class Coordinates(NamedTuple):
    """Coordinates of all joints of a system, and their rates: rad and rad/s, m and m/s."""

    q: Float[Array, " q"]
    rate: Float[Array, " q"]


class Force(eqx.Module):
    """A force. What a kind has not is zero."""

    def energy(self, q: Float[Array, " q"]) -> Float[Array, ""]:
        """Potential energy (J) as a function of the joints' coordinates: its slope is a torque too."""
        return jnp.zeros((), q.dtype)

    def torque(self, at: Coordinates, signal: Float[Array, " u"]) -> Float[Array, " q"]:
        """Torques (N m, N) on the joints' coordinates; `signal`: what actuators are driven with."""
        return jnp.zeros_like(at.q)

    def on_points(self, x: Float[Array, "n d"], v: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """Forces (N) on the points."""
        return jnp.zeros_like(x)

    def dissipates(self) -> bool:
        """Whether it can only take energy away."""
        return False


class JointSpring(Force):
    """Springs of joints: torques `-(stiffness s + quadratic s^2 + cubic s^3)`, `s = q - rest`.

    **Arguments:** `stiffness` (q,), of each coordinate of the system's joints (N m/rad, N/m), or one for all; `rest`
    (q,), where they are slack (rad, m), or one for all; `deadband`, half of the width in which there is no force;
    `quadratic` and `cubic`, zero by default. `gears` (s, q), if given: the springs are those of the lengths `gears q`,
    of tendons say, with one number for each.
    """

    stiffness: Float[Array, "..."]
    rest: Float[Array, "..."]
    deadband: Float[Array, "..."]
    quadratic: Float[Array, "..."]
    cubic: Float[Array, "..."]
    gears: Float[Array, "s q"] | None

    def __init__(
        self,
        stiffness,
        rest: Numbers = 0.0,
        deadband: Numbers = 0.0,
        quadratic: Numbers = 0.0,
        cubic: Numbers = 0.0,
        gears=None,
    ):
        self.stiffness, self.rest, self.deadband = as_floats(stiffness), as_floats(rest), as_floats(deadband)
        self.quadratic, self.cubic = as_floats(quadratic), as_floats(cubic)
        self.gears = None if gears is None else as_floats(gears)
        require_values("JointSpring stiffness", stiffness, not_negative, "zero or positive numbers of N m/rad or N/m")
        require_values("JointSpring deadband", deadband, not_negative, "zero or positive numbers of rad or m")

    def energy(self, q):
        length = q if self.gears is None else self.gears @ q
        off, slack = length - self.rest, self.deadband
        off = jnp.where(off >= slack, off - slack, jnp.where(off <= -slack, off + slack, 0))
        return jnp.sum(self.stiffness * off**2 / 2 + self.quadratic * off**3 / 3 + self.cubic * off**4 / 4)


class JointDamping(Force):
    """Damping of joints: torques `-(viscous + quadratic |rate| + cubic rate^2) rate`.

    **Arguments:** `viscous` (q,), of each coordinate of the system's joints (N m s/rad, N s/m), or one for all;
    `quadratic` and `cubic` alike, zero by default. `gears` (s, q), if given: of the lengths `gears q`, of tendons say.
    """

    viscous: Float[Array, "..."]
    quadratic: Float[Array, "..."]
    cubic: Float[Array, "..."]
    gears: Float[Array, "s q"] | None

    def __init__(self, viscous, quadratic: Numbers = 0.0, cubic: Numbers = 0.0, gears=None):
        self.viscous, self.quadratic, self.cubic = as_floats(viscous), as_floats(quadratic), as_floats(cubic)
        self.gears = None if gears is None else as_floats(gears)
        for name, value in (("viscous", viscous), ("quadratic", quadratic), ("cubic", cubic)):
            require_values(f"JointDamping {name}", value, not_negative, "zero or positive numbers")

    def torque(self, at, signal):
        rate = at.rate if self.gears is None else self.gears @ at.rate
        torque = -(self.viscous + self.quadratic * jnp.abs(rate) + self.cubic * rate**2) * rate
        return torque if self.gears is None else self.gears.T @ torque

    def dissipates(self):
        return True


Dynamics = Literal["none", "integrator", "filter"]


class Actuators(Force):
    """Motors, servos and dampers: a torque `gear^T clip(gain a + bias_0 + bias_1 l + bias_2 l')` of each.

    `a` is its control, clipped to `control_range`, or the activation that this drives; `l = gear q` its length. The
    gain may be affine in the length and its rate too: `gain_0 + gain_1 l + gain_2 l'`.

    **Arguments:** (of `u` actuators on `q` coordinates)

    - `gears` (u, q): how far each moves with each coordinate.
    - `gain` (u, 3), or (u,) without the last two; `bias` (u, 3), zero by default.
    - `control_range`, `force_range` (u, 2): infinite where there is none, as by default.
    - `dynamics` (u,): `"none"`; `"integrator"`, `a' = c`; `"filter"`, `a' = (c - a) / time_constant` (u,) (s).
    - `activation_range` (u, 2) of what has dynamics.
    - `names` of the actuators.
    - `torque_range` (q, 2): of what all together do to a coordinate.

    A motor has a gain alone; a servo of stiffness k has the gain k and the bias (0, -k, 0).
    """

    gears: Float[Array, "u q"]
    gain: Float[Array, "u 3"]
    bias: Float[Array, "u 3"]
    control_range: Float[Array, "u 2"]
    force_range: Float[Array, "u 2"]
    activation_range: Float[Array, "u 2"]
    time_constant: Float[Array, " u"]
    torque_range: Float[Array, "q 2"] | None
    dynamics: tuple[Dynamics, ...] = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        gears,
        gain: Numbers = 1.0,
        bias: Numbers = 0.0,
        control_range=None,
        force_range=None,
        activation_range=None,
        dynamics: Sequence[Dynamics] | None = None,
        time_constant: Numbers = 1.0,
        names: Sequence[str] | None = None,
        torque_range=None,
    ):
        self.gears = as_floats(gears)
        require(
            self.gears.ndim == 2, f"Actuators gears must be (actuators, coordinates); they were {self.gears.shape}."
        )
        u = self.gears.shape[0]
        gain = np.asarray(gain, float)
        if gain.ndim < 2:
            gain = np.stack([np.broadcast_to(gain, (u,)), np.zeros(u), np.zeros(u)], axis=1)
        self.gain = as_floats(gain)
        self.bias = as_floats(np.broadcast_to(np.asarray(bias, float), (u, 3)))
        none = np.tile([-np.inf, np.inf], (u, 1))
        for name, value in (
            ("control_range", control_range),
            ("force_range", force_range),
            ("activation_range", activation_range),
        ):
            found = as_floats(none if value is None else value)
            require(found.shape == (u, 2), f"Actuators {name} must be ({u}, 2); its shape was {found.shape}.")
            setattr(self, name, found)
        self.torque_range = None if torque_range is None else as_floats(torque_range)
        self.dynamics = ("none",) * u if dynamics is None else tuple(dynamics)
        self.time_constant = as_floats(np.broadcast_to(np.asarray(time_constant, float), (u,)))
        self.names = tuple(f"actuator {k}" for k in range(u)) if names is None else tuple(names)
        for name in ("dynamics", "names"):
            count = len(getattr(self, name))
            require(count == u, f"Actuators {name} must be one for each of {u}; there were {count}.")

    @property
    def count(self) -> int:
        """Number of actuators."""
        return self.gears.shape[0]

    def torque(self, at, signal):
        length, rate = self.gears @ at.q, self.gears @ at.rate
        terms = jnp.stack([jnp.ones_like(length), length, rate], axis=1)
        force = jnp.sum(self.gain * terms, axis=1) * signal + jnp.sum(self.bias * terms, axis=1)
        torque = self.gears.T @ jnp.clip(force, self.force_range[:, 0], self.force_range[:, 1])
        if self.torque_range is not None:
            torque = jnp.clip(torque, self.torque_range[:, 0], self.torque_range[:, 1])
        return torque


class Signal(NamedTuple):
    """What drives actuators within a step, as a function of the time since it began: `goal + slope t + (start - goal)
    exp(-rate t)`, clipped."""

    start: Float[Array, " u"]
    goal: Float[Array, " u"]
    slope: Float[Array, " u"]
    rate: Float[Array, " u"]
    range: Float[Array, "u 2"]

    def at(self, time) -> Float[Array, " u"]:
        """Its value."""
        value = self.goal + self.slope * time + (self.start - self.goal) * jnp.exp(-self.rate * time)
        return jnp.clip(value, self.range[:, 0], self.range[:, 1])


def signal_of(actuators: Actuators, control: Float[Array, " u"], activation: Float[Array, " u"]) -> Signal:
    """What actuators are driven with in a step of constant `control`, from their `activation` at its start."""
    control = jnp.clip(control, actuators.control_range[:, 0], actuators.control_range[:, 1])
    kinds = np.array(actuators.dynamics)
    direct, integrates, filters = (kinds == kind for kind in ("none", "integrator", "filter"))
    start = jnp.where(direct, control, activation)
    free = jnp.where(direct[:, None], jnp.array([-jnp.inf, jnp.inf]), actuators.activation_range)
    return Signal(
        start=start,
        goal=jnp.where(filters, control, start),
        slope=jnp.where(integrates, control, 0),
        rate=jnp.where(filters, 1 / actuators.time_constant, 0),
        range=free,
    )


class PointForce(Force):
    """A constant force on a material point of a rigid body, in space: what carries part of its weight, say.

    **Arguments:** `first`, the body's first point; `place` (d,) in its frame (m); `force` (d,) in N.
    """

    first: int = eqx.field(static=True)
    weights: Float[Array, " p"]
    force: Float[Array, " d"]

    def __init__(self, first: int, place, force):
        self.first, self.weights, self.force = whole("PointForce first", first), place_weights(place), as_floats(force)

    def on_points(self, x, v):
        span = slice(self.first, self.first + self.weights.shape[0])
        return jnp.zeros_like(x).at[span].set(self.weights[:, None] * self.force)


class BodyForce(Force):
    """A force and a torque on a rigid body that hang on how it moves: a base for damping, drag and fluids.

    Of `first`, the body's first point, in 3D, with a frame of `axes` (3, 3), rows in the body's frame, at `place`.
    """

    first: int = eqx.field(static=True)
    place: Float[Array, " 3"]
    axes: Float[Array, "3 3"]

    def __init__(self, first: int, place=None, axes=None):
        self.first = whole(f"{type(self).__name__} first", first)
        self.place = as_floats(np.zeros(3) if place is None else place)
        self.axes = as_floats(np.eye(3) if axes is None else axes)

    def wrench(self, velocity: Float[Array, " 3"], spin: Float[Array, " 3"]) -> tuple[Array, Array]:
        """Force (N) at the place and torque (N m), from its velocity (m/s) and the spin (rad/s), all along `axes`."""
        raise NotImplementedError

    def on_points(self, x, v):
        at = slice(self.first, self.first + 4)
        weights = place_weights(self.place)
        own = x[self.first + 1 : self.first + 4] - x[self.first]
        turning = v[self.first + 1 : self.first + 4] - v[self.first]
        spin = own @ (jnp.sum(jnp.cross(own, turning), axis=0) / 2)
        force, torque = self.wrench(self.axes @ (own @ (weights @ v[at])), self.axes @ spin)
        # A torque as forces on the axes' ends: of each half of `torque x axis`.
        pulls = jnp.cross((self.axes.T @ torque) @ own, own) / 2
        forces = weights[:, None] * ((self.axes.T @ force) @ own)
        forces = forces + jnp.concatenate([-jnp.sum(pulls, axis=0, keepdims=True), pulls])
        return jnp.zeros_like(x).at[at].add(forces)

    def dissipates(self):
        return True


class BodyDrag(BodyForce):
    """Damping and drag of a rigid body: `-(linear + quadratic |v|) v` at its place, and `-angular omega` of its spin.

    **Arguments:** `first`, the body's first point; `linear` (kg/s), `quadratic` (kg/m), `angular` (kg m^2/s);
    `place` (3,) in its frame (m), the centre of mass by default.
    """

    linear: Float[Array, ""]
    quadratic: Float[Array, ""]
    angular: Float[Array, ""]

    def __init__(self, first: int, linear=0.0, quadratic=0.0, angular=0.0, place=None):
        super().__init__(first, place)
        self.linear, self.quadratic, self.angular = as_floats(linear), as_floats(quadratic), as_floats(angular)
        for name in ("linear", "quadratic", "angular"):
            require_values(f"BodyDrag {name}", getattr(self, name), not_negative, "zero or a positive number")

    def wrench(self, velocity, spin):
        return -(self.linear + self.quadratic * _length(velocity)) * velocity, -self.angular * spin


class PointDrag(Force):
    """Damping and drag of points, the centres of bodies say: `-(linear + quadratic |v|) v` of each.

    **Arguments:** `points`, their numbers; `linear` (kg/s), `quadratic` (kg/m): one for all, or one for each.
    """

    points: tuple[int, ...] = eqx.field(static=True)
    linear: Float[Array, "..."]
    quadratic: Float[Array, "..."]

    def __init__(self, points: Sequence[int], linear=0.0, quadratic=0.0):
        self.points = tuple(whole("PointDrag points", p) for p in points)
        self.linear, self.quadratic = as_floats(linear), as_floats(quadratic)
        for name in ("linear", "quadratic"):
            require_values(f"PointDrag {name}", getattr(self, name), not_negative, "zero or positive numbers")

    def on_points(self, x, v):
        at = np.array(self.points, int)
        speed = jnp.stack([_length(v[p]) for p in self.points])
        return jnp.zeros_like(x).at[at].add(-(self.linear + self.quadratic * speed)[:, None] * v[at])

    def dissipates(self):
        return True


class InertiaBoxFluid(BodyForce):
    """A fluid's forces on a body as on the box of its inertia, MuJoCo's model of that name.

    **Arguments:** `first`, `place`, `axes`: the frame of its inertia; `box` (3,), edges (m); `density` (kg/m^3) and
    `viscosity` (Pa s) of the fluid.
    """

    box: Float[Array, " 3"]
    density: Float[Array, ""]
    viscosity: Float[Array, ""]

    def __init__(self, first: int, place, axes, box, density, viscosity):
        super().__init__(first, place, axes)
        self.box, self.density, self.viscosity = as_floats(box), as_floats(density), as_floats(viscosity)

    def wrench(self, velocity, spin):
        diameter, box = jnp.mean(self.box), self.box
        force = -3 * jnp.pi * diameter * self.viscosity * velocity
        torque = -jnp.pi * diameter**3 * self.viscosity * spin
        area = jnp.stack([box[1] * box[2], box[0] * box[2], box[0] * box[1]])
        force = force - 0.5 * self.density * area * jnp.abs(velocity) * velocity
        a, b = jnp.stack([box[1], box[0], box[0]]), jnp.stack([box[2], box[2], box[1]])
        return force, torque - self.density * box * (a**4 + b**4) * jnp.abs(spin) * spin / 64


def _length(vector: Float[Array, " d"]) -> Float[Array, ""]:
    """Its length, with a derivative of zero at zero."""
    square = jnp.sum(vector**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


class Rotors(eqx.Module):
    """Rotors behind gears: inertias that turn with joints, of energy `inertia (gear rate)^2 / 2` each.

    **Arguments:** `gears` (r, q), how fast each turns with each coordinate of the system's joints; `inertia` (r,)
    (kg m^2, or kg where it shifts), positive. With gears of one it is what MuJoCo calls armature.
    """

    gears: Float[Array, "r q"]
    inertia: Float[Array, " r"]

    def __init__(self, gears, inertia):
        self.gears, self.inertia = as_floats(gears), as_floats(inertia)
        require(
            self.gears.ndim == 2 and self.inertia.shape == self.gears.shape[:1],
            f"Rotors gears must be (rotors, coordinates) and inertia one for each; their shapes were "
            f"{self.gears.shape} and {self.inertia.shape}.",
        )
        require_values("Rotors inertia", inertia, lambda a: np.isfinite(a) & (a > 0), "positive numbers of kg m^2")
