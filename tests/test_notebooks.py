"""The notebooks: they run, at a tiny size and without Jupyter, and are in the repository without outputs."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pytest

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
IN_BUDGET = ("2-learning", "5-contact")
LINK = re.compile(r"\[[^\]]*\]\((?!https?:)([^)\s#]+)\)")


def cells_of(notebook: Path) -> list[dict]:
    return json.loads(notebook.read_text())["cells"]


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_has_no_outputs_and_is_valid(notebook):
    whole = json.loads(notebook.read_text())
    assert (whole["nbformat"], whole["nbformat_minor"]) == (4, 5)
    assert set(whole) == {"cells", "metadata", "nbformat", "nbformat_minor"}
    assert set(whole["metadata"]) == {"kernelspec", "language_info"}  # no version of Python, no state of widgets
    for cell in whole["cells"]:
        wanted = {"cell_type", "id", "metadata", "source"}
        if cell["cell_type"] == "code":
            wanted |= {"execution_count", "outputs"}
            assert cell["execution_count"] is None, cell["id"]
            assert cell["outputs"] == [], cell["id"]
        else:
            assert cell["cell_type"] == "markdown", cell["id"]
        assert set(cell) == wanted, cell["id"]
        assert cell["metadata"] == {}, cell["id"]
        assert re.fullmatch(r"[a-zA-Z0-9_-]{1,64}", cell["id"])
    names = [cell["id"] for cell in whole["cells"]]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_text_is_sound(notebook):
    """A title first, an end to each equation, links that lead somewhere, and exercises."""
    texts = {cell["id"]: "".join(cell["source"]) for cell in cells_of(notebook) if cell["cell_type"] == "markdown"}
    assert next(iter(texts.values())).startswith("# ")
    assert "## Exercises" in list(texts.values())[-1]
    for name, text in texts.items():
        assert re.sub(r"```.*?```|`[^`\n]+`", "", text, flags=re.S).count("$") % 2 == 0, name
        for link in LINK.findall(text):
            assert (FOLDER / link).exists(), link


def test_what_is_shown_belongs_to_cells():
    """Files of docs/notebooks/shown are of cells that are there, and each notebook has some figures."""
    cells = {f"{notebook.stem}-{cell['id']}" for notebook in NOTEBOOKS for cell in cells_of(notebook)}
    shown = list((FOLDER / "shown").iterdir())
    assert {path.suffix for path in shown} == {".png", ".txt"}
    assert {path.stem for path in shown} <= cells
    for notebook in NOTEBOOKS:
        drawn = [cell for cell in cells_of(notebook) if "plt.subplots" in "".join(cell["source"])]
        assert len(drawn) >= 2
        for cell in drawn:
            assert (FOLDER / "shown" / f"{notebook.stem}-{cell['id']}.png").exists(), cell["id"]


def test_each_has_a_place_in_the_table_of_contents():
    contents = (ROOT / "mkdocs.yml").read_text()
    for notebook in NOTEBOOKS:
        assert f": notebooks/{notebook.stem}.md\n" in contents, notebook.name


@pytest.mark.slow
@pytest.mark.parametrize(
    "notebook",
    [pytest.param(path, marks=[pytest.mark.ci_budget] if path.stem in IN_BUDGET else []) for path in NOTEBOOKS],
    ids=lambda path: path.stem,
)
def test_runs(notebook, tmp_path):
    cache = jax.config.jax_compilation_cache_dir
    environment = {**os.environ, "CAROM_SMALL": "1", "MPLBACKEND": "Agg"}
    if cache:
        environment |= {"JAX_COMPILATION_CACHE_DIR": cache, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.05"}
    command = [sys.executable, "-m", "docs.figures.notebooks", str(notebook), "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr[-3000:]
    kept = {path.name for path in (FOLDER / "shown").glob(f"{notebook.stem}-*")}
    assert {path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".txt")} == kept
