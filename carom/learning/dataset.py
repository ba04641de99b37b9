"""Training data: short chunks of recorded trajectories, about half of them with a contact."""

from collections.abc import Iterator
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from carom.checks import require
from carom.recordings.recording import Recording
from carom.simulation.rollout import Trajectory
from carom.system import System

PIECES = 10
"""Into how many pieces of equal length a single trajectory is cut."""


class Chunks(eqx.Module):
    """Where chunks of consecutive states may start, by trajectory and by whether a contact falls into them.

    A chunk never starts in contact: the state after an impact alone does not tell what happened.
    """

    length: int = eqx.field(static=True)  # states in a chunk
    smooth: tuple[Int[np.ndarray, " _"], ...]  # starts, by trajectory
    impact: tuple[Int[np.ndarray, " _"], ...]

    @classmethod
    def of(cls, contact: Bool[np.ndarray, "N T"], valid: Int[np.ndarray, " N"], length: int) -> "Chunks":
        """All chunks of `length` states in trajectories with `valid` samples each."""
        smooth, impact = [], []
        for flags, count in zip(contact, valid, strict=True):
            starts = np.arange(max(int(count) - length + 1, 0))
            starts = starts[~flags[starts]]
            windows = (
                np.lib.stride_tricks.sliding_window_view(flags[:count], length) if len(starts) else flags[:0, None]
            )
            hit = windows[starts, 1:].any(axis=1) if len(starts) else np.zeros(0, bool)
            smooth.append(starts[~hit])
            impact.append(starts[hit])
        return cls(length, tuple(smooth), tuple(impact))

    def draw(self, rng: np.random.Generator, count: int, share: float) -> tuple[np.ndarray, np.ndarray]:
        """`count` chunks `(trajectory, start)`, spread evenly over the trajectories.

        About `share` of them hold a contact, as far as their trajectories have any.
        """
        drawable = [k for k in range(len(self.smooth)) if len(self.smooth[k]) or len(self.impact[k])]
        rounds = -(-count // len(drawable))
        trajectory = np.concatenate([rng.permutation(drawable) for _ in range(rounds)])[:count]
        start = []
        for k in trajectory:
            smooth, impact = self.smooth[k], self.impact[k]
            pool = impact if len(impact) and (rng.random() < share or not len(smooth)) else smooth
            start.append(rng.choice(pool))
        return trajectory.astype(np.int32), np.array(start, dtype=np.int32)

    def count(self) -> tuple[int, int]:
        """Number of chunks without and with a contact."""
        return sum(map(len, self.smooth)), sum(map(len, self.impact))


class Dataset(eqx.Module):
    """Recordings to learn from: `train` to fit, `val` to stop and choose by.

    Build one from recordings (`load_recording`) or simulated trajectories (`Recording.of`), or let `Dataset.split`
    divide one recording.
    """

    train: Recording
    val: Recording

    def __check_init__(self):
        require(
            self.train.x.shape[2:] == self.val.x.shape[2:],
            f"train and val must be of one system; their points and axes were {self.train.x.shape[2:]} and "
            f"{self.val.x.shape[2:]}.",
        )
        require(
            abs(self.train.dt - self.val.dt) <= 1e-6 * self.train.dt,
            f"train and val must have one time step; they had {self.train.dt} s and {self.val.dt} s. If that is the "
            "rounding of their times, write more digits, or both into one file to be split.",
        )

    @classmethod
    def split(cls, recording: Recording, *, val: float = 0.1, seed: int = 0) -> "Dataset":
        """Divide the trajectories of one recording: a share `val` of them, at least one, for validation.

        Where they are of several sessions (`group`), each session stays whole, and `val` is a share of the sessions.
        """
        n = recording.n_trajectories
        require(
            n >= 2,
            f"a recording must have at least 2 trajectories to be split; it had {n}. Cut it into pieces first: "
            f"recording.cut(samples), with up to {int(recording.length.max()) // 2} samples each.",
        )
        require(0 < val < 1, f"val must be a share between 0 and 1; it was {val}.")
        sessions = len(np.unique(sessions_of(recording)))
        require(sessions >= 2, "a recording of one session cannot be split: give a file to validate on.")
        held = hold_out(recording, val, np.random.default_rng(seed))
        return cls(recording.select(~held), recording.select(held))


def in_pieces(recording: Recording, least: int, shortest: int) -> tuple[Recording, str]:
    """A recording of at least `least` trajectories: as it is, or cut into pieces; and a word about that, or "".

    **Arguments:** `shortest`, the least number of samples of a piece.

    **Raises:** `CaromError` for a recording that is too short to cut.
    """
    n, longest = recording.n_trajectories, int(recording.length.max())
    if n >= least:
        return recording, ""
    samples = max(int(recording.length.sum()) // PIECES, shortest)
    found = int(np.sum(recording.length // samples))
    require(
        found >= least,
        f"data must hold at least {least} trajectories to learn from and to be tested with; it held {n} of up to "
        f"{longest} samples, which is too little to cut into pieces of {shortest}. Record more.",
    )
    # Pieces of one session must be divided here, for want of another.
    pieces = replace(recording.cut(samples), group=None)
    return pieces, (
        f"The data have {n} {'trajectory' if n == 1 else 'trajectories'} of up to {longest} samples: cut into {found} "
        f"pieces of {samples}. Several motions from different starts would tell more."
    )


def sessions_of(recording: Recording) -> Int[np.ndarray, " N"]:
    """Each trajectory's session (`group`); each is one of its own where that was not recorded."""
    return np.arange(recording.n_trajectories) if recording.group is None else recording.group


def hold_out(recording: Recording, share: float, rng: np.random.Generator) -> Bool[np.ndarray, " N"]:
    """Which trajectories to hold out: all of a `share` of the sessions, of at least one and never of all.

    Trajectories of one session are alike, so that none may be learned from where another is held out.
    """
    each = sessions_of(recording)
    order = rng.permutation(np.unique(each))
    return np.isin(each, order[: min(max(1, round(share * len(order))), len(order) - 1)])


def contact_flags(recording: Recording, system: System) -> Bool[np.ndarray, "N T"]:
    """The recorded contact flags; where there are none, the states in which a gap of `system` is closed."""
    if recording.contact is not None:
        return recording.contact
    return closed_contacts(recording.x, system) > 0


def closed_contacts(x: Float[np.ndarray, "N T n d"], system: System) -> Int[np.ndarray, "N T"]:
    """How many contacts of `system` are closed in each recorded state."""
    if not system.contacts:
        return np.zeros(x.shape[:2], int)
    return np.stack([(gaps < 0).sum(axis=-1) for gaps in all_gaps(x, system)])


def all_gaps(x: Float[np.ndarray, "N T n d"], system: System) -> Iterator[Float[np.ndarray, "T C"]]:
    """Gaps of all contacts, by trajectory."""
    return (np.asarray(_gaps(system, jnp.asarray(one))) for one in x)


@eqx.filter_jit
def _gaps(system: System, x):
    return system.gaps(x)


def closing(recording: Recording, system: System) -> Int[np.ndarray, " P"]:
    """How many recorded steps close a contact of each contact property that was open before."""
    out = np.zeros(system.n_properties, int)
    if not system.contacts:
        return out
    index = np.array([p for contact in system.contacts for p in contact.property_index])
    for gaps, length in zip(all_gaps(recording.x, system), recording.length, strict=True):
        closed = gaps[:length] < 0
        np.add.at(out, index, (closed[1:] & ~closed[:-1]).sum(axis=0))
    return out


def properties_closed(x: Float[np.ndarray, "S n d"], system: System) -> Bool[np.ndarray, "S P"]:
    """Of which contact properties a contact is closed, by state."""
    out = np.zeros((len(x), system.n_properties), bool)
    if system.contacts and len(x):
        index = np.array([p for contact in system.contacts for p in contact.property_index])
        states, contacts = np.nonzero(np.asarray(_gaps(system, jnp.asarray(x))) < 0)
        out[states, index[contacts]] = True
    return out


def recording_of(trajectory: Trajectory, *, task: str = "", source: str = "") -> Recording:
    """Simulated trajectories, or a single one, as a recording, to learn from or to write to a file."""
    x, v = (part.reshape(-1, *part.shape[-3:]) for part in (trajectory.x, trajectory.v))
    contact = trajectory.contact.reshape(-1, trajectory.contact.shape[-1])
    return Recording.of(x, v, time=trajectory.time, contact=contact, task=task, source=source)


def trajectory_of(recording: Recording, k: int) -> Trajectory:
    """Trajectory number `k` of a recording, up to its own length."""
    count = int(recording.length[k])
    contact = np.zeros(count, bool) if recording.contact is None else recording.contact[k, :count]
    return Trajectory(
        x=jnp.asarray(recording.x[k, :count]),
        v=jnp.asarray(recording.v[k, :count]),
        contact=jnp.asarray(contact),
        time=jnp.asarray(recording.time[:count]),
        overflow=jnp.zeros(count, int),
        residual=jnp.zeros(count),
    )
