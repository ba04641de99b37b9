"""`carom view RUN_OR_FILE`: a system in motion in the browser, or as a page, GIF or MP4."""

import dataclasses
import http.server
import tempfile
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax.numpy as jnp
import numpy as np
import tyro
from rich.console import Console

from carom.atomic import check_writable
from carom.checks import require
from carom.cli.outcome import TEST_DATA, one_of
from carom.cli.systems import Chosen, chosen_by, data_and_system
from carom.cli.tosses import LearnedToss
from carom.errors import CaromError
from carom.learning.dataset import trajectory_of
from carom.learning.estimation.protocols import body_points
from carom.learning.estimation.tosses import COMPENSATION, toss_motions
from carom.learning.evaluate import predict
from carom.learning.model_file import load_model_into, read_model_header
from carom.learning.run import CONFIG, MODEL, RunFolder
from carom.recordings.files import load_recording
from carom.recordings.recording import Recording, check_system
from carom.simulation.impact import COMPENSATION_STEPS
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.view.extras import check_movies

HOST = "127.0.0.1"
"""Nobody else's computer can look."""
KINDS = (".html", ".gif", ".mp4")


@dataclasses.dataclass(frozen=True)
class View:
    """Show a run's predictions against the truth, or a trajectory file, moving, in the browser.

    Bodies, links, walls, impulses with their friction cones, energy, the smallest gap: play, pause, scrub. A system in
    3D is turned with the mouse. Space plays and pauses, the arrow keys go on by a sample. No network is needed.
    """

    run_or_file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN_OR_FILE")]
    """Run folder of `carom learn`, or a trajectory file (.h5, .hdf5, .npz or .csv)."""
    save: Path | None = None
    """Write a page (.html: one file that works offline), .gif or .mp4 instead of opening the browser."""
    trajectories: int = 4
    """How many trajectories to choose from, those with the most contact first (a .gif or .mp4 has one)."""
    task: str = ""
    """Name of the task, or a Python file with a `system`, for a trajectory file that does not say."""
    port: int = 0
    """Port to serve the page on; 0: any that is free."""
    no_open: bool = False
    """Only say the address."""

    def after_interrupt(self) -> str:
        """What to say when interrupted."""
        return "Nothing was changed."

    def run(self) -> None:
        """Do it."""
        require(self.trajectories >= 1, f"--trajectories must be at least 1; it was {self.trajectories}.")
        require(0 <= self.port < 65536, f"--port must be from 0 to 65535; it was {self.port}.")
        if self.save is not None:
            suffix = self.save.suffix.lower()
            require(suffix in KINDS, f"--save must end in {', '.join(KINDS)}; it was {str(self.save)!r}.")
            check_writable(self.save)
            if suffix == ".mp4":
                check_movies("--save")
        require(
            self.run_or_file.exists(),
            f"there is no run folder or trajectory file {str(self.run_or_file)!r}: check its name.",
        )
        console = Console()
        shown = self._run_folder() if self.run_or_file.is_dir() else self._file(console)
        if self.save is None:
            with tempfile.TemporaryDirectory() as folder:
                self._serve(shown.page(Path(folder) / "page.html").read_bytes(), console)
            return
        if self.save.suffix.lower() == ".html":
            shown.page(self.save)
        else:
            from carom.view.animate import animate

            true, predicted = shown.pairs[0]
            animate(shown.system, true, predicted, self.save)
        console.print(f"Written to {self.save}", soft_wrap=True, highlight=False)

    def _run_folder(self) -> "_Shown":
        run = RunFolder.open(self.run_or_file)
        chosen, config = chosen_by(run), run.read_json(CONFIG)
        if config.get("tosses") is not None:
            return self._tosses(run, chosen, config["task"])
        header = read_model_header(run.path / MODEL)
        system = load_model_into(run.path / MODEL, chosen.system)
        test = self._some(load_recording(run.path / TEST_DATA, task=chosen.task))
        compensation = header["compensation_steps"]
        found = predict(
            system,
            test,
            formulation=header["formulation"],
            compensation_steps=compensation,
            impact=header["impact"],
        )
        pairs = [
            (true, one_of(found, k, len(true.time)))
            for k, true in enumerate(trajectory_of(test, k) for k in range(test.n_trajectories))
        ]
        return _Shown(system, pairs, f"{config['task']}: true and predicted", compensation)

    def _tosses(self, run: RunFolder, chosen: Chosen, name: str) -> "_Shown":
        """Predictions as they were measured, of the body's own points: recordings are of the middle of its box."""
        learned = LearnedToss.of_run(run.path)
        test = self._some(load_recording(run.path / TEST_DATA, task=chosen.task))
        found = toss_motions(learned.system, test, substeps=learned.substeps)
        pairs = []
        for k, recorded in enumerate(trajectory_of(test, k) for k in range(test.n_trajectories)):
            x, v = (body_points(learned.system, part) for part in (recorded.x, recorded.v))
            true = dataclasses.replace(recorded, x=x, v=v)
            pairs.append((true, one_of(found, k, len(true.time))))
        return _Shown(learned.system.with_max_active(4), pairs, f"{name}: true and predicted", COMPENSATION)

    def _file(self, console: Console) -> "_Shown":
        recording, chosen, word = data_and_system(self.run_or_file, self.task)
        if chosen is None:
            raise CaromError(word)
        if word:
            console.print(word, soft_wrap=True, highlight=False)
        system, name = chosen.system, chosen.name
        check_system(recording, system, str(self.run_or_file))
        recording = self._some(recording)
        pairs = [(None, trajectory_of(recording, k)) for k in range(recording.n_trajectories)]
        return _Shown(system, pairs, name, COMPENSATION_STEPS)

    def _some(self, recording: Recording) -> Recording:
        """The trajectories to show, those with the most contact first."""
        if recording.contact is None:
            return recording.select(slice(self.trajectories))
        order = np.argsort(-(recording.contact & recording.valid).sum(axis=1), kind="stable")
        return recording.select(order[: self.trajectories])

    def _serve(self, page: bytes, console: Console) -> None:
        try:
            server = http.server.ThreadingHTTPServer((HOST, self.port), _handler(page))
        except OSError as error:
            require(False, f"--port {self.port} cannot be used ({error.strerror}): give another, or 0 for any.")
            raise
        with server:
            address = f"http://{HOST}:{server.server_address[1]}/"
            console.print(f"{address} shows {self.run_or_file}. Ctrl-C ends.", soft_wrap=True, highlight=False)
            if not self.no_open:
                webbrowser.open(address)
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                console.print("Ended.")


