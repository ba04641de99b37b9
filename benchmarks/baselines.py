"""The contact model against the paper's baselines on the rope (paper, table S.9), one training each.

`python -m benchmarks.baselines` learns `rope` from 800 trajectories with carom's model and each baseline, predicts 100
test trajectories of 100 steps, and writes the table to `docs/baselines.md` and the numbers to `docs/baselines.json`.
Trainings are run folders in `--runs`, with checkpoints: a run that was stopped goes on there. `--models`, `--task`,
`--trajectories` and `--epochs` make other tables; give them another `--out`.
"""

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
from rich.console import Console

import carom
from carom.atomic import write_whole
from carom.cli.main import configure_jax
from carom.learning.config import FORMULATIONS
from carom.learning.dataset import Dataset
from carom.learning.run import CONFIG, MODEL, REPORT, RunFolder
from carom.tasks import make_data_sets

MODELS = ("clnn", "mlp-cd-clnn", "in-cp-clnn", "in-cp-sp")
PAPER = {
    "clnn": ("CM-CD-CLNN", 0.0032),
    "mlp-cd-clnn": ("MLP-CD-CLNN", 0.00598),
    "in-cp-clnn": ("IN-CP-CLNN", 0.00687),
    "in-cp-sp": ("IN-CP-SP", 0.00894),
}
"""The paper's names, and its trajectory relative errors on the rope with 800 trajectories (table S.9)."""
TEST_SEED = 1_000_000
"""Test states are drawn apart from those to train on."""


def recordings(task: str, trajectories: int, seed: int) -> tuple[Dataset, carom.Recording]:
    """Training and validation data, and 100 test trajectories of at least 100 steps."""
    key, parts = jax.random.key(seed), [(0, trajectories), (1, max(trajectories // 8, 2)), (TEST_SEED, 100)]
    train, val, test = make_data_sets(carom.task(task), *((jax.random.fold_in(key, k), n) for k, n in parts))
    return Dataset(train, val), test


def measured(model: str, options: argparse.Namespace, data, folder: Path) -> dict[str, Any]:
    """Learn (or go on, or read) one model, and measure its predictions."""
    config = carom.LearnConfig(model=model, epochs=options.epochs, seed=options.seed)
    settings = {"task": options.task, "trajectories": options.trajectories, **dataclasses.asdict(config)}
    fresh = not (folder / CONFIG).exists()
    run = RunFolder.create(folder, settings) if fresh else RunFolder.open(folder)
    before = run.read_json(CONFIG)
    if before != json.loads(json.dumps(settings)):
        raise SystemExit(f"{folder} was made with other settings. Choose another folder with --runs.")
    if (folder / REPORT).exists():
        return run.read_json(REPORT)
    (dataset, test), truth = data, carom.task(options.task)
    system, report = carom.learn(truth, dataset, config, run=run)
    run.close()
    carom.save_model(folder / MODEL, system, formulation=FORMULATIONS[model])
    out, _ = carom.evaluate(system, test, truth=truth, formulation=FORMULATIONS[model])
    run.write_json(REPORT, {"learned": dataclasses.asdict(report), "evaluation": out})
    return run.read_json(REPORT)


def table(results: dict[str, dict[str, Any]], options: argparse.Namespace) -> str:
    """The page in Markdown."""
    paper = (options.task, options.trajectories) == ("rope", 800)
    lines = [
        f"# The contact model and the baselines on `{options.task}`",
        "",
        f"Learned from {options.trajectories} trajectories, at most {options.epochs} epochs, seed {options.seed}; "
        "predictions of 100 test trajectories. Made by `python -m benchmarks.baselines`, which says what is what; the "
        "numbers are in `baselines.json`. Errors are relative, of positions and velocities together, mean over time.",
        "",
        "| model | error, mean | 95 % | median | geometric | bounded | epochs | training (s) |"
        + (" paper |" if paper else ""),
        "|---|---|---|---|---|---|---|---|" + ("---|" if paper else ""),
    ]
    for model, result in results.items():
        numbers = result["evaluation"]
        shown = [numbers[f"trajectory_error{part}"] for part in ("", "_ci95", "_median", "_geometric")] + [
            numbers["bounded_error"]
        ]
        row = [
            PAPER[model][0],
            *("not finite" if v is None else f"{v:.2e}" for v in shown),
            f"{result['learned']['epochs']}",
            f"{result['learned']['seconds']:.0f}",
        ]
        lines.append("| " + " | ".join(row + ([f"{PAPER[model][1]:.2e}"] if paper else [])) + " |")
    if paper:
        lines += [
            "",
            "The paper's own numbers (table S.9) are from its own trainings, test states and lengths. The baselines "
            "learn from single steps, and here their predictions leave the rope's way within 100 steps: the bounded "
            "error, about 1 where nothing is right any more, says how far. No epochs: the Gauss-Newton steps that a "
            "training begins with were enough.",
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description="The contact model against the baselines.")
    parser.add_argument("--task", default="rope", help="task (default: rope)")
    parser.add_argument("--trajectories", type=int, default=800, help="training trajectories (default: 800)")
    parser.add_argument("--epochs", type=int, default=250, help="epochs of each training (default: 250)")
    parser.add_argument("--models", nargs="+", default=MODELS, choices=MODELS, help="which (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="seed of data and networks (default: 0)")
    parser.add_argument("--runs", type=Path, default=Path("runs/baselines"), help="folder of the trainings")
    parser.add_argument("--out", type=Path, default=Path("docs/baselines"), help="table and numbers, without ending")
    options = parser.parse_args()
    configure_jax()
    console, results = Console(), {}
    data = recordings(options.task, options.trajectories, options.seed)
    for model in options.models:
        console.print(f"{PAPER[model][0]} ...", highlight=False)
        results[model] = measured(model, options, data, options.runs / model)
        write_whole(options.out.with_suffix(".json"), (json.dumps(results, indent=1) + "\n").encode())
        write_whole(options.out.with_suffix(".md"), table(results, options).encode())
    console.print(options.out.with_suffix(".md").read_text(), highlight=False, markup=False)


if __name__ == "__main__":
    main()
