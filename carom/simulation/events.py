"""Impacts at the time at which they happen: a step is cut where a gap closes, which makes derivatives right.

A step that only looks at its end lets contacts act up to a step too late. Its motion is as good, but the time of impact
is frozen: the derivative of a ball's height after a bounce by its height before comes out as 1 instead of -e (Zhong,
Han and Brikis, *Differentiable Physics Simulations with Contacts: Do They Have Correct Gradients w.r.t. Position,
Velocity and Control?*, 2022). Here the time of impact moves with the state.

Contacts that rest, or that close again too soon after they have opened, are no events: they are held over the step, see
`segments.py`.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from carom.contact.impulses import ContactState, Jump
from carom.system import System

State = tuple[Float[Array, "n d"], Float[Array, "n d"]]


# The time of the event is found without derivatives, on an interpolant of the step. One Newton step at the state there,
# with everything but the gap itself constant,
#
#     t = t_0 - gap(x(t_0)) / gap'(t_0),
#
# takes away what the interpolant was wrong by, and its plain derivative is the implicit one,
# dt = -(d gap / d theta) / gap'. The state is moved along by its Taylor series.

_LATEST = 0.05
"""An event is taken for one if the interpolant was wrong by no more than this share of the time that was left."""


def to_event(
    state: State, left: Float[Array, ""], event: "Event", system: System, motion: tuple[Callable, Callable]
) -> tuple[State, Float[Array, ""], Bool[Array, " C"], Bool[Array, ""]]:
    """The state at an event that was found within the time that is `left` (s), its time, and what is closed there.

    Also whether it is one: if not, nothing is closed.
    """
    rate, after = motion
    x, v = after(state, event.time)

    def gap_of(x):
        return system.gaps(x)[event.candidate]

    gap, speed = jax.jvp(gap_of, (x,), (v,))
    closing = event.happens & (speed < 0)
    late = jnp.asarray(jnp.where(closing, -gap / jax.lax.stop_gradient(jnp.where(closing, speed, 1)), 0))
    met = event.time + late
    happens = closing & (jnp.abs(late) <= _LATEST * left) & (met >= 0) & (met <= left)
    late = jnp.asarray(jnp.where(happens, late, 0))
    acceleration = jax.lax.stop_gradient(rate((x, v))[1])
    x, v = x + late * v + late**2 / 2 * acceleration, v + late * acceleration
    gaps = jax.lax.stop_gradient(system.gaps(x))
    this = jnp.arange(gaps.shape[0]) == event.candidate
    return (x, v), event.time + late, happens & (this | (gaps <= touching(system, x))), happens


def own_times(
    contacts: ContactState, jump: Jump, dt: Float[Array, ""], near: Float[Array, " C"]
) -> Float[Array, "n d"]:
    """What the positions lose because contacts that close together do so each at its own time (m).

    As good as zero, but for its derivative: contact k acts `gap_k / speed_k` before the event, or after. To first
    order, and exact for contacts that do not act on one another.
    """
    if jump.impulse is None:
        return jnp.zeros_like(contacts.x)
    active, near = contacts.active, near[contacts.active.candidate]
    speed = jax.lax.stop_gradient(contacts.velocity[:, 0])
    closing = active.active & (active.gap > -near) & (_REOPENING * dt * speed < -near)
    late = jnp.where(closing, -active.gap / jnp.where(closing, speed, 1), 0)
    impulse = jnp.sum(jump.impulse, axis=0)
    response = contacts.response.reshape(*impulse.shape, *contacts.x.shape)
    kicks = jax.lax.stop_gradient(jnp.einsum("kr,krid->kid", impulse, response))
    return jnp.einsum("k,kid->id", late, kicks)


def touching(system: System, x: Float[Array, "n d"]) -> Float[Array, " C"]:
    """Contacts nearer than this (m or rad) touch: a gap of zero is known to rounding only.

    In double precision 1.5e-8 of what meets: of a radius, or of how far a gap changes smoothly.
    """
    x = jax.lax.stop_gradient(x)
    own = jnp.minimum(system.reach(), system.travel())
    own = jnp.where((own > 0) & jnp.isfinite(own), own, system.size(x))
    return jnp.maximum(jnp.finfo(x.dtype).eps ** 0.5 * own, rounding(system, x)).astype(x.dtype)


def rounding(system: System, x: Float[Array, "n d"]) -> Float[Array, " C"]:
    """What is rounding in gaps (m or rad)."""
    candidates = system.candidates(x)
    sizes = jnp.linalg.norm(candidates.rows[:, 0], axis=-1) * jnp.linalg.norm(x, axis=-1)[candidates.stencil]
    return 8 * jnp.finfo(x.dtype).eps * jnp.sum(sizes, axis=1)


# --- Where is the next event? -----------------------------------------------------------------------------------
#
# Positions are a cubic in time, from both ends of the interval with their velocities. It is gone along in pieces in
# which no gap can close and open again unseen: nothing moves far beside the size of the bodies, or not half as far as
# it is away; mostly there is one. In a piece each gap is a cubic in time again. Where one goes below zero, so must the
# gap itself, or the piece ends there and the next is begun. The first root is refined on the interpolant.

_REOPENING = 1e-3
"""Share of the interval in which a contact that touches at its start must open, or it is taken to rest."""
_MOST_PIECES = 500
"""Bodies that go on side by side take one for each half of their size; if that is not enough, the step is not right."""


class Event(NamedTuple):
    happens: Bool[Array, ""]
    time: Float[Array, ""]  # s from the start of the interval; 0 without an event
    candidate: Int[Array, ""]
    unsure: Bool[Array, ""]  # the interval was too long to look at all of it


class _Search(NamedTuple):
    """How far it has come, and what it has found."""

    end: Float[Array, ""]
    gap: Float[Array, " C"]
    speed: Float[Array, " C"]
    is_open: Bool[Array, " C"]
    found: Bool[Array, ""]
    lower: Float[Array, ""]
    guess: Float[Array, ""]
    candidate: Int[Array, ""]
    pieces: Int[Array, ""]
    unsure: Bool[Array, ""]


def next_event(system: System, start: State, end: State, time: Float[Array, ""], acted: Bool[Array, " C"]) -> Event:
    """The first time at which an open gap closes on the way from `start` to `end`, `time` (s) later.

    Contacts that have `acted` at the start must open first.
    """
    total = jnp.where(time > 0, time, 1)

    def gaps_at(t):
        where, velocity = hermite(start, end, total, t)
        return jax.jvp(system.gaps, (where,), (velocity,))

    gap, speed = gaps_at(jnp.zeros_like(time))
    fastest, travel = closing_speed(system, start, end), system.travel()
    nothing, near = jnp.zeros_like(time), touching(system, start[0])
    clear = jnp.maximum(1e-3 * near, rounding(system, start[0]))
    # The first piece is a short one: what touches at the start is open if it is by then, or if it closes at speed.
    closes = (gap > -near) & (_REOPENING * time * speed < -near)
    first = _Search(
        end=nothing,
        gap=gap,
        speed=speed,
        is_open=((gap > near) | closes) & ~acted,
        found=jnp.asarray(False),
        lower=nothing,
        guess=nothing,
        candidate=jnp.asarray(0),
        pieces=jnp.asarray(0),
        unsure=jnp.asarray(False),
    )

    def keep_going(search: _Search):
        return ~search.found & (search.end < time) & (search.pieces < _MOST_PIECES)

    def body(search: _Search) -> _Search:
        longest = longest_piece(search.gap, fastest, travel, time - search.end)
        length = jnp.where(search.pieces == 0, jnp.minimum(_REOPENING * time, longest), longest)
        whole = jnp.minimum(search.end + length, time)
        last = search.pieces == _MOST_PIECES - 1
        unsure = last & (whole < time)
        whole = jnp.where(last, time, whole)
        length = whole - search.end
        gap, speed = gaps_at(whole)
        share, most = first_root(search.gap, length * search.speed, gap, length * speed)
        share = jnp.where(search.is_open, share, jnp.inf)
        which = jnp.argmin(share)
        root = share[which] <= 1
        # Where the cubic dips below zero, so may the gap, or not.
        end = jnp.where(root & (most[which] < 1), search.end + length * most[which], whole)
        gap, speed = gaps_at(end)
        return _Search(
            end=end,
            gap=gap,
            speed=speed,
            is_open=(search.is_open & (gap >= 0)) | (gap > clear),
            found=root & (gap[which] < 0),
            lower=search.end,
            guess=search.end + length * jnp.where(root, share[which], 0),
            candidate=which,
            pieces=search.pieces + 1,
            unsure=unsure,
        )

    search = jax.lax.while_loop(keep_going, body, first)

    # In shares of the interval, and gaps such that the tolerance is a hundredth of what touches.
    guess, tolerance = search.guess / total, 1e-3 * float(jnp.finfo(gap.dtype).eps) ** 0.5
    unit = near[search.candidate] / (100 * tolerance)

    def gap_of(share, _):
        where, _ = hermite(start, end, total, share * total)
        return jnp.where(search.found, system.gaps(where)[search.candidate] / unit, share - guess)

    refined = optx.root_find(
        gap_of,
        optx.Newton(rtol=1e-9, atol=tolerance),
        guess,
        options={"lower": search.lower / total, "upper": search.end / total},
        max_steps=8,
        throw=False,
    ).value
    refined = jnp.where(jnp.isfinite(refined), refined * total, search.guess)
    return Event(search.found, jnp.where(search.found, refined, 0), search.candidate, search.unsure)


def hermite(start: State, end: State, time: Float[Array, ""], t: Float[Array, ""]) -> State:
    """Positions and velocities at `t` of the cubic with those of `start` at 0 and of `end` at `time` (s)."""
    (x0, v0), (x1, v1) = start, end
    s = t / time
    mean = (x1 - x0) / time
    bend, twist = 3 * mean - 2 * v0 - v1, v0 + v1 - 2 * mean
    return x0 + t * (v0 + s * (bend + s * twist)), v0 + s * (2 * bend + 3 * s * twist)


def closing_speed(system: System, start: State, end: State) -> Float[Array, " C"]:
    """How fast each gap can change (m/s): no faster than the speeds of its points allow."""
    candidates = system.candidates(start[0])
    speeds = jnp.maximum(*(jnp.linalg.norm(v, axis=-1) for v in (start[1], end[1])))
    return jnp.sum(jnp.linalg.norm(candidates.rows[:, 0], axis=-1) * speeds[candidates.stencil], axis=1)


def may_close(system: System, start: State, end: State, time: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether a gap can be closed at any time on the way from `start` to `end`, `time` (s) later.

    Twice the speeds at both ends, for what happens in between.
    """
    fastest = closing_speed(system, start, end)
    nearest = jnp.minimum(system.gaps(start[0]), system.gaps(end[0]))
    return jnp.any(nearest <= 2 * fastest * time + touching(system, start[0]))


