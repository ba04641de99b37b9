"""Tables on the terminal: learned against true, and how good the predictions are."""

from collections.abc import Iterable
from typing import Any

import numpy as np
from rich.table import Table

from carom.contact.impulses import CMr
from carom.learning.estimation.identify import Estimate, Identification
from carom.learning.unknowns.baselines import physical_quantities
from carom.learning.unknowns.models import mass_ratios
from carom.learning.unknowns.quantities import describe
from carom.recordings.recording_checks import Finding
from carom.system import System


def property_names(system: System) -> list[str]:
    """What each contact property belongs to, in words."""
    owners: list[list[str]] = [[] for _ in range(system.n_properties)]
    for contact in system.contacts:
        for name, index in zip(contact.names(), contact.property_index, strict=True):
            owners[index].append(name)
    return [
        names[0] if len(names) == 1 else "all contacts" if len(owners) == 1 else f"{names[0]} ..." for names in owners
    ]


def property_table(system: System, truth: System, file: str = "") -> Table:
    """Learned and true friction, restitution and mass ratios, with errors; those that the system has.

    `file`: where numbers to compare with are from that need not be true.
    """
    table = Table(title=f"Learned, and as {file} has them" if file else "Learned and true")
    for name in ("quantity", "of"):
        table.add_column(name)
    for name in ("in the file", "learned", "difference") if file else ("true", "learned", "error"):
        table.add_column(name, justify="right")
    names = property_names(system)
    has = physical_quantities(system)
    for quantity in (name for name in ("friction", "restitution") if name in has):
        learned, true = np.asarray(getattr(system, quantity)), np.asarray(getattr(truth, quantity))
        for k, name in enumerate(names):
            error = f"{abs(learned[k] - true[k]):.1e}"
            table.add_row(quantity, name, f"{true[k]:.4f}", f"{learned[k]:.5f}", error)
    learned, true = mass_ratios(system), mass_ratios(truth)
    for k in range(1, len(true) if "mass" in has else 1):
        error = f"{abs(learned[k] / true[k] - 1):.1e} rel"
        table.add_row("mass ratio", f"{k} to 0", f"{true[k]:.4f}", f"{learned[k]:.5f}", error)
    if isinstance(system.contact_model, CMr):
        table.add_row("epsilon", "contact model", "", f"{float(system.contact_model.epsilon):.5f}", "")
    return table


def told_table(system: System, found: Identification) -> Table:
    """What the data tell of each quantity that was learned.

    `impacts` are all of the data, `telling` those of them that were looked at on which the quantity has an effect.
    """
    table = Table(title="What the data tell")
    for name in ("quantity", "of"):
        table.add_column(name)
    for name in ("impacts", "telling", "refined +- 95 %"):
        table.add_column(name, justify="right")
    table.add_column("told")
    names, impacts = property_names(system), [str(count) for count in found.impacts]
    for quantity in ("friction", "restitution"):  # no estimates of one that was not learned
        for name, count, estimate in zip(names, impacts, getattr(found, quantity), strict=False):
            table.add_row(quantity, name, count, *_told(estimate))
    for k, estimate in enumerate(found.mass_ratio, 1):
        table.add_row("mass ratio", f"{k} to 0", "", *_told(estimate))
    return table


def _told(estimate: Estimate) -> tuple[str, str, str]:
    """How many impacts tell of a quantity, its value with half of its 95 % interval, and the verdict."""
    impacts = "" if estimate.impacts is None else str(estimate.impacts)
    if estimate.verdict == "bounded below":
        return impacts, "", f">= {estimate.bound:.3f}"
    if estimate.verdict == "bounded above":
        return impacts, "", f"<= {estimate.bound:.3f}"
    interval = f"{max(estimate.value, 0.0):.4f} +- {1.96 * estimate.standard_error:.1g}"  # never -0.0000
    return impacts, interval, "yes" if estimate.verdict == "identified" else "no"


def findings_table(title: str, findings: Iterable[Finding]) -> Table:
    """What checks of data found, and what to do about it."""
    table = Table(title=title)
    for name in ("check", "found", "what to do"):
        table.add_column(name)
    for finding in findings:
        table.add_row(*finding)
    return table


def quantities_table(system: System) -> Table:
    """Everything that can be learned of a system, with the values that it has."""
    table = Table(title="What can be learned, by name")
    table.add_column("quantity", no_wrap=True)
    table.add_column("of")
    table.add_column("value", justify="right")
    table.add_column("unit")
    for row in describe(system):
        table.add_row(*row)
    return table


MEASURES = {
    "trajectory_error": "trajectory relative error, mean",
    "trajectory_error_ci95": "  95 % interval of the mean, +-",
    "trajectory_error_median": "trajectory relative error, median",
    "trajectory_error_geometric": "trajectory relative error, geometric mean",
    "bounded_error": "bounded relative error, mean",
    "energy_drift": "energy drift, relative, largest",
    "constraint_error": "constraint error, largest (m^2)",
}


def evaluation_table(measures: dict[str, Any]) -> Table:
    """What `evaluate` measured."""
    table = Table(title=f"Predictions of {measures['trajectories']} test trajectories, {measures['steps']} steps each")
    table.add_column("measure")
    table.add_column("value", justify="right")
    for key, name in MEASURES.items():
        if measures.get(key) is not None:
            table.add_row(name, f"{measures[key]:.2e}")
    return table
