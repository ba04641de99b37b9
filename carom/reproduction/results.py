"""From finished trainings to the cells of a table, beside the paper's, and what a written table has already."""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from carom.checks import require
from carom.errors import CaromError
from carom.reproduction.jobs import Job
from carom.reproduction.tables import Cell, Table
from carom.tasks import find_task

ZERO = 1e-4
"""A printed error of zero is met, and beaten, by one of at most this."""
TIMES_BETTER = 3.0
OVER_TIME = ("state", "energy")
"""Quantities whose errors over time are kept."""
QUANTITIES = ("mu", "e")
"""Contact properties, as columns name them: `gyro mu`, `bp5 e[3]`."""


def deviation(cell: Cell, value: float) -> float:
    """How far a number is from what it ought to be: its own size for an error, relative for ratios above 1."""
    if cell.kind == "error":
        return abs(value)
    return abs(value - cell.true) / max(abs(cell.true), 1.0)


def measured(cell: Cell, values: list[float | None], errors: list[float | None] | None = None) -> dict[str, Any]:
    """A cell's entry: mean over seeds, half of its 95 % interval (Student's t), error, the paper's, and their ratio.

    `verdict`: "better" (by `TIMES_BETTER`), "met", "worse", or "" where there is nothing to compare with; `counted`,
    whether it counts. `errors`: standard errors, by seed, where there are any.
    """
    found = [float(v) for v in values if v is not None]
    finite = bool(found) and len(found) == len(values) and bool(np.all(np.isfinite(found)))
    mean = float(np.mean(found)) if finite else None
    spread = None
    if finite and len(found) > 1:
        spread = float(stats.t.ppf(0.975, len(found) - 1) * np.std(found, ddof=1) / np.sqrt(len(found)))
    # The error of a cell is the mean of its seeds' errors: that of their mean would be too kind.
    error = float(np.mean([deviation(cell, v) for v in found])) if finite else None
    paper_error = None if cell.paper is None else deviation(cell, cell.paper)
    out: dict[str, Any] = {
        "row": cell.row,
        "column": cell.column,
        "kind": cell.kind,
        "true": cell.true if cell.kind == "property" else None,
        "paper": cell.paper,
        "carom": mean,
        "ci95": spread,
        "seeds": len(values),
        "error": error,
        "paper_error": paper_error,
        "ratio": None,
        "verdict": "",
        "note": cell.note,
        "counted": cell.counted,
    }
    known = [e for e in errors or [] if e is not None]
    if known:
        out["standard_error"] = float(np.mean(known))
    if cell.job is None or paper_error is None:
        return out
    if error is None:
        return {**out, "verdict": "worse", "note": "not finite"}
    if paper_error < 1e-12:
        out["verdict"] = "better" if error <= ZERO else "worse"
    else:
        out["ratio"] = error / paper_error
        out["verdict"] = (
            "better" if out["ratio"] <= 1 / TIMES_BETTER else "met" if out["ratio"] <= 1 + 1e-9 else "worse"
        )
    return out


