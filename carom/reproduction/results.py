"""From finished trainings to a table: `results/TABLE.json`, `results/TABLE.md`, and the page of all of them."""

import dataclasses
import json
import platform
from pathlib import Path
from typing import Any

import numpy as np

from carom.atomic import write_whole
from carom.checks import require
from carom.errors import CaromError
from carom.reproduction.jobs import Job
from carom.reproduction.tables import BUILDERS, Cell, Table
from carom.tasks import find_task

ZERO = 1e-4
"""A printed error of zero is met, and beaten, by one of at most this."""
TIMES_BETTER = 3.0
PICTURES = {"state": "errors_over_time.png", "energy": "energy_over_time.png"}
"""Files of the pictures of errors over time."""


def deviation(cell: Cell, value: float) -> float:
    """How far a number is from what it ought to be: its own size for an error, relative for ratios above 1."""
    if cell.kind == "error":
        return abs(value)
    return abs(value - cell.true) / max(abs(cell.true), 1.0)


def measured(cell: Cell, values: list[float | None], errors: list[float | None] | None = None) -> dict[str, Any]:
    """A cell's entry: mean over seeds with its 95 % interval, error, the paper's, and their ratio.

    `verdict`: "better" (by `TIMES_BETTER`), "met", "worse", or "" where there is nothing to compare with; `counted`,
    whether it counts. `errors`: standard errors, by seed, where there are any.
    """
    found = [float(v) for v in values if v is not None]
    finite = bool(found) and len(found) == len(values) and bool(np.all(np.isfinite(found)))
    mean = float(np.mean(found)) if finite else None
    spread = float(1.96 * np.std(found, ddof=1) / np.sqrt(len(found))) if finite and len(found) > 1 else None
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
    no report of them now.
    """
    kept = {} if earlier is None else known(table, earlier, seeds, quick=quick)
    kept = {job: run for job, run in kept.items() if job not in reports}
    before = {(cell["row"], cell["column"]): cell.get("by_seed", {}) for cell in (earlier or {}).get("cells", [])}
    cells = []
    for cell in table.cells:
        if cell.job is None:
            cells.append(measured(cell, []))
            continue
        found = {}
        for seed in range(seeds):
            job = dataclasses.replace(cell.job, seed=seed)
            if job in reports:
                found[str(seed)] = _entry(cell, reports[job])
            elif job in kept and str(seed) in (old := before.get((cell.row, cell.column), {})):
                found[str(seed)] = old[str(seed)]
        if found:
            entry = measured(cell, _column(found, "value"), _column(found, "standard_error"))
            bounded = [value for value in _column(found, "bounded") if value is not None]
            if entry["carom"] is None and bounded:
                entry["bounded"] = float(np.mean(bounded))
            cells.append({**entry, "by_seed": found})
        else:
            cells.append({**measured(dataclasses.replace(cell, job=None), []), "note": "not run yet"})
    curves = _curves(table, reports, earlier) if table.over_time else []
    return {
        "table": table.name,
        "title": table.title,
        "note": table.note,
        "quick": quick,
        "cells": cells,
        "summary": summary(cells),
        "runs": {job.name: report["provenance"] for job, report in reports.items()}
        | {job.name: {"commit": None, **run} for job, run in kept.items()},
        "machine": f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}",
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


def _entry(cell: Cell, report: dict[str, Any]) -> dict[str, float | None]:
    """What one training says of a cell; None for a number that is not finite."""
    readers = {"value": cell.read, "standard_error": cell.read_error, "bounded": cell.read_bounded}
    found = {name: read(report) for name, read in readers.items() if read is not None}
    return {name: None if value is None or not np.isfinite(value) else float(value) for name, value in found.items()}


def _column(by_seed: dict[str, dict[str, float | None]], name: str) -> list[float | None]:
    return [entry.get(name) for entry in by_seed.values()]


def _curves(table: Table, reports: dict[Job, dict[str, Any]], earlier: dict[str, Any] | None) -> list[dict[str, Any]]:
    """Errors over time of a table's trainings: of those with a report, else as they were written before."""
    before = {(curve["row"], curve["column"]): curve for curve in (earlier or {}).get("over_time", [])}
    curves = []
    for cell in table.cells:
        place = (cell.row, cell.column)
        if cell.job is not None and any(_of(cell.job, job) for job in reports):
            curves.append({"row": cell.row, "column": cell.column, **_mean_over_seeds(cell.job, reports)})
        elif place in before:
            curves.append(before[place])
    return curves


def _of(job: Job, other: Job) -> bool:
    """Whether they differ in their seeds alone."""
    return dataclasses.replace(job, seed=other.seed) == other


def _mean_over_seeds(job: Job, reports: dict[Job, dict[str, Any]]) -> dict[str, Any]:
    """Errors over time of all seeds of a job together: of the same number of trajectories each."""
    seeds = [report["over_time"][job.data] for other, report in reports.items() if _of(job, other)]
    out: dict[str, Any] = {"dt": find_task(job.task).dt}
    for quantity in ("state", "energy"):
        mean, half, median = (
            np.array([seed[quantity][k] for seed in seeds], float) for k in ("mean", "ci95", "median")
        )
        # Independent test sets: the variance of their mean.
        spread = np.sqrt(np.sum(half**2, axis=0)) / len(seeds)
        named = {"mean": mean.mean(axis=0), "ci95": spread, "median": median.mean(axis=0)}
        out[quantity] = {name: [float(f"{v:.4g}") for v in values] for name, values in named.items()}
    return out


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


