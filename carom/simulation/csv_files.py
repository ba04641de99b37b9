"""Trajectories in text: CSV files with a header, a row for each sample.

Columns, in any order:

    trajectory      optional: number or name; a new one begins a new trajectory
    time (or t)     s, in equal steps within each trajectory
    x0 y0 (z0) ...  m, of point 0, 1, ...
    vx0 vy0 ...     m/s, optional: without them, by differences of the positions
    contact         optional: 1 where the step that ends at the sample had a contact, else 0

Separated by commas, semicolons or tabs. Lines that begin with # are comments.
"""

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from carom.errors import CaromError

COORDINATE = re.compile(r"(v?)([xyz])(\d+)")
DIFFERENCES = "velocities by differences of positions"
"""What `source` says where they are."""


def read_csv(path: Path) -> dict[str, Any]:
    """What `Recording.of` takes.

    **Raises:** `CaromError` naming line and column, what was there, and what to do; `OSError` if it cannot be read.
    """
    rows, names = _rows(path)
    columns = {name: k for k, name in enumerate(names)}
    clock = next((name for name in ("time", "t") if name in columns), None)
    if clock is None:
        raise CaromError(f"the header must have a column time (s); it had {', '.join(names)}.")
    points, dim, has_velocity = _layout(names)
    if "trajectory" in columns:
        labels = [row[columns["trajectory"]] for _, row in rows]
    else:
        labels = [""] * len(rows)
    wanted = [clock, *(f"{axis}{p}" for p in range(points) for axis in "xyz"[:dim])]
    if has_velocity:
        wanted += [f"v{axis}{p}" for p in range(points) for axis in "xyz"[:dim]]
    wanted += ["contact"] if "contact" in columns else []
    table = np.array([[_number(row[columns[name]], name, line) for name in wanted] for line, row in rows])
    groups = _trajectories(labels, [line for line, _ in rows])
    most = max(len(group) for group in groups)

    def padded(part: Float[np.ndarray, "S c"]) -> np.ndarray:
        """(trajectory, time, c), the last sample repeated where one is shorter."""
        return np.stack([part[[*group, *([group[-1]] * (most - len(group)))]] for group in groups])

    count = points * dim
    x = padded(table[:, 1 : 1 + count]).reshape(len(groups), most, points, dim)
    time = np.stack([_clock(table[group, 0], most) for group in groups])
    out: dict[str, Any] = {"x": x, "time": time, "length": np.array([len(group) for group in groups])}
    if has_velocity:
        out["v"] = padded(table[:, 1 + count : 1 + 2 * count]).reshape(x.shape)
    else:
        if min(map(len, groups)) < 3:
            raise CaromError("trajectories without velocities must have at least 3 samples; one had fewer.")
        out["v"] = np.zeros_like(x)
        for k, group in enumerate(groups):
            n = len(group)
            out["v"][k, :n] = np.gradient(x[k, :n], time[k, :n], axis=0, edge_order=2)
        out["source"] = DIFFERENCES
    if "contact" in columns:
        out["contact"] = _flags(padded(table[:, -1:])[..., 0])
    return out


