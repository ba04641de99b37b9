"""The named problems of optimal control: billiards, thrown disks, and those of Zhong, Han and Brikis (2022)."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.tasks.base import find_named
from carom.tasks.control import Control, OptimizerName, Setup
from carom.tasks.disks import BILLIARDS, THROW
from carom.tasks.impacts import BOUNCE_ONCE, GROUND_WALL, TWO_BALLS

Point = tuple[float, float]


class Aim(Control):
    """The velocity with which one ball, from a given place, is at another place at the end (Zhong et al., 1 and 3)."""

    name: str
    task: str
    dt: float
    steps: int
    place: Point
    velocity: Point
    aim: Point
    optimizer: OptimizerName = "lbfgs"
    learning_rate: float = 0.1
    unit: str = "m"

    def start(self):
        return {"velocity": jnp.asarray(self.velocity)}

    def setup(self, system, choice):
        return Setup(system, jnp.asarray(self.place)[None], choice["velocity"][None])

    def loss(self, choice, motion):
        return jnp.sum((motion.x[-1, 0] - jnp.asarray(self.aim)) ** 2)

    def miss(self, motion):
        return jnp.linalg.norm(motion.x[-1, 0] - jnp.asarray(self.aim))

    def scout(self, key, play):
        return None

    def target(self):
        return np.array(self.aim)


class TwoBalls(Control):
    """The force on one ball, over time, that makes it drive another to the origin at little cost (Zhong et al., 4).

    The loss is `|x_2(T)|^2 + 0.1 int |u|^2 dt`; its analytic optimum is 1.396542.
    """

    name: str = "two-balls"
    task: str = TWO_BALLS.name
    dt: float = TWO_BALLS.dt
    steps: int = TWO_BALLS.steps
    first_force: Point = (3.0, 3.0)
    weight: float = 0.1
    optimizer: OptimizerName = "lbfgs"
    learning_rate: float = 0.1
    unit: str = "m"

    def start(self):
        return {"force": jnp.broadcast_to(jnp.asarray(self.first_force), (self.steps, 2))}

    def setup(self, system, choice):
        force = jnp.stack([choice["force"], jnp.zeros_like(choice["force"])], axis=1)
        return Setup(system, jnp.asarray(TWO_BALLS.start), jnp.asarray(TWO_BALLS.velocity), force)

    def loss(self, choice, motion):
        return jnp.sum(motion.x[-1, 1] ** 2) + self.weight * self.dt * jnp.sum(choice["force"] ** 2)

    def miss(self, motion):
        return jnp.linalg.norm(motion.x[-1, 1])

    def scout(self, key, play):
        return None

    def target(self):
        return np.zeros(2)


class Billiards(Control):
    """Place and velocity of the cue ball that bring the last ball of the triangle to a place at the end.

    In which order the balls meet decides in which direction the last one goes, almost alone: they stand closer together
    than they are wide, so that each impact makes deviations smaller. A descent that keeps the order of the given start
    ends 4.6 mm from the place. So `scout` tries shots until one makes the last ball pass by it.
    """

    name: str = "billiards"
    task: str = BILLIARDS.name
    dt: float = BILLIARDS.dt
    steps: int = BILLIARDS.steps
    place: Point = (0.1, 0.5)
    velocity: Point = (0.3, 0.0)
    aim: Point = (0.9, 0.75)
    shots: int = 100  # that are tried at once
    optimizer: OptimizerName = "lbfgs"
    learning_rate: float = 0.01
    unit: str = "m"

    def start(self):
        return {"place": jnp.asarray(self.place), "velocity": jnp.asarray(self.velocity)}

    def setup(self, system, choice):
        x0 = jnp.concatenate([choice["place"][None], jnp.asarray(BILLIARDS.triangle())])
        return Setup(system, x0, jnp.zeros_like(x0).at[0].set(choice["velocity"]))

    def loss(self, choice, motion):
        return jnp.sum((motion.x[-1, -1] - jnp.asarray(self.aim)) ** 2)

    def miss(self, motion):
        return jnp.linalg.norm(motion.x[-1, -1] - jnp.asarray(self.aim))

    def scout(self, key, play):
        where, ball, aside, speed = jax.random.split(key, 4)
        count, rack = self.shots, jnp.asarray(BILLIARDS.triangle())
        away = jnp.asarray(self.place) + jax.random.uniform(where, (count, 2), minval=-1.0) * jnp.array([0.1, 0.3])
        aim = rack[jax.random.randint(ball, (count,), 0, len(rack))] + 0.02 * jax.random.normal(aside, (count, 2))
        towards = (aim - away) / jnp.linalg.norm(aim - away, axis=1, keepdims=True)
        shot = {"place": away, "velocity": towards * jax.random.uniform(speed, (count, 1), minval=0.8, maxval=1.6)}
        miss, time = jax.vmap(self.passes_by)(play(shot))
        best = jnp.argmin(jnp.asarray(miss))
        # Nothing slows the balls down: with another speed they take the same way, in another time.
        whole = self.dt * self.steps
        return {"place": shot["place"][best], "velocity": shot["velocity"][best] * time[best] / whole}

    def passes_by(self, motion: Trajectory) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """How near (m) the last ball comes to the place, and when (s)."""
        start, step = motion.x[:-1, -1], jnp.diff(motion.x[:, -1], axis=0)
        square = jnp.sum(step**2, axis=1)
        share = jnp.sum((jnp.asarray(self.aim) - start) * step, axis=1) / jnp.where(square > 0, square, 1)
        share = jnp.clip(share, 0, 1)
        miss = jnp.linalg.norm(start + share[:, None] * step - jnp.asarray(self.aim), axis=1)
        nearest = jnp.argmin(jnp.asarray(jnp.where(jnp.isfinite(miss), miss, jnp.inf)))
        return miss[nearest], motion.time[nearest] + share[nearest] * self.dt

    def target(self):
        return np.array(self.aim)


def thrown(system: System, place: Point, velocity: Float[Array, "2"], spin: Float[Array, "1"]) -> Setup:
    """A disk that starts at `place` (m) with a velocity (m/s) and a spin (rad/s)."""
    upright = jnp.eye(2)[None]
    x0 = embed_pose(jnp.asarray(place)[None], upright)
    return Setup(system, x0[0], embed_velocity(upright, velocity[None], spin[None])[0])


def floor_bounces(motion: Trajectory, radius: float) -> Bool[Array, " steps"]:
    """In which steps the first body, of this radius (m), bounces on the floor y = 0."""
    height, rate = motion.x[:, 0, 1] - radius, motion.v[:, 0, 1]
    near = height[:-1] <= 2 * jnp.abs(rate[:-1]) * (motion.time[1] - motion.time[0])
    return motion.contact[1:] & near & (rate[:-1] < 0) & (rate[1:] > rate[:-1])


def nth_step(flags: Bool[Array, " steps"], count: int) -> tuple[Array, Bool[Array, ""]]:
    """The step with the flag for the `count`th time, and whether there is one."""
    nth = flags & (jnp.cumsum(flags) == count)
    return jnp.argmax(nth), jnp.any(nth)


class ThrowHit(Control):
    """Velocity and spin of a disk that bounces once on the floor, and next meets the floor at a place.

    It is found from the last state before, along a parabola. A disk that has not landed by the end is measured there.
    """

    name: str = "throw-hit"
    task: str = THROW.name
    dt: float = THROW.dt
    steps: int = 150
    place: Point = (0.25, 0.65)
    velocity: Point = (0.3, 0.0)
    aim: Point = (0.75, 0.1)
    optimizer: OptimizerName = "lbfgs"
    learning_rate: float = 0.1
    unit: str = "m"

    def start(self):
        return {"velocity": jnp.asarray(self.velocity), "spin": jnp.zeros(1)}

    def setup(self, system, choice):
        return thrown(system, self.place, choice["velocity"], choice["spin"])

    def landing(self, motion: Trajectory) -> Float[Array, "2"]:
        """Where the disk meets the floor for the second time (m)."""
        step, lands = nth_step(floor_bounces(motion, self.aim[1]), 2)
        x, v, before = motion.x[step, 0], motion.v[step, 0], motion.v[jnp.maximum(step - 1, 0), 0]
        acceleration = (v - before) / self.dt
        height = jnp.maximum(x[1] - self.aim[1], 0)
        # The root of a parabola without cancellation.
        root = jnp.sqrt(jnp.where(lands, v[1] ** 2 - 2 * acceleration[1] * height, 1))
        time = 2 * height / jnp.where(lands, root - v[1], 1)
        return jnp.where(lands, x + v * time + acceleration * time**2 / 2, motion.x[-1, 0])

    def loss(self, choice, motion):
        return jnp.sum((self.landing(motion) - jnp.asarray(self.aim)) ** 2)

    def miss(self, motion):
        return jnp.linalg.norm(self.landing(motion) - jnp.asarray(self.aim))

    def scout(self, key, play):
        return None

    def target(self):
        return np.array(self.aim)


class ThrowVertical(Control):
    """The spin of a disk after which its first bounce sends it straight up."""

    name: str = "throw-vertical"
    task: str = THROW.name
    dt: float = THROW.dt
    steps: int = 80
    place: Point = (0.25, 0.65)
    velocity: Point = (0.6, 0.4)
    radius: float = 0.1
    optimizer: OptimizerName = "lbfgs"
    learning_rate: float = 1.0
    unit: str = "m/s"

    def start(self):
        return {"spin": jnp.zeros(1)}

    def setup(self, system, choice):
        return thrown(system, self.place, jnp.asarray(self.velocity), choice["spin"])

    def sideways(self, motion: Trajectory) -> Float[Array, ""]:
        """Horizontal speed (m/s) after the first bounce; without one, at the end."""
        step, bounces = nth_step(floor_bounces(motion, self.radius), 1)
        return motion.v[jnp.where(bounces, step + 1, -1), 0, 0]

    def loss(self, choice, motion):
        return self.sideways(motion) ** 2

    def miss(self, motion):
        return jnp.abs(self.sideways(motion))

    def scout(self, key, play):
        return None

    def target(self):
        return None


_PROBLEMS: tuple[Control, ...] = (
    Billiards(),
    ThrowHit(),
    ThrowVertical(),
    Aim(
        name="bounce-once",
        task=BOUNCE_ONCE.name,
        dt=BOUNCE_ONCE.dt,
        steps=BOUNCE_ONCE.steps,
        place=BOUNCE_ONCE.start[0],
        velocity=BOUNCE_ONCE.velocity[0],
        aim=(0.0, 0.6),
    ),
    Aim(
        name="ground-wall",
        task=GROUND_WALL.name,
        dt=GROUND_WALL.dt,
        steps=GROUND_WALL.steps,
        place=GROUND_WALL.start[0],
        velocity=GROUND_WALL.velocity[0],
        aim=(-2.0, 1.5),
    ),
    TwoBalls(),
)
CONTROLS: dict[str, Control] = {problem.name: problem for problem in _PROBLEMS}


def find_control(name: str) -> Control:
    """The problem of this name. Raises `CaromError` with the nearest names for an unknown one."""
    return find_named("problem", name, CONTROLS)
