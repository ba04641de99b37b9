"""Motions as a viewer shows them, the page that plays them, and the command that serves it."""

import dataclasses
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import ball_on_floor

import carom
from carom.cli.main import main
from carom.errors import CaromError
from carom.recordings.files import save_recording
from carom.view.motion import motion_of
from carom.view.web_page import save_page

MASS, FRICTION, RESTITUTION = 2.0, 0.1, 0.5


@pytest.fixture(scope="module")
def system():
    return ball_on_floor(mass=MASS, friction=FRICTION, restitution=RESTITUTION, gravity=0.0)


@pytest.fixture(scope="module")
def bounce(system):
    """A ball comes down slantwise, bounces once and slides."""
    x0, v0 = jnp.array([[0.0, 0.25]]), jnp.array([[3.0, -1.0]])
    return carom.simulate(system, x0, v0, dt=0.02, steps=20, compensation_steps=None)


def test_an_impulse_is_what_changed_the_momentum(system, bounce):
    motion = motion_of(system, bounce, compensation_steps=None)
    (k,) = np.flatnonzero(motion.acting.any(axis=1))
    change = MASS * (np.asarray(bounce.v)[k, 0] - np.asarray(bounce.v)[k - 1, 0])
    np.testing.assert_allclose(motion.impulse[k, 0], change, atol=1e-9)
    np.testing.assert_allclose(motion.normal[k, 0], [0, 1])
    assert motion.friction[k, 0] == pytest.approx(FRICTION)
    # The lowest point of the ball.
    np.testing.assert_allclose(motion.place[k, 0], np.asarray(bounce.x)[k, 0] - [0, 0.1], atol=1e-12)
    np.testing.assert_allclose(motion.gap, np.asarray(bounce.x)[:, 0, 1] - 0.1, atol=1e-12)
    energy = 0.5 * MASS * np.sum(np.asarray(bounce.v)[:, 0] ** 2, axis=1)
    np.testing.assert_allclose(motion.energy, energy)
    assert motion.impulse_size[k] == pytest.approx(np.linalg.norm(change))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cp3", "gyro"])
def test_impulses_of_joined_bodies_point_out_of_the_wall(name):
    system = carom.task(name)
    x0, v0 = carom.sample(system, jax.random.key(3), 1)
    trajectory = carom.simulate(system, x0[0], v0[0], dt=0.02, steps=60)
    motion = motion_of(system, trajectory)
    assert motion.acting.any()
    normal = np.sum(motion.impulse * motion.normal, axis=-1)[motion.acting]
    across = motion.impulse - np.sum(motion.impulse * motion.normal, axis=-1, keepdims=True) * motion.normal
    along = np.linalg.norm(across, axis=-1)
    assert normal.min() > -1e-9
    # Coulomb's law, of the sum of both phases.
    assert np.all(along[motion.acting] <= motion.friction[motion.acting] * normal + 1e-7)
    wall = {"cp3": -1.0, "gyro": -0.33}[name]
    # What touches is as deep in the wall as the gap says.
    depth = motion.place[..., 1][motion.acting] - wall
    assert np.all(depth < 1e-9)
    assert depth.min() >= motion.gap.min() - 1e-9


def test_a_trajectory_of_another_system_is_refused(system):
    other = carom.task("two-balls")
    x0, v0 = carom.sample(other, jax.random.key(0), 1)
    with pytest.raises(CaromError, match="trajectory must have the shape"):
        motion_of(system, carom.simulate(other, x0[0], v0[0], dt=0.01, steps=3))


@pytest.fixture(scope="module")
def page(system, bounce, tmp_path_factory):
    motion = motion_of(system, bounce, compensation_steps=None)
    path = tmp_path_factory.mktemp("page") / "bounce.html"
    title = 'a </script><b>"ball"</b>'
    return save_page(system, [("</script>", [motion, motion])], path, names=("true", "predicted"), title=title)


def data_of(page: Path) -> dict:
    return json.loads(re.search(r'type="application/json">(.*?)</script>', page.read_text(), re.S)[1])


def test_a_page_is_one_file_with_all_that_it_needs(page, bounce):
    text = page.read_text()
    assert not re.search(r"https?:|src=|href=|@import|url\(", text)
    assert text.count("</script>") == 2
    assert "<b>" not in text
    data = data_of(page)
    assert data["names"] == ["true", "predicted"]
    assert data["trajectories"][0]["name"] == "</script>"
    (motion, _) = data["trajectories"][0]["motions"]
    np.testing.assert_allclose(np.array(motion["center"])[:, 0], np.asarray(bounce.x)[:, 0], rtol=1e-4, atol=1e-9)
    assert sum(map(len, motion["contacts"])) == 1
    assert len(data["walls"]) == 1


def test_long_motions_are_thinned_but_keep_their_contacts(system, bounce, tmp_path, monkeypatch):
    monkeypatch.setattr("carom.view.web_page.MOST_SAMPLES", 5)
    path = save_page(system, [("1", [motion_of(system, bounce)])], tmp_path / "a.html", names=["one"], title="t")
    (motion,) = data_of(path)["trajectories"][0]["motions"]
    assert 5 <= len(motion["center"]) <= 6
    assert sum(map(len, motion["contacts"])) == 1


