"""The site has every page in its navigation, its links lead somewhere, its formulas are shown."""

import importlib
import importlib.util
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = ROOT / "docs" / "site"


@pytest.fixture
def build(tmp_path, monkeypatch):
    """Return the program that builds the site, which lays out its pages in a folder of the test."""
    spec = importlib.util.spec_from_file_location("site_build", SITE / "build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "SOURCE", tmp_path)
    monkeypatch.setattr(module, "WRITTEN", set())
    return module


def test_every_page_is_in_the_navigation_once(build):
    index = build.with_further_pages((SITE / "index.md").read_text("utf-8"))
    assert "FURTHER" not in index
    listed = re.findall(r"^(?:API <)?([\w/]+)>?$", index, re.MULTILINE)
    pages = {
        path.relative_to(ROOT / "docs").with_suffix("").as_posix()
        for path in (ROOT / "docs").rglob("*.md")
        if path.parent != SITE
    }
    tops = {"readme", "changelog", "contributing", "security"}
    assert sorted(listed) == sorted(pages | tops | {"api/neuroslam"})


def test_a_page_that_the_navigation_does_not_name_is_added(build):
    index = (SITE / "index.md").read_text("utf-8").replace("\nmemory\n", "\n")
    further = build.with_further_pages(index).partition("Further pages\n:hidden:\n")[2]
    assert further.startswith("memory\n```")


def test_links_of_pages_lead_to_pages_of_the_site(build, tmp_path):
    build.lay_out_pages()
    build.lay_out_api()
    for page in tmp_path.rglob("*.md"):
        for target in re.findall(r"\]\(([^)#\s]+)[^)\s]*\)", page.read_text("utf-8")):
            found = (page.parent / target).resolve()
            assert "://" in target or found.is_file(), f"{page.name}: {target}"
            assert "://" in target or found.is_relative_to(tmp_path)
    assert (tmp_path / "api/neuroslam.brain.brain.rst").is_file()
    assert "## Start" in (tmp_path / "readme.md").read_text("utf-8")


def test_a_notebook_becomes_text_and_programs(build):
    cells = ["[markdown]\n# # Title\n# Text\n\n", "\n# %matplotlib inline\na = 1\n"]
    text = "# ---\n# x\n# ---\n\n" + "".join(f"# %%{cell}" for cell in cells)
    assert build.notebook(text) == "# Title\nText\n\n```python\na = 1\n```\n"


def test_every_formula_is_shown(monkeypatch):
    for name in ("latex2mathml", "sphinx"):
        pytest.importorskip(name, reason="needs the extra docs")
    monkeypatch.syspath_prepend(SITE)
    mathml = importlib.import_module("mathml")
    formulas = [
        formula
        for path in sorted((ROOT / "neuroslam").rglob("*.py"))
        for formula in re.findall(r":math:`([^`]+)`", path.read_text("utf-8"))
    ]
    assert len(formulas) > 400
    for formula in formulas:
        assert mathml.to_mathml(formula, "inline").startswith("<math")
    monkeypatch.delitem(sys.modules, "mathml")
