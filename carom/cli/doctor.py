"""`carom doctor`: is this machine fit for carom? Versions, devices, precision, and a check of solver and gradients."""

import dataclasses
import importlib.metadata
import os
import subprocess
import sys
import time
from collections.abc import Callable

from rich.console import Console
from rich.table import Table

PACKAGES = ("jax", "jaxlib", "equinox", "diffrax", "lineax", "optax", "orbax-checkpoint", "numpy", "h5py", "tyro")
EXTRAS = ("imageio-ffmpeg", "mujoco", "optuna")
HANGS = ((0, 10, 0), (0, 11, 0))
"""From the first to the second: versions of JAX that wait forever on machines with few cores."""
SOLVES_SIDE_BY_SIDE = (
    "import jax, jax.numpy as jnp; jax.config.update('jax_enable_x64', True); "
    "A = jnp.eye(6) + jnp.zeros((1000, 6, 6)); b = jnp.ones((1000, 6, 1)); "
    "jax.block_until_ready(jax.jit(lambda A, b: [jnp.linalg.solve(A + k, b) for k in range(3)])(A, b))"
)
"""A program that never returns in these versions."""
PATIENCE = 60
"""Seconds that it may take."""


@dataclasses.dataclass(frozen=True)
class Doctor:
    """Check versions, devices, precision, the contact solver and its gradients on this machine.

    Takes half a minute the first time, then some seconds. Exit code 1 if something is wrong.
    """

    def run(self) -> None:
        """Do it."""
        console = Console()
        table = Table("check", "found", "", title="carom doctor")
        good = True
        for name, check in CHECKS.items():
            started = time.monotonic()
            try:
                ok, found = check()
            except Exception as error:
                ok, found = False, f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
            good &= ok
            table.add_row(name, f"{found} ({time.monotonic() - started:.1f} s)", "ok" if ok else "[bold red]WRONG")
        console.print(table)
        if not good:
            console.print("Something is wrong: see the rows above.", highlight=False)
            sys.exit(1)
        console.print("All is well.")


def _version(name: str) -> str:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "-"


def versions() -> tuple[bool, str]:
    """Of Python and of the packages that results depend on."""
    found = {name: _version(name) for name in ("carom", *PACKAGES)}
    extras = {name: _version(name) for name in EXTRAS}
    missing = [name for name, version in found.items() if version == "-" and name != "carom"]
    listed = ", ".join(f"{name} {version}" for name, version in {**found, **extras}.items())
    return not missing, f"Python {sys.version.split()[0]}, {listed}"


def hanging_version() -> tuple[bool, str]:
    """Whether the version of JAX is one that is known to hang."""
    version = tuple(int("".join(c for c in part if c.isdigit()) or 0) for part in _version("jax").split(".")[:3])
    if HANGS[0] <= version <= HANGS[1]:
        return False, f"jax {_version('jax')} waits forever on few cores: pip install 'jax>=0.11.1' or 'jax<0.10'"
    return True, f"jax {_version('jax')} is none of those that hang"


def side_by_side() -> tuple[bool, str]:
    """Whether batched solves of one program block one another."""
    try:
        subprocess.run([sys.executable, "-c", SOLVES_SIDE_BY_SIDE], check=True, timeout=PATIENCE, capture_output=True)
    except subprocess.TimeoutExpired:
        return False, f"no answer within {PATIENCE} s: another version of jax is needed"
    return True, "batched solves do not block one another"


def devices() -> tuple[bool, str]:
    """What JAX computes on, and where compiled programs are kept."""
    import jax

    listed = ", ".join(str(device) for device in jax.devices())
    cache = getattr(jax.config, "jax_compilation_cache_dir", None) or "none (CAROM_CACHE)"
    return True, f"{jax.default_backend()}: {listed}; {os.cpu_count()} cores; compiled programs in {cache}"


def precision() -> tuple[bool, str]:
    """Whether double precision is what it should be."""
    import jax.numpy as jnp

    third = jnp.asarray(1.0) / 3
    off = abs(float(third * 3 - 1))
    return (
        third.dtype == jnp.float64 and off < 1e-15,
        f"{third.dtype}, machine epsilon {jnp.finfo(third.dtype).eps:.1e}",
    )


def solver() -> tuple[bool, str]:
    """Optimality of impulses of random contact problems, of one contact in 2D and of four in 3D."""
    import jax.numpy as jnp
    import numpy as np

    from carom.contact.cones import solve_cone_problem

    rng, worst = np.random.default_rng(0), 0.0
    for d, k in ((2, 1), (3, 4)):
        factor = rng.normal(size=(100, k * d, k * d))
        A = jnp.asarray(factor @ factor.transpose(0, 2, 1) / (k * d))
        v = jnp.asarray(rng.normal(size=(100, k, d)))
        friction = jnp.asarray(rng.uniform(0, 1, size=(100, k)))
        worst = max(worst, float(jnp.max(solve_cone_problem(A, v, friction, jnp.zeros((100, k))).residual)))
    return worst < 1e-8, f"200 random contact problems: largest residual {worst:.1e}"


def gradients() -> tuple[bool, str]:
    """Implicit derivatives of an impulse against differences."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    from carom import solve_impulse

    rng = np.random.default_rng(1)
    factor = rng.normal(size=(6, 6))
    A, v = jnp.asarray(factor @ factor.T + np.eye(6)), jnp.asarray(rng.normal(size=(2, 3)) - np.array([2.0, 0, 0]))
    friction, lower, h = jnp.array([0.1, 0.9]), jnp.zeros(2), 1e-6

    def impulse(v):
        return solve_impulse(A, v, friction, lower)

    direction = jnp.asarray(rng.normal(size=(2, 3)))
    _, exact = jax.jvp(impulse, (v,), (direction,))
    differences = (impulse(v + h * direction) - impulse(v - h * direction)) / (2 * h)
    off = float(jnp.max(jnp.abs(exact - differences)) / jnp.max(jnp.abs(exact)))
    return off < 1e-5, f"derivatives of impulses against differences: off by {off:.1e}"


def bounce() -> tuple[bool, str]:
    """A ball that falls on a floor: d x(T) / d x(0) is -e."""
    import jax
    import jax.numpy as jnp

    from carom import DiskPlane, PointMass, System, simulate

    floor = DiskPlane([0], point=(0.0, 0.0), normal=(0.0, 1.0))
    system = System(bodies=[PointMass(mass=1.0, radius=0.1)], contacts=[floor], restitution=0.8)

    def end(height):
        x0, v0 = jnp.stack([jnp.zeros(()), height])[None], jnp.array([[0.0, -1.0]])
        return simulate(system, x0, v0, dt=0.05, steps=10, impact="event").x[-1, 0, 1]

    slope = float(jax.grad(end)(jnp.asarray(0.3)))
    return abs(slope + 0.8) < 1e-6, f"d x(T) / d x(0) through a bounce with e = 0.8: {slope:.6f}"


CHECKS: dict[str, Callable[[], tuple[bool, str]]] = {
    "versions": versions,
    "known hangs": hanging_version,
    "side by side": side_by_side,
    "devices": devices,
    "precision": precision,
    "contact solver": solver,
    "gradients": gradients,
    "impact": bounce,
}
"""By name: whether it is well, and what was found."""
