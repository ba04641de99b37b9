"""Run notebooks without Jupyter, and keep what their cells show for the pages of the site.

    python -m docs.figures.notebooks [NOTEBOOK.ipynb ...] [--out FOLDER]

The notebooks in the repository have no outputs. What a cell shows goes into docs/notebooks/shown, as
`NOTEBOOK-CELL.png` and `NOTEBOOK-CELL.txt`, from where `docs/figures/notebook_pages.py` takes it. With `CAROM_SMALL=1`
in the environment they run at the tiny sizes of the tests.
"""

import argparse
import ast
import contextlib
import io
import json
import time
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib import pyplot as plt

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"


def run_cell(source: str, names: dict[str, Any], where: str) -> str:
    """Run a cell as Jupyter does; returns what it printed, and the value of its last line if that is an expression."""
    body = ast.parse(source, where).body
    last = body[-1] if body and isinstance(body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(ast.Module(body if last is None else body[:-1], type_ignores=[]), where, "exec"), names)
        value = None if last is None else eval(compile(ast.Expression(last.value), where, "eval"), names)
        if value is not None and not source.rstrip().endswith(";"):
            print(repr(value))
    return printed.getvalue()


def run_notebook(notebook: Path, out: Path) -> None:
    """Run all code cells in order in one fresh namespace, and write into `out` what they show."""
    for old in out.glob(f"{notebook.stem}-*.*"):
        old.unlink()
    names: dict[str, Any] = {"__name__": "__main__"}
    with contextlib.chdir(out):  # where a cell that writes files would do no harm
        for cell in json.loads(notebook.read_text())["cells"]:
            if cell["cell_type"] != "code":
                continue
            shown = out / f"{notebook.stem}-{cell['id']}"
            begin = time.perf_counter()
            text = run_cell("".join(cell["source"]), names, f"{notebook.name}, cell {cell['id']}")
            print(f"{notebook.stem:>24} {cell['id']:24} {time.perf_counter() - begin:6.1f} s", flush=True)
            if text.strip():
                shown.with_suffix(".txt").write_text(text.rstrip() + "\n")
            for number in plt.get_fignums():
                plt.figure(number).savefig(shown.with_suffix(".png"))
            plt.close("all")


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(description="Run notebooks and keep what they show.")
    parser.add_argument("notebooks", nargs="*", type=Path, help="by default all")
    parser.add_argument("--out", type=Path, default=NOTEBOOKS / "shown", help="folder for what they show")
    options = parser.parse_args()
    options.out.mkdir(exist_ok=True)
    for notebook in options.notebooks or sorted(NOTEBOOKS.glob("*.ipynb")):
        run_notebook(notebook.resolve(), options.out.resolve())


if __name__ == "__main__":
    main()
