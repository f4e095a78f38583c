"""Build the site: ``python docs/site/build.py`` writes build/site/html, without a network.

The pages of ``docs/``, README, notebooks and the docstrings of all modules are laid out as Sphinx
needs them in ``build/site/source``; links to files of the repository become links to pages of the
site or to copies of the files. Warnings are errors.
"""

import os
import re
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BUILD = ROOT / "build" / "site"
SOURCE = BUILD / "source"
TOP_PAGES = {
    "README.md": "readme.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
LINK = re.compile(r"(?P<begin>\]\()(?P<target>[^)#\s]+)(?P<anchor>#[^)\s]*)?(?P<end>\))")
NO_PAGE = ("__main__.py", "conftest.py")


def page_of(path: Path) -> Path | None:
    """Return where the site has a file or folder of the repository, relative to its top."""
    name = path.relative_to(ROOT).as_posix()
    if name in TOP_PAGES:
        return Path(TOP_PAGES[name])
    if name.startswith("docs/site/"):
        return Path(name.removeprefix("docs/site/"))
    if name.startswith("docs/") and path.suffix in (".md", ".png"):
        return Path(name.removeprefix("docs/"))
    if name.startswith("notebooks/") and path.suffix == ".py":
        return Path(name).with_suffix(".md")
    if name.startswith("neuroslam/") and (path.suffix == ".py" or path.is_dir()):
        return Path(f"api/{module_name(path)}.rst")
    return None


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def with_links_of_the_site(text: str, file: Path, page: Path) -> str:
    """Return the text of a page with links to files of the repository led to pages of the site."""

    def link(match: re.Match[str]) -> str:
        target = match["target"]
        if "://" in target or target.startswith("mailto:"):
            return match[0]
        path = (file.parent / target).resolve()
        found = page_of(path)
        if found is None:
            if not path.is_file():
                raise SystemExit(f"{file.relative_to(ROOT)}: no file or page for {target}")
            found = Path("files") / path.relative_to(ROOT)
            write(found, path.read_bytes())
        relative = Path(os.path.relpath(found, page.parent)).as_posix()
        anchor = match["anchor"] or ""
        return f"{match['begin']}{relative}{anchor}{match['end']}"

    return LINK.sub(link, text)


def notebook(text: str) -> str:
    """Return a notebook, kept as a program with cells, as Markdown."""
    _, _, body = text.partition("# ---\n\n")
    pages = []
    for cell in re.split(r"^# %%", body, flags=re.MULTILINE)[1:]:
        head, _, lines = cell.partition("\n")
        if "[markdown]" in head:
            pages.append(re.sub(r"^# ?", "", lines, flags=re.MULTILINE).strip())
        else:
            shown = re.sub(r"^# %.*\n", "", lines, flags=re.MULTILINE).strip()
            pages.append(f"```python\n{shown}\n```")
    return "\n\n".join(pages) + "\n"


WRITTEN: set[Path] = set()


def with_further_pages(index: str) -> str:
    """Return the text of the front page with the pages that its navigation does not name yet."""
    pages = [path.relative_to(ROOT / "docs") for path in (ROOT / "docs").rglob("*.md")]
    names = [path.with_suffix("").as_posix() for path in pages if path.parts[0] != "site"]
    new = [name for name in sorted(names) if f"\n{name}\n" not in index]
    empty = "```{toctree}\n:caption: Further pages\n:hidden:\nFURTHER\n```\n\n"
    return index.replace("FURTHER", "\n".join(new)) if new else index.replace(empty, "")


def write(page: Path, content: bytes) -> None:
    """Write a file unless it is there: Sphinx builds only what is newer than its last build."""
    file = SOURCE / page
    WRITTEN.add(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    if not file.exists() or file.read_bytes() != content:
        file.write_bytes(content)


def lay_out_pages() -> None:
    files = [ROOT / name for name in TOP_PAGES]
    files += [*sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "notebooks").glob("*.py"))]
    for file in files:
        page = page_of(file)
        assert page is not None
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".py":
            text = notebook(text)
        if file == HERE / "index.md":
            text = with_further_pages(text)
        write(page, with_links_of_the_site(text, file, page).encode())
    for picture in sorted((ROOT / "docs" / "img").glob("*.png")):
        write(Path("img") / picture.name, picture.read_bytes())


def lay_out_api() -> None:
    """Write a page for every module, with its docstring and members, and one for all of them."""
    files = [path for path in (ROOT / "neuroslam").rglob("*.py") if path.name not in NO_PAGE]
    modules = sorted(map(module_name, files))
    for name in modules:
        inner = [
            each for each in modules if each.rpartition(".")[0] == name and each != "neuroslam"
        ]
        lines = [name, "=" * len(name), "", f".. automodule:: {name}"]
        lines += ["   :members:", "   :show-inheritance:", "   :ignore-module-all:", ""]
        if inner:
            lines += [".. toctree::", "   :maxdepth: 1", "", *(f"   {each}" for each in inner), ""]
        write(Path(f"api/{name}.rst"), "\n".join(lines).encode())


def main(builder: str = "html") -> int:
    """Lay out the pages and run Sphinx; the exit status is not 0 if it warns."""
    from sphinx.cmd.build import main as sphinx

    lay_out_pages()
    lay_out_api()
    for file in SOURCE.rglob("*"):
        if file.is_file() and file not in WRITTEN:
            file.unlink()
    command = ["-W", "--keep-going", "-q", "-b", builder, "-c", str(HERE)]
    return sphinx([*command, "-d", str(BUILD / "doctrees"), str(SOURCE), str(BUILD / builder)])


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
