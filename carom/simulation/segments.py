"""Steps with contact that lasts: a step as one or more segments, each from one impact to the next.

A contact that is closed over a segment acts over it, not at its end. At the start of a segment the contacts that touch
and stay are found, with the constant forces, each in the contact's own frame, by which their law holds at its end to
first order. The motion is integrated under them. At the end the law is met by what is still missing of their impulses,
impacts happen, and penetration is undone.

What rests is held: where these forces cancel the others, the state is a fixed point of the step, to rounding. Where
forces are constant (sliding on a plane) the motion is exact, else of second order in the time step.

By the rule `"step"` a step is one segment, and contacts that close within it act at its end. By `"event"` it is cut at
the times at which contacts close.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from carom.contact.batching import anywhere
from carom.contact.energy import dissipative, islands
from carom.contact.impulses import ContactState, Jump
from carom.contact.penetration import pushes
from carom.simulation.events import may_close, next_event, own_times, to_event, touching
from carom.simulation.impact import Stepper, StepResult, closed_contacts, compensation_steps_of, has_impulses
from carom.simulation.projection import project_state
from carom.system import System

State = tuple[Float[Array, "n d"], Float[Array, "n d"]]

_NEAR = 1e-3
"""A gap that is less than this share of what the accelerations could close within the segment counts as closed."""
_CLOSING = 0.5
"""Closed contacts that approach faster than this share of what the accelerations give within the segment are hit."""
_LEAVING = 1e-3
"""Closed contacts that leave faster than this share leave; those that do not stay."""
_REBOUNDS = {"step": 1.0, "event": 0.05}
"""An impact slower than this share of what the accelerations give within a step has no rebound. By the rule of events
it grows with the events of the step: what comes to rest does so after few."""


_AT_REST = 0.6
"""A body rests if it moves by less than this power of the machine's precision, of what its acceleration alone would."""


