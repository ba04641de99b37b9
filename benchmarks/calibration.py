"""Do the 95 % intervals of `identify` hold the true values? Repeated noisy data sets, each learned, then identified.

`python -m benchmarks.calibration bp5` (masses, friction, restitution; the forces are known) and
`python -m benchmarks.calibration cp3 --network` (the potential is learned too). Each set has its own initial states,
and normal errors of `--noise` on every recorded position (m) and velocity (m/s). Contact flags are not recorded:
contacts must be found in the noisy positions. Trajectories are few, so that some properties are rarely seen: those must
not be called identified, or be covered all the same. `--epochs 0` starts from the true values moved by about 0.03
rather than from learned ones.

`python -m benchmarks.calibration pucks` is that of the estimator from positions alone: worlds with other numbers each,
made without carom (`worlds.py`), of which radii, walls and the first mass are told. `--wrong drag` slows the pucks by a
drag, `--wrong radius` tells a radius that is 1 % off: no interval may then be called identified that does not hold.

Each set is a line of `--out`; a run that was stopped goes on there. Exit status 1 if the coverage is not within 90 to
99 %, as far as the number of sets can tell (its own 95 % interval).
"""

import argparse
import dataclasses
import json
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import carom
from benchmarks.worlds import WALLS, Pucks, observe
from carom.cli.main import configure_jax
from carom.learning.config import Quantity
from carom.learning.dataset import Dataset
from carom.learning.estimation.estimate import estimate
from carom.learning.estimation.identify import Identification, identify
from carom.learning.unknowns.models import mass_ratios
from carom.recordings.observations import Observations


def noisy(recording: carom.Recording, sd: float, seed: int) -> carom.Recording:
    """Errors on every number of a recording, and no contact flags."""
    rng = np.random.default_rng(seed)
    x, v = (part + sd * rng.normal(size=part.shape) for part in (recording.x, recording.v))
    return carom.Recording.of(x, v, dt=recording.dt, task=recording.task)


def moved(truth: carom.System, seed: int) -> carom.System:
    """The true system with friction and restitution moved: a stand-in for a learned one."""
    rng = np.random.default_rng((seed, 1))
    friction, restitution = (
        np.asarray(part) + 0.03 * rng.normal(size=part.shape) for part in (truth.friction, truth.restitution)
    )
    values = jnp.asarray(friction.clip(0)), jnp.asarray(restitution.clip(0, 1))
    return eqx.tree_at(lambda s: (s.friction, s.restitution), truth, values)


