"""The page "From the papers to the code": every item is there, and every name leads somewhere."""

import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).resolve().parents[2] / "docs"
SPEC = importlib.util.spec_from_file_location("papers", DOCS / "papers.py")
assert SPEC is not None
assert SPEC.loader is not None
papers = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(papers)

NUMBERED = {
    "multisession": {"Eq.": 17, "Table": 1, "Fig.": 18, "Algorithm": 1},
    "python": {},
    "slrb": {"Eq.": 15, "Table": 3, "Fig.": 13, "Algorithm": 1},
    "ssp": {"Eq.": 24, "Table": 2, "Fig.": 11},
}
"""Last number of each kind in each source."""

METHODS = {
    "VisualOdometry": 3, "LocalViewMatch": 7, "PoseCellNetwork": 17, "ExperienceMap": 9,
    "RatSLAM": 3, "Utils": 3,
}  # fmt: skip
"""Methods that the documentation of 2017 describes, by class."""

RATSLAM_PARAMETERS = 28
"""Rows of Table 1 of the multisession paper."""


def rows(field):
    """Return all rows that have a field, as parameters of a test."""
    return [
        pytest.param(source, row, id=f"{source}: {row['item']}")
        for source in papers.TABLE
        for _, row in papers.rows_of(source)
        if field in row
    ]


def items(source):
    return [row["item"] for _, row in papers.rows_of(source)]


def test_the_page_is_the_one_that_the_script_makes():
    assert (DOCS / "papers.md").read_text("utf-8") == papers.page(), "run: python docs/papers.py"


def test_the_readme_links_to_the_page():
    assert "(docs/papers.md)" in (DOCS.parent / "README.md").read_text("utf-8")


@pytest.mark.parametrize("source", NUMBERED)
def test_every_numbered_item_has_a_row(source):
    named = items(source)
    missing = [
        f"{kind} {k}"
        for kind, last in NUMBERED[source].items()
        for k in range(1, last + 1)
        if not any(re.match(rf"{re.escape(kind)} {k}(?!\d)", item) for item in named)
    ]
    assert missing == []


@pytest.mark.parametrize("source", NUMBERED)
def test_no_row_has_a_number_that_the_source_has_not(source):
    for item in items(source):
        found = re.match(r"(Eq\.|Table|Fig\.|Algorithm) (\d+)", item)
        assert found is None or int(found[2]) <= NUMBERED[source][found[1]], item


def test_every_method_of_the_documentation_has_a_row():
    found = [item.split(".")[0] for item in items("python") if re.fullmatch(r"\w+\.\w+", item)]
    assert {name: found.count(name) for name in dict.fromkeys(found)} == METHODS


def test_every_row_of_the_table_of_parameters_is_there():
    found = [item for item in items("multisession") if item.startswith("Table 1, ")]
    assert len(found) == RATSLAM_PARAMETERS


def test_the_sources_are_these_and_no_item_is_there_twice():
    assert papers.TABLE.keys() == NUMBERED.keys()
    for source in papers.TABLE:
        assert len(set(items(source))) == len(items(source))
    assert all(
        key in papers.GROUPS or key in ("title", "cite", "note", "configs")
        for about in papers.TABLE.values()
        for key in about
    )


@pytest.mark.parametrize(("source", "row"), rows("item"))
def test_a_row_is_complete(source, row):
    own = {"key", "printed"} if "key" in row else {"says", "where"}
    assert row.keys() - {"why"} == {"item", "status"} | own
    assert row["status"] in papers.STATUSES
    assert row["status"] == "as printed" or row["why"], "a reason is needed"
    texts = [row["item"], row.get("says", "x"), row.get("why", "x")]
    assert all(text and text == text.strip() and "\n" not in text for text in texts)


@pytest.mark.parametrize(("source", "row"), rows("where"))
def test_every_place_of_a_row_is_there(source, row):
    assert row["where"]
    for place in row["where"]:
        papers.check_place(place)


@pytest.mark.parametrize(("source", "row"), rows("where"))
def test_a_number_in_a_remark_is_on_a_page_that_the_row_links_to(source, row):
    pages = [place.partition("#")[0] for place in row["where"] if ".md" in place]
    text = " ".join((papers.ROOT / page).read_text("utf-8") for page in pages)
    numbers = re.findall(r"\d*\.\d+|\d{2,}", row.get("why", "") if pages else "")
    assert [n for n in numbers if not re.search(rf"(?<![\d.]){re.escape(n)}(?!\d)", text)] == []


@pytest.mark.parametrize(("source", "row"), rows("key"))
def test_a_parameter_has_a_key_and_is_as_printed_only_if_it_is(source, row):
    assert row in papers.TABLE[source]["parameters"]
    ours = papers.values_of(source, row)
    pairs = zip(ours, row["printed"], strict=True)
    known = [(mine, theirs) for mine, theirs in pairs if theirs != papers.UNKNOWN]
    if row["status"] == "as printed":
        assert known
        assert all(mine == theirs for mine, theirs in known)


@pytest.mark.parametrize(
    "place",
    [
        "neuroslam.cells.pose.PoseCells", "neuroslam.nothing", "pose_cells.n_z", "nothing.n_xy",
        "experiment nothing", "preset nothing", "docs/nothing.md", "docs/sessions.md#nothing",
    ],
)  # fmt: skip
def test_a_place_that_is_not_there_is_found_out(place):
    with pytest.raises((LookupError, AttributeError, ModuleNotFoundError)):
        papers.check_place(place)
