"""Figures and animations: files of the right kind and size, which show what they should."""

import importlib.util
import math
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
from PIL import Image

from carom.contact.candidates import DiskDisk, DiskPlane
from carom.errors import CaromError
from carom.mechanics.bodies import PointMass, RigidBody, embed_pose
from carom.mechanics.constraints import Distance, Joint, Tether
from carom.simulation.rollout import Trajectory
from carom.system import System
from carom.view.animate import animate
from carom.view.figures import _quartiles, energy, trajectory_error
from carom.view.scene import lines_of, touching
from carom.view.style import DPI, ORANGE, TINT, theme
from carom.view.training_figures import contact_properties, learning_curves

NAN, INF = math.nan, math.inf
HEADER = 58  # pixels above the scene, with legend and time


# --- helpers -------------------------------------------------------------------------------------


def training(epochs: int = 20, properties: int = 1, bodies: int = 3) -> tuple[list[dict], dict]:
    """Metrics of a made-up training that converges, and the truth."""
    random = np.random.default_rng(0)
    truth = {
        "friction": random.uniform(0, 1, properties).tolist(),
        "restitution": random.uniform(0, 1, properties).tolist(),
        "mass_ratio": [1.0, *random.uniform(0.5, 5, bodies - 1).tolist()],
    }
    rows = []
    for epoch in range(epochs):
        rest = math.exp(-epoch / 4)
        rows.append(
            {
                "epoch": epoch,
                "step": 4 * epoch,
                "seconds": 0.1 * epoch,
                "loss": 0.3 * rest + 1e-4,
                "val_loss": 0.4 * rest + 1e-4,
                "learning_rate": 3e-3 * (1 - epoch / epochs),
                **{key: [v + (0.5 - v) * rest for v in values] for key, values in truth.items()},
            }
        )
    return rows, truth


def png_size(path) -> tuple[int, int]:
    with Image.open(path) as image:
        image.verify()
        assert image.format == "PNG"
        return image.size


def gif_frames(path) -> np.ndarray:
    """All frames (frames, height, width, 3)."""
    with Image.open(path) as image:
        assert image.format == "GIF"
        frames = []
        for k in range(image.n_frames):
            image.seek(k)
            frames.append(np.asarray(image.convert("RGB")))
    return np.stack(frames)


def pixels_of(frame: np.ndarray, color: str) -> np.ndarray:
    """Coordinates (count, 2) of the pixels below the header that have exactly this color."""
    rgb = [int(color[k : k + 2], 16) for k in (1, 3, 5)]
    return np.argwhere((frame[HEADER:] == rgb).all(axis=-1))


def trajectory(x, dt: float = 0.01, contact=None) -> Trajectory:
    x = np.asarray(x, float)
    v = np.gradient(np.nan_to_num(x), dt, axis=0) if len(x) > 1 else np.ones_like(x)
    count = len(x)
    flags = np.zeros(count, bool) if contact is None else contact
    return Trajectory(
        x=jnp.asarray(x),
        v=jnp.asarray(v),
        contact=jnp.asarray(flags),
        time=jnp.asarray(dt * np.arange(count)),
        overflow=jnp.zeros(count, int),
        residual=jnp.zeros(count),
    )


def ball(**options) -> System:
    return System([PointMass(1.0, 0.1)], contacts=[DiskPlane([0], (0, 0), (0, 1))], **options)


def bounce(count: int = 101, phase: float = 0.0) -> Trajectory:
    """A ball that bounces twice on y = 0 and moves along x at 1 m/s."""
    t = np.linspace(0, 1, count)
    height = 0.1 + np.abs(np.cos(2 * np.pi * t + phase))
    x = np.stack([t, height], axis=-1)[:, None]
    # As in a simulation, where contact is felt the ball is a little inside the ground.
    contact = height < 0.1 + np.pi / (count - 1)
    x[contact, :, 1] = 0.0999
    return trajectory(x, contact=contact, dt=1 / (count - 1))


