"""Sweeps: what is varied, the trials, what is kept when they are stopped. Trainings are stood in for by a program."""

import csv
import sys
import time

import numpy as np
import pytest
from PIL import Image
from systems import refused

import carom
from carom.cli import sweep
from carom.cli.main import main
from carom.cli.search_space import Choices, Range, grid, parse_space, words_of
from carom.cli.sweep import Sweep
from carom.learning.config import LearnConfig
from carom.view.sweeps import draw_sweep

optuna = pytest.importorskip("optuna")

SYSTEM = """
import carom

system = carom.System(
    bodies=[carom.PointMass(mass=1.0, radius=0.1)],
    contacts=[carom.DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))],
)
"""
TRAINING = """
# Stands in for `carom learn`: its error is smallest for width 20, and width 13 fails.
import json, pathlib, sys
words = sys.argv[1:]
given = dict(zip(words[1::2], words[2::2]))
width = int(given.get("--width", 256))
if width == 13:
    sys.exit("carom: width must not be 13.")
out = pathlib.Path(given["--out"])
out.mkdir(exist_ok=True)
(out / "config.json").write_text("{}")
(out / "words.json").write_text(json.dumps(words))
(out / "report.json").write_text(json.dumps({"evaluation": {"bounded_error": abs(width - 20) / 100}}))
"""


def test_what_is_varied():
    space = parse_space(["width=64,128", "learning-rate=1e-4:1e-2:log", "depth=1:4", "contact_model=cm,None"])
    assert space == {
        "width": Choices((64, 128)),
        "learning_rate": Range(1e-4, 1e-2, True),
        "depth": Range(1, 4, False),
        "contact_model": Choices(("cm", None)),
    }
    assert isinstance(space["depth"].distribution(), optuna.distributions.IntDistribution)
    assert isinstance(space["learning_rate"].distribution(), optuna.distributions.FloatDistribution)
    assert space["contact_model"].distribution().choices == ("cm", None)
    assert parse_space(["refine=True,False"]) == {"refine": Choices((True, False))}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ([], "over must name what to vary"),
        (["width"], "of the form NAME=A,B,C"),
        (["size=3"], "over can vary model, epochs"),
        (["width=3", "width=4"], "names width twice"),
        (["width=3,3"], "names a value of width twice"),
        (["width=1.5,2"], "'1.5' is no value of width"),
        (["width=0,2"], "width must be at least 1"),
        (["refine=yes"], "refine must be True or False"),
        (["model=mlp,clnn"], "'mlp' is no value of model"),
        (["width=8:4"], "from the lower number to the higher"),
        (["enough=0:1:log"], "starts above 0"),
        (["width=8:4:linear"], "NAME=LOW:HIGH:log"),
        (["model=clnn:chnn"], "model is not a number"),
    ],
)
def test_what_cannot_be_varied_is_named(words, text):
    with refused(text):
        parse_space(words)


def test_a_grid_is_all_combinations():
    assert grid(parse_space(["width=8,16", "seed=0,1"])) == [
        {"width": width, "seed": seed} for width in (8, 16) for seed in (0, 1)
    ]
    with refused("method grid needs lists"):
        grid(parse_space(["width=8:16"]))


def test_words_say_what_differs_from_the_default():
    assert words_of(LearnConfig()) == []
    config = LearnConfig(width=8, refine=False, learn=("mass",), compensation_steps=None, epsilon="learn")
    words = " ".join(words_of(config))
    assert words == "--learn mass --no-refine --width 8 --epsilon learn --compensation-steps None"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a system, data for it, and a program that stands in for trainings."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    monkeypatch.setattr(sweep, "TRAIN", (sys.executable, "train.py"))
    monkeypatch.setattr(sweep, "PATIENCE", 0.02)
    (tmp_path / "train.py").write_text(TRAINING)
    (tmp_path / "mine.py").write_text(SYSTEM)
    x = np.random.default_rng(0).uniform(0.2, 1, (10, 5, 1, 2))
    carom.save_recording("motions.h5", carom.Recording.of(x, x, dt=0.01))
    return tmp_path


def command(*words):
    main(["sweep", "mine.py", "--data", "motions.h5", *words])


def width_of(picture):
    with Image.open(picture) as image:
        return image.size[0]


