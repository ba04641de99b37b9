"""`carom import`: recordings of points or poses as a trajectory file, and the public recordings as poses."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import equinox as eqx
import tyro
from rich.console import Console

from carom.atomic import check_writable
from carom.checks import require
from carom.cli.arguments import FilePath

if TYPE_CHECKING:
    from carom.recordings.pose_conventions import Reading
    from carom.recordings.poses import PoseRecording
    from carom.recordings.recording_checks import Finding

Kind = Annotated[
    Literal["points", "poses", "contactnets"],
    tyro.conf.Positional,
    tyro.conf.arg(metavar="points|poses|contactnets"),
]
Sources = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@dataclasses.dataclass(frozen=True)
class Import:
    """Turn recorded points, or poses of a body (positions and quaternions), into a carom trajectory file.

    `carom import points FILE...` reads CSV, NPZ and HDF5 files, several at once, with or without velocities, with
    samples missing and times of any kind, and keeps all that as it was recorded (docs/data.md).
    `carom import poses FILE` is for a tossed body; it says what looks wrong: scale, gravity, penetration, bias, copies,
    late velocities (docs/real-data.md), and estimates velocities, but for --positions-only.
    `carom import contactnets FILE.tar.gz` turns the public recordings of a tossed cube into a pose file; the archive is
    downloaded if it is not there.
    """

    kind: Kind
    """What the file holds."""
    files: Sources
    """Files of points, pose file, or archive."""
    size: float | None = None
    """Nominal width of the body in m; needed to check poses."""
    mass: float | None = None
    """Mass in kg, noted in the file; motion under gravity and contact does not depend on it."""
    out: FilePath = None
    """File to write (.h5, .hdf5 or .npz); by default FILE-trajectories.h5, or cube_tosses.npz for contactnets."""
    positions_only: bool = False
    """Keep no velocities, and estimate none; times and samples that are missing stay as they are."""
    sha256: str | None = None
    """Checksum that the archive must have."""
    scale: float = 1.0
    """Multiplies all recorded lengths."""
    quaternion_order: Literal["wxyz", "xyzw"] | None = None
    """Order in which the file has the numbers of a quaternion; wxyz unless it is given, if the motion fits that."""
    quaternion_direction: Literal["body-to-world", "world-to-body"] | None = None
    """Whose axes quaternions turn into whose; body-to-world unless it is given, if the motion fits that."""
    estimate_velocities: bool = False
    """Estimate velocities from poses even if the file has some."""
    keep_copies: bool = False
    """Keep trajectories that the file says are copies of others."""
    task: str | None = None
    """Task that the trajectories are of; cube for poses unless it is given."""

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "Nothing was written."

    def run(self) -> None:
        """Do it."""
        require(len(self.files) > 0, "FILE must be named: what is to be imported.")
        require(
            self.kind == "points" or len(self.files) == 1,
            f"{self.kind} must be one FILE; there were {len(self.files)}.",
        )
        require(self.scale > 0, f"--scale must be positive; it was {self.scale}.")
        if self.kind == "contactnets":
            self._convert()
        elif self.kind == "points" or self.positions_only:
            self._keep()
        else:
            self._import()

    @property
    def file(self) -> Path:
        """The first file, or the only one."""
        return self.files[0]

    def _keep(self) -> None:
        """Write what was seen as it was recorded."""
        from carom.recordings.observations import load_observations, save_observations

        out = self.out or self.file.with_name(f"{self.file.stem}-trajectories.h5")
        check_writable(out)
        found = load_observations(self.files)
        require(
            self.kind == "points" or found.n_points == 4,
            f"{self.file}: it holds points, not poses: carom import points.",
        )
        v = None if self.positions_only or found.v is None else found.v * self.scale
        found = found._replace(x=found.x * self.scale, v=v)
        task = self.task or ("cube" if self.kind == "poses" else "")
        save_observations(out, found, task=task, source=", ".join(file.name for file in self.files))
        lost = 1 - found.seen.sum() / (found.valid.sum() * found.n_points)
        Console().print(
            f"{found.n_trajectories} trajectories of up to {found.length.max()} samples, {found.n_points} points in "
            f"{found.dim}D, {'no' if v is None else 'with'} velocities, {lost:.1%} not seen\nWritten to {out}",
            highlight=False,
            soft_wrap=True,
        )

    def _convert(self) -> None:
        from carom.recordings import contactnets

        out, console = self.out or Path("cube_tosses.npz"), Console()
        require(out.suffix == ".npz", f"--out must end in .npz; it was {out}.")
        check_writable(out)
        if not self.file.exists():
            console.print(f"Fetching {contactnets.URL} ...", highlight=False, soft_wrap=True)
            contactnets.download(self.file)
        found = contactnets.convert(self.file, out, sha256=self.sha256)
        console.print(
            f"{found['tosses']} tosses ({found['copies']} copies) in {found['sessions']} sessions, {found['samples']} "
            f"samples; SHA-256 of the archive: {found['sha256']}\nWritten to {out}",
            highlight=False,
            soft_wrap=True,
        )

    def _import(self) -> None:
        from carom.cli.tables import findings_table
        from carom.recordings.files import save_recording
        from carom.recordings.pose_checks import LATE, check_poses, flight_noise
        from carom.recordings.pose_conventions import Reading
        from carom.recordings.poses import at_samples, load_poses, velocity_lag, with_velocities

        width = self.size
        require(
            width is not None and width > 0,
            f"--size must be the body's width, a positive length in m; it was {width}. Give --size 0.1 for 10 cm.",
        )
        assert width is not None
        require(self.mass is None or self.mass > 0, f"--mass must be positive, in kg; it was {self.mass}.")
        out = self.out or self.file.with_name(f"{self.file.stem}-trajectories.h5")
        check_writable(out)
        poses, copies = load_poses(self.file, keep_copies=self.keep_copies)
        poses = eqx.tree_at(lambda p: p.position, poses, poses.position * self.scale)
        if poses.velocity is not None:
            poses = eqx.tree_at(lambda p: p.velocity, poses, poses.velocity * self.scale)
        reading = Reading(self.quaternion_order or "wxyz", self.quaternion_direction or "body-to-world")
        poses = eqx.tree_at(lambda p: p.quaternion, poses, reading.read(poses.quaternion))
        findings = [self._check_reading(poses, width, reading), *check_poses(poses, width)]
        if self.estimate_velocities or poses.velocity is None or poses.omega is None:
            poses = with_velocities(poses)
        elif abs(lag := velocity_lag(poses) / poses.dt) > LATE:
            # Differences of the past are half a sample old; what is measured is that, with noise.
            poses = at_samples(poses, 0.5 * poses.dt * round(2 * lag))
        about = f"{self.file.name}, width {width} m" + (f", mass {self.mass} kg" if self.mass else "")
        save_recording(out, poses.to_recording(task=self.task or "cube", source=about))
        console = Console()
        table = findings_table(f"{self.file.name}: {len(poses.length)} trajectories at {1 / poses.dt:.0f} Hz", findings)
        table.add_row("noise of heights in flight", f"{flight_noise(poses) * 1e3:.3f} mm", "")
        console.print(table)
        if copies:
            console.print(f"{copies} trajectories that are copies of others were left out.", highlight=False)
        console.print(f"Written to {out}", soft_wrap=True, highlight=False)

    def _check_reading(self, poses: "PoseRecording", width: float, reading: "Reading") -> "Finding":
        """What the motion tells of how quaternions are written; `CaromError` if in another way than is assumed."""
        from carom.recordings.pose_conventions import check_convention, options

        found = check_convention(poses, width, reading)
        given = (self.quaternion_order, self.quaternion_direction)
        likely = [r for r in found.possible if all(part in (None, own) for part, own in zip(given, r, strict=True))]
        ways = ", or ".join(f"{options(reading, r)}{' (likelier)' if r != likely[-1] else ''}" for r in likely)
        require(
            not found.wrong or not likely,
            f"{self.file}: quaternion does not seem to be {reading}: {found.wrong}. Give {ways}. (With both options "
            "they are taken as given.)",
        )
        return found.finding
