"""Impacts at the time at which they happen, against closed forms: motion, and derivatives by all that is given."""

import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import GRAVITY, refused

import carom
from carom.mechanics.bodies import embed_pose, embed_velocity
from carom.mechanics.dynamics import saddle_point
from carom.simulation.events import first_root
from carom.tasks import find_task

RADIUS = 0.1
TIME = 1.0
STEPS = 20
"""Coarse steps: how near to a closed form one comes must not hang on them."""


class Given(eqx.Module):
    """All that the end of a motion depends on."""

    x: jax.Array
    v: jax.Array
    force: jax.Array  # N, constant
    friction: jax.Array
    restitution: jax.Array


@dataclasses.dataclass
class Case:
    """Balls of radius 0.1 m that meet planes and each other in turn: `("plane", ball, which)`, `("pair", a, b)`."""

    x: list
    v: list
    meets: list
    planes: tuple = ()
    friction: float = 0.0
    restitution: float = 0.8
    gravity: float = GRAVITY
    masses: tuple = (1.3,)
    model: str = "cm"

    def given(self):
        x = jnp.array(self.x)
        force = jnp.zeros_like(x).at[:, 0].set(0.05)
        return Given(x, jnp.array(self.v), force, jnp.array([self.friction]), jnp.array([self.restitution]))

    def system(self):
        pairs = list(itertools.combinations(range(len(self.masses)), 2))
        balls = range(len(self.masses))
        return carom.System(
            bodies=[carom.PointMass(m, RADIUS) for m in self.masses],
            contacts=[*([carom.DiskDisk(pairs)] if pairs else []), *(carom.DiskPlane(balls, *p) for p in self.planes)],
            potential=carom.Gravity((0.0, -self.gravity)),
            friction=self.friction,
            restitution=self.restitution,
            contact_model=self.model,
        )

    def end(self, given: Given):
        """State at the end: parabolas, with the law of the contact model where balls meet."""
        masses = jnp.array(self.masses)[:, None]
        acceleration = given.force / masses + jnp.array([0.0, -self.gravity])
        x, v, left = given.x, given.v, jnp.asarray(TIME)
        for meet in self.meets:
            t = self._time(meet, x, v, acceleration)
            x, v, left = x + v * t + acceleration * t**2 / 2, v + acceleration * t, left - t
            v = self._after(meet, x, v, given)
        return x + v * left + acceleration * left**2 / 2, v + acceleration * left

    def _gap(self, meet, x):
        kind, a, b = meet
        if kind == "plane":
            point, normal = (jnp.array(part) for part in self.planes[b])
            return (x[a] - point) @ normal - RADIUS, normal
        apart = x[a] - x[b]
        return jnp.linalg.norm(apart) - 2 * RADIUS, apart / jnp.linalg.norm(apart)

    def _time(self, meet, x, v, acceleration):
        def gap(t):
            return self._gap(meet, x + v * t + acceleration * t**2 / 2)[0]

        times = np.linspace(1e-6, TIME, 2001)
        values = np.asarray(jax.lax.stop_gradient(jax.vmap(gap)(times)))
        t = jnp.asarray(times[np.argmax((values[1:] < 0) & (values[:-1] >= 0))])
        for _ in range(6):
            t = t - gap(t) / jax.grad(gap)(t)
        return t

    def _after(self, meet, x, v, given):
        kind, a, b = meet
        _, normal = self._gap(meet, x)
        relative = v[a] - (v[b] if kind == "pair" else 0)
        mass = self.masses[a] if kind == "plane" else 1 / (1 / self.masses[a] + 1 / self.masses[b])
        speed = relative @ normal
        sliding = relative - speed * normal
        slip = jnp.linalg.norm(sliding) if self.friction else 1.0
        friction = given.friction[0]
        # Both phases of CM while the contact slides: the point of the cone's edge with the least energy (eq. 5).
        compression = (friction * slip - speed) / (1 + friction**2) if self.model == "cm" else -speed
        kick = mass * (1 + given.restitution[0]) * compression * (normal - friction * sliding / slip)
        v = v.at[a].add(kick / self.masses[a])
        return v.at[b].add(-kick / self.masses[b]) if kind == "pair" else v


