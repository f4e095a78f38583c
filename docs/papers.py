"""Write ``docs/papers.md`` from ``docs/papers.toml``: ``python docs/papers.py``."""

import importlib
import re
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

import neuroslam
from neuroslam.config import BrainConfig, build_config, preset_names, read_preset
from neuroslam.config.semantic import SSPSLAMConfig
from neuroslam.experiments import EXPERIMENTS

Row = dict[str, Any]

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(neuroslam.__file__).resolve().parents[1]
TABLE = tomllib.loads(Path(__file__).with_name("papers.toml").read_text(encoding="utf-8"))

STATUSES = {
    "as printed": "the same formula, value, figure or result",
    "corrected": "the text has an error or lost symbols; the code has what must be meant",
    "differs": "another formula, value or result, for the reason given",
    "not built": "absent, for the reason given",
}

GROUPS = {
    "equations": "Equations and algorithms",
    "parameters": "Parameters",
    "tables": "Tables",
    "methods": "Methods",
    "attributes": "Attributes",
    "settings": "Parameters",
    "figures": "Figures",
    "claims": "Claims and results",
}

HEAD = """# From the papers to the code

You find here every equation, table, figure, parameter and claim of the four sources: where it is in
the package, and what differs. Numbers in remarks are from the page that a row links to;
`neuroslam experiment NAME` measures them again.
"""

UNKNOWN = "-"
"""A value that the source does not give."""


def rows_of(source: str) -> list[tuple[str, Row]]:
    """Return the rows of a source with their groups, in the order of the page."""
    return [(group, row) for group in GROUPS for row in TABLE[source].get(group, ())]


@lru_cache
def find(dotted: str) -> tuple[Path, str]:
    """Return the file and the rest of a dotted name; ``AttributeError`` if nothing has it."""
    parts = dotted.split(".")
    for n in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:n]))
        except ModuleNotFoundError:
            continue
        path = Path(found.__file__ or "").resolve()
        for part in parts[n:]:
            # A field of a named tuple or of a model, or the type of a buffer, is no attribute.
            known = getattr(found, "__annotations__", {})
            found = getattr(found, part) if hasattr(found, part) else known[part]
        return path.relative_to(PACKAGE), ".".join(parts[n:])
    raise ModuleNotFoundError(dotted)


@lru_cache
def config_named(name: str) -> BrainConfig | SSPSLAMConfig:
    """Return the config of a preset, or the defaults: of a brain for ``""``, or of SSP-SLAM."""
    if name == SSPSLAMConfig.__name__:
        return SSPSLAMConfig()
    return build_config(read_preset(name), name) if name else BrainConfig()


def value_of(config: BrainConfig | SSPSLAMConfig, key: str) -> Any:
    """Return the value of ``section.key``, or of one of its numbers, ``section.key.0``."""
    value: Any = config
    for part in key.split("."):
        if part.isdigit():
            value = None if value is None else value[int(part)]
        else:
            value = getattr(value, part)
    return value


def values_of(source: str, row: Row) -> list[Any]:
    """Return our values of a parameter, in the order of the printed ones."""
    return [value_of(config_named(name), row["key"]) for name in TABLE[source]["configs"]]


def slugs(page: Path) -> set[str]:
    """Return the anchors of a Markdown page."""
    heads = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def check_place(place: str) -> None:
    """Raise an error that names what a place refers to, if that is not there."""
    kind, _, name = place.partition(" ")
    if kind == "experiment":
        if name not in EXPERIMENTS:
            raise LookupError(f"no experiment {name!r}")
    elif kind == "preset":
        if name not in preset_names():
            raise LookupError(f"no preset {name!r}")
    elif "/" in place or place.partition("#")[0].endswith(".md"):
        file, _, anchor = place.partition("#")
        if not (ROOT / file).is_file():
            raise LookupError(f"no file {file}")
        if anchor and anchor not in slugs(ROOT / file):
            raise LookupError(f"no heading {anchor} in {file}")
    elif place.startswith("neuroslam."):
        find(place)
    else:
        value_of(BrainConfig(), place)