def write(content: dict[str, Any], folder: Path) -> Path:
    """Write `TABLE.json` and `TABLE.md` into the folder; returns the former's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{content['table']}.json"
    write_whole(path, (json.dumps(content, indent=1) + "\n").encode())
    write_whole(path.with_suffix(".md"), markdown(content).encode())
    return path


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.2e}" if value and abs(value) < 1e-3 else f"{value:.5g}"


def _without_number(cell: dict[str, Any]) -> str:
    bounded = cell.get("bounded")
    return cell["note"] if bounded is None else f"not finite (bounded: {_number(bounded)})"


def markdown(content: dict[str, Any]) -> str:
    """The table as a page's section: a line a cell, with the paper's number, ours, errors and their ratio."""
    lines = [f"## {content['title']}", ""]
    if content["quick"]:
        lines += ["A smoke run (`--quick`): the numbers mean nothing.", ""]
    head = ["row", "column", "true", "paper", "carom", "error of the paper", "error of carom", "ratio", ""]
    told = any("standard_error" in cell for cell in content["cells"])
    if told:
        head.insert(5, "standard error")
    lines += ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for cell in content["cells"]:
        carom = _number(cell["carom"])
        if cell["ci95"] is not None:
            carom += f" ± {cell['ci95']:.0e}"
        row = [
            cell["row"],
            cell["column"],
            _number(cell["true"]),
            _number(cell["paper"]),
            carom or _without_number(cell),
            _number(cell["paper_error"]),
            _number(cell["error"]),
            _number(cell["ratio"]),
            cell["verdict"] if cell.get("counted", True) or not cell["verdict"] else f"({cell['verdict']})",
        ]
        if told:
            row.insert(5, _number(cell.get("standard_error")))
        lines.append("| " + " | ".join(row) + " |")
    counts = content["summary"]
    if counts["compared"]:
        lines += [
            "",
            f"{counts['met']} of {counts['compared']} cells are at least as good as the paper's, {counts['better']} at "
            "least three times better.",
        ]
    if content["note"]:
        lines += ["", content["note"]]
    if "over_time" in content:
        lines += [""] + [f"![{name.removesuffix('.png')}](images/{name})" for name in PICTURES.values()]
    if content["runs"]:
        commits = sorted({run["commit"] for run in content["runs"].values() if run.get("commit")})
        seconds = sum(run["seconds"] for run in content["runs"].values())
        lines += [
            "",
            f"{len(content['runs'])} trainings ({_seeds(content)}), {seconds / 60:.0f} minutes together; "
            f"{content['machine']}"
            + (f"; commit {', '.join(commits)}" if commits else "")
            + f". `carom reproduce {content['table']}`.",
        ]
    return "\n".join(lines) + "\n"


def _seeds(content: dict[str, Any]) -> str:
    """Which seeds a table is of."""
    found = sorted({int(seed) for cell in content["cells"] for seed in cell.get("by_seed", {})})
    return "seed 0 alone" if found == [0] else f"seeds {', '.join(map(str, found))}"


def _worse(content: dict[str, Any]) -> list[str]:
    """The cells of a table that count and are worse than the paper's, in a line."""
    cells = [cell for cell in content["cells"] if cell["verdict"] == "worse" and cell.get("counted", True)]
    if not cells:
        return []
    listed = "; ".join(
        f"{cell['row']}, {cell['column']}: {_number(cell['error']) or cell['note']} "
        f"(paper {_number(cell['paper_error'])})"
        for cell in cells
    )
    return [f"* {content['title']}. {listed}."]


def page(folder: Path) -> str:
    """The page of all tables that the folder has."""
    lines = [
        "# The paper's tables, measured again",
        "",
        "Made by `carom reproduce`; numbers, seeds, times and settings are in `results/`. A property's error is its "
        "distance to the true value (relative for mass ratios above one), that of a trajectory `|z - z^| / |z|` over "
        "positions and velocities together, mean over time and 100 test trajectories, whose states have their own "
        "seed. The mean is over seeds, after ± half of its 95 % interval. A printed error of zero is met by one of at "
        f"most {ZERO:g}. Paper: Zhong, Dey, Chakraborty, NeurIPS 2021, supplement.",
        "",
    ]
    total = {"compared": 0, "met": 0, "better": 0}
    parts, worse = [], []
    for name in BUILDERS:
        path = folder / f"{name}.json"
        if path.exists():
            content = json.loads(path.read_text())
            parts.append(markdown(content))
            total = {key: total[key] + content["summary"][key] for key in total}
            worse += _worse(content)
    lines += [
        f"Of {total['compared']} cells that can be compared {total['met']} are at least as good as the paper's, and "
        f"{total['better']} at least three times better.",
        "",
        *(
            ["## Where carom is worse", "", "Errors; what they are due to stands below each table.", "", *worse, ""]
            if worse
            else []
        ),
    ]
    return "\n".join([*lines, "\n".join(parts)])


def pictures(folder: Path, images: Path) -> list[Path]:
    """Draw errors over time, if the folder has `figure3`; returns the PNGs' paths."""
    path = folder / "figure3.json"
    content = json.loads(path.read_text()) if path.exists() else {}
    if "over_time" not in content:
        return []
    from carom.reproduction.figure import draw  # matplotlib is slow to import

    images.mkdir(parents=True, exist_ok=True)
    return [draw(content, quantity, images / name) for quantity, name in PICTURES.items()]
