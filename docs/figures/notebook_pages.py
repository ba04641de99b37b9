"""A hook of MkDocs that makes a page of each notebook, with what its cells show and with its equations as MathML.

Notebooks in the repository have no outputs; those of docs/figures/notebooks.py are put below their cells here. Nothing
is run, and the pages need no script from elsewhere: they work offline, like the rest of the site.
"""

import json
import re
from pathlib import Path, PurePosixPath
from typing import Any

from latex2mathml.converter import convert

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
SHOWN = "shown"
_CODE = re.compile(r"```.*?```|`[^`\n]+`", re.S)
_MATH = re.compile(r"\$\$(?P<display>.+?)\$\$|\$(?P<inline>[^$\s](?:[^$]*[^$\s])?)\$", re.S)
_PLACE = "xx-equation-{}-xx"  # what stands for an equation while Markdown is turned into HTML
_PLACES = re.compile(r"<p>\s*xx-equation-(\d+)-xx\s*</p>|xx-equation-(\d+)-xx")


def page_of(notebook: Path) -> str:
    """The notebook as Markdown: its texts, its code, and what was kept of what each cell shows."""
    parts = []
    for cell in json.loads(notebook.read_text())["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        shown = NOTEBOOKS / SHOWN / f"{notebook.stem}-{cell['id']}"
        if shown.with_suffix(".txt").exists():
            parts.append(f"```text\n{shown.with_suffix('.txt').read_text().rstrip()}\n```")
        if shown.with_suffix(".png").exists():
            parts.append(f"![What the cell above draws]({SHOWN}/{shown.name}.png)")
    title, _, rest = "\n\n".join(parts).partition("\n")
    return f"{title}\n\n*A notebook: [{notebook.name}]({notebook.name}) runs in JupyterLab.*\n{rest}\n"


def without_equations(markdown: str) -> tuple[str, list[str]]:
    """The text with a place for each equation, and the equations as MathML; code is left alone."""
    equations = []

    def taken(match: re.Match[str]) -> str:
        display = match["display"]
        equations.append(convert(display or match["inline"], display="block" if display else "inline"))
        place = _PLACE.format(len(equations) - 1)
        return f"\n\n{place}\n\n" if display else place

    pieces, end = [], 0
    for code in _CODE.finditer(markdown):
        pieces += [_MATH.sub(taken, markdown[end : code.start()]), code[0]]
        end = code.end()
    return "".join([*pieces, _MATH.sub(taken, markdown[end:])]), equations


def with_equations(html: str, equations: list[str]) -> str:
    """The page with its equations in their places."""
    return _PLACES.sub(lambda match: equations[int(match[1] or match[2])], html)


# ------------------------------------------------------------------------------------------ what MkDocs calls

_equations: dict[str, list[str]] = {}


def on_files(files: Any, config: Any) -> Any:
    """Add a page for each notebook."""
    from mkdocs.structure.files import File

    for notebook in sorted(NOTEBOOKS.glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{notebook.stem}.md", content=page_of(notebook)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to notebooks lead to their pages, but for a page's link to its own file; equations make room."""
    source = PurePosixPath(page.file.src_uri)
    if source.parent.name != NOTEBOOKS.name:
        return re.sub(r"\]\((notebooks/[\w-]+)\.ipynb\)", r"](\1.md)", markdown)
    markdown, _equations[page.file.src_uri] = without_equations(markdown)
    return markdown


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Equations back into their places."""
    return with_equations(html, _equations.get(page.file.src_uri, []))