FLOOR, WALL = ((0.0, 0.0), (0.0, 1.0)), ((1.75, 0.0), (-1.0, 0.0))
CASES = {
    "one bounce": Case([[0.0, 0.6]], [[0.2, 0.3]], [("plane", 0, 0)], (FLOOR,), restitution=0.9, gravity=3.0),
    "three bounces": Case([[0.0, 0.3]], [[0.2, 0.3]], [("plane", 0, 0)] * 3, (FLOOR,), restitution=0.85),
    "ground, then wall": Case(
        [[0.3, 0.6]], [[2.0, -2.0]], [("plane", 0, 0), ("plane", 0, 1)], (FLOOR, WALL), gravity=3.0
    ),
    "oblique, sliding": Case([[0.0, 0.5]], [[3.0, -1.0]], [("plane", 0, 0)], (FLOOR,), 0.2, gravity=3.0),
    "the same with LCP": Case([[0.0, 0.5]], [[3.0, -1.0]], [("plane", 0, 0)], (FLOOR,), 0.2, gravity=3.0, model="lcp"),
    "head-on": Case(
        [[0.0, 0.0], [0.5, 0.0]],
        [[1.0, 0.0], [0.0, 0.0]],
        [("pair", 0, 1)],
        restitution=1.0,
        gravity=0.0,
        masses=(1.0, 1.0),
    ),
    "chain of three": Case(
        [[0.0, 0.0], [0.4, 0.02], [0.9, 0.0]],
        [[1.5, 0.1], [0.0, 0.0], [-0.1, 0.0]],
        [("pair", 0, 1), ("pair", 1, 2)],
        gravity=0.0,
        masses=(0.7, 1.0, 0.4),
        restitution=0.9,
    ),
}


def at_end(system, given: Given, dt, steps: int, impact="event", **options):
    changed = eqx.tree_at(lambda s: (s.friction, s.restitution), system, (given.friction, given.restitution))
    force = jnp.broadcast_to(given.force, (steps, *given.x.shape))
    out = carom.simulate(changed, given.x, given.v, dt=dt, steps=steps, impact=impact, force=force, **options)
    return out.x[-1], out.v[-1]


@eqx.filter_jit
def rows_of(system, given, dt, steps):
    """The end of a motion, and its derivatives by all that is given, in reverse mode."""
    flat = lambda given: jnp.concatenate([part.ravel() for part in at_end(system, given, dt, steps)])  # noqa: E731
    return flat(given), jax.jacrev(flat)(given)


IN_BUDGET = {"one bounce", "three bounces", "oblique, sliding"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.ci_budget] if name in IN_BUDGET else []) for name in CASES]
)
def test_the_end_and_its_derivatives_are_those_of_the_closed_form(name):
    case = CASES[name]
    given = case.given()
    end, slopes = rows_of(case.system(), given, TIME / STEPS, STEPS)

    def exact(given):
        return jnp.concatenate([part.ravel() for part in case.end(given)])

    assert np.allclose(end, exact(given), atol=1e-9)
    for part in ("x", "v", "force", "restitution", "friction" if case.friction else "x"):
        found, wanted = getattr(slopes, part), getattr(jax.jacrev(exact)(given), part)
        error = np.abs(found - wanted).max() / np.abs(wanted).max()
        assert error < 1e-6, f"{part}: {error:.1e}"


