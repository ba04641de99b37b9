"""Options of the benchmarks, and the table and JSON file that they end with."""

import importlib.metadata
import json
import os
import platform
from datetime import UTC, datetime
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

PACKAGES = ("carom", "jax", "jaxlib", "moreau", "moreau-cpu", "qpax", "cvxpylayers", "cvxpy", "diffcp")
PACKAGES += ("clarabel", "scs", "torch", "numpy", "scipy")


def pytest_addoption(parser):
    group = parser.getgroup("carom benchmarks")
    group.addoption(
        "--solver-json",
        type=Path,
        default=Path(__file__).parent / "results" / "solver.json",
        help="where bench_solver.py writes its results (default: benchmarks/results/solver.json)",
    )
    group.addoption(
        "--solver-batch", type=int, default=1000, help="problems in a batch of bench_solver.py (default: 1000)"
    )


_RESULTS = pytest.StashKey[list]()


def pytest_configure(config):
    config.stash[_RESULTS] = []


@pytest.fixture(scope="session")
def results(pytestconfig):
    """The list that bench_solver.py appends its rows to."""
    return pytestconfig.stash[_RESULTS]


def pytest_terminal_summary(terminalreporter, config):
    rows = config.stash[_RESULTS]
    if not rows:
        return
    _add_ratios(rows)
    report = {
        "benchmark": "forward and gradient of friction-cone problems in 3D, double precision",
        "batch": config.getoption("--solver-batch"),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine(),
        "versions": versions(),
        "results": rows,
    }
    path = config.getoption("--solver-json")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")

    write = terminalreporter.write_line
    terminalreporter.section("forward + gradient, friction-cone problems in 3D, double precision")
    write(f"batch {report['batch']}; {report['machine']}")
    write(", ".join(f"{name} {version}" for name, version in report["versions"].items()))
    write("")
    for line in table(rows):
        write(line)
    write("")
    for line in LEGEND:
        write(line)
    write(f"Written to {path}")


LEGEND = (
    "us: microseconds per problem, fastest round and median round; ratio: fastest round over that of carom.",
    "others: share of the machine's cores that other processes used meanwhile; above 5 % the row is not to be trusted.",
    "objective, limits: worst relative error of the objective and violation of the friction limits; gradient: median",
    "relative error of a directional derivative. All against Clarabel at 1e-12 on problems with the same limits.",
)


def table(rows):
    """The results as lines of text."""
    yield (
        f"{'contacts':>8}  {'tool':<12} {'us (min)':>9} {'us (med)':>9} {'ratio':>7} {'others':>7} "
        f"{'objective':>10} {'limits':>8} {'gradient':>9}  configuration"
    )
    for row in rows:
        start = f"{row['contacts']:>8}  {row['tool']:<12} "
        if row["status"] != "run":
            yield f"{start}{row['status']}: {row['reason']}"
            continue
        ratio = "-" if row["ratio_to_carom"] is None else f"{row['ratio_to_carom']:.1f}"
        others = "?" if row["others"] is None else f"{row['others']:.0%}"
        yield (
            f"{start}{row['us_min']:>9.1f} {row['us_median']:>9.1f} {ratio:>7} {others:>7} "
            f"{row['objective_error']:>10.0e} {row['violation']:>8.0e} {row['gradient_error']:>9.0e}  "
            f"{row['configuration']}"
        )


def _add_ratios(rows):
    own = {r["contacts"]: r["us_min"] for r in rows if r["tool"] == "carom" and r["status"] == "run"}
    for row in rows:
        if row["status"] == "run":
            base = own.get(row["contacts"])
            row["ratio_to_carom"] = None if base is None else row["us_min"] / base


def machine():
    """One line about the machine."""
    model = platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [x for x in cpuinfo.read_text(encoding="utf-8").splitlines() if x.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{model}, {cores} cores, {platform.system()}, Python {platform.python_version()}"


def versions():
    found = {}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found
