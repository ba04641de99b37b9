"""Impacts of many contacts: Coulomb's law on 10,000 random problems, its cost beside CM's, energy in 5,000 impacts.

`python -m benchmarks.impacts` prints, in double precision and for each number of contacts (1 to 8, in 2D and 3D,
friction up to 2, singular and degenerate problems among them): in how many problems the law is missed by more than 1e-8
as NumPy sees it and as the solver says; the time of a solve beside that of CM's on the same batch, in one run; and the
largest gain of energy, relative to that of the contacts, by impacts with restitutions of 0 to 1. It ends with exit code
1 if a miss is silent, or energy is gained. `--share 0.1` does a tenth of it.
"""

import argparse
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import carom
from carom.contact.cones import solve_cone_problem
from carom.contact.coulomb import solve_coulomb_problem
from tests.cone_problems import FAMILIES, generate, law, rigid_bodies
from tests.contact_states import gains

MOST = 8
PROBLEMS, IMPACTS = 10_000, 5_000
MISSED, SILENT, GAIN = 1e-8, 1e-7, 1e-10


def problems(rng: np.random.Generator, count: int, d: int, contacts: int):
    """Matrices, velocities and frictions of about `count` problems with so many contacts: families and bodies."""
    each = max(count // (len(FAMILIES) + 2), 1)
    made = [generate(rng, family, each, MOST, d, contacts) for family in FAMILIES]
    drawn = [(p.A, p.v, p.friction) for p in made]
    drawn += [rigid_bodies(rng, 2 * each, MOST, d, contacts)]
    return tuple(np.concatenate(part) for part in zip(*drawn, strict=True))


def seconds(solve, *arrays) -> float:
    """The least time of five solves, compiled before."""
    jax.block_until_ready(solve(*arrays))
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        jax.block_until_ready(solve(*arrays))
        times.append(time.perf_counter() - begun)
    return min(times)


def gain_of_energy(rng: np.random.Generator, made, model) -> float:
    """The largest gain, relative to the energy of the contacts' velocities, of impacts that were solved."""
    A, v, mu = made
    problem = generate(rng, "gaussian", len(v), v.shape[1], v.shape[2])
    problem = problem._replace(A=A, v=v, friction=mu, v_star=0 * v, restitution=rng.uniform(0, 1, mu.shape))
    gained, residual = gains(problem, model)
    return float(np.max(np.where(residual < MISSED, gained, 0)))


def main() -> int:
    """Run it; 1 if a miss is silent or energy is gained."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--share", type=float, default=1.0, help="share of the problems (default: 1.0)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the problems (default: 0)")
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rng, models = np.random.default_rng(options.seed), (carom.Coulomb(), carom.CM())
    coulomb, cm = jax.jit(solve_coulomb_problem), jax.jit(solve_cone_problem)
    console = Console()
    table = Table(title="impacts of many contacts")
    for column in ("contacts", "problems", "missed", "of these silent", "time / CM's", "gain, coulomb", "gain, cm"):
        table.add_column(column, justify="right")
    failed, missed_in_all, all_problems = False, 0, 0
    for d in (2, 3):
        for contacts in range(1, MOST + 1):
            made = problems(rng, round(options.share * PROBLEMS / (2 * MOST)), d, contacts)
            arrays = tuple(map(jnp.asarray, made))
            out = coulomb(*arrays)
            off, reported = law(*made, np.asarray(out.impulse)), np.asarray(out.residual)
            missed = (off > MISSED) | (reported > MISSED)
            silent = (off > SILENT) & (reported <= MISSED)
            ratio = seconds(coulomb, *arrays) / seconds(cm, *arrays)
            some = tuple(part[: round(len(made[1]) * IMPACTS / PROBLEMS)] for part in made)
            gained = [gain_of_energy(rng, some, model) for model in models]
            failed |= bool(silent.any()) or max(gained) > GAIN
            missed_in_all, all_problems = missed_in_all + int(missed.sum()), all_problems + len(missed)
            cells = (f"{contacts} in {d}D", len(missed), int(missed.sum()), int(silent.sum()), f"{ratio:.1f}")
            table.add_row(*map(str, cells), *(f"{gain:.0e}" for gain in gained))
            console.print(f"{contacts} contacts in {d}D: {int(missed.sum())} of {len(missed)} missed", highlight=False)
    console.print(table)
    console.print(f"Coulomb's law holds in {1 - missed_in_all / all_problems:.2%} of {all_problems} problems.")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