def _rows(path: Path) -> tuple[list[tuple[int, list[str]]], list[str]]:
    """Rows with the numbers of their lines, and the names of the columns."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise CaromError(f"it is not a text in UTF-8 (byte {error.start}): save it as CSV in UTF-8.") from error
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(lines) < 3:
        raise CaromError(f"it must have a header and at least 2 samples; it had {max(len(lines) - 1, 0)}.")
    first = lines[0][1]
    delimiter = max(",;\t", key=first.count)
    try:
        parsed = list(csv.reader([line for _, line in lines], delimiter=delimiter))
    except csv.Error as error:
        raise CaromError(f"it is not a CSV file ({error}).") from error
    names = [name.strip().lower() for name in parsed[0]]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise CaromError(f"the header must name each column once; {sorted(twice)[0]!r} was there twice.")
    rows = [(number, row) for (number, _), row in zip(lines[1:], parsed[1:], strict=True)]
    for number, row in rows:
        if len(row) != len(names):
            raise CaromError(f"line {number} must have {len(names)} values, as the header; it had {len(row)}.")
    return rows, names


def _layout(names: list[str]) -> tuple[int, int, bool]:
    """How many points there are, of how many axes, and whether with velocities."""
    known = [match for name in names if (match := COORDINATE.fullmatch(name))]
    other = [name for name in names if not COORDINATE.fullmatch(name)]
    strange = [name for name in other if name not in ("trajectory", "time", "t", "contact")]
    if strange:
        raise CaromError(
            f"the header has a column {strange[0]!r}, which is none of trajectory, time, x0, y0, z0, vx0, ..., "
            "contact: rename or remove it."
        )
    positions = {(m[2], int(m[3])) for m in known if not m[1]}
    velocities = {(m[2], int(m[3])) for m in known if m[1]}
    points = 1 + max((p for _, p in positions), default=-1)
    dim = 3 if any(axis == "z" for axis, _ in positions) else 2
    every = {(axis, p) for p in range(points) for axis in "xyz"[:dim]}
    missing = sorted(every - positions, key=lambda c: (c[1], c[0]))
    if not points or missing:
        name = "x0" if not points else "".join(map(str, missing[0]))
        raise CaromError(f"the header must have a column {name} (m); it had {', '.join(names)}.")
    if velocities and velocities != every:
        axis, p = sorted(every ^ velocities, key=lambda c: (c[1], c[0]))[0]
        raise CaromError(f"velocities must be there for all coordinates or for none; look at v{axis}{p}.")
    return points, dim, bool(velocities)


def _number(text: str, name: str, line: int) -> float:
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not np.isfinite(value):
        raise CaromError(f"line {line}, column {name} must be a number; it was {text.strip()[:40]!r}.")
    return value


def _trajectories(labels: list[str], lines: list[int]) -> list[list[int]]:
    """Rows of each trajectory, which must follow one another."""
    groups: dict[str, list[int]] = {}
    for k, label in enumerate(labels):
        if label in groups and groups[label][-1] != k - 1:
            raise CaromError(
                f"line {lines[k]}, column trajectory: {label!r} begins again; the samples of a trajectory must follow "
                "one another."
            )
        groups.setdefault(label, []).append(k)
    short = next((label for label, group in groups.items() if len(group) < 2), None)
    if short is not None:
        raise CaromError(f"each trajectory must have at least 2 samples; {short!r} had 1.")
    return list(groups.values())


def _clock(time: Float[np.ndarray, " S"], most: int) -> Float[np.ndarray, " T"]:
    """Times of a trajectory, going on in equal steps where it is shorter than the longest."""
    step = (time[-1] - time[0]) / (len(time) - 1)
    return np.concatenate([time, time[-1] + step * np.arange(1, most - len(time) + 1)])


def _flags(values: np.ndarray) -> np.ndarray:
    bad = values[~np.isin(values, (0, 1))]
    if bad.size:
        raise CaromError(f"column contact must be 0 or 1; it was {bad.flat[0]:g}.")
    return values.astype(bool)


def encode_csv(content: Mapping[str, Any]) -> io.BytesIO:
    """The arrays of a recording as text; units are SI, what else it says of itself stands in comments."""
    x, v, time = content["x"], content["v"], np.asarray(content["time"])
    axes = "xyz"[: x.shape[3]]
    names = [f"{kind}{axis}{p}" for kind in ("", "v") for p in range(x.shape[2]) for axis in axes]
    length = content.get("length", np.full(len(x), x.shape[1]))
    contact = content.get("contact")
    out = io.StringIO(newline="")
    for name in ("task", "source", "carom_version"):
        if content.get(name):
            out.write(f"# {name}: {' '.join(str(content[name]).split())}\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["trajectory", "time", *names, *([] if contact is None else ["contact"])])
    for k, count in enumerate(length):
        for s in range(int(count)):
            numbers = [time[s], *x[k, s].ravel(), *v[k, s].ravel()]
            flag = [] if contact is None else [int(contact[k, s])]
            writer.writerow([k, *(repr(float(number)) for number in numbers), *flag])
    return io.BytesIO(out.getvalue().encode())
