"""Words of landmarks: a table of names, attributes, walls and regions, from a file or a world."""

import ast
import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from neuroslam.errors import SourceError
from neuroslam.limits import parse_toml, read_bounded

Kind = Literal["landmark", "wall", "region"]
"""A point with a number; a line through landmarks; a polygon whose corners are landmarks."""

KINDS: tuple[Kind, ...] = ("landmark", "wall", "region")
MOST_CORNERS = 16
NAME_BYTES, WORDS_BYTES = 64, 128
MOST_TABLE_BYTES = 16 * 2**20
"""Largest table of landmarks: some hundred thousand entries."""
_LEAST_CORNERS = {"landmark": 0, "wall": 2, "region": 3}
_COLUMNS = ("kind", "number", "name", "words", "corners")
_RESERVED = ("landmark_", "view_", "nameless_")


class LandmarkWords(NamedTuple):
    """Name and attributes of a landmark, a wall or a region.

    Attributes:
        name: Unique; letters, digits and underscores.
        words: Expression of attributes: ``BLUE * SQUARE`` binds, ``BLUE + SQUARE`` bundles; empty
            for none.
        kind: What it is.
        number: Of a landmark, as the source or the marker has it; -1 for walls and regions.
        corners: Numbers of the landmarks at the corners of a wall or region, in order.
    """

    name: str
    words: str = ""
    kind: Kind = "landmark"
    number: int = -1
    corners: tuple[int, ...] = ()


def products(expression: str) -> tuple[frozenset[str], ...]:
    """Expand an expression of words into a sum of products, each a set of words.

    Args:
        expression: Words, ``*`` to bind, ``+`` to add, and brackets.

    Raises:
        SourceError: If it is anything else.

    Example:
        >>> [sorted(product) for product in products("BLUE * (SQUARE + TRIANGLE)")]
        [['BLUE', 'SQUARE'], ['BLUE', 'TRIANGLE']]
    """
    try:
        tree: ast.AST | None = ast.parse(expression.strip(), mode="eval").body
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        tree = None
    return _products(tree, expression)


def _products(node: ast.AST | None, whole: str) -> tuple[frozenset[str], ...]:
    match node:
        case ast.Name(id=word):
            return (frozenset([word.upper()]),)
        case ast.BinOp(left=left, op=ast.Mult(), right=right):
            return tuple(a | b for a in _products(left, whole) for b in _products(right, whole))
        case ast.BinOp(left=left, op=ast.Add(), right=right):
            return _products(left, whole) + _products(right, whole)
    raise SourceError(
        f"cannot read the words {whole!r}; expected names, * to bind, + to add, and brackets, "
        "such as BLUE * (SQUARE + TRIANGLE)"
    )


def checked_words(table: Iterable[LandmarkWords], origin: str) -> tuple[LandmarkWords, ...]:
    """Return a table of words after checking it.

    Args:
        table: Its entries.
        origin: Where it comes from, for messages.

    Raises:
        SourceError: If a name is invalid, or a name or number occurs twice, a kind is unknown,
            words cannot be read or are too long, or corners are too few, too many or no landmarks.

    Example:
        >>> checked_words([LandmarkWords("DOOR", "BLUE ** 2", number=3)], "table")
        Traceback (most recent call last):
        neuroslam.errors.SourceError: table: DOOR: cannot read the words 'BLUE ** 2'; expected \
names, * to bind, + to add, and brackets, such as BLUE * (SQUARE + TRIANGLE)
    """
    entries = tuple(table)
    names: set[str] = set()
    numbers: set[int] = set()
    for entry in entries:
        where = f"{origin}: {entry.name}"
        if not entry.name.isidentifier() or len(entry.name.encode()) > NAME_BYTES:
            raise SourceError(
                f"{origin}: {entry.name!r} is no name; expected letters, digits and underscores, "
                f"at most {NAME_BYTES} bytes"
            )
        if entry.name.upper() in names:
            raise SourceError(f"{where}: occurs twice; give each entry its own name")
        if entry.name.lower().startswith(_RESERVED):
            raise SourceError(
                f"{where}: names that begin with {', '.join(_RESERVED)} are those of landmarks "
                "without a name; choose another"
            )
        if entry.kind not in KINDS:
            raise SourceError(f"{where}: is a {entry.kind!r}; expected {', '.join(KINDS)}")
        if entry.words:
            try:
                products(entry.words)
            except SourceError as error:
                raise SourceError(f"{where}: {error}") from None
        if len(entry.words.encode()) > WORDS_BYTES:
            raise SourceError(
                f"{where}: {len(entry.words.encode())} bytes of words; expected at most "
                f"{WORDS_BYTES}"
            )
        _check_numbers(entry, where)
        if entry.kind == "landmark":
            if entry.number in numbers:
                raise SourceError(
                    f"{where}: number {entry.number} occurs twice; give each landmark its own"
                )
            numbers.add(entry.number)
        names.add(entry.name.upper())
    return entries


