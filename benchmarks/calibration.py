"""Do the 95 % intervals of `identify` hold the true values? Repeated noisy data sets, each learned, then identified.

`python -m benchmarks.calibration bp5` (masses, friction, restitution; the forces are known) and
`python -m benchmarks.calibration cp3 --network` (the potential is learned too). Each set has its own initial states,
and normal errors of `--noise` on every recorded position (m) and velocity (m/s). Contact flags are not recorded:
contacts must be found in the noisy positions. Trajectories are few, so that some properties are rarely seen: those must
not be called identified, or be covered all the same. `--epochs 0` starts from the true values moved by about 0.03
rather than from learned ones. Exit status 1 if the coverage is not within 90 to 99 %, as far as the number of sets can
tell (its own 95 % interval).
"""

import argparse
import sys
import time
from collections import defaultdict

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import carom
from carom.learning.dataset import Dataset
from carom.learning.identify import Estimate, Identification, identify
from carom.learning.models import mass_ratios
from carom.learning.train import Quantity


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


def one_set(truth: carom.System, options: argparse.Namespace, seed: int) -> tuple[Identification, float, float]:
    """Learn one data set and identify it; also the seconds that both took."""
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
    return identify(system, data, learned=learned), between - started, time.monotonic() - between


def with_truth(found: Identification, truth: carom.System) -> list[tuple[str, int, Estimate, float]]:
    """Every estimate with its quantity, index and true value."""
    values = {"friction": truth.friction, "restitution": truth.restitution, "mass_ratio": mass_ratios(truth)[1:]}
    return [
        (name, k, estimate, float(true))
        for name, numbers in values.items()
        for k, (estimate, true) in enumerate(zip(getattr(found, name), np.asarray(numbers), strict=True))
    ]


def main() -> int:
    """Run it; 1 if the intervals are not calibrated."""
    parser = argparse.ArgumentParser(description="Coverage of the intervals of identify.")
    parser.add_argument("task", nargs="?", default="bp5", help="task (default: bp5)")
    parser.add_argument("--sets", type=int, default=20, help="data sets (default: 20)")
    parser.add_argument("--trajectories", type=int, default=100, help="trajectories in each (default: 100)")
    parser.add_argument("--noise", type=float, default=1e-3, help="standard deviation of the errors (default: 1e-3)")
    parser.add_argument("--epochs", type=int, default=25, help="epochs of each training (default: 25)")
    parser.add_argument("--network", action="store_true", help="learn the potential too")
    parser.add_argument("--seed", type=int, default=0, help="seed of the data (default: 0)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    truth, console = carom.task(options.task), Console()
    verdicts: dict[tuple[str, str], int] = defaultdict(int)
    covered, scores = defaultdict(list), defaultdict(list)
    for seed in range(options.sets):
        found, learning, identifying = one_set(truth, options, seed)
        inside = []
        for name, _, estimate, true in with_truth(found, truth):
            verdicts[name, estimate.verdict] += 1
            if estimate.verdict == "identified":
                inside.append(estimate.lower <= true <= estimate.upper)
                covered[name].append(inside[-1])
                scores[name].append((estimate.value - true) / estimate.standard_error)
            elif estimate.bound is not None:
                covered[f"{name} ({estimate.verdict})"].append(estimate.lower <= true <= estimate.upper)
        covered["sets"].append(np.mean(inside) if inside else np.nan)
        console.print(
            f"set {seed}: {sum(inside)} of {len(inside)} covered; learned in {learning:.0f} s, identified in "
            f"{identifying:.0f} s",
            highlight=False,
        )
    sets = np.array(covered.pop("sets"))
    console.print(_table(covered, scores), dict(verdicts))
    share = np.mean(np.concatenate([part for name, part in covered.items() if name in scores]))
    half = 1.96 * np.nanstd(sets) / np.sqrt(len(sets))
    console.print(f"coverage of what is called identified: {share:.1%} +- {half:.1%}", highlight=False)
    return 0 if 0.9 - half <= share <= 0.99 + half else 1


def _table(covered, scores) -> Table:
    table = Table(title="95 % intervals")
    for name in ("quantity", "intervals", "cover", "mean of error / standard error", "its standard deviation"):
        table.add_column(name, justify="left" if name == "quantity" else "right")
    for name, part in covered.items():
        z = np.array(scores.get(name, [np.nan]))
        table.add_row(name, str(len(part)), f"{np.mean(part):.1%}", f"{z.mean():.2f}", f"{z.std():.2f}")
    return table


if __name__ == "__main__":
    sys.exit(main())
