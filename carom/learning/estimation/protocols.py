"""How predictions of tossed bodies are measured: errors of position and rotation, penetration, by toss."""

import dataclasses
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from carom.checks import require
from carom.contact.boxes import CornerPlane
from carom.mechanics.bodies import RigidBody
from carom.recordings.recording import Recording
from carom.system import System

Protocol = Literal["A", "B"]


@dataclasses.dataclass(frozen=True)
class TossErrors:
    """By toss: mean errors of position and penetration (% of the width) and of rotation (degrees)."""

    position: Float[np.ndarray, " N"]
    rotation: Float[np.ndarray, " N"]
    penetration: Float[np.ndarray, " N"]

    def summary(self) -> dict[str, dict[str, float]]:
        """Mean, standard deviation and median of each."""
        parts = {name: getattr(self, name) for name in ("position", "rotation", "penetration")}
        return {
            name: {"mean": float(np.mean(part)), "sd": float(np.std(part)), "median": float(np.median(part))}
            for name, part in parts.items()
        }


def pose_errors(
    predicted: Float[np.ndarray, "N T 4 3"], recorded: Float[np.ndarray, "N T 4 3"], length: Int[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Mean distance of the centres (m) and mean geodesic angle (rad) of each toss, over its `length` samples."""
    valid = np.arange(recorded.shape[1]) < length[:, None]
    distance = np.linalg.norm(predicted[:, :, 0] - recorded[:, :, 0], axis=-1)
    axes = [part[:, :, 1:] - part[:, :, :1] for part in (predicted, recorded)]
    cosine = (np.einsum("ntij,ntij->nt", *axes) - 1) / 2
    angle = np.arccos(np.clip(cosine, -1, 1))
    return tuple(np.where(valid, part, 0).sum(axis=1) / valid.sum(axis=1) for part in (distance, angle))  # pyright: ignore[reportReturnType]


def protocol_starts(
    recording: Recording, protocol: Protocol, height: float, moments: Float[np.ndarray, " 3"] | None = None
) -> Recording:
    """The recording as a protocol predicts it: each toss from the sample that it starts from.

    A: the first sample. B: the sample before the centre first falls below `height` (m), at which a corner can touch
    (half of the box's diagonal), with the velocities refitted on the flight before it (Acosta, Yang, Posa, RA-L 2022).
    In flight a body keeps its angular momentum, for which its second `moments` are needed, but for a common factor;
    without them it turns like a cube, at one rate.
    """
    require(protocol in ("A", "B"), f"protocol must be A or B; it was {protocol!r}.")
    if protocol == "A":
        return recording
    second = np.ones(3) if moments is None else np.asarray(moments)
    inertia = np.sum(second) - second  # I_x = mu_y + mu_z and so on
    starts, states = [], []
    for k, length in enumerate(recording.length):
        low = recording.x[k, :length, 0, 2] < height
        start = max(int(low.argmax()) - 1, 0) if low.any() else 0
        starts.append(start)
        states.append(_flight_velocity(recording.x[k, : start + 1], recording.v[k, start], recording.dt, inertia))
    length = recording.length - np.array(starts)
    rows = (np.array(starts)[:, None] + np.arange(length.max())).clip(max=recording.x.shape[1] - 1)
    x, v = (part[np.arange(len(starts))[:, None], rows] for part in (recording.x, recording.v))
    v[:, 0] = np.array(states)
    return Recording.of(
        x, v, dt=recording.dt, length=length, group=recording.group, task=recording.task, source=recording.source
    )


def _flight_velocity(
    x: Float[np.ndarray, "t 4 3"], recorded: Float[np.ndarray, "4 3"], dt: float, inertia: Float[np.ndarray, " 3"]
):
    """Velocities of the points at the end of a flight: a parabola for the centre, one angular momentum for the axes.

    `inertia` holds the principal moments of inertia, in any unit.
    """
    if len(x) < 4:
        return recorded
    from scipy.spatial.transform import Rotation

    time = (np.arange(len(x)) - len(x) + 1) * dt
    center = np.polyfit(time, x[:, 0], 2)[1]
    turn = Rotation.from_matrix(np.swapaxes(x[:, 1:] - x[:, :1], 1, 2))  # the nearest rotations to the axes
    # A rotation vector has no more than half a turn: so from sample to sample, however far the whole flight turns.
    # These weights make the mean of a body that turns at one rate the slope of its angle's straight line of least
    # squares through the last sample, sum t phi(t) / sum t^2.
    steps = (turn[1:] * turn[:-1].inv()).as_rotvec()
    weights = np.cumsum(-time[:-1])
    halfway = (Rotation.from_rotvec(steps / 2) * turn[:-1]).as_matrix()
    momentum = weights @ _turned(halfway, inertia, steps / dt) / weights.sum()
    omega = _turned(turn[-1].as_matrix(), 1 / inertia, momentum)
    return center + np.concatenate([np.zeros((1, 3)), np.cross(omega, x[-1, 1:] - x[-1, :1])])


def _turned(
    rotation: Float[np.ndarray, "*t 3 3"], diagonal: Float[np.ndarray, " 3"], vector: Float[np.ndarray, "*t 3"]
):
    """`R diag(d) R^T u`: what is diagonal in the body's frame, on vectors of the world's."""
    return np.einsum("...ij,j,...kj,...k->...i", rotation, diagonal, rotation, vector)


def body_points(system: System, box: Float[Array, "... 4 3"]) -> Float[Array, "... 4 3"]:
    """Points of the body (from its centre of mass), or their velocities, from those that start at the box's centre.

    Recordings are of the box's centre, `x_0 + R c` for a box whose `center` is at c; axes are the same for both.
    """
    return box - _middle(system, box)


def box_points(system: System, body: Float[Array, "... 4 3"]) -> Float[Array, "... 4 3"]:
    """The inverse of `body_points`."""
    return body + _middle(system, body)


def _middle(system: System, points):
    return jnp.einsum("a,...ad->...d", box_of(system).center, points[..., 1:, :] - points[..., :1, :])[..., None, :]


def lowest_corner(system: System, x: Float[np.ndarray, "N T 4 3"]) -> Float[np.ndarray, "N T"]:
    """Height of the lowest corner above the plane (m), of recorded points; negative where it penetrates."""
    gaps = jax.jit(jax.vmap(jax.vmap(system.gaps)))(body_points(system, jnp.asarray(x)))
    return np.asarray(jnp.min(gaps, axis=-1))


def toss_errors(
    system: System, recording: Recording, predicted: Float[np.ndarray, "N T 4 3"], width: float
) -> TossErrors:
    """Errors of predicted tosses, in % of `width` (m) and degrees, over each toss to its own end."""
    distance, angle = pose_errors(predicted, recording.x, recording.length)
    depth = np.maximum(-lowest_corner(system, predicted), 0)
    valid = recording.valid
    inside = np.where(valid, depth, 0).sum(axis=1) / valid.sum(axis=1)
    return TossErrors(100 * distance / width, np.degrees(angle), 100 * inside / width)


def box_of(system: System) -> CornerPlane:
    """The contact of a box with a plane. Raises `CaromError` for a system without one."""
    found = [contact for contact in system.contacts if isinstance(contact, CornerPlane)]
    require(len(found) > 0, "protocols A and B are for tossed boxes; this system has no CornerPlane contact.")
    return found[0]


def moments_of(system: System) -> Float[np.ndarray, " 3"]:
    """Second moments (kg m^2) of the one body that is tossed."""
    (body,) = system.bodies
    assert isinstance(body, RigidBody)
    return np.asarray(body.moments)


def paired_difference(
    first: Float[np.ndarray, " N"], second: Float[np.ndarray, " N"], group: Int[np.ndarray, " N"] | None, seed: int = 0
) -> dict[str, Any]:
    """Mean of `first - second` by toss, with a 95 % interval by 10 000 bootstrap draws of whole sessions."""
    difference = first - second
    each = np.arange(len(difference)) if group is None else np.asarray(group)
    sessions = np.unique(each)
    sums = np.array([difference[each == s].sum() for s in sessions])
    counts = np.array([(each == s).sum() for s in sessions])
    draws = np.random.default_rng(seed).integers(len(sessions), size=(10000, len(sessions)))
    means = sums[draws].sum(axis=1) / counts[draws].sum(axis=1)
    lower, upper = np.quantile(means, [0.025, 0.975])
    return {"mean": float(difference.mean()), "lower": float(lower), "upper": float(upper), "sessions": len(sessions)}