def one_set(truth: carom.System, options: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Learn one data set and identify it: its estimates with their true values, and the seconds that both took."""
    exact = carom.make_recording(truth, jax.random.fold_in(jax.random.key(options.seed), seed), options.trajectories)
    data = noisy(exact, options.noise, seed)
    learned: tuple[Quantity, ...] = ("mass", "friction", "restitution")
    if options.network:
        learned = (*learned, "potential")
    config = carom.LearnConfig(learn=learned, epochs=max(options.epochs, 1), width=64, depth=2, seed=seed)
    started = time.monotonic()
    if options.epochs:
        system, _ = carom.learn(truth, Dataset.split(data, seed=seed), config, progress=False)
    else:
        system = moved(truth, seed)
    between = time.monotonic()
    estimates = with_truth(identify(system, data, learned=learned), truth)
    return {"set": seed, "learn": between - started, "identify": time.monotonic() - between, "estimates": estimates}


WORLD = {"trajectories": 150, "samples": 121}
"""Sizes of the worlds of pucks."""


def other_pucks(seed: int, wrong: str | None) -> Pucks:
    """Pucks with numbers of their own."""
    rng = np.random.default_rng((seed, 7))
    first, ratio = 0.1, rng.uniform(0.6, 2.5)
    pair, walls = rng.uniform(0.05, 0.3, 2)
    friction, restitution = (float(pair), float(walls)), tuple(rng.uniform(0.55, 0.95, 2).tolist())
    field = (0.0, 0.0) if wrong == "drag" else tuple(rng.uniform(-0.3, 0.3, 2).tolist())
    return Pucks((first, first * float(ratio)), (0.1, 0.15), friction, restitution, field, 0.3 * (wrong == "drag"))


def told_of(pucks: Pucks, wrong: str | None) -> carom.System:
    """What is told of pucks."""
    radii = pucks.radii[0], pucks.radii[1] * (1.01 if wrong == "radius" else 1)
    walls = [(normal.clip(max=0) * -1.0, normal) for normal in WALLS]
    return carom.System(
        [carom.PointMass(pucks.masses[0], radius) for radius in radii],
        contacts=[carom.DiskDisk([(0, 1)])] + [carom.DiskPlane([0, 1], *wall, property=1) for wall in walls],
        friction=[0.2, 0.2],
        restitution=[0.7, 0.7],
        dim=2,
    )


def one_world(options: argparse.Namespace, seed: int) -> dict[str, Any]:
    """A world of pucks through the estimator."""
    pucks = other_pucks(options.seed + seed, options.wrong)
    seen = observe(pucks, **WORLD, noise=options.noise, seed=options.seed + seed)
    learn = ("friction", "restitution", "mass", "gravity")
    told = estimate(told_of(pucks, options.wrong), Observations.checked(seen.x, seen.time), learn)
    true = {"mass:1": pucks.masses[1] / pucks.masses[0]}
    for name, values in (("friction", pucks.friction), ("restitution", pucks.restitution)):
        true |= {f"{name}:{k}": value for k, value in enumerate(values)}
    true |= {f"gravity:{axis}": value for axis, value in zip("xy", pucks.field, strict=True)}
    estimates = [
        {"quantity": one.name.split(":")[0], "true": true[one.name], "bound": None, **dataclasses.asdict(one)}
        for one in told.estimates
    ]
    return {"set": seed, "learn": told.seconds, "identify": 0.0, "chi2": told.fit.chi2, "estimates": estimates}


def with_truth(found: Identification, truth: carom.System) -> list[dict[str, Any]]:
    """Every estimate with its quantity, index and true value."""
    values = {"friction": truth.friction, "restitution": truth.restitution, "mass_ratio": mass_ratios(truth)[1:]}
    return [
        {"quantity": name, "index": k, "true": float(true), **dataclasses.asdict(estimate)}
        for name, numbers in values.items()
        for k, (estimate, true) in enumerate(zip(getattr(found, name), np.asarray(numbers), strict=True))
    ]


def covers(estimate: dict[str, Any]) -> bool:
    """Whether the interval holds the true value."""
    return estimate["lower"] <= estimate["true"] <= estimate["upper"]


def read_sets(path: Path, settings: dict[str, Any]) -> list[dict[str, Any]]:
    """The sets that are done: the first line of the file holds the settings they were made with."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(settings) + "\n")
        return []
    first, *lines = path.read_text().splitlines()
    if json.loads(first) != settings:
        sys.exit(f"{path} was made with other settings: {first}. Choose another file with --out.")
    return [json.loads(line) for line in lines]


def coverage_table(sets: list[dict[str, Any]]) -> Table:
    """Coverage and standardised errors by quantity; bounds of what is not identified beside them."""
    covered, scores = defaultdict(list), defaultdict(list)
    for found in (e for one in sets for e in one["estimates"]):
        name = found["quantity"]
        if found["verdict"] == "identified":
            covered[name].append(covers(found))
            scores[name].append((found["value"] - found["true"]) / found["standard_error"])
        elif found["bound"] is not None:
            covered[f"{name} ({found['verdict']})"].append(covers(found))
    table = Table(title="95 % intervals")
    for name in ("quantity", "intervals", "cover", "mean of error / standard error", "its standard deviation"):
        table.add_column(name, justify="left" if name == "quantity" else "right")
    for name, part in covered.items():
        z = np.array(scores.get(name, [np.nan]))
        table.add_row(name, str(len(part)), f"{np.mean(part):.1%}", f"{z.mean():.2f}", f"{z.std():.2f}")
    return table


def coverage(sets: list[dict[str, Any]]) -> tuple[float, float]:
    """Share of the intervals of what is called identified that hold the true value, and half of its 95 % interval.

    The sets, not the intervals, are taken as independent.
    """
    parts = [[covers(e) for e in one["estimates"] if e["verdict"] == "identified"] for one in sets]
    if not any(parts):
        return 0.95, 0.0  # nothing is called identified, which is right whatever its interval
    shares = [np.mean(part) for part in parts if part]
    return float(np.mean(np.concatenate(parts))), float(1.96 * np.std(shares) / np.sqrt(len(shares)))


def main() -> int:
    """Run it; 1 if the intervals are not calibrated."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals of identify.")
    parser.add_argument("task", nargs="?", default="bp5", help="task (default: bp5)")
    parser.add_argument("--sets", type=int, default=20, help="data sets (default: 20)")
    parser.add_argument("--trajectories", type=int, default=100, help="trajectories in each (default: 100)")
    parser.add_argument("--noise", type=float, default=1e-3, help="standard deviation of the errors (default: 1e-3)")
    parser.add_argument("--epochs", type=int, default=25, help="epochs of each training (default: 25)")
    parser.add_argument("--network", action="store_true", help="learn the potential too")
    parser.add_argument("--wrong", choices=("drag", "radius"), help="what is not told, or told wrong, of pucks")
    parser.add_argument("--seed", type=int, default=0, help="seed of the data (default: 0)")
    parser.add_argument("--out", type=Path, help="results (default: runs/calibration-TASK.jsonl)")
    options = parser.parse_args()
    configure_jax()
    name = f"calibration-{options.task}{'-network' if options.network else ''}.jsonl"
    path = options.out or Path("runs") / name
    settings = {k: v for k, v in vars(options).items() if k not in ("sets", "out")}
    sets, console = read_sets(path, settings)[: options.sets], Console()
    truth = None if options.task == "pucks" else carom.task(options.task)
    for seed in range(len(sets), options.sets):
        sets.append(one_world(options, seed) if truth is None else one_set(truth, options, seed))
        with path.open("a") as file:
            file.write(json.dumps(sets[-1]) + "\n")
        told = [e for e in sets[-1]["estimates"] if e["verdict"] == "identified"]
        console.print(
            f"set {seed + 1}/{options.sets}: {sum(map(covers, told))} of {len(told)} covered; learned in "
            f"{sets[-1]['learn']:.0f} s, identified in {sets[-1]['identify']:.0f} s",
            highlight=False,
        )
    verdicts = Counter((e["quantity"], e["verdict"]) for one in sets for e in one["estimates"])
    console.print(coverage_table(sets))
    for (quantity, verdict), count in sorted(verdicts.items()):
        console.print(f"{quantity}: {count} {verdict}", highlight=False)
    share, half = coverage(sets)
    console.print(f"coverage of what is called identified: {share:.1%} +- {half:.1%}. Sets: {path}", highlight=False)
    return 0 if 0.9 - half <= share <= 0.99 + half else 1


if __name__ == "__main__":
    sys.exit(main())
