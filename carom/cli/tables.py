"""Tables on the terminal: learned against true, and how good the predictions are."""

from typing import Any

import numpy as np
from rich.table import Table

from carom.contact.impulses import CMr
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


def property_table(system: System, truth: System, touches: np.ndarray) -> Table:
    """Learned and true friction, restitution and mass ratios, with errors.

    `touches` (P,): recorded states in which a contact of each property is closed; few tell little.
    """
    table = Table(title="Learned and true")
    for name in ("quantity", "of"):
        table.add_column(name)
    for name in ("true", "learned", "error", "touches"):
        table.add_column(name, justify="right")
    names = property_names(system)
    for quantity in ("friction", "restitution"):
        learned, true = np.asarray(getattr(system, quantity)), np.asarray(getattr(truth, quantity))
        for k, name in enumerate(names):
            table.add_row(
                quantity,
                name,
                f"{true[k]:.4f}",
                f"{learned[k]:.5f}",
                f"{abs(learned[k] - true[k]):.1e}",
                str(touches[k]),
            )
    learned, true = mass_ratios(system), mass_ratios(truth)
    for k in range(1, len(true)):
        error = abs(learned[k] / true[k] - 1)
        table.add_row("mass ratio", f"{k} to 0", f"{true[k]:.4f}", f"{learned[k]:.5f}", f"{error:.1e} rel", "")
    if isinstance(system.contact_model, CMr):
        table.add_row("epsilon", "contact model", "", f"{float(system.contact_model.epsilon):.5f}", "", "")
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