def trials_of(folder):
    with (folder / "trials.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_grid_by_two_workers(place, capsys):
    command("--over", "width=10,18,30", "seed=0,1", "--method", "grid", "--workers", "2", "--epochs", "3")
    folder = place / "sweeps" / "mine"
    rows = trials_of(folder)
    assert sorted((row["width"], row["seed"]) for row in rows) == sorted(
        (w, s) for w in ("10", "18", "30") for s in "01"
    )
    assert {float(row["bounded_error"]) for row in rows} == {0.1, 0.02}
    out = capsys.readouterr().out
    assert "6 trials, 0 of them finished" in out
    assert "The best of 6 trials" in out
    assert width_of(folder / "sweep.png") > 500
    words = (folder / "trial-0000" / "words.json").read_text()
    for part in ('"--epochs", "3"', "sweeps/mine/train.h5", '"--test", "sweeps/mine/val.h5"', "sweeps/mine/mine.py"):
        assert part in words
    counts = [carom.load_recording(folder / name).n_trajectories for name in ("train.h5", "val.h5", "test.h5")]
    assert counts == [8, 1, 1]
    # The same again: all is there already.
    command("--over", "width=10,18,30", "seed=0,1", "--method", "grid", "--workers", "2", "--epochs", "3")
    assert "6 trials, 6 of them finished" in capsys.readouterr().out
    assert len(trials_of(folder)) == 6


def test_what_was_stopped_goes_on_in_its_folder(place, capsys, monkeypatch):
    (place / "slow.py").write_text(TRAINING + "\nimport time\ntime.sleep(60)\n")
    monkeypatch.setattr(sweep, "TRAIN", (sys.executable, "slow.py"))
    started = place / "sweeps" / "mine" / "trial-0000" / "report.json"

    def interrupted(seconds):
        if started.exists():
            raise KeyboardInterrupt
        time.sleep(seconds)

    time_module = type("Time", (), {"sleep": staticmethod(interrupted), "monotonic": staticmethod(time.monotonic)})
    monkeypatch.setattr(sweep, "time", time_module)
    with pytest.raises(SystemExit) as stop:
        command("--over", "width=8:40", "--trials", "2")
    assert stop.value.code == 130
    assert "give the same command again" in capsys.readouterr().err
    monkeypatch.setattr(sweep, "time", time)
    monkeypatch.setattr(sweep, "TRAIN", (sys.executable, "train.py"))
    before = (started.parent / "words.json").read_text()
    command("--over", "width=8:40", "--trials", "2")
    rows = trials_of(place / "sweeps" / "mine")
    assert [row["trial"] for row in rows] == ["trial-0000", "trial-0002"]
    after = (started.parent / "words.json").read_text()
    assert after == before.removesuffix("]") + ', "--resume"]'


def test_trials_that_fail(place, capsys):
    command("--over", "width=13,20", "--method", "grid")
    out = capsys.readouterr().out
    assert "failed: width must not be 13." in out
    assert [row["width"] for row in trials_of(place / "sweeps" / "mine")] == ["20"]
    # The same again, now that what was wrong is put right: that training alone, in its folder.
    (place / "train.py").write_text(TRAINING.replace("width == 13", "width == 14"))
    command("--over", "width=13,20", "--method", "grid")
    assert "2 trials, 1 of them finished" in capsys.readouterr().out
    rows = [(row["width"], row["trial"]) for row in trials_of(place / "sweeps" / "mine")]
    assert sorted(rows) == [("13", "trial-0000"), ("20", "trial-0001")]


@pytest.mark.parametrize("method", ["tpe", "random"])
def test_more_trials_draw_other_options(place, method):
    """Values of a range, so that none comes twice by chance."""
    for trials in ("2", "4"):
        command("--over", "learning_rate=1e-4:1e-2:log", "--method", method, "--trials", trials)
    rows = trials_of(place / "sweeps" / "mine")
    assert len({row["learning_rate"] for row in rows}) == len(rows) == 4


def test_a_sweep_that_can_only_fail_ends(place, capsys):
    with pytest.raises(SystemExit) as stop:
        command("--over", "seed=0,1,2,3", "--width", "13", "--method", "grid")
    assert stop.value.code == 2
    assert "no trial can be finished. The last said: width must not be 13." in capsys.readouterr().err


def test_other_settings_and_other_sweeps_are_refused(place, capsys):
    command("--over", "width=20", "--method", "grid")
    for words, text in (
        (("--over", "width=20,21", "--method", "grid"), "was started with over = ['width=20'], not ['width=20', "),
        (("--over", "width=20", "--method", "grid", "--epochs", "3"), "was started with epochs = "),
        (("--over", "width=20", "--method", "grid", "--workers", "0"), "workers must be at least 1"),
    ):
        with pytest.raises(SystemExit):
            command(*words)
        error = capsys.readouterr().err
        assert text.split(", not")[0] in error
    with sweep._alone(place / "sweeps" / "mine"), refused("another `carom sweep`"):
        Sweep("mine.py", ("width=20",), method="grid", data=place / "motions.h5").run()
    (place / "sweeps" / "mine" / "sweep.db").write_bytes(b"no database")
    with pytest.raises(SystemExit):
        command("--over", "width=20", "--method", "grid")
    assert "Restore it, or choose another folder" in capsys.readouterr().err


def test_the_picture(tmp_path):
    options = {"width": [8, 16, 8], "model": ["clnn", "chnn", "clnn"], "learning_rate": [1e-4, 1e-3, 1e-2]}
    path = draw_sweep(
        options, [0.1, float("inf"), 0.01], tmp_path / "p.png", label="bounded_error", log={"learning_rate"}
    )
    assert width_of(path) > 1000
    with refused("values must hold a number"):
        draw_sweep({"width": []}, [], tmp_path / "p.png", label="error")