def pendulum(dim: int = 2) -> tuple[System, Trajectory, Trajectory]:
    down, flat = [0.0] * dim, [0.0] * dim
    down[-1], flat[0] = -1.0, 1.0
    system = System(
        [PointMass(0.1, 0.05), PointMass(0.2, 0.15)],
        [Tether(0, [0.0] * dim, 0.4), Distance(0, 1, 0.5)],
        [
            DiskPlane([0, 1], np.array(down), -np.array(down)),
            DiskDisk([(0, 1)]),
        ],
        dim=dim,
        name=f"pendulum-{dim}",
    )

    def swing(rate):
        t = np.arange(101) * 0.01
        direction = [np.sin(a)[:, None] * flat + np.cos(a)[:, None] * down for a in (rate * t, 3 * t)]
        first = 0.4 * direction[0]
        return trajectory(np.stack([first, first + 0.5 * direction[1]], axis=1))

    return system, swing(2.0), swing(2.1)


# --- figures -------------------------------------------------------------------------------------


def test_learning_curves_are_written_at_their_size(tmp_path):
    path = tmp_path / "curves.png"
    assert learning_curves(training()[0], path) == path
    assert png_size(path) == (round(6.4 * DPI), round(4.2 * DPI))
    assert os.listdir(tmp_path) == ["curves.png"]


@pytest.mark.parametrize(
    "change",
    [
        {"loss": None, "val_loss": None},
        {"loss": NAN, "val_loss": NAN, "learning_rate": NAN},
        {"loss": INF, "val_loss": 0.0, "learning_rate": None},
        {"friction": None, "restitution": [None], "mass_ratio": [1.0, None, NAN]},
        {"friction": [NAN], "mass_ratio": None},
        {"epoch": None},
    ],
    ids=str,
)
@pytest.mark.parametrize("every", [True, False], ids=["every epoch", "one epoch"])
def test_missing_values_are_left_out(tmp_path, change, every):
    metrics, truth = training()
    for row in metrics if every else metrics[3:4]:
        row |= change
    assert learning_curves(metrics, tmp_path / "a.png").exists()
    assert contact_properties(metrics, truth, tmp_path / "b.png").exists()
    assert contact_properties(metrics, None, tmp_path / "c.png").exists()


@pytest.mark.parametrize("metrics", [[], [{}], [{"epoch": 0}], training(epochs=1)[0]], ids=range(4))
def test_a_training_that_has_hardly_begun_has_figures(tmp_path, metrics):
    assert learning_curves(metrics, tmp_path / "a.png").exists()
    assert contact_properties(metrics, {}, tmp_path / "b.png").exists()


def test_of_an_epoch_logged_twice_the_later_entry_counts(tmp_path):
    metrics, _ = training()
    again = [*metrics[:12], *[row | {"loss": 5.0} for row in metrics[5:12]], *metrics[5:]]
    learning_curves(metrics, tmp_path / "once.png")
    learning_curves(again, tmp_path / "twice.png")
    assert (tmp_path / "once.png").read_bytes() == (tmp_path / "twice.png").read_bytes()


@pytest.mark.parametrize(("properties", "bodies", "rows"), [(1, 1, 2), (1, 3, 3), (6, 2, 3), (30, 5, 3), (2, 12, 3)])
def test_contact_properties_have_a_row_each(tmp_path, properties, bodies, rows):
    metrics, truth = training(properties=properties, bodies=bodies)
    height = round((0.7 + 2.1 * rows) * DPI)
    assert png_size(contact_properties(metrics, truth, tmp_path / "a.png")) == (9 * DPI, height)
    path = contact_properties(metrics, None, tmp_path / "b.png")
    assert png_size(path) == (round(5.4 * DPI), height)


@pytest.mark.parametrize(
    "change",
    [{"friction": None}, {"restitution": [NAN, 0.5]}, {"mass_ratio": [None] * 3}, {"friction": []}],
    ids=str,
)
def test_truth_may_be_known_in_part(tmp_path, change):
    metrics, truth = training(properties=2)
    assert contact_properties(metrics, truth | change, tmp_path / "a.png").exists()


