"""Systems of the user's own on the command line, from a Python file; and runs that are started again from a folder."""

import json
import shutil
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from rich.console import Console
from test_cli import TINY, command, refused

import carom
from carom.cli.learn import Learn
from carom.cli.systems import choose

FILE = """
import carom

system = carom.System(
    bodies=[carom.PointMass(mass=1.0, radius=0.1)],
    contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
    potential=carom.Gravity((0.0, -9.81)),
    friction=0.3,
    restitution=0.7,
)
"""


@pytest.fixture(autouse=True)
def _apart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    (tmp_path / "mine.py").write_text(FILE)


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (None, "does not exist. `carom new other.py` writes one"),
        ("x = 1", "must set `system` to a carom.System outside of any function; it was missing"),
        ("system = 3", "it was int"),
        ("import carom\n\nsystem = carom.System(bodies=[])", "other.py, line 3: CaromError: bodies must hold"),
        ("a = (\n", "other.py, line 1: SyntaxError"),
        (f"{FILE}unknown = 'friction'", "must set `unknown` to a list of names of quantities; it was 'friction'"),
        ("import nothing_of_that_name", "ModuleNotFoundError: No module named 'nothing_of_that_name'"),
    ],
)
def test_files_without_a_system_are_refused(tmp_path, content, text):
    if content is not None:
        (tmp_path / "other.py").write_text(content)
    with pytest.raises(carom.CaromError) as error:
        choose("other.py")
    assert text in str(error.value)
    assert str(tmp_path) not in sys.path


def test_modules_beside_the_file_can_be_imported(tmp_path):
    (tmp_path / "parts_beside.py").write_text(FILE)
    (tmp_path / "other.py").write_text("from parts_beside import system")
    assert choose("other.py").system.n_points == 1


def test_a_file_says_what_is_unknown(tmp_path):
    (tmp_path / "other.py").write_text(f"{FILE}unknown = ['friction', 'radius:0']")
    assert choose("other.py").unknown == ("friction", "radius:0")
    assert choose("mine.py").unknown == ()


def test_the_template_makes_a_system_and_no_more(tmp_path):
    command("new", "two.py")
    chosen = choose("two.py")
    assert chosen.system.n_points == 2
    assert chosen.own
    assert chosen.truth is None
    assert {path.name for path in tmp_path.iterdir()} == {"mine.py", "two.py"}


def recorded(path, count=8):
    rng = np.random.default_rng(0)
    system = choose("mine.py").system
    x0 = np.stack([rng.uniform(-1, 1, count), rng.uniform(0.3, 0.8, count)], axis=1)[:, None]
    v0 = rng.normal(0, 1, (count, 1, 2))
    motion = carom.simulate(system, jax.numpy.asarray(x0), jax.numpy.asarray(v0), dt=0.02, steps=20)
    carom.save_recording(path, carom.recording_of(motion))


def test_what_an_own_system_needs(capsys):
    assert "data is needed for mine.py: give a trajectory file to learn from, --data FILE" in refused(
        capsys, "learn", "mine.py"
    )
    assert "to start from its first states, --initial FILE" in refused(capsys, "simulate", "mine.py")


def falling(task="", count=1, states=200):
    """A file of a ball that falls past the floor's edge."""
    time = 0.01 * np.arange(states)
    x = np.stack([0.3 * time, 9 + time - 4.905 * time**2], axis=1)[None, :, None] + np.zeros((count, 1, 1, 1))
    v = np.stack([0.3 + 0 * time, 1 - 9.81 * time], axis=1)[None, :, None] + np.zeros((count, 1, 1, 1))
    carom.save_recording("falling.h5", carom.Recording.of(x, v, dt=0.01, task=task))


def test_one_recording_is_cut_with_a_word(capsys):
    falling()
    learn = Learn("mine.py", data=Path("falling.h5"))
    dataset, test = learn.data_sets(choose("mine.py"), Console())
    assert (dataset.train.n_trajectories, dataset.val.n_trajectories, test.n_trajectories) == (8, 1, 1)
    assert "cut into 10 pieces of 20" in " ".join(capsys.readouterr().out.split())
    falling(states=12)
    with pytest.raises(carom.CaromError, match="too little to cut into pieces of 5"):
        learn.data_sets(choose("mine.py"), Console())


