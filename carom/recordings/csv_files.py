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
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from carom.errors import CaromError
from carom.recordings.clock import Clock, Irregular, clock_of, digit_of, digits_of, rounding_of

COORDINATE = re.compile(r"(v?)([xyz])(\d+)")
WITH_UNIT = re.compile(r"(?P<name>t|time|v?[xyz]\d+)\s*([\[({].*|[/_,]\s*\S.*|in\s.*)")
SHORTEST_DIGIT = 1e-9
"""Times with more decimals (s) are floats as they are."""
MISSING = ("", "nan", "na", "n/a", "null", "none", "-")
"""What stands in a cell whose number is not there."""
DIFFERENCES = "velocities by differences of positions"
"""What `source` says where they are."""


class Table(NamedTuple):
    """What a CSV holds, padded by each trajectory's last sample.

    `parts`: `x` and, if they are there, `v` and `contact`, as `Recording.of` takes them; `time` (s) and what its last
    digits are worth; `length` of each trajectory; its rows in `groups`, and their `lines`; `clock`, the name of the
    column of times.
    """

    parts: dict[str, Any]
    time: Float[np.ndarray, "N T"]
    digit: Float[np.ndarray, "N T"]
    length: Int[np.ndarray, " N"]
    groups: list[list[int]]
    lines: list[int]
    clock: str


def read_csv(path: Path) -> dict[str, Any]:
    """What `Recording.of` takes.

    **Raises:** `CaromError` naming line and column, what was there, and what to do; `OSError` if it cannot be read.
    """
    table = _table(path, missing=False)
    length, x = table.length, table.parts["x"]
    found = _equal_steps(table.time, table.digit, length)
    if isinstance(found, Irregular):
        k, s = found.trajectory, found.sample
        first = table.groups[k][s]
        raise CaromError(_unequal(found, table.clock, table.lines[first : first + 2], table.time[k, s : s + 2]))
    out: dict[str, Any] = {**table.parts, "time": found.time, "dt": found.step, "length": length}
    if "v" not in out:
        if length.min() < 3:
            raise CaromError("trajectories without velocities must have at least 3 samples; one had fewer.")
        out["v"] = np.zeros_like(x)
        for k, n in enumerate(length):
            out["v"][k, :n] = np.gradient(x[k, :n], found.step, axis=0, edge_order=2)
        out["source"] = DIFFERENCES
    return out


def read_samples(path: Path) -> dict[str, Any]:
    """What `Observations.checked` takes: nothing is made, times are any, and cells may be empty where nothing was seen.

    **Raises:** as `read_csv`.
    """
    table = _table(path, missing=True)
    digit = table.digit
    if digit.min() < SHORTEST_DIGIT:  # all that a float had was printed, which may be less
        digit = np.maximum(digit, digit_of(table.time, np.arange(digit.shape[1]) < table.length[:, None]))
    with np.errstate(invalid="ignore"):
        back = np.argwhere((np.diff(table.time, axis=1) <= 0) & (np.arange(1, digit.shape[1]) < table.length[:, None]))
    if len(back):
        k, s = back[0]
        row, times = table.groups[k][s], table.time[k, s : s + 2]
        found = Irregular(int(k), int(s), float(times[1] - times[0]), 0.0, True, float(digit[k, s]), False)
        where = _unequal(found, table.clock, table.lines[row : row + 2], times)
        raise CaromError(f"{where} (trajectory {k}, sample {s + 1})")
    return {**table.parts, "time": table.time, "digit": digit, "length": table.length}


def _table(path: Path, *, missing: bool) -> Table:
    """What is in the file; cells of positions and velocities may be empty if they may be `missing`."""
    rows, names = _rows(path)
    _check_names(names)
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
    _check_first(rows[0], [columns[name] for name in wanted])
    gaps = [missing and name != clock for name in wanted]
    table = np.array(
        [
            [_number(row[columns[name]], name, line, gap) for name, gap in zip(wanted, gaps, strict=True)]
            for line, row in rows
        ]
    )
    lines = [line for line, _ in rows]
    groups = _trajectories(labels, lines)
    most = max(len(group) for group in groups)

    def padded(part: Float[np.ndarray, "S c"]) -> np.ndarray:
        """(trajectory, time, c), the last sample repeated where one is shorter."""
        return np.stack([part[[*group, *([group[-1]] * (most - len(group)))]] for group in groups])

    count = points * dim
    shape = (len(groups), most, points, dim)
    digits = digits_of([row[columns[clock]] for _, row in rows])
    time = padded(np.stack([table[:, 0], digits], axis=1))
    parts: dict[str, Any] = {"x": padded(table[:, 1 : 1 + count]).reshape(shape)}
    if has_velocity:
        parts["v"] = padded(table[:, 1 + count : 1 + 2 * count]).reshape(shape)
    if "contact" in columns:
        flags = padded(table[:, -1:])[..., 0]
        parts["contact"] = _flags(np.where(np.isnan(flags), 0, flags))
    return Table(parts, time[..., 0], time[..., 1], np.array([len(g) for g in groups]), groups, lines, clock)


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
            more = len(row) > len(names) and delimiter == ","
            advice = "if decimals have commas, write points" if more else "add or remove separators"
            raise CaromError(
                f"line {number} must have {len(names)} values, as the header; it had {len(row)}: {advice}."
            )
    return rows, names