def test_what_was_kept_is_marked(tmp_path):
    metrics, truth = training(properties=2)
    plain = contact_properties(metrics, truth, tmp_path / "plain.png").read_bytes()
    kept = contact_properties(metrics, truth, tmp_path / "kept.png", kept=truth).read_bytes()
    assert kept != plain
    assert contact_properties(metrics, None, tmp_path / "a.png", kept=truth | {"friction": []}).exists()
    with pytest.raises(CaromError, match=r"kept\['friction'\] must have 2 values.* it had 1"):
        contact_properties(metrics, truth, tmp_path / "b.png", kept={"friction": [0.1]})


@pytest.mark.parametrize("first_exact", [0, 10], ids=["always", "in the end"])
def test_exact_values_have_a_place_on_the_error_axis(tmp_path, first_exact):
    metrics, truth = training()
    for row in metrics[first_exact:]:
        row |= truth
    assert contact_properties(metrics, truth, tmp_path / "a.png").exists()


def test_relative_errors_of_several_models(tmp_path):
    seconds = np.arange(50) * 0.01
    errors = {f"model {k}": 10.0 ** (k - 5) * np.exp(seconds) * np.ones((9, 1)) for k in range(8)}
    errors["model 0"][:, 0] = 0.0
    path = trajectory_error(seconds, errors, tmp_path / "a.png")
    assert png_size(path) == (round(6.4 * DPI), 4 * DPI)


@pytest.mark.parametrize("value", [0.0, NAN, INF, 1e200], ids=str)
@pytest.mark.parametrize("where", [np.s_[:], np.s_[:, 20:], np.s_[:4], np.s_[3, 3]], ids=str)
def test_errors_that_are_zero_or_not_finite(tmp_path, value, where):
    seconds = np.arange(30) * 0.01
    errors = np.full((5, 30), 1e-3)
    errors[where] = value
    assert trajectory_error(seconds, {"one": errors}, tmp_path / "a.png").exists()
    both = {"one": errors, "other": jnp.full((1, 30), 0.1)}
    assert trajectory_error(jnp.asarray(seconds), both, tmp_path / "b.png").exists()


def test_a_lost_trajectory_counts_as_the_worst():
    values = np.array([[1.0, 1.0, NAN], [2.0, 2.0, NAN], [3.0, INF, NAN], [4.0, INF, NAN], [5, INF, NAN]])
    lower, median, upper = _quartiles(values)
    np.testing.assert_array_equal(lower, [2, 2, NAN])
    np.testing.assert_array_equal(median, [3, NAN, NAN])
    np.testing.assert_array_equal(upper, [4, INF, NAN])


@pytest.mark.parametrize(
    "curves",
    [
        {"true": np.ones(30), "learned": np.full(30, 1.1)},
        {"true": np.ones((7, 30)), "learned": np.linspace(0, 1, 210).reshape(7, 30)},
        {"learned": np.full(30, NAN)},
        {"learned": np.where(np.arange(30) > 9, INF, 1.0), "true": np.zeros(30)},
    ],
    ids=range(4),
)
def test_energy(tmp_path, curves):
    path = energy(np.arange(30) * 0.01, curves, tmp_path / "a.png")
    assert png_size(path) == (round(6.4 * DPI), round(3.4 * DPI))


def test_nothing_global_changes(tmp_path):
    with matplotlib.rc_context({"lines.linewidth": 7.0, "font.size": 30.0}):
        before = dict(matplotlib.rcParams)
        learning_curves(training()[0], tmp_path / "a.png")
        animate(ball(), None, bounce(11), tmp_path / "a.gif")
        assert dict(matplotlib.rcParams) == before
    # Nor does what others have set change the figures.
    learning_curves(training()[0], tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_pyplot_is_not_imported():
    modules = "carom.view.figures, carom.view.training_figures, carom.view.animate"
    code = f"import sys, {modules}; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parent.parent,
    )
    assert done.stdout.strip() == "False"


# --- paths and errors ----------------------------------------------------------------------------

