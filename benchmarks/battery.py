"""The solver on 100,000 and more random and degenerate problems, each judged from its data alone.

`python -m benchmarks.battery` runs every family of `tests/cone_problems.py` with 1 to 20 contacts in 2D and 3D, both
phases of an impact and problems with bounds of their own, and prints for each family the worst residual of the
optimality conditions in double and in single precision, and how far the objective is from Clarabel's on a sample. It
ends with exit code 1 if an impulse is not finite or a limit below is not kept. `--share 0.1` does a tenth of it.
"""

import argparse
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import carom
from carom.contact.cones import solve_cone_problem
from carom.contact.phases import two_phases
from tests.cone_problems import (
    FAMILIES,
    TINY,
    apply,
    clarabel_solution,
    generate,
    kkt_residual,
    objective,
    problem_scale,
)

ROOMS = (1, 2, 3, 4, 6, 10, 20)
DOUBLE, SINGLE, OBJECTIVE = 1e-8, 1e-4, 1e-8
"""Largest residuals that pass, and by how much an objective may exceed Clarabel's, relative to the problem's scale."""

_own = jax.jit(solve_cone_problem)
_phases = jax.jit(two_phases)


def solved(problems, dtype):
    """The problems of a batch in three forms, `(A, v, friction, lower, f, reference)`: own bounds and both phases."""
    A, v, friction, restitution, v_star, lower = (np.asarray(x, dtype) for x in problems)
    own = _own(*map(jnp.asarray, (A, v, friction, lower))).impulse
    compression, rebound = (
        np.asarray(s.impulse) for s in _phases(*map(jnp.asarray, (A, v, friction, restitution, v_star)))
    )
    exact = [np.asarray(x, np.float64) for x in (A, v, friction, lower, own, compression, rebound)]
    A, v, friction, lower, own, compression, rebound = exact
    after = v + apply(A, compression) - v_star
    bound = restitution * np.maximum(compression[..., 0], 0)
    yield "own bounds", (A, v, friction, lower, own, None)
    yield "compression", (A, v, friction, np.zeros_like(lower), compression, None)
    yield "restitution", (A, after, friction, bound, rebound, v)


def objective_excess(A, v, friction, lower, f):
    """How far the objective of `f` is above Clarabel's, relative to the problem's scale and impulse; (B,).

    Less the rounding of Clarabel's own value: of a singular `A` it may return an impulse a thousand times larger than
    any needed, and what the rounding of `A` (which can leave a negative eigenvalue) makes of such an impulse decides
    nothing.
    """
    with ThreadPoolExecutor(2) as pool:
        values = list(pool.map(lambda p: clarabel_solution(*p), zip(A, v, friction, lower, strict=True)))
    impulse = np.array([impulse for impulse, *_ in values])
    other = np.array([value for _, value, _ in values])
    solved = np.array([status in ("Solved", "AlmostSolved") for *_, status in values])
    rounding = np.finfo(np.float64).eps * np.sum(np.abs(impulse) * apply(np.abs(A), np.abs(impulse)), axis=(1, 2))
    own = objective(A, v, f)
    scale = np.maximum(problem_scale(A, v, friction, lower) ** 2, np.abs(own))
    return np.where(solved, (own - other - rounding) / np.where(scale > TINY, scale, 1), np.nan)


def main() -> int:
    """Run the battery; 1 if anything failed."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--share", type=float, default=1.0, help="share of the battery to run (default: 1.0)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the problems (default: 0)")
    parser.add_argument(
        "--clarabel", type=int, default=40, help="problems a batch compared with Clarabel (default: 40)"
    )
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    batch = max(8, round(320 * options.share))
    console, started, total, failed, compared, unknown = Console(), time.monotonic(), 0, 0, 0, 0
    table = Table(title="largest values by family, over 1 to 20 contacts in 2D and 3D")
    for name in ("family", "problems", "not finite", "KKT, double", "99.9 %", "KKT, single", "objective - Clarabel"):
        table.add_column(name, justify="left" if name == "family" else "right")
    for number, family in enumerate(FAMILIES):
        rng = np.random.default_rng([options.seed, number])
        residual, single, excess, lost = [], [], [], 0
        for d in (2, 3):
            for room in ROOMS:
                problems = generate(rng, family, batch, room, d)
                for form, (A, v, friction, lower, f, reference) in solved(problems, np.float64):
                    worst = kkt_residual(A, v, friction, lower, f, reference)
                    residual.append(worst)
                    lost += int(np.sum(~np.isfinite(f).all((1, 2))))
                    if not (worst <= DOUBLE).all():
                        k = int(np.nanargmax(worst))
                        console.print(
                            f"{family}, {d}D, {room} contacts, {form}: problem {k} has {worst[k]:.1e}, "
                            f"{int(np.sum(~(worst <= DOUBLE)))} of {len(worst)} are above {DOUBLE}"
                        )
                    if form != "restitution":
                        some = slice(0, options.clarabel)
                        excess.append(objective_excess(*(x[some] for x in (A, v, friction, lower, f))))
                for _, (A, v, friction, lower, f, reference) in solved(problems, np.float32):
                    single.append(kkt_residual(A, v, friction, lower, f, reference))
                    lost += int(np.sum(~np.isfinite(f).all((1, 2))))
        residual, single, excess = (np.concatenate(x) for x in (residual, single, excess))
        total += len(residual) + len(single)
        compared, unknown = compared + len(excess), unknown + int(np.isnan(excess).sum())
        failed += lost + int(np.sum(~(residual <= DOUBLE)) + np.sum(~(single <= SINGLE)) + np.sum(excess > OBJECTIVE))
        table.add_row(
            family,
            str(len(residual) + len(single)),
            str(lost),
            f"{residual.max():.0e}",
            f"{np.quantile(residual, 0.999):.0e}",
            f"{single.max():.0e}",
            f"{np.nanmax(excess):.0e}",
        )
        console.print(f"{family}: {len(residual)} problems, {time.monotonic() - started:.0f} s", highlight=False)
    console.print(table)
    console.print(
        f"{total} problems, {compared} compared with Clarabel ({unknown} that it did not solve left out), "
        f"{failed} failures; carom {carom.__version__}, {time.monotonic() - started:.0f} s",
        highlight=False,
    )
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
