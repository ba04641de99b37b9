"""Error of predicted tosses against the number of tosses that were learned from.

    python -m docs.figures.toss_curve TRAIN.h5 VAL.h5 [--out docs/images/toss_curve.png]

Learns from 4, 8, ... 256 tosses of one file, three draws each, by segments alone, and predicts every toss of the other
(protocol A). Numbers go to a JSON file beside the figure after each fit; a run that was stopped goes on there.
"""

import argparse
import json
from pathlib import Path

import jax
import numpy as np

import carom
from carom.atomic import write_whole
from carom.cli.main import configure_jax
from carom.cli.tosses import nominal_width
from carom.learning.estimation.protocols import toss_errors
from carom.learning.estimation.toss_config import TossConfig
from carom.learning.estimation.tosses import learn_tosses, predict_tosses
from carom.view.style import BLUE, VERMILLION, figure_style, new_figure, save_png

SIZES = (4, 8, 16, 32, 64, 128, 256)
DRAWS = 3
CONFIG = TossConfig(evaluations=0, segments=600)


def measure(train: carom.Recording, val: carom.Recording, size: int, draw: int) -> dict[str, float]:
    """Learn from `size` tosses: mean errors over the other file's, and what was learned."""
    chosen = np.random.default_rng((size, draw)).permutation(train.n_trajectories)[:size]
    skeleton = carom.task("cube").with_contact_model("coulomb")
    system, report = learn_tosses(skeleton, train.select(np.sort(chosen)), config=CONFIG, progress=False)
    errors = toss_errors(system, val, predict_tosses(system, val), nominal_width(skeleton))
    values = {name: estimate.value for name, estimate in report.estimates.items()}
    return {
        "size": size,
        "draw": draw,
        "position": float(errors.position.mean()),
        "rotation": float(errors.rotation.mean()),
        "segments": report.segments,
        **values,
    }


def draw_figure(rows: list[dict[str, float]], path: Path) -> Path:
    """Each fit a point, and the mean of a size's a line."""
    with figure_style():
        figure = new_figure(7.2, 3.0)
        panels = figure.subplots(1, 2)
        for axes, kind, unit, color in zip(
            panels, ("position", "rotation"), ("% of the width", "degrees"), (BLUE, VERMILLION), strict=True
        ):
            sizes = sorted({row["size"] for row in rows})
            each = [[row[kind] for row in rows if row["size"] == size] for size in sizes]
            axes.plot(sizes, [np.mean(e) for e in each], color=color)
            for size, values in zip(sizes, each, strict=True):
                axes.plot([size] * len(values), values, "o", color=color, markersize=4, alpha=0.7)
            axes.set_xscale("log", base=2)
            axes.set_xticks(sizes, [f"{int(size)}" for size in sizes])
            axes.set_ylim(0, 1.1 * max(max(e) for e in each))
            axes.set_xlabel("tosses to learn from")
            axes.set_ylabel(f"{kind} error ({unit})")
        return save_png(figure, path)


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description="Error against the number of tosses learned from.")
    parser.add_argument("train", type=Path, help="trajectory file of tosses to learn from")
    parser.add_argument("val", type=Path, help="trajectory file of tosses to predict")
    parser.add_argument("--out", type=Path, default=Path("docs/images/toss_curve.png"), help="figure")
    options = parser.parse_args()
    configure_jax()
    jax.config.update("jax_enable_x64", True)
    train, val = (carom.load_recording(path, task="cube") for path in (options.train, options.val))
    store = options.out.with_suffix(".json")
    rows = json.loads(store.read_text()) if store.exists() else []
    for size in SIZES:
        for draw in range(DRAWS):
            if any((row["size"], row["draw"]) == (size, draw) for row in rows):
                continue
            rows.append(measure(train, val, size, draw))
            write_whole(store, (json.dumps(rows, indent=1) + "\n").encode())
            last = rows[-1]
            print(f"{size} tosses, draw {draw}: {last['position']:.2f} %, {last['rotation']:.2f} degrees", flush=True)
    print(f"Written to {draw_figure(rows, options.out)}")


if __name__ == "__main__":
    main()
