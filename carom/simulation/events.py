"""Impacts at the time at which they happen: a step is cut where a gap closes, which makes derivatives right.

A step that only looks at its end lets contacts act up to a step too late. Its motion is as good, but the time of impact
is frozen: the derivative of a ball's height after a bounce by its height before comes out as 1 instead of -e (Zhong,
Han and Brikis, *Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients w.r.t. Position,
Velocity and Control?*, 2022). Here the time of impact moves with the state.

What cannot be told by events is left to the rule of the step's end: contacts that rest, that close again too soon
after they have opened, and those that close after the last event that a step may have.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from carom.simulation.impact import Stepper, StepResult, impact_at
from carom.system import System

State = tuple[Float[Array, "n d"], Float[Array, "n d"]]


def step_with_events(
    system: System,
    x: Float[Array, "n d"],
    v: Float[Array, "n d"],
    inverse_mass: Float[Array, "n n"],
    stepper: Stepper,
    motion: tuple[Callable, Callable],
) -> StepResult:
    """One step, cut at up to `stepper.events` times at which contacts close; `motion` is that of `smooth_flow`."""

    def part(carry, last):
        state, left = carry
        state, left, closed = to_next_event(system, state, left, last, motion)
        out = impact_at(system, *state, inverse_mass, stepper, closed)
        return ((out.x, out.v), left), (out.contact, out.overflow, out.residual)

    # One program for all parts of the step, the last of which ends where the step does.
    last = jnp.arange(stepper.events + 1) == stepper.events
    ((x, v), _), (contact, overflow, residual) = jax.lax.scan(part, ((x, v), stepper.dt), last)
    return StepResult(x, v, jnp.any(contact), jnp.sum(overflow), jnp.max(residual))


# The time of the event is found without derivatives, on an interpolant of the step. One Newton step at the state there,
# with everything but the gap itself constant,
#
#     t = t_0 - gap(x(t_0)) / gap'(t_0),
#
# takes away what the interpolant was wrong by, and its plain derivative is the implicit one,
# dt = -(d gap / d theta) / gap'. The state is moved along by its Taylor series.
def to_next_event(
    system: System, state: State, left: Float[Array, ""], last: Bool[Array, ""], motion: tuple[Callable, Callable]
) -> tuple[State, Float[Array, ""], Bool[Array, " C"]]:
    """The state at the next event within the time that is left (s), the time left then, and what is closed there.

    Without an event the state and the time are what they were, and nothing is closed. The `last` part of a step goes
    to its end, by the rule of which closed is what has a negative gap.
    """
    rate, after = motion
    frozen = jax.lax.stop_gradient(state)
    event = next_event(system, frozen, jax.lax.stop_gradient(after(state, left)), jax.lax.stop_gradient(left))
    happens = event.happens & ~last
    time = jnp.where(last, left, jnp.where(happens, event.time, 0))
    x, v = after(state, time)

    def gap_of(x):
        return system.gaps(x)[event.candidate]

    gap, speed = jax.jvp(gap_of, (x,), (v,))
    closing = happens & (speed < 0)
    late = jnp.asarray(jnp.where(closing, -gap / jax.lax.stop_gradient(jnp.where(closing, speed, 1)), 0))
    acceleration = rate((x, v))[1]
    x, v = x + late * v + late**2 / 2 * acceleration, v + late * acceleration
    gaps = jax.lax.stop_gradient(system.gaps(x))
    this = jnp.arange(gaps.shape[0]) == event.candidate
    meet = happens & (this | (gaps <= touching(gaps.dtype)))
    return (x, v), left - time - late, jnp.where(last, gaps < 0, meet)


def touching(dtype) -> float:
    """Contacts nearer than this (m) touch: a gap of zero is known to rounding only."""
    return 0.1 * float(jnp.finfo(dtype).eps) ** 0.5


# --- Where is the next event? -----------------------------------------------------------------------------------
#
# Positions are a cubic in time, from both ends of the interval with their velocities. It is gone along in pieces in
# which nothing moves far beside the size of the bodies, so that none passes through another unseen; mostly there is
# one. In a piece each gap is a cubic in time again. The first root of any is refined on the interpolant.

_REOPENING = 1e-3
"""Share of the interval in which a contact that touches at its start must open, or it is taken to rest."""
_FARTHEST = 0.5
"""Farthest way in a piece, as a share of the way through a body."""
_MOST_PIECES = 1000


class Event(NamedTuple):
    happens: Bool[Array, ""]
    time: Float[Array, ""]  # s from the start of the interval; 0 without an event
    candidate: Int[Array, ""]


class _Piece(NamedTuple):
    """A piece `[start, end]` of the interval, looked at up to `end`."""

    end: Float[Array, ""]
    gap: Float[Array, " C"]
    speed: Float[Array, " C"]
    is_open: Bool[Array, " C"]
    found: Bool[Array, ""]
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    guess: Float[Array, ""]
    candidate: Int[Array, ""]
    number: Int[Array, ""]


def next_event(system: System, start: State, end: State, time: Float[Array, ""]) -> Event:
    """The first time at which an open gap closes on the way from `start` to `end`, `time` (s) later."""

    def gaps_at(t):
        where, velocity = hermite(start, end, time, t)
        return jax.jvp(system.gaps, (where,), (velocity,))

    gap, speed = gaps_at(jnp.zeros_like(time))
    longest = longest_piece(system, start, end, time, gap)
    nothing, near = jnp.zeros_like(time), touching(gap.dtype)
    # The first piece is a short one: what touches at the start is open if it is by then, or if it closes at speed.
    first = _Piece(
        end=nothing,
        gap=gap,
        speed=speed,
        is_open=(gap > near) | ((gap > -near) & (_REOPENING * time * speed < -near)),
        found=jnp.asarray(False),
        lower=nothing,
        upper=nothing,
        guess=nothing,
        candidate=jnp.asarray(0),
        number=jnp.asarray(0),
    )

    def keep_going(piece: _Piece):
        return ~piece.found & (piece.end < time) & (piece.number < _MOST_PIECES)

    def body(piece: _Piece) -> _Piece:
        length = jnp.where(piece.number == 0, _REOPENING * time, longest)
        end = jnp.minimum(piece.end + length, time)
        end = jnp.where(piece.number == _MOST_PIECES - 1, time, end)
        length = end - piece.end
        gap, speed = gaps_at(end)
        share, most = first_root(piece.gap, length * piece.speed, gap, length * speed)
        share = jnp.where(piece.is_open, share, jnp.inf)
        which = jnp.argmin(share)
        found = share[which] <= 1
        return _Piece(
            end=end,
            gap=gap,
            speed=speed,
            is_open=(piece.is_open & (gap >= 0)) | (gap > 1e-3 * near),
            found=found,
            lower=piece.end,
            upper=piece.end + length * most[which],
            guess=piece.end + length * jnp.where(found, share[which], 0),
            candidate=which,
            number=piece.number + 1,
        )

    piece = jax.lax.while_loop(keep_going, body, first)

    def gap_of(t, _):
        return gaps_at(t)[0][piece.candidate]

    refined = optx.root_find(
        gap_of,
        optx.Newton(rtol=1e-12, atol=1e-3 * touching(gap.dtype) * float(jnp.finfo(gap.dtype).eps) ** 0.25),
        piece.guess,
        options={"lower": piece.lower, "upper": piece.upper},
        max_steps=8,
        throw=False,
    ).value
    happens = piece.found
    refined = jnp.where(jnp.isfinite(refined), refined, piece.guess)
    return Event(happens, jnp.where(happens, refined, 0), piece.candidate)


def hermite(start: State, end: State, time: Float[Array, ""], t: Float[Array, ""]) -> State:
    """Positions and velocities at `t` of the cubic with those of `start` at 0 and of `end` at `time` (s)."""
    (x0, v0), (x1, v1) = start, end
    s = t / time
    mean = (x1 - x0) / time
    bend, twist = 3 * mean - 2 * v0 - v1, v0 + v1 - 2 * mean
    return x0 + t * (v0 + s * (bend + s * twist)), v0 + s * (2 * bend + 3 * s * twist)


def longest_piece(
    system: System, start: State, end: State, time: Float[Array, ""], gap: Float[Array, " C"]
) -> Float[Array, ""]:
    """A time (s) in which no body moves far beside the way through what it could meet."""
    candidates = system.candidates(start[0])
    speeds = jnp.maximum(*(jnp.linalg.norm(v, axis=-1) for v in (start[1], end[1])))
    # A gap changes no faster than the speeds of its points allow.
    fastest = jnp.sum(jnp.linalg.norm(candidates.rows[:, 0], axis=-1) * speeds[candidates.stencil], axis=1)
    near = gap <= fastest * time
    allowed = _FARTHEST * system.reach() / jnp.where(fastest > 0, fastest, 1)
    return jnp.min(jnp.where(near & (fastest > 0), allowed, jnp.inf), initial=jnp.inf)


def first_root(
    g0: Float[Array, " C"], r0: Float[Array, " C"], g1: Float[Array, " C"], r1: Float[Array, " C"]
) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
    """Where in [0, 1] cubics first go below zero, and a place after, before which there is no other root.

    `g0`, `r0`: value and slope at 0; `g1`, `r1`: at 1. Infinite where it does not.
    """
    c2, c3 = 3 * (g1 - g0) - 2 * r0 - r1, 2 * (g0 - g1) + r0 + r1

    def value(s):
        return g0 + s * (r0 + s * (c2 + s * c3))

    # The minimum: the root of the derivative at which it grows.
    discriminant = c2**2 - 3 * c3 * r0
    divisor = c2 + jnp.sqrt(jnp.maximum(discriminant, 0))
    lowest = -r0 / jnp.where(divisor > 0, divisor, 1)
    inside = (discriminant > 0) & (divisor > 0) & (lowest > 0) & (lowest < 1)
    dips = inside & (value(lowest) < 0)
    most = jnp.where(dips, lowest, 1.0)

    def halve(_, bracket):
        lower, upper = bracket
        middle = (lower + upper) / 2
        below = value(middle) < 0
        return jnp.where(below, lower, middle), jnp.where(below, middle, upper)

    _, root = jax.lax.fori_loop(0, 20, halve, (jnp.zeros_like(most), most))
    return jnp.asarray(jnp.where(dips | (g1 < 0), root, jnp.inf)), most