WRITERS = {
    "a.png": lambda path: learning_curves(training()[0], path),
    "b.png": lambda path: contact_properties(*training(), path),
    "c.png": lambda path: trajectory_error(np.arange(3.0), {"m": np.ones((2, 3))}, path),
    "d.png": lambda path: energy(np.arange(3.0), {"m": np.ones(3)}, path),
    "e.gif": lambda path: animate(ball(), None, bounce(11), path),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_path_may_be_a_string(tmp_path, name):
    assert WRITERS[name](str(tmp_path / name)) == tmp_path / name


@pytest.mark.parametrize("name", WRITERS)
def test_a_path_that_cannot_be_is_named(tmp_path, name):
    with pytest.raises(CaromError, match=r"'.*nowhere', which does not exist. Make it"):
        WRITERS[name](tmp_path / "nowhere" / name)
    with pytest.raises(CaromError, match=r"path must end in .*; it was '.*a.txt'"):
        WRITERS[name](tmp_path / "a.txt")
    (tmp_path / name).mkdir()
    with pytest.raises(CaromError, match=r"cannot be written in .*Is a directory"):
        WRITERS[name](tmp_path / name)
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("name", WRITERS)
def test_a_failure_leaves_what_was_there(tmp_path, name, monkeypatch):
    (tmp_path / name).write_text("before")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(CaromError, match=r"cannot be written in .*No space left on device"):
        WRITERS[name](tmp_path / name)
    assert os.listdir(tmp_path) == [name]
    assert (tmp_path / name).read_text() == "before"


def test_bad_metrics_are_named(tmp_path):
    metrics, truth = training()
    path = tmp_path / "a.png"
    with pytest.raises(CaromError, match=r"truth\['friction'\] must have 1 values.* it had 2"):
        contact_properties(metrics, truth | {"friction": [0.1, 0.2]}, path)
    with pytest.raises(CaromError, match="'loss' must be a number or None; one was 'low'"):
        learning_curves([*metrics, {"epoch": 99, "loss": "low"}], path)
    with pytest.raises(CaromError, match="'friction' must be a list of numbers; it was 'low'"):
        contact_properties([*metrics, {"epoch": 99, "friction": "low"}], truth, path)
    assert not path.exists()


@pytest.mark.parametrize(("figure", "name"), [(trajectory_error, "errors"), (energy, "curves")])
def test_curves_of_another_length_are_named(tmp_path, figure, name):
    with pytest.raises(CaromError, match=rf"{name}\['m'\] must have the shape \(N, 4\)"):
        figure(np.arange(4.0), {"m": np.ones((2, 3))}, tmp_path / "a.png")
    with pytest.raises(CaromError, match=f"{name} must hold at least one curve"):
        figure(np.arange(4.0), {}, tmp_path / "a.png")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0.0}, "fps must be positive; it was 0.0"),
        ({"speed": -1.0}, "speed must be positive; it was -1.0"),
        ({"trail": -0.1}, "trail must not be negative; it was -0.1"),
        ({"width": 20}, "width must be at least 300 pixels; it was 20"),
    ],
)
def test_bad_options_are_named(tmp_path, options, message):
    with pytest.raises(CaromError, match=message):
        animate(ball(), None, bounce(11), tmp_path / "a.gif", **options)


def test_trajectories_that_do_not_fit_are_named(tmp_path):
    path, motion = tmp_path / "a.gif", bounce(11)
    two = trajectory(np.zeros((11, 2, 2)))
    with pytest.raises(CaromError, match=r"predicted must be one trajectory .*\(time, 1, 2\).*\(11, 2, 2\)"):
        animate(ball(), motion, two, path)
    with pytest.raises(CaromError, match="true must be one trajectory of this system"):
        animate(ball(), two, motion, path)
    with pytest.raises(CaromError, match="predicted must have positions to draw; none was finite"):
        animate(ball(), motion, trajectory(np.full((11, 1, 2), NAN)), path)
    assert os.listdir(tmp_path) == []


def test_mp4_without_its_package_is_said(tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "imageio_ffmpeg" else find(name))
    with pytest.raises(CaromError, match="MP4, which needs the package imageio-ffmpeg"):
        animate(ball(), None, bounce(11), tmp_path / "a.mp4")