@pytest.mark.slow
def test_a_compound_pendulum_hits_a_wall():
    """A disk on a massless arm turns about the origin, without gravity, and rebounds from a wall (eq. of its angle)."""
    arm, radius, wall, start, rate, restitution, time = 0.8, 0.15, 0.5, 0.1, 0.7, 0.6, 1.0
    system = carom.System(
        bodies=[carom.RigidBody(0.4, (0.01, 0.02), radius)],
        constraints=[carom.Joint(0, (1 + arm, 0.0, -arm), (0.0, 0.0))],
        contacts=[carom.DiskPlane([0], (wall, 0.0), (-1.0, 0.0))],
        friction=0.0,
        restitution=restitution,
        dim=2,
    )

    def exact(angle, rate, restitution):
        met = jnp.arcsin((wall - radius) / arm)
        return met - restitution * rate * (time - (met - angle) / rate)

    def simulated(angle, rate, restitution):
        # The body's second axis points along the arm, which hangs at `angle` from it.
        c, s = jnp.cos(angle), jnp.sin(angle)
        rotation = jnp.array([[c, s], [-s, c]])[None]
        center = arm * rotation[:, :, 1]
        velocity = rate * arm * jnp.array([[c, -s]])
        x0, v0 = embed_pose(center, rotation)[0], embed_velocity(rotation, velocity, -rate * jnp.ones((1, 1)))[0]
        changed = eqx.tree_at(lambda s: s.restitution, system, restitution[None])
        x = carom.simulate(changed, x0, v0, dt=time / 50, steps=50, impact="event").x[-1, 0]
        return jnp.arctan2(x[0], x[1])

    given = tuple(jnp.asarray(value) for value in (start, rate, restitution))
    found, slopes = jax.jit(jax.value_and_grad(simulated, argnums=(0, 1, 2)))(*given)
    wanted, wanted_slopes = jax.value_and_grad(exact, argnums=(0, 1, 2))(*given)
    assert abs(found - wanted) < 1e-8
    assert np.allclose(slopes, wanted_slopes, rtol=1e-6)


@pytest.mark.slow
def test_bounce_once():
    """Zhong, Han and Brikis (2022), task 1: elastic, no gravity, 480 steps; with the step's rule the sign is wrong."""
    task, system = find_task("bounce-once"), carom.task("bounce-once")

    def height(x0, v0, impact):
        return carom.simulate(system, x0, v0, dt=task.dt, steps=task.steps, impact=impact).x[-1, 0, 1]

    state = jnp.array([[-1.0, 1.0]]), jnp.array([[2.0, -2.0]])
    by_place, by_speed = jax.grad(height, argnums=(0, 1))(*state, "event")
    assert np.allclose(by_place[0], [0, -1], atol=1e-7)
    assert np.allclose(by_speed[0], [0, -1], atol=1e-7)
    assert jax.grad(height)(*state, "step")[0, 1] > 0


@pytest.mark.slow
def test_two_balls():
    """Task 4 of the same: derivatives of its loss by the start, from the analytic solution (to the 6 digits given)."""
    task, system = find_task("two-balls"), carom.task("two-balls")
    force = jnp.zeros((task.steps, 2, 2)).at[:, 0].set(3.0)

    @jax.jit
    def slopes(x0, v0):
        def loss(x0, v0):
            out = carom.simulate(system, x0, v0, dt=task.dt, steps=task.steps, impact="event", force=force)
            return jnp.sum(out.x[-1, 1] ** 2) + 0.1 * jnp.sum(force**2) * task.dt

        return jax.grad(loss, argnums=(0, 1))(x0, v0)

    by_place, by_speed = slopes(jnp.array(task.start), jnp.array(task.velocity))
    assert np.allclose(by_place, [[-0.398669] * 2, [-0.321253] * 2], atol=1e-4)
    assert np.allclose(by_speed, [[-0.497791] * 2, [-0.222131] * 2], atol=1e-4)


@pytest.mark.slow
def test_geometry_and_impacts_at_the_same_time():
    """Elastic, no gravity: `y = v T - y_0 + 2 r + 2 h` over a floor at h, for each of two balls that land together."""

    def heights(radius, floor, y0):
        system = carom.System(
            bodies=[carom.PointMass(1.0, radius), carom.PointMass(2.0, radius)],
            contacts=[carom.DiskPlane([0, 1], jnp.stack([jnp.zeros(()), floor]), (0.0, 1.0))],
            friction=0.0,
            restitution=1.0,
            dim=2,
        )
        x0 = jnp.stack([jnp.array([0.0, 1.0]), y0], axis=1)
        v0 = jnp.array([[0.5, -2.0], [0.1, -2.0]])
        return carom.simulate(system, x0, v0, dt=0.05, steps=20, impact="event").x[-1, :, 1]

    given = jnp.asarray(0.0), jnp.asarray(0.1), jnp.array([0.93, 0.93])  # points: bodies need no radius
    by_radius, by_floor, by_height = jax.jacrev(heights, argnums=(0, 1, 2))(*given)
    assert np.allclose(heights(*given), 2 - 0.93 + 0.2, atol=1e-8)
    assert np.allclose(by_radius, 2, atol=1e-6)
    assert np.allclose(by_floor, 2, atol=1e-6)
    assert np.allclose(by_height, -np.eye(2), atol=1e-6)


