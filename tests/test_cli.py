"""The command line as a user types it: results, files, and one clear line for what is wrong."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import jax
import jaxtyping
import numpy as np
import pytest
from PIL import Image

import carom
from carom.cli.main import COMMANDS, main
from carom.learning.run import RunFolder

TINY = [
    *("--trajectories", "16", "--epochs", "2", "--chunks-per-epoch", "16", "--batch-size", "8"),
    *("--chunk-length", "3", "--width", "8", "--depth", "1", "--checkpoint-every", "1"),
]


@pytest.fixture(autouse=True)
def _apart(tmp_path, monkeypatch):
    """Each test in a folder of its own, without the user's cache; JAX's settings are put back afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    cache = jax.config.jax_compilation_cache_dir
    yield
    jax.config.update("jax_compilation_cache_dir", cache)


def command(*arguments):
    main([str(a) for a in arguments])


def refused(capsys, *arguments) -> str:
    """Run a command that must fail: exit code 2 and one line, which is returned."""
    jaxtyping.config.update("jaxtyping_disable", True)  # the run-time checks would speak first
    try:
        with pytest.raises(SystemExit) as stop:
            command(*arguments)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)
    assert stop.value.code == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("carom: ")
    return lines[0]


EPOCHS = 40


@dataclasses.dataclass(frozen=True)
class Killed:
    """A tiny training on the command line that was killed, and went on."""

    folder: Path
    start: list[str]
    environment: dict[str, str]

    def again(self, *options: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*self.start, "--resume", *options], env=self.environment, capture_output=True, text=True, check=False
        )


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("learned") / "run"
    options = [*TINY, "--out", str(folder), "--no-refine"]  # to the last epoch
    options[options.index("--epochs") + 1] = str(EPOCHS)
    start = [sys.executable, "-m", "carom.cli.main", "learn", "throw", *options]
    environment = {
        **os.environ,
        "CAROM_CACHE": "",
        "JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir or str(folder.with_name("cache")),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.5",
        "PYTHONPATH": str(Path(carom.__file__).parents[1]),
    }
    process = subprocess.Popen(start, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 240
    while len(RunFolder(folder).metrics()) < 5:
        assert process.poll() is None, "the training ended by itself"
        assert time.monotonic() < deadline, "no five epochs within four minutes"
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert RunFolder(folder).metrics()[-1]["epoch"] < EPOCHS
    run = Killed(folder, start, environment)
    resumed = run.again()
    assert resumed.returncode == 0, resumed.stderr
    return run


@pytest.mark.slow
@pytest.mark.timeout(500)
def test_a_killed_training_goes_on_where_it_was(killed):
    assert [m["epoch"] for m in RunFolder(killed.folder).metrics()] == list(range(1, EPOCHS + 1))
    other = killed.again("--seed", "5")
    assert other.returncode == 2
    assert "was started with seed = 0" in other.stderr


@pytest.mark.slow
@pytest.mark.ci_budget
def test_learn_writes_a_whole_run_folder(killed):
    learned = killed.folder
    names = {p.name for p in learned.iterdir()}
    assert names == {
        "config.json",
        "truth.json",
        "metrics.jsonl",
        "checkpoints",
        "model.carom",
        "report.json",
        "test.h5",
        "learning_curves.png",
        "contact_properties.png",
        "trajectory_error.png",
        "estimates.png",
        "prediction.gif",
    }
    config = json.loads((learned / "config.json").read_text())
    assert (config["task"], config["epochs"], config["model"]) == ("throw", EPOCHS, "clnn")
    report = json.loads((learned / "report.json").read_text())
    assert set(report) == {"estimates", "fit", "learned", "evaluation", "identification"}
    assert report["fit"]["impact_rule"] == "step"
    shown = {one["name"]: one for one in report["estimates"]}
    told = report["identification"]
    assert set(shown) == {f"{kind}:{k}" for kind in ("friction", "restitution") for k in range(len(told[kind]))}
    assert shown["friction:0"]["value"] == told["friction"][0]["value"]
    with Image.open(learned / "prediction.gif") as animation:
        assert animation.n_frames > 20
    assert carom.load_model(learned / "model.carom").friction.tolist() == report["learned"]["friction"]


@pytest.mark.slow
@pytest.mark.ci_budget
def test_evaluate_and_simulate_use_the_learned_model(killed, capsys):
    learned = killed.folder
    command("evaluate", learned)
    assert "trajectory relative error" in capsys.readouterr().out
    measures = json.loads((learned / "evaluation.json").read_text())
    assert measures["trajectories"] == 2
    command("simulate", "throw", "--run-folder", learned, "--trajectories", 2, "--steps", 5, "--out", "own.npz")
    own = carom.load_recording("own.npz", task="throw")
    assert own.x.shape == (2, 6, 3, 2)
    assert "model.carom" in own.source


def test_simulate_writes_a_trajectory_file(capsys):
    command("simulate", "bp5-e", "--trajectories", 3, "--steps", 7, "--seed", 4)
    out = carom.load_recording("bp5-e.h5", task="bp5-e")
    assert out.x.shape == (3, 8, 5, 2)
    assert out.dt == pytest.approx(0.01)
    with h5py.File("bp5-e.h5") as file:
        assert {"dt", "units", "task", "source", "carom_version"} <= set(file.attrs)
    command("simulate", "bp5-e", "--steps", 7, "--initial", "bp5-e.h5", "--out", "again.h5")
    assert np.array_equal(carom.load_recording("again.h5").x, out.x)
    assert "Wrote 3 trajectories of 8 states" in capsys.readouterr().out


@pytest.mark.slow
def test_simulate_with_another_contact_model(capsys):
    options = ("--trajectories", 40, "--steps", 30)
    command("simulate", "throw", *options, "--contact-model", "lcp", "--compensation-steps", "None", "--out", "lcp.h5")
    command("simulate", "throw", *options, "--out", "cm.h5")
    lcp, cm = (carom.load_recording(f"{name}.h5") for name in ("lcp", "cm"))
    assert "contact model lcp" in lcp.source
    assert np.array_equal(lcp.x[:, 0], cm.x[:, 0])
    assert np.abs(lcp.v - cm.v).max() > 1e-3


@pytest.mark.slow
@pytest.mark.timeout(800)
def test_a_run_keeps_its_contact_model_and_compensation(capsys, tmp_path):
    chosen = ("--contact-model", "cmr", "--epsilon", "learn", "--compensation-steps", "None")
    command("learn", "cp3", "--out", "run", "--data-contact-model", "lcp", *chosen, *TINY)
    assert "epsilon" in capsys.readouterr().out
    run = RunFolder.open("run")
    config, report = run.read_json("config.json"), run.read_json("report.json")
    names = ("contact_model", "epsilon", "compensation_steps", "data_contact_model")
    assert [config[n] for n in names] == ["cmr", "learn", None, "lcp"]
    assert "contact model lcp" in carom.load_recording(tmp_path / "run" / "test.h5").source
    learned = carom.load_model(tmp_path / "run" / "model.carom").contact_model
    assert isinstance(learned, carom.CMr)
    assert float(learned.epsilon) == report["learned"]["epsilon"]
    assert float(learned.epsilon) in [row["epsilon"] for row in run.metrics()]  # of the best epoch
    command("evaluate", "run")
    again = run.read_json("evaluation.json")
    # The same predictions again: by the contact model and the compensation that were learned with.
    assert again["trajectory_error"] == report["evaluation"]["trajectory_error"]


def test_bad_arguments_are_one_clear_line(capsys, tmp_path):
    assert "Did you mean 'cp3'" in refused(capsys, "learn", "cp33")
    assert "trajectories must be at least 8" in refused(capsys, "learn", "cp3", "--trajectories", 3)
    assert "resume needs --out" in refused(capsys, "learn", "cp3", "--resume")
    assert "not a run folder" in refused(capsys, "evaluate", tmp_path)
    assert "missing.npz" in refused(capsys, "learn", "cp3", "--data", "missing.npz")
    assert "val needs --data" in refused(capsys, "learn", "cp3", "--val", "val.npz")
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "run"
    assert "cannot make the run folder" in refused(capsys, "learn", "cp3", "--out", out, "--trajectories", 8)
    assert "trajectories must be at least 1" in refused(capsys, "simulate", "cp3", "--trajectories", 0)
    assert "dt must be a positive" in refused(capsys, "simulate", "throw", "--dt", 0, "--trajectories", 1)
    assert "cannot be written" in refused(
        capsys, "simulate", "cp3", "--trajectories", 1, "--steps", 2, "--out", tmp_path / "no" / "x.h5"
    )
    assert not list(tmp_path.glob("**/x.h5"))


def test_bad_configurations_are_one_clear_line(capsys):
    assert "epochs must be at least 1" in refused(capsys, "learn", "cp3", "--epochs", 0)
    assert "initial_restitution" in refused(capsys, "learn", "cp3", "--initial-restitution", 2)
    for name in ("contact-model", "data-contact-model"):
        line = refused(capsys, "learn", "cp3", f"--{name}", "soft")
        assert line.startswith(f"carom: {name.replace('-', '_')} must be one of 'cm', 'cmr', 'lcp'")
    assert "contact_model must be one of" in refused(capsys, "simulate", "cp3", "--contact-model", "soft")
    assert "epsilon belongs to the contact model cmr" in refused(capsys, "learn", "cp3", "--epsilon", 0.1)
    for name in ("learn", "simulate"):
        assert "compensation_steps must be a positive" in refused(capsys, name, "cp3", "--compensation-steps", 0)


@pytest.mark.parametrize("fault", ["nan", "steps", "task", "points", "wall"])
def test_bad_recordings_are_one_clear_line(capsys, tmp_path, fault):
    x = np.zeros((12, 9, 3, 2))
    x[:, :, :, 1] = [-0.35, -0.75, -1.1] if fault == "wall" else [-0.35, -0.75, -0.8]
    content = {"x": x, "v": np.zeros_like(x), "time": 0.01 * np.arange(9.0)}
    if fault == "nan":
        content["x"][3, 4, 1, 0] = np.nan
    elif fault == "steps":
        content["time"][5] += 0.004
    elif fault == "task":
        content["task"] = np.array("bp5")
    elif fault == "points":
        content["x"], content["v"] = content["x"][:, :, :2], content["v"][:, :, :2]
    np.savez("bad.npz", **content)
    message = {
        "nan": "bad.npz: x",
        "steps": "bad.npz: time",
        "task": "another task",
        "points": "2 points in 2D",
        "wall": "body 2 in a wall",
    }
    assert message[fault] in refused(capsys, "learn", "cp3", "--data", "bad.npz", "--out", "run")
    assert not (tmp_path / "run" / "model.carom").exists()


def help_of(*arguments: str) -> str:
    """What a process of its own prints: help changes the classes that it is of."""
    program = "import sys; from carom.cli.main import main; main(sys.argv[1:])"
    environment = {**os.environ, "COLUMNS": "100", "PYTHONPATH": str(Path(carom.__file__).parents[1])}
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, env=environment, check=True
    )
    return done.stdout