def collect(
    table: Table,
    reports: dict[Job, dict[str, Any]],
    *,
    seeds: int,
    quick: bool,
    earlier: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """All cells of a table, by the seeds that have a report, with where they come from.

    `earlier`: the table as it was written before. What it has of trainings with the same settings stays, where there is
    no report of them now: of more seeds than `seeds`, too.
    """
    seeds = max([seeds, *(1 + int(name.rpartition("-seed")[2]) for name in (earlier or {"runs": {}})["runs"])])
    kept = {} if earlier is None else known(table, earlier, seeds, quick=quick)
    kept = {job: run for job, run in kept.items() if job not in reports}
    before = _written_by_place(earlier, "cells")
    cells = []
    for cell in table.cells:
        found = _by_seed(cell, functools.partial(_entry, cell), reports, kept, before, seeds)
        if found:
            entry = measured(cell, _column(found, "value"), _column(found, "standard_error"))
            if entry["carom"] is None:
                entry |= _mean_of_all("bounded", found)
            cells.append({**entry, **_mean_of_all("early", found), "by_seed": found})
        elif cell.job is None:
            cells.append(measured(cell, []))
        else:
            cells.append({**measured(dataclasses.replace(cell, job=None), []), "note": "not run yet"})
    curves = []
    if table.over_time:
        before = _written_by_place(earlier, "over_time")
        for cell in table.cells:
            found = _by_seed(cell, functools.partial(_curves, cell), reports, kept, before, seeds)
            if cell.job is not None and found:
                dt = find_task(cell.job.task).dt
                curves.append({"row": cell.row, "column": cell.column, "dt": dt, "by_seed": found})
    return {
        "table": table.name,
        "title": table.title,
        "note": table.note,
        "quick": quick,
        "cells": cells,
        "summary": summary(cells),
        "runs": {job.name: report["provenance"] for job, report in reports.items()}
        | {job.name: {"commit": None, **run} for job, run in kept.items()},
        **({"over_time": curves} if curves else {}),
    }


def known(table: Table, earlier: dict[str, Any], seeds: int, *, quick: bool) -> dict[Job, dict[str, Any]]:
    """The trainings that a written table has, with the settings of today: each with where it comes from."""
    if earlier["quick"] != quick:
        return {}
    runs = earlier["runs"]
    return {
        job: runs[job.name]
        for job in table.jobs(seeds)
        if job.name in runs and runs[job.name]["digest"] == job.digest(quick)
    }


def _written_by_place(earlier: dict[str, Any] | None, what: str) -> dict[tuple[str, str], dict[str, Any]]:
    """What a written table has by seed, by row and column."""
    return {(entry["row"], entry["column"]): entry.get("by_seed", {}) for entry in (earlier or {}).get(what, [])}


def _by_seed(
    cell: Cell,
    read: Callable[[dict[str, Any]], dict[str, Any]],
    reports: dict[Job, dict[str, Any]],
    kept: dict[Job, dict[str, Any]],
    before: dict[tuple[str, str], dict[str, Any]],
    seeds: int,
) -> dict[str, dict[str, Any]]:
    """What each seed's training says of a cell: by its report, else as it was written before."""
    if cell.job is None:
        return {}
    old, found = before.get((cell.row, cell.column), {}), {}
    for seed in range(seeds):
        job = dataclasses.replace(cell.job, seed=seed)
        if job in reports:
            found[str(seed)] = read(reports[job])
        elif job in kept and str(seed) in old:
            found[str(seed)] = old[str(seed)]
    return found


def _entry(cell: Cell, report: dict[str, Any]) -> dict[str, float | None]:
    """What one training says of a cell; None for a number that is not finite."""
    readers = {
        "value": cell.read,
        "standard_error": cell.read_error,
        "bounded": cell.read_bounded,
        "early": cell.read_early,
    }
    found = {name: read(report) for name, read in readers.items() if read is not None}
    return {name: None if value is None or not np.isfinite(value) else float(value) for name, value in found.items()}


def _column(by_seed: dict[str, dict[str, float | None]], name: str) -> list[float | None]:
    return [entry.get(name) for entry in by_seed.values()]


def _mean_of_all(name: str, by_seed: dict[str, dict[str, float | None]]) -> dict[str, float]:
    """The mean over seeds of a number that all of them have; nothing where one has not."""
    values = [value for value in _column(by_seed, name) if value is not None]
    return {name: float(np.mean(values))} if len(values) == len(by_seed) else {}


def _curves(cell: Cell, report: dict[str, Any]) -> dict[str, dict[str, list[float | None]]]:
    """Errors over time that one training has, by quantity: means, halves of 95 % intervals, medians.

    None where they are not finite.
    """
    assert cell.job is not None
    found = report["over_time"][cell.job.data]
    return {
        quantity: {name: [v and float(f"{v:.3g}") for v in values] for name, values in found[quantity].items()}
        for quantity in OVER_TIME
    }


def mean_over_seeds(curve: dict[str, Any], quantity: str) -> dict[str, Float[np.ndarray, " T"]]:
    """Errors over time of all seeds of a cell together, which have as many trajectories each."""
    seeds = [seed[quantity] for seed in curve["by_seed"].values()]
    mean, half, median = (np.array([seed[name] for seed in seeds], float) for name in ("mean", "ci95", "median"))
    # Independent test sets: the variance of their mean.
    spread = np.sqrt(np.sum(half**2, axis=0)) / len(seeds)
    return {"mean": mean.mean(axis=0), "ci95": spread, "median": median.mean(axis=0)}


def task_of(cell: dict[str, Any]) -> str:
    """The task of a contact property's cell."""
    return cell["column"].split()[0]


def quantity_of(cell: dict[str, Any]) -> str:
    """Which of `QUANTITIES` a contact property's cell is."""
    return cell["column"].split()[1].partition("[")[0]


def is_told(cell: dict[str, Any]) -> bool:
    """Whether the data tell of a contact property: it has a standard error."""
    return cell.get("standard_error") is not None


def summary(cells: list[dict[str, Any]]) -> dict[str, int]:
    """How many cells can be compared, are at least as good as the paper's, and are three times better."""
    verdicts = [cell["verdict"] for cell in cells if cell["verdict"] and cell["counted"]]
    return {
        "compared": len(verdicts),
        "met": sum(verdict in ("met", "better") for verdict in verdicts),
        "better": verdicts.count("better"),
    }


def written(name: str, folder: Path) -> dict[str, Any] | None:
    """The table of this name in a folder of results, if it is there.

    **Raises:** `CaromError` if the file is damaged.
    """
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    try:
        content = json.loads(path.read_text())
        require(set(content) >= {"cells", "runs", "quick"}, "incomplete")
    except (ValueError, TypeError) as error:
        raise CaromError(
            f"{path} is not a table that carom wrote ({error}): restore it, or remove it to measure anew."
        ) from error
    return content
