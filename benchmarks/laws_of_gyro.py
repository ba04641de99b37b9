"""How far the contact models LCP and Coulomb leave from each other in impacts of `gyro`, and what makes the difference.

`python -m benchmarks.laws_of_gyro`: the states before the impacts of trajectories made with LCP, one step by each. As
the tables S.4 and S.5 have it, then with one difference taken away at a time: friction pyramids (edges in place of 4),
restitution (Newton's and Poisson's are the same without it), friction (without it a contact has but one direction),
and what undoes penetration. Shares are of the jump of velocities, medians and means over impacts.
"""

import argparse
import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import carom
from carom.cli.main import configure_jax
from carom.contact.impulses import LCP
from carom.simulation.impact import COMPENSATION_STEPS, Stepper
from carom.simulation.rollout import step
from carom.tasks.gyroscopes import GYRO


class Case(NamedTuple):
    """What is taken away."""

    name: str
    facets: int = 4
    friction: float = 1.0
    restitution: float = 1.0
    compensation: bool = True


CASES = (
    Case("as in S.4 and S.5"),
    Case("32 edges of the pyramid", facets=32),
    Case("no restitution", restitution=0.0),
    Case("no restitution, 32 edges", facets=32, restitution=0.0),
    Case("no friction", friction=0.0),
    Case("penetration is not undone", compensation=False),
)


@eqx.filter_jit
def _after(system: carom.System, x, v, stepper: Stepper):
    return jax.vmap(lambda x, v: step(system, x, v, stepper).v)(x, v)


def differences(system: carom.System, x, v, case: Case) -> np.ndarray:
    """Differences of velocities after an impact as shares of its jump, in the metric of the mass."""
    system = eqx.tree_at(
        lambda s: (s.friction, s.restitution),
        system,
        (case.friction * system.friction, case.restitution * system.restitution),
    )
    steps = jnp.asarray(COMPENSATION_STEPS) if case.compensation else None
    stepper = Stepper(dt=jnp.asarray(GYRO.dt), compensation_steps=steps)
    free = _after(system, x, v, dataclasses.replace(stepper, contact=False))
    lcp = _after(system.with_contact_model(LCP(case.facets)), x, v, stepper)
    coulomb = _after(system.with_contact_model("coulomb"), x, v, stepper)
    size = jax.vmap(lambda v: jnp.sqrt(2 * system.kinetic_energy(v)))
    return np.asarray(size(lcp - coulomb) / size(lcp - free))


def impacts(trajectories: int):
    """The system, and its states before steps with an impact."""
    system = carom.task("gyro")
    data = carom.make_recording(system, jax.random.key(0), trajectories, contact_model="lcp")
    hit = np.argwhere(data.contact[:, 1:])
    before = tuple(hit.T)
    return system, jnp.asarray(data.x[before]), jnp.asarray(data.v[before])


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description="What makes LCP and Coulomb differ in impacts of gyro.")
    parser.add_argument("--trajectories", type=int, default=100, help="trajectories (default: 100)")
    options = parser.parse_args()
    configure_jax()
    system, x, v = impacts(options.trajectories)
    table = Table(title=f"LCP and Coulomb in {len(x)} impacts of gyro: differences, as shares of the jump")
    for name in ("", "median", "mean", "90 %"):
        table.add_column(name, justify="right" if name else "left")
    for case in CASES:
        shares = differences(system, x, v, case)
        shares = shares[np.isfinite(shares)]
        numbers = (np.median(shares), np.mean(shares), np.quantile(shares, 0.9))
        table.add_row(case.name, *(f"{number:.2%}" for number in numbers))
    Console().print(table)


if __name__ == "__main__":
    main()
