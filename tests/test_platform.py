"""The platform: what carom excludes in pyproject.toml must not be installed, and the doctor says so."""

import subprocess
import sys

import jax
import pytest

from carom.cli import doctor
from carom.cli.main import main


def test_batched_solves_of_one_program_do_not_block_one_another():
    """Versions of JAX in which this never returns are excluded in pyproject.toml."""
    subprocess.run([sys.executable, "-c", doctor.SOLVES_SIDE_BY_SIDE], check=True, timeout=120)


@pytest.fixture
def _light(monkeypatch):
    """The doctor's checks without those that take long and are tested above; JAX's settings are put back."""
    checks = {name: check for name, check in doctor.CHECKS.items() if name != "side by side"}
    monkeypatch.setattr(doctor, "CHECKS", checks)
    monkeypatch.setenv("CAROM_CACHE", "")
    cache = jax.config.jax_compilation_cache_dir
    yield
    jax.config.update("jax_compilation_cache_dir", cache)


@pytest.mark.slow
@pytest.mark.usefixtures("_light")
def test_the_doctor_finds_all_well(capsys):
    main(["doctor"])
    said = " ".join(capsys.readouterr().out.split())
    assert "All is well" in said
    assert said.count(" ok ") == len(doctor.CHECKS)
    assert "-0.800000" in said


@pytest.mark.usefixtures("_light")
def test_the_doctor_says_what_is_wrong(capsys, monkeypatch):
    quick = ("versions", "known hangs", "devices", "precision")
    monkeypatch.setattr(doctor, "CHECKS", {name: doctor.CHECKS[name] for name in quick})
    monkeypatch.setattr(doctor, "_version", lambda name: "0.10.2" if name == "jax" else "1.0")
    with pytest.raises(SystemExit) as stop:
        main(["doctor"])
    assert stop.value.code == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "WRONG" in said
    assert "waits forever" in said


@pytest.mark.parametrize(("version", "good"), [("0.9.2", True), ("0.10.0", False), ("0.11.0", False), ("0.11.1", True)])
def test_versions_that_hang_are_known(monkeypatch, version, good):
    monkeypatch.setattr(doctor, "_version", lambda name: version)
    assert doctor.hanging_version()[0] is good