def longest_piece(
    gap: Float[Array, " C"], fastest: Float[Array, " C"], travel: Float[Array, " C"], left: Float[Array, ""]
) -> Float[Array, ""]:
    """A time (s) in which no gap closes and opens again: see the head of this part.

    `fastest`, how fast gaps change; `travel`, how far they may, see `Contact.travel`; `left` (s), of the interval.
    """
    matters = (fastest > 0) & (gap <= 2 * fastest * left) & (travel > 0)
    allowed = jnp.maximum(travel, gap / 2) / jnp.where(fastest > 0, fastest, 1)
    return jnp.min(jnp.where(matters, allowed, jnp.inf), initial=jnp.inf)


def first_root(
    g0: Float[Array, " C"], r0: Float[Array, " C"], g1: Float[Array, " C"], r1: Float[Array, " C"]
) -> tuple[Float[Array, " C"], Float[Array, " C"]]:
    """Where in [0, 1] cubics first go below zero, and a place after, before which there is no other root.

    `g0`, `r0`: value and slope at 0; `g1`, `r1`: at 1. Infinite where it does not.
    """
    c2, c3 = 3 * (g1 - g0) - 2 * r0 - r1, 2 * (g0 - g1) + r0 + r1

    def value(s):
        return g0 + s * (r0 + s * (c2 + s * c3))

    # The minimum: the root of the derivative at which it grows, without cancellation.
    discriminant = c2**2 - 3 * c3 * r0
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    plus, minus = jnp.where(c2 > 0, c2 + root, 1), jnp.where((c2 <= 0) & (c3 > 0), 3 * c3, jnp.inf)
    lowest = jnp.where(c2 > 0, -r0 / plus, (root - c2) / minus)
    dips = (discriminant > 0) & (lowest > 0) & (lowest < 1) & (value(lowest) < 0)
    most = jnp.where(dips, lowest, 1.0)

    def halve(_, bracket):
        lower, upper = bracket
        middle = (lower + upper) / 2
        below = value(middle) < 0
        return jnp.where(below, lower, middle), jnp.where(below, middle, upper)

    _, root = jax.lax.fori_loop(0, 20, halve, (jnp.zeros_like(most), most))
    return jnp.asarray(jnp.where(dips | (g1 < 0), root, jnp.inf)), most