def test_first_root_of_cubics():
    """Against a fine grid; also where a cubic first rises, and where it only dips below zero."""
    rng = np.random.default_rng(0)
    g0, r0, g1, r1 = (jnp.asarray(a) for a in rng.normal(size=(4, 20_000)) * np.array([1, 4, 1, 4])[:, None])
    g0 = jnp.abs(g0)
    s = np.linspace(0, 1, 4001)[:, None]
    c2, c3 = 3 * (g1 - g0) - 2 * r0 - r1, 2 * (g0 - g1) + r0 + r1
    values = np.asarray(g0 + s * (r0 + s * (c2 + s * c3)))
    below = values < -1e-6
    wanted = np.where(below.any(axis=0), s[below.argmax(axis=0), 0], np.inf)
    found, most = first_root(g0, r0, g1, r1)
    sure = below.any(axis=0) | (values.min(axis=0) > 1e-6)
    assert np.array_equal(np.isfinite(found)[sure], np.isfinite(wanted)[sure])
    both = np.isfinite(found) & np.isfinite(wanted)
    assert (found[both] <= most[both]).all()
    assert np.quantile(np.abs(found - wanted)[both], 0.99) < 1e-3


# --- What is not in closed form ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("task", ["cp3-e", "bd5", "gyro"])
def test_derivatives_are_those_of_differences(task):
    """Up to the third impact of the first trajectory that has one."""
    system, dt = carom.task(task), {"gyro": 0.02}.get(task, 0.01)
    x0, v0 = carom.sample(system, jax.random.key(2), 16)
    motion = carom.simulate(system, x0, v0, dt=dt, steps=50, impact="event")
    impacts = np.cumsum(motion.contact, axis=1)
    k = int(np.argmax(impacts[:, -1] >= 2))
    steps = int(np.argmax(impacts[k] >= min(3, impacts[k, -1])))
    x, v = x0[k], v0[k]
    rng = np.random.default_rng(0)
    inverse = system.inverse_mass_matrix()
    if system.links:
        saddle = saddle_point(system.constraints, x, inverse)
        towards = saddle.project(jnp.asarray(rng.normal(size=(1, *x.shape))))[0]
    else:
        towards = jnp.asarray(rng.normal(size=x.shape))
    weights = jnp.asarray(rng.normal(size=(2, *x.shape)))

    @jax.jit
    def loss(change):
        out = carom.simulate(system, x, v + change * towards, dt=dt, steps=50, impact="event")
        return jnp.sum(weights * jnp.stack([out.x[steps], out.v[steps]]))

    slope = jax.jit(jax.grad(loss))(0.0)
    step = 1e-6
    difference = (loss(step) - loss(-step)) / (2 * step)
    assert abs(slope - difference) < 1e-4 * abs(difference)


@pytest.mark.slow
def test_forward_equals_reverse():
    case = CASES["oblique, sliding"]
    system, given = case.system(), case.given()
    _, reverse = rows_of(system, given, TIME / STEPS, STEPS)

    @jax.jit
    def forward(v):
        end = lambda v: jnp.concatenate(  # noqa: E731
            [part.ravel() for part in at_end(system, dataclasses.replace(given, v=v), TIME / STEPS, STEPS)]
        )
        return jax.jacfwd(end)(v)

    assert np.allclose(forward(given.v), reverse.v, atol=1e-10)