def _check_numbers(entry: LandmarkWords, where: str) -> None:
    if entry.kind == "landmark":
        if not 0 <= entry.number < 2**53 or entry.corners:
            raise SourceError(
                f"{where}: a landmark has a number of 0 or more and no corners, got number "
                f"{entry.number} and corners {list(entry.corners)}"
            )
        return
    least, n = _LEAST_CORNERS[entry.kind], len(entry.corners)
    if entry.number != -1 or not least <= n <= MOST_CORNERS or min(entry.corners) < 0:
        raise SourceError(
            f"{where}: a {entry.kind} has {least} to {MOST_CORNERS} numbers of landmarks as "
            f"corners and no number of its own, got {list(entry.corners)}"
        )


def read_landmarks(path: str | Path) -> tuple[LandmarkWords, ...]:
    """Read the words of landmarks from a CSV or TOML file.

    A CSV file has a header of some of ``kind,number,name,words,corners``; corners are separated by
    spaces. A TOML file has a table ``[[landmark]]``, ``[[wall]]`` or ``[[region]]`` for each entry,
    with the same keys.

    Args:
        path: Ends in ``.csv`` or ``.toml``.

    Raises:
        SourceError: If the file cannot be read, or an entry is invalid.
    """
    path = Path(path)
    try:
        text = read_bounded(path, MOST_TABLE_BYTES).decode("utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; expected a table of landmarks") from None
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"{path}: cannot be read ({reason})") from None
    entries = _from_toml(text, path) if path.suffix.lower() == ".toml" else _from_csv(text, path)
    if not entries:
        raise SourceError(f"{path}: has no entries; expected a row for each landmark")
    return checked_words(entries, str(path))


def _from_csv(text: str, path: Path) -> list[LandmarkWords]:
    try:
        return _entries(csv.DictReader(io.StringIO(text), skipinitialspace=True, restkey=""), path)
    except csv.Error as error:
        raise SourceError(f"{path}: is no CSV table ({error})") from None


def _entries(rows: "csv.DictReader[str]", path: Path) -> list[LandmarkWords]:
    columns = [name.strip() for name in rows.fieldnames or ()]
    if "name" not in columns or set(columns) - set(_COLUMNS):
        raise SourceError(
            f"{path}: columns {', '.join(columns) or 'none'}; expected name, and some of "
            f"{', '.join(column for column in _COLUMNS if column != 'name')}"
        )
    rows.fieldnames = columns
    entries = []
    for row in rows:
        if "" in row:
            raise SourceError(
                f"{path}: line {rows.line_num} has more values than columns; quote words that "
                "hold a comma"
            )
        values: dict[str, Any] = {name: (value or "").strip() for name, value in row.items()}
        values["corners"] = values.get("corners", "").split()
        entries.append(_entry(values, f"{path}: line {rows.line_num}"))
    return entries


def _from_toml(text: str, path: Path) -> list[LandmarkWords]:
    try:
        tables = parse_toml(text)
    except ValueError as error:
        raise SourceError(f"{path}: is not TOML ({error})") from None
    entries = []
    for kind, rows in tables.items():
        if kind not in KINDS or not isinstance(rows, list):
            raise SourceError(f"{path}: has {kind!r}; expected tables [[{']], [['.join(KINDS)}]]")
        for i, row in enumerate(rows):
            where = f"{path}: {kind} {i}"
            unknown = sorted(set(row) - set(_COLUMNS[1:])) if isinstance(row, dict) else ["value"]
            if unknown:
                raise SourceError(
                    f"{where}: has {', '.join(unknown)}; expected {', '.join(_COLUMNS[1:])}"
                )
            entries.append(_entry({**row, "kind": kind}, where))
    return entries


def _entry(values: Mapping[str, Any], where: str) -> LandmarkWords:
    corners = values.get("corners", ())
    try:
        if not isinstance(corners, Sequence) or isinstance(corners, str):
            raise TypeError("corners")
        number = values.get("number", "")
        return LandmarkWords(
            str(values.get("name", "")),
            str(values.get("words", "")),
            values.get("kind") or "landmark",
            -1 if number == "" else int(number),
            tuple(int(corner) for corner in corners),
        )
    except (TypeError, ValueError):
        raise SourceError(
            f"{where}: number {values.get('number', '')!r}, corners {corners!r}; expected whole "
            "numbers"
        ) from None
