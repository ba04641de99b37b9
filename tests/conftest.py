"""What every test shares: precision, run-time type checks, compilation cache, the --slow option."""

import os
import sys
import time
from pathlib import Path

# XLA logs pages about the processor for each program it loads from the cache.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# Half of the time to compile, for gradients that take a fifth longer: tests compile more than they compute. Commands
# that tests start inherit it; the smoke runs of .ci/run do not.
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_use_fusion_emitters=false".strip()

import jax
import jaxtyping
import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent
CACHE_DAYS = 14

# The checks are put in while a module is imported, so no module of carom may have been before.
assert "carom" not in sys.modules, "carom was imported before tests/conftest.py could instrument it"
jaxtyping.install_import_hook("carom", "beartype.beartype")

from carom.cli.cache import use_compilation_cache  # noqa: E402 - not before the hook

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


def _use_compilation_cache() -> None:
    """Keeps compiled programs between runs, outside of the repository: most of a run's time."""
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    try:
        (caches / "carom-test-jax").mkdir(parents=True, exist_ok=True)
    except OSError:
        return  # no writable home: the tests only take longer
    cache = use_compilation_cache(caches / "carom-test-jax")
    # jax never removes an entry, and every edit of a function under test leaves one behind.
    oldest = time.time() - CACHE_DAYS * 86_400
    for entry in cache.glob("*-cache") if cache is not None else ():
        if entry.stat().st_mtime < oldest:
            entry.unlink(missing_ok=True)


_use_compilation_cache()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--slow",
        choices=("none", "ci", "all"),
        default="ci",
        help="which tests marked slow (over 5 s) to run: none, those also marked ci_budget (ci, the default), or all",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    chosen = config.getoption("--slow")
    for item in items:
        slow = item.get_closest_marker("slow") is not None
        in_budget = item.get_closest_marker("ci_budget") is not None
        if in_budget and not slow:
            raise pytest.UsageError(f"{item.nodeid}: a ci_budget test must be marked slow too")
        if slow and (chosen == "none" or (chosen == "ci" and not in_budget)):
            needed = "--slow=ci or --slow=all" if in_budget else "--slow=all"
            reason = f"slow; run it with {needed} (this run: --slow={chosen})"
            item.add_marker(pytest.mark.skip(reason=reason))


@pytest.fixture(scope="module", autouse=True)
def _compiled_programs_of_one_file():
    """Lets go of compiled programs, which are gigabytes by the end of a run; few are used by two files."""
    yield
    jax.clear_caches()


@pytest.fixture(scope="session")
def reference_dir() -> Path:
    """The folder of recorded data that carom did not make; skips where it is not at hand."""
    named = os.environ.get("CAROM_REFERENCE_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    if folder.is_dir():
        return folder
    if named:
        pytest.fail(f"CAROM_REFERENCE_DATA is {named!r}, which is not a folder", pytrace=False)
    pytest.skip("no reference data; set CAROM_REFERENCE_DATA to its folder")


@pytest.fixture(scope="session")
def cp3():
    """The task `cp3`."""
    import carom

    return carom.task("cp3")


@pytest.fixture(scope="session")
def cp3_data(cp3):
    """24 trajectories of `cp3`, a quarter of them to validate on."""
    import carom

    return carom.Dataset.split(carom.make_recording(cp3, jax.random.key(0), 24), val=0.25)


@pytest.fixture(scope="session")
def cube_tosses():
    """60 simulated tosses of the task `cube`, at 148 Hz: positions, velocities (60, 61, 4, 3), and contact (60, 61)."""
    import carom

    cube = carom.task("cube").with_max_active(4)
    x0, v0 = carom.sample(cube, jax.random.key(3), 60)
    motion = carom.simulate(cube, x0, v0, dt=1 / 148, steps=60, impact="event")
    return tuple(np.array(part) for part in (motion.x, motion.v, motion.contact))
