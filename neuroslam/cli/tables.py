"""Tables of results."""

from collections.abc import Iterator
from typing import Any

from rich import table as rich
from rich.table import Column

from neuroslam.errors import printable


class Table(rich.Table):
    """A table whose text is escaped: names come from elsewhere."""

    def add_row(self, *cells: Any, **options: Any) -> None:  # noqa: ANN401 - as in rich
        """Add a row of cells."""
        super().add_row(*(printable(c) if isinstance(c, str) else c for c in cells), **options)


def new_table(*names: str, title: str | None = None, headed: bool = True) -> Table:
    """Make a table that folds long cells and never truncates them, so that names can be copied."""
    columns = (Column(name, overflow="fold") for name in names)
    title = None if title is None else printable(title)
    return Table(*columns, title=title, show_header=headed)


def down(rows: list[dict[str, Any]], title: str) -> Table:
    """Make a table with one line per row."""
    table = new_table(*(key.replace("_", " ") for key in rows[0]), title=title)
    for row in rows:
        table.add_row(*map(shown, row.values()))
    return table


def across(rows: list[dict[str, Any]], title: str) -> Iterator[Table]:
    """Make transposed tables, three rows as columns each: for many figures of few maps."""
    for first in range(0, len(rows), 3):
        some = rows[first : first + 3]
        table = Table(title=printable(title), show_header=False)
        for key in dict.fromkeys(key for row in some for key in row):
            cells = [shown(row.get(key, "")) for row in some]
            if any(cells):
                table.add_row(key.replace("_", " "), *cells)
        yield table


def shown(value: object) -> str:
    """Format a value for a table: four significant digits, empty for NaN."""
    if isinstance(value, float):
        return f"{value:.4g}" if value == value else ""  # NaN is not equal to itself
    text = "; ".join(map(shown, value)) if isinstance(value, list) else str(value)
    return text.replace("_", " ")
