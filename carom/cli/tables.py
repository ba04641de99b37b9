"""Tables on the terminal: learned against true, and how good the predictions are."""

from typing import Any

import numpy as np
from rich.table import Table

from carom.learning.baselines import physical_quantities
from carom.learning.identify import Estimate, Identification
from carom.learning.models import mass_ratios
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


def property_table(system: System, truth: System, found: Identification | None) -> Table:
    """Learned and true friction, restitution and mass ratios, with errors, and what the data tell of each, if known.

    `impacts` are all of the data, `telling` those looked at on which the quantity has an effect.
    """
    table = Table(title="Learned and true")
    for name in ("quantity", "of"):
        table.add_column(name)
    for name in ("true", "learned", "error", "impacts", "telling", "refined +- 95 %"):
        table.add_column(name, justify="right")
    table.add_column("told")
    names = property_names(system)
    has = physical_quantities(system)
    for quantity in (name for name in ("friction", "restitution") if name in has):
        learned, true = np.asarray(getattr(system, quantity)), np.asarray(getattr(truth, quantity))
        told = getattr(found, quantity, None) or [None] * len(names)
        impacts = [str(count) for count in found.impacts] if found else [""] * len(names)
        for k, name in enumerate(names):
            error = f"{abs(learned[k] - true[k]):.1e}"
            table.add_row(quantity, name, f"{true[k]:.4f}", f"{learned[k]:.5f}", error, impacts[k], *_told(told[k]))
    learned, true = mass_ratios(system), mass_ratios(truth)
    told = getattr(found, "mass_ratio", None) or [None] * (len(true) - 1)
    for k in range(1, len(true) if "mass" in has else 1):
        error = f"{abs(learned[k] / true[k] - 1):.1e} rel"
        row = ("mass ratio", f"{k} to 0", f"{true[k]:.4f}", f"{learned[k]:.5f}", error, "")
        table.add_row(*row, *_told(told[k - 1]))
    return table


def _told(estimate: Estimate | None) -> tuple[str, str, str]:
    """How many impacts tell of a quantity, its value with half of its 95 % interval, and the verdict."""
    if estimate is None:
        return "", "", ""
    impacts = "" if estimate.impacts is None else str(estimate.impacts)
    if estimate.verdict == "bounded below":
        return impacts, "", f">= {estimate.bound:.3f}"
    if estimate.verdict == "bounded above":
        return impacts, "", f"<= {estimate.bound:.3f}"
    interval = f"{estimate.value:.4f} +- {1.96 * estimate.standard_error:.1g}"
    return impacts, interval, "yes" if estimate.verdict == "identified" else "no"


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