def _handler(page: bytes) -> type[http.server.BaseHTTPRequestHandler]:
    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            there = self.path.split("?")[0] in ("/", "/index.html")
            body = page if there else b"not here"
            self.send_response(200 if there else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8" if there else "text/plain")
            self.send_header("Content-Length", str(len(body)))
            self.send_header(
                "Content-Security-Policy",
                "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:",
            )
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format, *args):
            pass

    return Page


@dataclasses.dataclass(frozen=True)
class _Shown:
    """Pairs of a true and a predicted trajectory; without truth, of a trajectory alone."""

    system: System
    pairs: Sequence[tuple[Trajectory | None, Trajectory]]
    title: str
    compensation_steps: float | None

    def page(self, path: Path) -> Path:
        """Write the page of all of them."""
        from carom.view.motion import motion_of
        from carom.view.web_page import save_page

        names = ("true", "predicted") if self.pairs[0][0] is not None else ("recorded",)
        groups = []
        for number, pair in enumerate(self.pairs, 1):
            motions = []
            for one in pair:
                if one is not None:
                    finite = one if jnp.isfinite(one.x).all() else _until_lost(one)
                    motions.append(motion_of(self.system, finite, compensation_steps=self.compensation_steps))
            groups.append((f"{number}", motions))
        return save_page(self.system, groups, path, names=names, title=self.title)


def _until_lost(trajectory: Trajectory) -> Trajectory:
    """The part of a prediction before it is no longer finite."""
    good = jnp.isfinite(trajectory.x).all(axis=(1, 2))
    count = max(int(jnp.argmin(good)), 2)
    return dataclasses.replace(
        trajectory, **{f.name: getattr(trajectory, f.name)[:count] for f in dataclasses.fields(trajectory)}
    )