def _check_names(names: list[str]) -> None:
    """Raise `CaromError` for names of columns that only need to be written in another way."""
    for k, name in enumerate(names, 1):
        if not name:
            raise CaromError(
                f"column {k} of the header has no name: name it, or leave it out (a separator at line ends?)."
            )
        unit = WITH_UNIT.fullmatch(name)
        if unit:
            bare = unit["name"]
            wanted = "s" if bare in ("t", "time") else "m/s" if bare[0] == "v" else "m"
            raise CaromError(
                f"the header has a column {name!r}: call it {bare}, without a unit; its values must be in {wanted}."
            )
        if re.fullmatch("v?[xyz]", name):
            raise CaromError(f"the header has a column {name!r}: call it {name}0, points are numbered from 0.")


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
        advice = " Points are numbered from 0." if points and min(p for _, p in positions) > 0 else ""
        raise CaromError(f"the header must have a column {name} (m); it had {', '.join(names)}.{advice}")
    if velocities and velocities != every:
        axis, p = sorted(every ^ velocities, key=lambda c: (c[1], c[0]))[0]
        raise CaromError(f"velocities must be there for all coordinates or for none; look at v{axis}{p}.")
    return points, dim, bool(velocities)


def _check_first(row: tuple[int, list[str]], wanted: list[int]) -> None:
    """Raise `CaromError` if the row below the header holds words, such as units."""
    line, cells = row
    if all(cells[k].strip() and not re.search(r"\d|nan|inf", cells[k].lower()) for k in wanted):
        shown = ", ".join(cells[k].strip() for k in wanted)[:40]
        raise CaromError(f"line {line} holds no numbers ({shown}): leave it out; units are s, m and m/s.")


def _number(text: str, name: str, line: int, may_be_missing: bool) -> float:
    text = text.strip()
    if may_be_missing and text.lower() in MISSING:
        return np.nan
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if np.isfinite(value):
        return value
    where, gap = (
        f"line {line}, column {name}",
        "fill it in, or leave the row out and give those after it another number in a column trajectory",
    )
    if not text:
        raise CaromError(f"{where} is empty: {gap}.")
    if re.fullmatch(r"[+-]?[\d.]*,\d+(e[+-]?\d+)?", text.lower()):
        raise CaromError(
            f"{where} must be a number with a decimal point; it was {text[:40]!r}: replace decimal commas by points."
        )
    advice = f": {gap}" if text.lower() in MISSING else ""
    raise CaromError(f"{where} must be a number; it was {text[:40]!r}{advice}.")


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


def _equal_steps(
    time: Float[np.ndarray, "N T"], digit: Float[np.ndarray, "N T"], length: Int[np.ndarray, " N"]
) -> Clock | Irregular:
    """The clock of the times of all trajectories, whose last digits are worth `digit`."""
    valid = np.arange(time.shape[1]) < length[:, None]
    if digit.min() < SHORTEST_DIGIT:  # all that a float had was printed, which may be less
        digit = np.maximum(digit, digit_of(time, valid))
    return clock_of(time, valid, digit=digit, rounding=2 * rounding_of(time, float(np.abs(time[valid]).max())))


def _unequal(found: Irregular, clock: str, lines: list[int], times: Float[np.ndarray, " 2"]) -> str:
    """What is wrong between two rows, of these lines and times, and what to do."""
    where, apart = (
        f"line {lines[1]}, column {clock}",
        "give the rows from there on another number in a column trajectory",
    )
    if found.coarse:
        apart = "write times with more decimals"
    if found.back:
        before = f"it was {times[1]:.15g}, after {times[0]:.15g} in line {lines[0]}"
        advice = "leave out one of the two rows" if found.step == 0 else "put the rows in the order of time"
        return f"{where} must increase; {before}: {advice}, or {apart}."
    lost = round(found.step / found.typical) - 1
    near = abs(found.step - (lost + 1) * found.typical) <= max(0.01 * found.typical, 2 * found.digit)
    # A step that differs from the first one on is another rate.
    gap = lost > 0 and found.sample > 0 and near and not found.coarse
    advice = (
        f"{lost} of the samples {'is' if lost == 1 else 'are'} missing there: fill in, or" if gap else "resample, or"
    )
    return (
        f"{where} must have equal steps; it was {found.step:.9g} s after line {lines[0]}, most are "
        f"{found.typical:.9g} s apart; {advice} {apart}."
    )


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