class Progress(NamedTuple):
    """How far a step has come. Only `x`, `v` and `left` have derivatives."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    left: Float[Array, ""]  # s until its end
    acted: Bool[Array, " C"]  # contacts that have acted at this state
    contact: Bool[Array, ""]
    overflow: Int[Array, ""]
    residual: Float[Array, ""]
    push: Float[Array, " n"]  # m/s^2, of the points without contact, at the start of the step

    @classmethod
    def begin(cls, system: System, x: Float[Array, "n d"], v: Float[Array, "n d"], dt: Float[Array, ""]) -> "Progress":
        """At the start of a step."""
        no, zero = jnp.asarray(False), jnp.zeros((), x.dtype)
        none = jnp.zeros(system.n_candidates, bool)
        return cls(x, v, dt, none, no, jnp.asarray(0), zero, jnp.zeros_like(x[:, 0]))


class _Segment(NamedTuple):
    """A state at an end of a segment, and what is known of the contacts there."""

    x: Float[Array, "n d"]
    v: Float[Array, "n d"]
    time: Float[Array, ""]  # s since the start
    pressing: Float[Array, "C d"]  # N, of contacts that last, each in its frame
    lasts: Bool[Array, " C"]
    closed: Bool[Array, " C"]
    gain: Float[Array, " C"]  # m/s, what the bodies' accelerations give contacts along the normal in a whole step
    push: Float[Array, " n"]  # m/s^2, of the points without contact, at the start
    again: Bool[Array, ""]  # the step has been cut here: there is more of it
    contact: Bool[Array, ""]
    overflow: Int[Array, ""]
    residual: Float[Array, ""]


def step_in_segments(
    system: System,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    stepper: Stepper,
    motion: tuple[Callable, Callable],
) -> StepResult:
    """One step with contact; `motion` is that of `smooth_flow`."""
    start = Progress.begin(system, x, v, stepper.dt)
    segment = Segments(system, inverse_mass, stepper, motion)
    if stepper.impact == "step":
        return end_of_step(system, start, segment(start, jnp.asarray(0)))

    def part(now: Progress, count):
        goes_on = now.left > 0

        def go_on():
            new = segment(now, count)
            return jax.tree.map(lambda a, b: jnp.where(goes_on, a, b), new, now)

        return jax.lax.cond(anywhere(goes_on), go_on, lambda: now), None

    def with_contact():
        # What a segment computes is computed again for the derivative: kept, it would be that of all segments that a
        # step may have, of which most have one.
        end, _ = jax.lax.scan(jax.checkpoint(part), start, jnp.arange(stepper.events + 1))
        return end_of_step(system, start, end)

    _, after = motion
    end = after((x, v), stepper.dt)
    near = may_close(segment.still, *jax.lax.stop_gradient(((x, v), end)), stepper.dt)

    def alone():
        return StepResult(end[0], end[1], start.contact, start.overflow, start.residual)

    return jax.lax.cond(anywhere(near), with_contact, alone)


def end_of_step(system: System, start: Progress, end: Progress) -> StepResult:
    """The step from its start and the end of its last segment."""
    # Rounding moves what rests, and an unstable equilibrium multiplies it. A body that has moved by no more stays where
    # it was, without a velocity; derivatives are those of the motion.
    body = _body_of_point(system)
    least = jnp.finfo(end.x.dtype).eps ** _AT_REST * start.left * end.push
    moves = (_size(end.x - start.x) > least * start.left) | (_size(end.v) > least)
    rests = ~jnp.zeros(len(system.bodies), bool).at[body].max(moves)[body][:, None]
    x = end.x + jax.lax.stop_gradient(jnp.where(rests, start.x - end.x, 0))
    v = end.v - jax.lax.stop_gradient(jnp.where(rests, end.v, 0))
    return StepResult(x, v, end.contact, end.overflow, end.residual)


def _body_of_point(system: System) -> Int[np.ndarray, " n"]:
    return np.searchsorted(np.array(system.table.center), np.arange(system.n_points), side="right") - 1


def _size(vectors: Float[Array, "n d"]) -> Float[Array, " n"]:
    """Largest coordinate of each, without a derivative."""
    return jnp.max(jnp.abs(jax.lax.stop_gradient(vectors)), axis=1)


class Segments:
    """What moves a step on by a segment: by the rule of events, to the next event or to its end."""

    def __init__(self, system: System, inverse_mass, stepper: Stepper, motion: tuple[Callable, Callable]):
        self.system, self.inverse_mass, self.stepper = system, inverse_mass, stepper
        self.rate, self.after = motion
        # Nothing in the search for events is differentiated, the system's own geometry included.
        self.still = jax.tree.map(lambda a: jax.lax.stop_gradient(a) if eqx.is_array(a) else a, system)
        self.dry, self.loss = system.dry_friction()

    def __call__(self, now: Progress, count: Int[Array, ""]) -> Progress:
        """From `now` to the next event, or to the end of the step; `count` segments have been before."""
        zero = jnp.zeros_like(now.left)
        forces = jnp.zeros((self.system.n_candidates, self.system.dim), now.x.dtype)
        none = jnp.zeros_like(now.acted)
        no = jnp.asarray(False)
        start = _Segment(
            x=now.x,
            v=now.v,
            time=zero,
            pressing=forces,
            lasts=none,
            closed=none,
            gain=forces[:, 0],
            push=now.push,
            again=no,
            contact=no,
            overflow=now.overflow,
            residual=now.residual,
        )

        # Both ends are one program, run twice: most of it is the solver. What is jitted is traced once: the loops
        # around it are each transformed several times, and all that is within them anew.
        def end_of(state: _Segment, first: Bool[Array, ""]):
            state, change = jax.lax.cond(
                first,
                jax.jit(lambda: self.touching(state, now.left)),
                lambda: (state, jnp.zeros_like(state.pressing)),
            )
            state, held = jax.jit(lambda: self.act(state, change, first, count, now.left))()
            return jax.lax.cond(first, jax.jit(lambda: self.move(state, held, now, count)), lambda: state), None

        end, _ = jax.lax.scan(end_of, start, jnp.array([True, False]))
        return Progress(
            x=end.x,
            v=end.v,
            left=jnp.where(end.again, now.left - end.time, 0),
            acted=end.closed,
            contact=now.contact | end.contact,
            overflow=end.overflow,
            residual=end.residual,
            push=jnp.where(count == 0, end.push, now.push),
        )

    def touching(self, state: _Segment, left: Float[Array, ""]) -> tuple[_Segment, Float[Array, "C d"]]:
        """Which contacts are closed and stay so, and how fast all contacts' velocities change without them (m/s^2)."""
        motion = self.rate((state.x, state.v), None, self.stepper.dt - left)

        def seen(x, v):
            candidates = self.system.candidates(x)
            # Which points of a stencil are of one body: two or three bodies are in it.
            body = _body_of_point(self.system)[candidates.stencil]
            which = np.array([np.unique(row, return_inverse=True)[1].reshape(-1) for row in body])
            mine = np.eye(which.max() + 1)[which].astype(x.dtype)
            return jnp.einsum("cipj,cpj,cpb->cbi", candidates.rows, v[candidates.stencil], mine), candidates.gap

        (by_body, gap), (changes, _) = jax.jvp(seen, (state.x, state.v), motion)
        # Added up as if all bodies were against each other: what falls together may be held apart.
        steps = self.stepper.dt * jax.lax.stop_gradient(changes)
        gain = jnp.sum(jnp.linalg.norm(steps, axis=-1), axis=1)
        normal, gap = jax.lax.stop_gradient((jnp.sum(by_body[..., 0], axis=1), gap))
        lasts = (gap <= _NEAR * left * gain) & (normal >= -_CLOSING * gain) & (normal <= _LEAVING * gain)
        lasts = lasts | self.dry
        if not has_impulses(self.system, state.x, state.v, self.stepper):
            lasts = jnp.zeros_like(lasts)
        state = state._replace(
            lasts=lasts,
            closed=lasts,
            gain=jnp.sum(jnp.abs(steps[..., 0]), axis=1),
            push=jax.lax.stop_gradient(jnp.linalg.norm(motion[1], axis=-1)),
        )
        return state, left * jnp.sum(changes, axis=1)

    def act(
        self,
        state: _Segment,
        change: Float[Array, "C d"],
        first: Bool[Array, ""],
        count: Int[Array, ""],
        left: Float[Array, ""],
    ) -> tuple[_Segment, Float[Array, "C d"]]:
        """Let contacts act at an end of a segment: those that last are held, the others hit.

        At the first end nothing is changed: what is found is the impulses (N s) that contacts which last will need by
        the other, if their velocities change by `change` (m/s) without them.
        """
        system, stepper = self.system, self.stepper
        contacts = closed_contacts(system, state.x, state.v, self.inverse_mass, stepper, state.closed)
        index, active = contacts.active.candidate, contacts.active.active
        k, d = contacts.velocity.shape
        held, dry = state.lasts[index] & active, jnp.asarray(self.dry)[index]
        past = jnp.where(held[:, None], state.time * state.pressing[index], 0)
        before = contacts.velocity + jnp.where(first, change[index], 0)
        free = before - (contacts.delassus @ past.reshape(-1)).reshape(k, d)
        if stepper.compensation_steps is not None:
            # A gap that is left may close, in as many steps as a penetration is undone in.
            room = jnp.maximum(contacts.active.gap, 0) / (stepper.dt * compensation_steps_of(stepper))
            free = free.at[:, 0].add(jnp.where(held, room, 0))
        contacts, free = self.with_dry_friction(contacts, free, jnp.where(first, left, state.time))
        together = islands(contacts.delassus, d)
        reference = jnp.maximum(jnp.abs(free), jnp.abs(before))
        slow = jnp.minimum(_REBOUNDS[stepper.impact] * jnp.exp2(count.astype(before.dtype) / 2), 1.0)
        rebounds = self.rebounds(contacts, before, state.gain[index], slow, together)

        class Acting(NamedTuple):
            velocity: Float[Array, "K d"]  # of the contacts
            change: Float[Array, "K d"]  # impulses by which the state's velocity changes
            other: Float[Array, "n d"]  # what it changes by beside them, if the model has none

        def part(acting: Acting, hits: Bool[Array, ""]):
            hit = active & ~held & (acting.velocity[:, 0] < 0) & ~first
            # In no time dry friction does nothing.
            these = jnp.where(hits, active & ~dry & jnp.any(together & hit, axis=1), held)
            restitution = jnp.where(hits, rebounds, 0)
            problem = _only(contacts, these, jnp.where(hits, acting.velocity, free), reference, restitution)
            problem = problem._replace(rebounds=hits)
            jump = dissipative(problem, system.contact_model(problem, smoothing=stepper.smoothing))
            if jump.impulse is None:
                return acting._replace(other=acting.other + jnp.where(hits & ~first, jump.velocity, 0)), jump
            impulse = jnp.sum(jump.impulse, axis=0) - jnp.where(hits, 0, past)
            velocity = acting.velocity + (contacts.delassus @ impulse.reshape(-1)).reshape(k, d)
            return acting._replace(velocity=velocity, change=acting.change + impulse), jump

        acting, jumps = jax.lax.scan(
            part, Acting(before, jnp.zeros_like(past), jnp.zeros_like(state.v)), jnp.array([False, True])
        )
        hit_jump = jax.tree.map(lambda a: a[1], jumps)
        wanted = jnp.zeros_like(state.pressing).at[index].add(jnp.where(held[:, None], acting.change, 0))
        kick = acting.other + jnp.einsum("rid,r->id", contacts.response, acting.change.reshape(-1))
        new = state._replace(
            overflow=jnp.maximum(state.overflow, contacts.active.overflow),
            residual=jnp.maximum(state.residual, jnp.max(jumps.residual)),
        )
        rest = jax.lax.cond(
            first,
            lambda: (new.x, new.v, new.contact),
            lambda: (*self.after_impact(new, contacts, hit_jump, kick, acting.velocity), jnp.any(active & ~dry)),
        )
        return new._replace(x=rest[0], v=rest[1], contact=rest[2]), wanted

    def with_dry_friction(
        self, contacts: ContactState, free: Float[Array, "K d"], time: Float[Array, ""]
    ) -> tuple[ContactState, Float[Array, "K d"]]:
        """Dry friction of joints over a `time` (s), as contacts that are pressed together by an impulse that is known.

        Their normal is a coordinate of its own, of the tangent's mobility, which no other contact moves: what stops it
        is that impulse.
        """
        if not self.dry.any():
            return contacts, free
        d = free.shape[1]
        dry = jnp.asarray(self.dry)[contacts.active.candidate] & contacts.active.active
        mobility = jnp.diagonal(contacts.delassus)
        own = jnp.asarray(jnp.where(dry, mobility[1::d], 0))
        delassus = contacts.delassus + jnp.diag(jnp.zeros_like(mobility).at[::d].set(own))
        pressed = -own * self.loss[contacts.active.candidate] * time
        free = free.at[:, 0].set(jnp.where(dry, pressed, free[:, 0]))
        friction = jnp.where(dry, 1, contacts.friction)
        return contacts._replace(delassus=delassus, friction=friction), free

    def rebounds(self, contacts: ContactState, velocity, gain, slow, together) -> Float[Array, " K"]:
        """The restitutions, or none where an island's hardest hit is too `slow` to matter.

        In shares of what the accelerations `gain` (m/s) within a step: contacts may be in m/s and in rad/s.
        """
        approach = jnp.where(contacts.active.active, jnp.maximum(-velocity[:, 0], 0), 0)
        none = jnp.where(approach > 0, jnp.inf, 0)
        hit = jnp.where(gain > 0, approach / jnp.asarray(jnp.where(gain > 0, gain, 1)), none)
        hardest = jnp.max(jnp.where(together, hit, 0), axis=1, initial=0)
        return jnp.where(jax.lax.stop_gradient(hardest > slow), contacts.restitution, 0)

    def after_impact(self, state: _Segment, contacts: ContactState, jump: Jump, kick, velocity) -> State:
        """The state with its velocity changed, and with penetration undone as far as this segment does."""
        stepper = self.stepper
        x, v = state.x, state.v + kick
        if stepper.impact == "event":
            x = x - own_times(contacts, jump, stepper.dt, touching(self.still, x))
        if stepper.compensation_steps is None:
            return x, v
        d = velocity.shape[1]
        depth = jnp.where(contacts.active.active, jnp.maximum(-contacts.active.gap, 0), 0)
        share = jnp.minimum(state.time / (stepper.dt * compensation_steps_of(stepper)), 1)
        # What leaves by itself is not pushed: that would be work.
        wanted = jnp.maximum(share * depth - jnp.maximum(velocity[:, 0], 0) * state.time, 0)
        push = pushes(contacts.delassus[::d, ::d], wanted)
        x = x + jnp.einsum("kid,k->id", contacts.response[::d], push)
        return project_state(self.system.constraints, x, v, self.inverse_mass) if stepper.project else (x, v)

    def move(self, state: _Segment, impulse: Float[Array, "C d"], now: Progress, count: Int[Array, ""]) -> _Segment:
        """From the start of a segment, where contacts that last want an `impulse` (N s), to its other end."""
        left = now.left
        pressing = impulse / jnp.where(left > 0, left, 1)
        begin = (state.x, state.v)
        since = self.stepper.dt - left
        end = self.after(begin, left, pressing, since)
        if self.stepper.impact == "step":
            time, again, unsure = left, jnp.asarray(False), jnp.asarray(False)
            closed = jax.lax.stop_gradient(self.system.gaps(end[0])) < 0
        else:
            still = jax.lax.stop_gradient((begin, end, left))
            event = next_event(self.still, *still, now.acted | state.lasts)

            def rate(state):
                return self.rate(state, pressing, since)

            def after(state, time):
                return self.after(state, time, pressing, since)

            met, time, closed, again = to_event(begin, left, event, self.system, (rate, after))
            # The last segment goes on to the end of the step, where slow contacts are met. To miss a fast one is wrong.
            last = count == self.stepper.events
            speed = jax.jvp(self.still.gaps, jax.lax.stop_gradient(met[:1]), jax.lax.stop_gradient(met[1:]))[1]
            missed = last & again & (-speed > state.gain)[event.candidate]
            again = again & ~last
            end = jax.tree.map(lambda a, b: jnp.where(again, a, b), met, end)
            time, unsure = jnp.where(again, time, left), event.unsure | missed
            closed = jnp.where(again, closed, jax.lax.stop_gradient(self.system.gaps(end[0])) < 0)
        return state._replace(
            x=end[0],
            v=end[1],
            time=time,
            pressing=pressing,
            closed=closed | state.lasts,
            again=again,
            residual=jnp.where(unsure, jnp.inf, state.residual),  # what could not be looked at is not right
        )


def _only(contacts: ContactState, these: Bool[Array, " K"], velocity, reference, restitution) -> ContactState:
    """The problem of `these` contacts alone, with other velocities and restitutions."""
    d = velocity.shape[1]
    rows = jnp.repeat(these, d)
    return contacts._replace(
        active=contacts.active._replace(active=contacts.active.active & these),
        delassus=jnp.where(rows[:, None] & rows, contacts.delassus, 0),
        velocity=jnp.where(these[:, None], velocity, 0),
        target=jnp.zeros_like(velocity),
        restitution=restitution,
        reference=jnp.where(these[:, None], reference, 0),
    )