# --- animations ----------------------------------------------------------------------------------


def test_a_hundred_frames_are_quick_and_small(tmp_path):
    start = time.process_time()
    path = animate(ball(name="ball"), bounce(), bounce(phase=0.05), tmp_path / "a.gif")
    # About 1.5 s of processor time.
    assert time.process_time() - start < 10
    assert path.stat().st_size < 2_000_000
    with Image.open(path) as image:
        assert image.n_frames >= 95  # equal frames may be written as one
        assert image.width == 500
        assert image.info["duration"] == 40  # ms: 1 s of motion takes 4 s
        assert image.info["loop"] == 0
    assert os.listdir(tmp_path) == ["a.gif"]


def test_disks_are_drawn_where_they_are_and_to_scale(tmp_path):
    motion = trajectory(np.linspace([0.0, 0.5], [1.0, 0.8], 51)[:, None])
    path = animate(System([PointMass(1.0, 0.1)]), None, motion, tmp_path / "a.gif", trail=0.0)
    frames = gif_frames(path)
    disks = [pixels_of(frame, TINT) for frame in frames]
    centers = np.array([disk.mean(axis=0) for disk in disks])
    # From lower left to upper right, in equal steps; rounding to pixels leaves half a pixel.
    np.testing.assert_allclose(centers, np.linspace(centers[0], centers[-1], len(frames)), atol=0.5)
    (rows, columns) = centers[-1] - centers[0]
    assert -rows / columns == pytest.approx(0.3, abs=0.01)
    # The edge, 1.5 points wide, covers a pixel of the rim.
    scale = columns / 1.0
    radius = np.sqrt(np.mean([len(disk) for disk in disks]) / np.pi)
    assert radius == pytest.approx(0.1 * scale - 1, abs=1.5)


def test_contacts_flash_when_and_where_they_happen(tmp_path):
    motion = bounce()
    frames = gif_frames(animate(ball(), None, motion, tmp_path / "a.gif", speed=0.25))
    first = int(np.argmax(motion.contact))
    assert all(len(pixels_of(frame, ORANGE)) == 0 for frame in frames[: first - 1])
    flash = pixels_of(frames[first], ORANGE)
    assert len(flash) > 10
    disk = pixels_of(frames[first], TINT)
    assert flash[:, 0].max() > disk[:, 0].max()
    assert flash[:, 1].mean() == pytest.approx(disk[:, 1].mean(), abs=4)


def test_touching_finds_the_closed_contacts():
    system, motion, _ = pendulum()
    contact = np.zeros(101, bool)
    contact[50] = True
    x = np.array(motion.x)
    x[50] = [[0.0, -0.5], [0.0, -0.9]]  # the second body reaches 0.05 below y = -1
    places, closed = touching(system, trajectory(x, contact=contact))
    np.testing.assert_array_equal(np.argwhere(closed), [[50, 1]])
    np.testing.assert_allclose(places[50], [[0, -0.55], [0, -1.05], [0, -0.55]], atol=1e-12)


def test_lines_join_the_right_points():
    disk = RigidBody(1.0, (0.0025, 0.0025), 0.1)
    system = System(
        [PointMass(1.0), disk],
        [Tether(0, (0.0, 0.0), 0.4), Distance(0, 1, 0.5), Joint(1, (1.0, 0.0, 0.0), (0.5, 0.5))],
    )
    x = np.concatenate([[[0.0, -0.4]], embed_pose(jnp.array([0.5, 0.5]), jnp.eye(2))])
    lines = lines_of(system)
    ends = np.einsum("lsn,nd->lsd", lines.weights, x) + lines.offset
    expected = [
        [[0, -0.4], [0, 0]],
        [[0, -0.4], [0.5, 0.5]],
        [[0.5, 0.5], [0.5, 0.5]],
        [[0.5, 0.5], [0.6, 0.5]],  # the spoke of the disk
    ]
    np.testing.assert_allclose(ends, expected, atol=1e-12)
    np.testing.assert_array_equal(lines.anchors, [[0, 0], [0.5, 0.5]])