def test_help_shows_every_default():
    text = help_of("learn", "--help-all")
    for option in ("--data", "--resume", "--quick", "--epochs", "--learning-rate", "--model", "--process-count"):
        assert option in text
    assert f"(default: {carom.LearnConfig.epochs})" in " ".join(text.split())


@pytest.mark.slow
@pytest.mark.ci_budget
def test_help_fits_a_screen():
    for name in COMMANDS:
        text = help_of(name, "--help")
        assert f"usage: carom {name}" in text
        assert len(text.splitlines()) <= 50, name
        assert name != "learn" or "--learning-rate" not in text


def test_help_of_the_whole_loads_neither_jax_nor_matplotlib():
    program = (
        "import sys; from carom.cli.main import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'jax', 'matplotlib', 'diffrax'} & set(sys.modules)))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(carom.__file__).parents[1])}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.splitlines()[-1] == "[]"
    for name in COMMANDS:
        assert f"• {name}" in done.stdout


def test_an_error_has_a_traceback_only_if_asked_for(capsys):
    assert "task must be one of" in refused(capsys, "learn", "cp4")
    with pytest.raises(SystemExit) as stop:
        command("--debug", "learn", "cp4")
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "Traceback" in said
    assert said.splitlines()[-1].startswith("carom: task must be one of")


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (PermissionError(13, "Permission denied", "runs/x"), 2, "runs/x: Permission denied"),
        (OSError(28, "No space left on device"), 2, "No space left on device"),
        (MemoryError(), 1, "out of memory"),
        (RuntimeError("first line\nsecond line"), 1, "RuntimeError: first line"),
    ],
)
def test_errors_that_nobody_wrote_a_text_for(capsys, monkeypatch, error, code, said):
    def fail(self):
        raise error

    monkeypatch.setattr("carom.cli.doctor.Doctor.run", fail)
    with pytest.raises(SystemExit) as stop:
        command("doctor")
    assert stop.value.code == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert said in lines[0]
    assert len(lines) <= 2
    assert ("--debug" in lines[-1]) == isinstance(error, RuntimeError)