@pytest.mark.slow
def test_a_batch_moves_as_its_members_do():
    """One that meets the floor, one that meets it later, one that does not."""
    case = CASES["oblique, sliding"]
    system, x = case.system(), case.given().x
    v = jnp.array([[[3.0, -1.0]], [[2.0, 0.2]], [[1.0, 2.0]]])
    move = {"dt": TIME / STEPS, "steps": STEPS, "impact": "event"}
    batch = carom.simulate(system, jnp.stack([x] * 3), v, **move)
    assert np.array_equal(batch.contact.sum(axis=1), [1, 1, 0])
    for k in range(3):
        one = carom.simulate(system, x, v[k], **move)
        assert np.allclose(one.x, batch.x[k], atol=1e-12)


@pytest.mark.slow
def test_fast_bodies_do_not_pass_through_each_other():
    """Two small balls that would change places within one step meet instead, and exchange velocities."""
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.01)] * 2,
        contacts=[carom.DiskDisk([(0, 1)])],
        friction=0.0,
        restitution=1.0,
        dim=2,
    )
    speed = jnp.array([3.0, 50.0, 500.0])
    x0 = jnp.array([[[-0.52, 0.0], [0.48, 0.0]]] * 3)
    v0 = speed[:, None, None] * jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    for k in range(3):
        time = 1 / float(speed[k])
        out = carom.simulate(system, x0[k], v0[k], dt=time / 10, steps=10, impact="event")
        assert np.allclose(out.v[-1], -v0[k], rtol=1e-6)
        assert np.allclose(out.x[-1], x0[k] + v0[k] * (2 * 0.49 - 1) * time, atol=1e-7)
        assert np.asarray(system.gaps(out.x)).min() > -1e-9


@pytest.mark.slow
@pytest.mark.ci_budget
def test_balls_that_fly_many_times_their_size_in_a_step_meet():
    """They exchange velocities at any speed; one that passes by is left alone."""
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.02), carom.PointMass(1.0, 0.01)],
        contacts=[carom.DiskDisk([(0, 1)])],
        friction=0.0,
        restitution=1.0,
        dim=2,
    )
    speed, dt = np.array([5.0, 500.0, 5e3, 5e5]), 0.01
    x0 = np.zeros((5, 2, 2))
    x0[:4, 0, 0], x0[4, 0] = -0.4567 * speed * dt - 0.03, [-20, 0.031]
    v0 = np.zeros((5, 2, 2))
    v0[:, 0, 0] = [*speed, 5e3]
    out = carom.simulate(system, jnp.asarray(x0), jnp.asarray(v0), dt=dt, steps=2, impact="event")
    for k in range(4):
        assert np.allclose(out.v[k, -1], v0[k, ::-1], atol=1e-9 * speed[k])
        # They meet after 0.4567 of a step, with the centres 0.03 apart.
        assert np.allclose(out.x[k, -1, :, 0], [-0.03, (2 - 0.4567) * speed[k] * dt], rtol=1e-9, atol=1e-9 * speed[k])
    assert np.allclose(out.v[4, -1], v0[4])


@pytest.mark.slow
@pytest.mark.ci_budget
def test_what_cannot_be_looked_at_is_an_error():
    """Two balls fly side by side, 10^5 times their size in a step: whether they touch on the way cannot be told."""
    system = carom.System(
        bodies=[carom.PointMass(1.0, 0.01)] * 2,
        contacts=[carom.DiskDisk([(0, 1)])],
        friction=0.0,
        restitution=1.0,
        dim=2,
    )
    x0, v0 = jnp.array([[0.0, 0.0], [0.0, 0.021]]), jnp.array([[1e5, 0.0], [1e5, 0.0]])
    with refused("a time step has more impacts than max_events, or bodies move so far in it, beside their size"):
        carom.simulate(system, x0, v0, dt=0.01, steps=2, impact="event")


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1e-6])
def test_events_are_the_same_at_every_scale(scale):
    """Lengths times s, times by its root, masses by its cube: a ball that bounces on another and on the floor."""

    def moved(s):
        system = carom.System(
            bodies=[carom.PointMass(s**3, 0.1 * s), carom.PointMass(0.5 * s**3, 0.1 * s)],
            contacts=[carom.DiskDisk([(0, 1)]), carom.DiskPlane([0, 1], *FLOOR)],
            potential=carom.Gravity((0.0, -GRAVITY)),
            friction=0.3,
            restitution=0.5,
        )
        x0, v0 = jnp.array([[0.0, 0.5], [0.05, 0.9]]) * s, jnp.array([[0.3, 0.0], [0.0, 0.0]]) * s**0.5
        return carom.simulate(system, x0, v0, dt=0.01 * s**0.5, steps=150, impact="event").x / s

    # Rounding, which impacts multiply.
    assert np.allclose(moved(scale), moved(1.0), atol=1e-10)


