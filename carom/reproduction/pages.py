"""From tables to what is read: `results/TABLE.json`, `results/TABLE.md`, the page of all tables, and its pictures."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from carom.atomic import write_whole
from carom.reproduction.results import QUANTITIES, ZERO, is_told, quantity_of, task_of, written
from carom.reproduction.tables import BUILDERS, EARLY_STEPS

PICTURES = {"state": "errors_over_time.png", "energy": "energy_over_time.png"}
"""Files of the pictures of errors over time."""
PROPERTIES = "contact_properties.png"
"""File of the picture of contact properties."""


def write(content: dict[str, Any], folder: Path) -> Path:
    """Write `TABLE.json` and `TABLE.md` into the folder; returns the former's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{content['table']}.json"
    text = json.dumps(content, indent=1, allow_nan=False)
    lists_on_a_line = re.sub(r"\[[^][{}\"]*\]", lambda found: " ".join(found[0].split()), text)
    write_whole(path, (lists_on_a_line + "\n").encode())
    write_whole(path.with_suffix(".md"), markdown(content).encode())
    return path


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.2e}" if value and abs(value) < 1e-3 else f"{value:.5g}"


def _with_interval(cell: dict[str, Any]) -> str:
    number = _number(cell["carom"]) or _without_number(cell)
    return number if cell["ci95"] is None else f"{number} ± {cell['ci95']:.0e}"


def _without_number(cell: dict[str, Any]) -> str:
    bounded = cell.get("bounded")
    return cell["note"] if bounded is None else f"not finite (bounded: {_number(bounded)})"


def markdown(content: dict[str, Any]) -> str:
    """The table as a page's section: a line a cell, with the paper's number, ours, errors and their ratio."""
    lines = [*_heading(content), *_cells(content)]
    counts = content["summary"]
    if counts["compared"]:
        lines += [
            "",
            f"{counts['met']} of {counts['compared']} cells are at least as good as the paper's, {counts['better']} at "
            "least three times better.",
        ]
    return "\n".join([*lines, *_remarks(content)]) + "\n"


def brief(content: dict[str, Any]) -> str:
    """The contact properties as a page's section: a line a task, with the largest errors by model, and the picture.

    All of them are some hundred lines, which are in `TABLE.md`.
    """
    cells = [cell for cell in content["cells"] if "by_seed" in cell]
    models = list(dict.fromkeys(cell["row"] for cell in cells))
    lines = [
        *_heading(content),
        "| task | properties | " + " | ".join(f"{model}: mu, e" for model in models) + " |",
        "|" + "---|" * (2 + len(models)),
    ]
    for task in dict.fromkeys(task_of(cell) for cell in cells):
        here = [cell for cell in cells if task_of(cell) == task]
        columns = [", ".join(_largest(here, model, quantity) for quantity in QUANTITIES) for model in models]
        count = len({cell["column"] for cell in here})
        lines.append("| " + " | ".join([task, str(count), *columns]) + " |")
    lines += [
        "",
        "The largest error of each task, of what its data tell; in parentheses, of what they do not tell, where that "
        f"is larger. Each property, with its standard error, is in `results/{content['table']}.md`.",
        "",
        f"![{PROPERTIES.removesuffix('.png')}](images/{PROPERTIES})",
    ]
    return "\n".join([*lines, *_remarks(content)]) + "\n"


def _largest(cells: list[dict[str, Any]], model: str, quantity: str) -> str:
    mine = [cell for cell in cells if cell["row"] == model and quantity_of(cell) == quantity]
    told, untold = (
        max((cell["error"] for cell in mine if is_told(cell) == wanted and cell["error"] is not None), default=None)
        for wanted in (True, False)
    )
    shown = "-" if told is None else _rounded(told)
    return shown if untold is None or untold <= (told or 0.0) else f"{shown} ({_rounded(untold)})"


def _rounded(value: float) -> str:
    return f"{value:.0e}" if value else "0"