def test_a_program_to_start_from(tmp_path, capsys):
    command("new", "mine.py")
    assert "Written to mine.py" in capsys.readouterr().out
    compile(Path("mine.py").read_text(), "mine.py", "exec")
    assert "mine.py is there already" in refused(capsys, "new", "mine.py")
    command("new", "mine.py", "--force")
    assert "file must end in .py" in refused(capsys, "new", "mine.txt")
    assert "does not exist" in refused(capsys, "new", "nowhere/mine.py")


@pytest.mark.slow
def test_the_program_to_start_from_runs(tmp_path):
    command("new", "mine.py")
    environment = {**os.environ, "PYTHONPATH": str(Path(carom.__file__).parents[1])}
    for words in ([], ["learn"]):
        program = [sys.executable, "mine.py", *words]
        done = subprocess.run(program, capture_output=True, text=True, check=True, env=environment)
    found = re.findall(r"restitution 1: (\S+) .* identified", done.stdout)
    assert float(found[0]) == pytest.approx(0.5, abs=1e-3)
    assert Path("motions.csv").exists()


def test_xla_logs_nothing_but_fatal_errors_unless_asked(monkeypatch):
    """JAX leaves 1, its own level, to commands that are started by a program which uses it."""
    monkeypatch.setenv("TF_CPP_MIN_LOG_LEVEL", "1")
    command("--debug", "new", "one.py")
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "1"
    command("new", "two.py")
    assert os.environ["TF_CPP_MIN_LOG_LEVEL"] == "3"


CACHED = """
import sys
from carom.cli.main import main

main(["new", *sys.argv[1:]])
import jax

jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
print(jax.jit(lambda x: 2 * x)(1.0))
"""


def test_programs_from_the_cache_are_loaded_without_a_word():
    environment = {
        **os.environ,
        "TF_CPP_MIN_LOG_LEVEL": "1",
        "CAROM_CACHE": "cache",
        "PYTHONPATH": str(Path(carom.__file__).parents[1]),
    }
    for name in ("one.py", "two.py"):
        words = [sys.executable, "-c", CACHED, name]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
        assert done.stderr == ""
    assert list(Path("cache").glob("*/*-cache"))