@pytest.mark.slow
@pytest.mark.ci_budget
def test_what_rests_or_bounces_ever_faster_is_left_to_the_rule_of_the_step():
    """A ball that is dropped comes to rest: no hang, no sinking, no energy from nothing (Zeno)."""
    case = Case([[0.0, 0.2]], [[0.3, 0.0]], [], (FLOOR,), 0.1)
    for restitution in (0.0, 0.5):
        given = dataclasses.replace(case.given(), force=jnp.zeros((1, 2)), restitution=jnp.array([restitution]))
        out = carom.simulate(
            eqx.tree_at(lambda s: s.restitution, case.system(), given.restitution),
            given.x, given.v, dt=0.01, steps=200, impact="event",
        )  # fmt: skip
        gap = np.asarray(out.x[:, 0, 1]) - RADIUS
        # CM lifts what slides, so that it hops until it stops sliding.
        assert gap.min() > -GRAVITY * 0.01**2
        np.testing.assert_allclose(gap[-1], 0, atol=1e-6)
        np.testing.assert_allclose(out.v[-1], 0, atol=1e-9)


@pytest.mark.slow
def test_impacts_within_one_step():
    """Three balls in a row, hit twice in a single step: as in many steps, if a step may be cut twice."""
    case = CASES["chain of three"]
    system, given = case.system(), case.given()
    fine = at_end(system, given, TIME / 100, 100)
    once = at_end(system, given, TIME, 1)
    assert np.allclose(np.concatenate(once), np.concatenate(fine), atol=1e-9)
    with refused("a time step has more impacts than max_events"):
        at_end(system, given, TIME, 1, max_events=1)


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.parametrize(("impact", "order"), [("event", 5), ("step", 1)])
def test_the_error_of_a_step_with_an_elastic_impact_in_its_middle(impact, order):
    """A ball on a spring goes back on the way that it came. With events the integrator (of order 4) keeps its order."""
    stiffness = 8.0
    system = carom.System(
        bodies=[carom.PointMass(1.0, RADIUS)],
        contacts=[carom.DiskPlane([0], *FLOOR)],
        potential=carom.Springs([0], stiffness, 0.0, anchor=(0.0, 0.0)),
        friction=0.0,
        restitution=1.0,
    )
    w = (2 * stiffness) ** 0.5

    @jax.jit
    @jax.vmap
    def error(dt):
        phase = jnp.arccos(RADIUS) - w * dt / 2
        x, v = jnp.array([[0.0, 1.0]]) * jnp.cos(phase), jnp.array([[0.0, -w]]) * jnp.sin(phase)
        out = carom.simulate(system, x, v, dt=dt, steps=1, impact=impact, compensation_steps=None)
        return jnp.linalg.norm(out.x[-1] - x) + jnp.linalg.norm(out.v[-1] + v) / w

    errors = np.asarray(error(jnp.array([0.08, 0.04, 0.02])))
    found = np.log2(errors[:-1] / errors[1:])
    assert np.allclose(found, order, atol=0.3), errors


def test_what_cannot_be_is_refused():
    case = CASES["one bounce"]
    system, given = case.system(), case.given()
    with refused("impact must be one of ['event', 'step']; it was 'never'"):
        carom.simulate(system, given.x, given.v, dt=0.01, steps=1, impact="never")  # pyright: ignore[reportArgumentType]
    with refused("max_events must be a positive whole number; it was 0"):
        carom.simulate(system, given.x, given.v, dt=0.01, steps=1, impact="event", max_events=0)