def as_link(place: str) -> str:
    """Return a place as Markdown, with a link from the page to its file."""
    kind, _, name = place.partition(" ")
    if kind == "experiment":
        return f"`experiment {name}`"
    if kind == "preset":
        return f"[`--preset {name}`](../configs/{name}.toml)"
    if place.startswith("neuroslam."):
        file, rest = find(place)
        return f"[`{rest or place.removeprefix('neuroslam.')}`](../{file.as_posix()})"
    file = place.partition("#")[0]
    if "/" in file or file.endswith(".md"):
        return f"[{Path(file).name}]({place[5:] if file.startswith('docs/') else f'../{place}'})"
    section = place.rpartition(".")[0].replace(".", "") or "outside-of-sections"
    return f"[`{place}`](parameters.md#{section})"


def as_text(value: object) -> str:
    """Return a value as it is written in a table."""
    if value is None or value == UNKNOWN:
        return "-"
    return f"{value:g}" if isinstance(value, int | float) else str(value)


def cells(*texts: str) -> str:
    """Return a row of a Markdown table."""
    return "| " + " | ".join(text.replace("|", "\\|") for text in texts) + " |"


def header(*names: str) -> list[str]:
    """Return the first two lines of a Markdown table."""
    return [cells(*names), "|" + "---|" * len(names)]


def parameters(source: str, rows: list[Row]) -> list[str]:
    """Return a table of printed values and ours."""
    configs = TABLE[source]["configs"]
    of = f": {', '.join(configs)}" if len(configs) > 1 else ""
    lines = header("item", "key", f"printed{of}", "ours", "status", "remark")
    for row in rows:
        ours, printed = values_of(source, row), row["printed"]
        known = [mine for mine, theirs in zip(ours, printed, strict=True) if theirs != UNKNOWN]
        same = known and known == [theirs for theirs in printed if theirs != UNKNOWN]
        text = "the same" if same else ", ".join(map(as_text, ours))
        key, theirs = f"`{row['key']}`", ", ".join(map(as_text, printed))
        lines.append(cells(row["item"], key, theirs, text, row["status"], row.get("why", "")))
    return lines


def places(rows: list[Row], *, names: bool) -> list[str]:
    """Return a table of what is printed and where it is; items may be names of the source."""
    lines = header("item", "what it says", "where", "status", "remark")
    for row in rows:
        where = ", ".join(map(as_link, row["where"]))
        item = re.sub(r"[\w.*]*_[\w.*]*", r"`\g<0>`", row["item"]) if names else row["item"]
        lines.append(cells(item, row["says"], where, row["status"], row.get("why", "")))
    return lines


def summary() -> list[str]:
    """Return a table of the number of rows by source and status."""
    lines = header("source", *STATUSES)
    for source, about in TABLE.items():
        counts = [sum(row["status"] == status for _, row in rows_of(source)) for status in STATUSES]
        anchor = re.sub(r"[^\w\- ]", "", about["title"].lower()).replace(" ", "-")
        lines.append(cells(f"[{about['title']}](#{anchor})", *map(str, counts)))
    return lines


def page() -> str:
    """Return the text of the page."""
    lines = [HEAD, *header("status", "meaning")]
    lines += [cells(status, meaning) for status, meaning in STATUSES.items()]
    lines += ["", *summary()]
    for source, about in TABLE.items():
        lines += [f"\n## {about['title']}", about["cite"]]
        if about["note"]:
            lines += ["", about["note"]]
        for group, name in GROUPS.items():
            rows = about.get(group)
            if rows and group == "parameters":
                lines += [f"\n### {name}", *parameters(source, rows)]
            elif rows:
                names = group in ("methods", "settings")
                lines += [f"\n### {name}", *places(rows, names=names)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("papers.md").write_text(page(), encoding="utf-8")
