"""Two pucks in a box, simulated without carom: flights in closed form, impacts at their own time.

Disks that do not turn, in a uniform field or slowed by drag, meet walls and each other: Coulomb's friction, and
Poisson's restitution, which is Newton's for a single contact that turns no body. NumPy alone; the next impact is the
least root of quadratics.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

WALLS = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""Normals of the walls of the box, into it."""


@dataclasses.dataclass(frozen=True)
class Pucks:
    """Masses (kg), radii (m), friction and restitution of the pair and of the walls, in a box of sides of 1 m.

    `field` (m/s^2); `drag` (1/s), the rate at which speeds fall, which goes without a field.
    """

    masses: tuple[float, float] = (0.1, 0.17)
    radii: tuple[float, float] = (0.1, 0.15)
    friction: tuple[float, float] = (0.2, 0.1)
    restitution: tuple[float, float] = (0.8, 0.7)
    field: tuple[float, float] = (0.0, 0.0)
    drag: float = 0.0

    def __post_init__(self):
        if self.drag and any(self.field):
            raise ValueError("drag and field are not in closed form together")


class Seen(NamedTuple):
    """Times (s) and positions (m), with noise, NaN where a sample is missing; and how many impacts there were."""

    time: Float[np.ndarray, "N T"]
    x: Float[np.ndarray, "N T 2 2"]
    impacts: int


def observe(
    pucks: Pucks,
    *,
    trajectories: int,
    samples: int,
    rate: float = 120.0,
    speed: float = 1.0,
    noise: float = 0.0,
    missing: float = 0.0,
    jitter: float = 0.0,
    decimals: int | None = None,
    seed: int = 0,
) -> Seen:
    """Positions of pucks from random starts.

    **Arguments:** `rate` (1/s); `speed` (m/s), of the starts' normal deviates; `noise` (m); `missing`, share of the
    samples; `jitter` (s), by which times are off an equal step at most; `decimals`, that times are rounded to.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(samples) / rate + jitter * rng.uniform(-1, 1, (trajectories, samples))
    x = np.zeros((trajectories, samples, 2, 2))
    impacts = 0
    for k in range(trajectories):
        start = _start(pucks, rng)
        x[k], count = _motion(pucks, start, speed * rng.normal(size=(2, 2)), time[k] - time[k, 0])
        impacts += count
    x += noise * rng.normal(size=x.shape)
    x[rng.random((trajectories, samples)) < missing] = np.nan
    time = time - time[:, :1]
    return Seen(time if decimals is None else np.round(time, decimals), x, impacts)


def _start(pucks: Pucks, rng: np.random.Generator) -> Float[np.ndarray, "2 2"]:
    radii = np.array(pucks.radii)[:, None]
    while True:
        x = rng.uniform(radii + 0.01, 1 - radii - 0.01, (2, 2))
        if np.linalg.norm(x[0] - x[1]) > sum(pucks.radii) + 0.01:
            return x


def _motion(pucks: Pucks, x, v, time: Float[np.ndarray, " T"]) -> tuple[Float[np.ndarray, "T 2 2"], int]:
    """Positions at `time`, and how many impacts there were."""
    out, done, now, count = np.zeros((len(time), 2, 2)), 0, 0.0, 0
    while done < len(time):
        wait, contact = _next(pucks, x, v)
        while done < len(time) and time[done] <= now + wait:
            out[done] = _after(pucks, x, v, time[done] - now)[0]
            done += 1
        if done < len(time):
            x, v = _after(pucks, x, v, wait)
            v = _hit(pucks, x, v, contact)
            now, count = now + wait, count + 1
    return out, count


def _after(pucks: Pucks, x, v, t: float):
    """State after a flight of `t` (s)."""
    if pucks.drag:
        fallen = np.exp(-pucks.drag * t)
        return x + v * (1 - fallen) / pucks.drag, v * fallen
    field = np.array(pucks.field)
    return x + v * t + field * t**2 / 2, v + field * t


def _next(pucks: Pucks, x, v) -> tuple[float, int]:
    """Time until the next impact, and where: at wall 0 to 3 of puck 0, 4 to 7 of puck 1, or 8, each other."""
    waits = []
    for k in range(2):
        for normal in WALLS:
            gap = normal @ x[k] + (0.0 if normal.sum() > 0 else 1.0) - pucks.radii[k]
            waits.append(_least_root(normal @ np.array(pucks.field) / 2, normal @ v[k], gap))
    apart, toward = x[1] - x[0], v[1] - v[0]
    waits.append(_least_root(toward @ toward, 2 * apart @ toward, apart @ apart - sum(pucks.radii) ** 2))
    contact = int(np.argmin(waits))
    wait = waits[contact]
    if pucks.drag and np.isfinite(wait):
        share = pucks.drag * wait  # distance is gone along as at constant speed, slower and slower
        wait = -np.log1p(-share) / pucks.drag if share < 1 else np.inf
    return float(wait), contact


def _least_root(a: float, b: float, c: float) -> float:
    """The first time from now on at which a t^2 + b t + c falls below zero; infinite if it does not."""
    c = max(c, 0.0)
    if b >= 0 and c == 0 and a >= 0:
        return np.inf
    square = b**2 - 4 * a * c
    if square <= 0:
        return np.inf
    root = np.sqrt(square)
    if b < 0:
        return 2 * c / (-b + root)
    return (b + root) / (-2 * a) if a < 0 else np.inf


def _hit(pucks: Pucks, x, v, contact: int):
    """Velocities after the impact `contact`."""
    v = v.copy()
    pair = contact == 8
    kind, body = (0, 0) if pair else (1, contact // 4)
    mu, e = pucks.friction[kind], pucks.restitution[kind]
    if pair:
        normal = (x[0] - x[1]) / np.linalg.norm(x[0] - x[1])
        mass = 1 / (1 / pucks.masses[0] + 1 / pucks.masses[1])
        meeting = v[0] - v[1]
    else:
        normal = WALLS[contact % 4]
        mass, meeting = pucks.masses[body], v[body]
    along = meeting - (meeting @ normal) * normal
    pressing = -(1 + e) * mass * (meeting @ normal)
    rubbing = mass * np.linalg.norm(along)
    impulse = pressing * normal
    if rubbing > 0:
        impulse = impulse - min(1.0, mu * pressing / rubbing) * mass * along
    if pair:
        v[0] += impulse / pucks.masses[0]
        v[1] -= impulse / pucks.masses[1]
    else:
        v[body] += impulse / mass
    return v