def test_check_goes_on_with_a_task_that_carom_does_not_have(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    falling(task="my-lab")
    command("check", "falling.h5")
    out = " ".join(capsys.readouterr().out.split())
    assert "is of 'my-lab', which is no task of carom's. Give --task NAME, or --task FILE.py" in out
    assert "recording.cut(samples)" in out
    command("check", "falling.h5", "--task", "mine.py", "--no-tell")
    out = " ".join(capsys.readouterr().out.split())
    assert "impacts of property 0" in out
    assert "What can be learned" not in out
    command("check", "falling.h5", "--task", "mine.py", "--no-tell", "--quantities")
    rows = [line.split("│")[1:-1] for line in capsys.readouterr().out.splitlines() if line.count("│") == 5]
    assert ["restitution:0", "0-wall", "0.7", ""] in [[cell.strip() for cell in row] for row in rows]
    command("check", "falling.h5", "--task", "bounce-once", "--no-tell")
    assert "says that it is of 'my-lab'; it is taken as of 'bounce-once'" in " ".join(capsys.readouterr().out.split())
    assert "is no task of carom's. Give --task NAME" in refused(capsys, "view", "falling.h5")
    assert "task must be one of" in refused(capsys, "check", "falling.h5", "--task", "nope")


@pytest.mark.slow
@pytest.mark.ci_budget
def test_learn_evaluate_simulate_view_and_learn_again(tmp_path, capsys):
    recorded("motions.h5")
    command("learn", "mine.py", "--data", "motions.h5", *TINY[2:])
    out = capsys.readouterr().out
    assert "Learned, and as mine.py has them" in out
    folder = tmp_path / "runs" / "mine-clnn"
    assert (folder / "system.py").read_text() == FILE
    report = json.loads((folder / "report.json").read_text())
    assert abs(report["learned"]["restitution"][0] - 0.7) < 0.1  # it began at .5, and has six short trajectories
    assert "friction_error" not in report["evaluation"]  # nobody says that the file's friction is true
    (tmp_path / "mine.py").unlink()  # the run has its own
    command("evaluate", "runs/mine-clnn")
    command("view", "runs/mine-clnn", "--save", "page.html")
    assert (tmp_path / "page.html").stat().st_size > 1000
    (tmp_path / "mine.py").write_text(FILE)
    command("simulate", "mine.py", "--initial", "motions.h5", "--run-folder", "runs/mine-clnn", "--out", "more.h5")
    more, first = carom.load_recording("more.h5"), carom.load_recording("motions.h5")
    assert more.x.shape == first.x.shape
    np.testing.assert_array_equal(more.x[:, 0], first.x[:, 0])
    (tmp_path / "mine.py").unlink()
    capsys.readouterr()
    again = Learn.defaults(["--from", str(folder), "--seed", "5"])
    assert again is not None
    chosen, before = again._chosen(), json.loads((folder / "config.json").read_text())
    assert chosen.name == "mine.py"
    now = json.loads(json.dumps(again._description(chosen)))
    assert {**now, "started": before["started"]} == before
    with (tmp_path / "motions.h5").open("ab") as file:
        file.write(b"more")
    assert "data_sha256" in refused(capsys, "learn", "--from", str(folder), "--out", str(folder), "--resume")


def test_runs_that_cannot_be_started_again(tmp_path, capsys):
    assert "nowhere is not a run folder" in refused(capsys, "learn", "--from", "nowhere")
    assert "nothing came after it" in refused(capsys, "learn", "--from")
    shutil.copytree(tmp_path, tmp_path / "old", ignore=lambda *_: ["old"])
    (tmp_path / "old" / "config.json").write_text('{"task": "cp3"}')
    assert "was not started by this version's `carom learn`" in refused(capsys, "learn", "--from", "old")