def test_what_is_not_finite_is_left_out(system, bounce, tmp_path):
    lost = dataclasses.replace(bounce, x=bounce.x.at[-1].set(jnp.inf))
    path = save_page(system, [("1", [motion_of(system, lost)])], tmp_path / "a.html", names=["one"], title="t")
    assert data_of(path)["trajectories"][0]["motions"][0]["center"][-1] == [[None, None]]
    assert np.isfinite(data_of(path)["box"]).all()


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A trajectory file, in the folder that the command is run in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CAROM_CACHE", "")
    system = carom.task("two-balls")
    x0, v0 = carom.sample(system, jax.random.key(0), 3)
    motion = carom.simulate(system, x0, v0, dt=0.02, steps=30)
    recording = carom.Recording.of(motion.x, motion.v, time=motion.time, contact=motion.contact, task="two-balls")
    save_recording(tmp_path / "two.h5", recording)
    cache = jax.config.jax_compilation_cache_dir
    yield tmp_path / "two.h5"
    jax.config.update("jax_compilation_cache_dir", cache)


def test_a_file_is_saved_as_a_page_and_as_a_gif(recorded, capsys):
    main(["view", str(recorded), "--save", "two.html", "--trajectories", "2"])
    assert len(data_of(Path("two.html"))["trajectories"]) == 2
    main(["view", "two.h5", "--save", "two.gif"])
    assert Path("two.gif").read_bytes()[:4] == b"GIF8"
    assert "Written to two.gif" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["none.h5"], "there is no run folder or trajectory file 'none.h5'"),
        (["nothing"], "there is no run folder or trajectory file 'nothing': check its name"),
        (["two.h5", "--save", "nowhere/two.gif"], "nowhere (there is no such folder)"),
        (["two.h5", "--save", "two.png"], "save must end in .html, .gif, .mp4"),
        (["two.h5", "--trajectories", "0"], "trajectories must be at least 1"),
        (["two.h5", "--port", "70000"], "port must be from 0 to 65535"),
        (["two.h5", "--task", "cp3"], "two.h5"),
        (["."], "not a run folder"),
    ],
)
def test_wrong_requests_are_answered_in_a_line(recorded, capsys, arguments, said):
    assert recorded.exists()
    with pytest.raises(SystemExit) as stop:
        main(["view", *arguments])
    assert stop.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line


def test_what_a_movie_needs_is_said_first(recorded, capsys, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else find(name))
    monkeypatch.setattr("carom.cli.view.data_and_system", None)  # nothing is read before
    with pytest.raises(SystemExit) as stop:
        main(["view", str(recorded), "--save", "two.mp4"])
    assert stop.value.code == 2
    assert "--save asks for an MP4, which needs the package imageio-ffmpeg" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.ci_budget
def test_the_page_is_served_to_this_machine_alone_until_interrupted(recorded):
    environment = {**os.environ, "PYTHONPATH": str(Path(carom.__file__).parents[1]), "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "carom.cli.main", "view", str(recorded), "--no-open"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    ) as server:
        assert server.stdout is not None
        address = re.match(r"(http://127\.0\.0\.1:\d+/) shows", server.stdout.readline())
        assert address is not None
        with urllib.request.urlopen(address[1], timeout=10) as answer:
            assert b'id="scene"' in answer.read()
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(address[1] + "../etc/passwd", timeout=10)
        server.send_signal(signal.SIGINT)
        out, errors = server.communicate(timeout=30)
        assert (server.returncode, "Ended." in out, "Traceback" in errors) == (0, True, False)


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
NO_BROWSER = "needs Chromium and the package playwright"


@pytest.mark.slow
@pytest.mark.ci_budget
@pytest.mark.skipif(CHROMIUM is None or importlib.util.find_spec("playwright") is None, reason=NO_BROWSER)
def test_the_page_moves_and_scrubs_in_a_browser(page):
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 900, "height": 700})
        said: list[str] = []
        tab.on("console", lambda message: said.append(message.text))
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.goto(page.as_uri())
        tab.wait_for_function("Number(document.getElementById('time').value) > 0", timeout=10_000)
        tab.click("#play")
        stopped = tab.input_value("#time")
        tab.wait_for_timeout(200)
        assert tab.input_value("#time") == stopped
        pictures = []
        for sample in ("2", "18"):
            tab.evaluate(
                "k => { const s = document.getElementById('time'); s.value = k; s.dispatchEvent(new Event('input')); }",
                sample,
            )
            assert tab.input_value("#time") == sample
            pictures.append(tab.screenshot())
        assert pictures[0] != pictures[1]
        assert "0.36 s of 0.40" in tab.inner_text("#clock")
        assert tab.inner_text("#legend").split() == ["true", "predicted"]
        assert said == []
        browser.close()
