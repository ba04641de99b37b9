"""The documentation: links lead somewhere, the API is whole, and what is to be copied works."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")


def without_code(text: str) -> str:
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.S)


def anchors_of(text: str) -> set[str]:
    """Names of the headings, as GitHub and MkDocs make them."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", text, flags=re.S), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", heading).strip().lower().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for link in LINK.findall(without_code(page.read_text())):
        if re.match(r"https?://|mailto:", link):
            continue
        name, _, anchor = link.partition("#")
        target = page.parent / name if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor and target.suffix == ".md":
            assert anchor in anchors_of(target.read_text()), f"{page.name}: {link}"


def test_every_page_is_in_the_table_of_contents():
    contents = (ROOT / "mkdocs.yml").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in contents, page.name


def test_the_api_has_every_public_name_once():
    public = re.findall(r"^from \.(\S+) import \w+ as (\w+)$", (ROOT / "carom" / "__init__.pyi").read_text(), re.M)
    listed = re.findall(r"^::: carom\.(\S+)$", (ROOT / "docs" / "api.md").read_text(), re.M)
    assert sorted(listed) == sorted(f"{module}.{name}" for module, name in public)


def blocks_of(page: str) -> str:
    """The page's Python, in its order."""
    return "\n".join(re.findall(r"```python\n(.*?)```", (ROOT / "docs" / page).read_text(), re.S))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param("index.md", marks=pytest.mark.slow),
        pytest.param("own-system.md", marks=pytest.mark.slow),
        pytest.param("own-contact.md", marks=[pytest.mark.slow, pytest.mark.ci_budget]),
    ],
)
def test_what_is_to_be_copied_works(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "page"}
    exec(compile(blocks_of(page), page, "exec"), names)
    if page == "own-contact.md":
        # A step of .005 s at 5 m/s is as deep as a body gets; an eighth of it is taken back in a step, by lifting it.
        assert float(names["system"].gaps(names["motion"].x).min()) > -0.03
        assert (np.diff(names["energy"]) < 1.5 * 9.81 * 0.03 / 8).all()
        assert (names["energy"] < names["energy"][0] * (1 + 1e-9)).all()
        differences = (names["last_height"](0.6 + 1e-6) - names["last_height"](0.6 - 1e-6)) / 2e-6
        assert float(names["slope"]) == pytest.approx(float(differences), rel=1e-5)
    if page == "own-system.md":
        assert (tmp_path / "balls.csv").exists()
        friction, restitution = names["report"].friction, names["report"].restitution
        assert friction[1] == pytest.approx(0.4, abs=1e-3)
        assert restitution[1] == pytest.approx(0.5, abs=1e-3)
        assert names["report"].mass_ratio[1] == pytest.approx(0.5, abs=1e-2)
        assert names["stuck"].contact.any()
        assert "identified" in capsys.readouterr().out