def _heading(content: dict[str, Any]) -> list[str]:
    smoke = ["A smoke run (`--quick`): the numbers mean nothing.", ""] if content["quick"] else []
    return [f"## {content['title']}", "", *smoke]


def _cells(content: dict[str, Any]) -> list[str]:
    """A line a cell."""
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "row": lambda cell: cell["row"],
        "column": lambda cell: cell["column"],
        "true": lambda cell: _number(cell["true"]),
        "paper": lambda cell: _number(cell["paper"]),
        "carom": _with_interval,
        "standard error": lambda cell: _number(cell.get("standard_error")),
        "error of the paper": lambda cell: _number(cell["paper_error"]),
        "error of carom": lambda cell: _number(cell["error"]),
        f"of carom, first {EARLY_STEPS} steps": lambda cell: _number(cell.get("early")),
        "ratio": lambda cell: _number(cell["ratio"]),
        "": lambda cell: (
            cell["verdict"] if cell.get("counted", True) or not cell["verdict"] else f"({cell['verdict']})"
        ),
    }
    rows = [{name: show(cell) for name, show in columns.items()} for cell in content["cells"]]
    shown = [name for name in columns if any(row[name] for row in rows)]
    return [
        "| " + " | ".join(shown) + " |",
        "|" + "---|" * len(shown),
        *("| " + " | ".join(row[name] for name in shown) + " |" for row in rows),
    ]


def _remarks(content: dict[str, Any]) -> list[str]:
    """What is to be known of a table, and which trainings it is of."""
    lines = ["", content["note"]] if content["note"] else []
    if content["runs"]:
        commits = sorted({run["commit"] for run in content["runs"].values() if run.get("commit")})
        count = len(content["runs"])
        seconds = sum(run["seconds"] for run in content["runs"].values())
        lines += [
            "",
            f"{count} training{'s' * (count != 1)} ({_seeds(content)}), {seconds / 60:.0f} minutes together; "
            f"{'; '.join(sorted({run['machine'] for run in content['runs'].values() if 'machine' in run}))}"
            + (f"; commit {', '.join(commits)}" if commits else "")
            + f". `carom reproduce {content['table']}`.",
        ]
    return lines


def _seeds(content: dict[str, Any]) -> str:
    """Which seeds a table is of, and how many of its cells have fewer."""
    cells = [set(cell["by_seed"]) for cell in content["cells"] if "by_seed" in cell]
    every = set().union(*cells)
    if every == {"0"}:
        return "seed 0 alone"
    fewer = sum(seeds != every for seeds in cells)
    return f"seeds {', '.join(sorted(every, key=int))}" + (
        f"; {fewer} of {len(cells)} cells have fewer" if fewer else ""
    )


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
        "seed. The mean is over seeds, after ± half of its 95 % interval (Student's t). A printed error of zero is "
        f"met, and counted as three times better, by one of at most {ZERO:g}. "
        "Paper: Zhong, Dey, Chakraborty, NeurIPS 2021, supplement.",
        "",
    ]
    total = {"compared": 0, "met": 0, "better": 0}
    parts, worse = [], []
    for name in BUILDERS:
        content = written(name, folder)
        if content is not None:
            parts.append(brief(content) if name == "properties" else markdown(content))
            if "over_time" in content:
                parts.append("\n".join(f"![{file.removesuffix('.png')}](images/{file})" for file in PICTURES.values()))
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
    """Draw errors over time and contact properties, where the folder has them; returns the PNGs' paths."""
    from carom.reproduction import figure  # matplotlib is slow to import

    images.mkdir(parents=True, exist_ok=True)
    drawn = []
    content = written("figure3", folder)
    if content is not None and "over_time" in content:
        drawn += [figure.draw_over_time(content, quantity, images / name) for quantity, name in PICTURES.items()]
    content = written("properties", folder)
    if content is not None and any("by_seed" in cell for cell in content["cells"]):
        drawn.append(figure.draw_properties(content, images / PROPERTIES))
    return drawn