@pytest.mark.parametrize("dim", [2, 3])
def test_links_and_walls_in_two_and_three_dimensions(tmp_path, dim):
    path = animate(*pendulum(dim), tmp_path / "a.gif", fps=5.0)
    frames = gif_frames(path)
    assert 15 <= len(frames) <= 20
    assert all(len(pixels_of(frame, TINT)) > 500 for frame in frames)


@pytest.mark.parametrize("value", [NAN, INF, 1e200, -1e9], ids=str)
def test_a_prediction_that_is_lost_leaves_the_picture(tmp_path, value):
    system, true, predicted = pendulum()
    lost = trajectory(np.array(predicted.x))
    lost = Trajectory(
        x=lost.x.at[50:, 1].set(value),
        v=lost.v,
        contact=lost.contact.at[60].set(True),
        time=lost.time,
        overflow=lost.overflow,
        residual=lost.residual,
    )
    good = gif_frames(animate(system, true, true, tmp_path / "a.gif", fps=5.0))
    bad = gif_frames(animate(system, true, lost, tmp_path / "b.gif", fps=5.0))
    assert bad.shape[1:] == pytest.approx(good.shape[1:], abs=40)


def test_the_shorter_trajectory_ends_the_animation(tmp_path):
    long, short = bounce(), bounce()
    short = Trajectory(*(getattr(short, f)[:31] for f in Trajectory.__dataclass_fields__))
    for name, pair in {"a.gif": (long, short), "b.gif": (short, long)}.items():
        frames = gif_frames(animate(ball(), *pair, tmp_path / name))
        assert len(frames) <= 31


@pytest.mark.parametrize("count", [1, 2, 3])
def test_very_short_trajectories(tmp_path, count):
    motion = trajectory(np.zeros((count, 1, 2)) + 0.5)
    assert animate(ball(), motion, motion, tmp_path / "a.gif").exists()


@pytest.mark.parametrize(
    ("count", "dt", "speed", "frames"),
    [(101, 0.01, 1.0, 25), (401, 0.01, None, 100), (2001, 0.01, None, 250), (21, 0.005, None, 21)],
)
def test_samples_are_left_out_to_keep_the_frame_rate(tmp_path, count, dt, speed, frames):
    x = np.stack([np.linspace(0, 1, count), np.linspace(0, 0.5, count)], axis=-1)[:, None]
    path = animate(ball(), None, trajectory(x, dt=dt), tmp_path / "a.gif", speed=speed)
    with Image.open(path) as image:
        assert image.n_frames == frames


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="imageio-ffmpeg is not installed")
def test_mp4(tmp_path):
    import imageio.v2

    path = animate(ball(), bounce(), bounce(), tmp_path / "a.mp4", width=401)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r".*fork\(\)")  # to run ffmpeg
        with imageio.v2.get_reader(path) as reader:
            assert reader.get_meta_data()["size"][0] == 400
            assert reader.count_frames() == 120  # 100 and the last one for another 0.8 s
    assert os.listdir(tmp_path) == ["a.mp4"]


def test_figures_for_a_dark_background(tmp_path):
    time, errors = np.arange(1, 11) * 0.1, {"learned": np.geomspace(1e-4, 1e-2, 30).reshape(3, 10)}
    light = trajectory_error(time, errors, tmp_path / "light.png")
    with theme("dark"):
        dark = trajectory_error(time, errors, tmp_path / "dark.png")
    again = trajectory_error(time, errors, tmp_path / "again.png")
    assert light.read_bytes() == again.read_bytes()
    brightness = [np.asarray(Image.open(path).convert("L"), float) for path in (light, dark)]
    assert brightness[0].shape == brightness[1].shape
    assert np.median(brightness[0]) > 250
    assert np.median(brightness[1]) < 40
    assert brightness[1].max() > 200  # text
    with pytest.raises(CaromError, match="theme must be 'light' or 'dark'; it was 'grey'"), theme("grey"):
        pass
