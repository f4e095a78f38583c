"""State of semantic cells: known landmarks, their pointers and words, and the present."""

from collections.abc import Iterable
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import SemanticConfig
from neuroslam.sensors.landmarks import (
    KINDS,
    MOST_CORNERS,
    NAME_BYTES,
    WORDS_BYTES,
    LandmarkWords,
    checked_words,
)
from neuroslam.spiking.sightings import LEAST_SEEN, NAMED, NAMELESS, VIEW
from neuroslam.state.tables import GrowingTable, Scalars

_KINDS = ("landmark", "view", "nameless")


class Vocabulary(GrowingTable):
    """Known landmarks, one row for each.

    Columns: kind and number; position (``place_m``); number of sightings (``seen``); variance of
    the robot's position when the landmark was first seen; first frame; the experience at which it
    was first seen or that it is, -1 for none; its position in the frame of that experience
    (``offset_m``).
    """

    def __init__(self) -> None:
        super().__init__(
            {
                "kind": ((), torch.int64),
                "number": ((), torch.int64),
                "place_m": ((2,), torch.float64),
                "seen": ((), torch.int64),
                "variance_m2": ((), torch.float64),
                "first_frame": ((), torch.int64),
                "experience": ((), torch.int64),
                "offset_m": ((2,), torch.float64),
            }
        )
        self.row_of: dict[tuple[int, int], int] = {}
        """Row of each kind and number."""

    def confirmed(self) -> Tensor:
        """Return for each row whether it was seen often enough to be no outlier."""
        return (self["seen"] >= LEAST_SEEN) | (self["kind"] == VIEW)

    def nearest_nameless(self, place_m: np.ndarray, same_m: float) -> tuple[int, int]:
        """Find the nameless landmark at a position.

        Args:
            place_m: Position, ``(2,)``.
            same_m: Distance within which it is taken for a known one.

        Returns:
            Its row and 0; or -1 and the number for a new one; or -1 and -1 if it is ambiguous.
        """
        mine = np.flatnonzero(self["kind"].numpy() == NAMELESS)
        if not len(mine):
            return -1, 0
        away = np.linalg.norm(self["place_m"].numpy()[mine] - place_m, axis=1)
        order = np.argsort(away)
        if away[order[0]] > 2.0 * same_m:
            return -1, len(mine)
        ambiguous = len(away) > 1 and away[order[1]] < 2.0 * away[order[0]]
        if away[order[0]] > same_m or ambiguous:
            return -1, -1
        return int(mine[order[0]]), 0

    def index(self) -> None:
        """Rebuild :attr:`row_of` from the columns."""
        kinds, numbers = (self[c].tolist() for c in ("kind", "number"))
        self.row_of = {key: i for i, key in enumerate(zip(kinds, numbers, strict=True))}


class WordTable(GrowingTable):
    """Words of landmarks, walls and regions, of those not yet seen too; see ``LandmarkWords``.

    The words of a landmark are found by its number, so that they are the same in every session.
    Text is UTF-8, padded with zeros.

    Example:
        >>> table = WordTable()
        >>> table.update([LandmarkWords("DOOR", "BLUE * SQUARE", number=7)])
        >>> table.name_of(NAMED, 7), table.name_of(NAMED, 8)
        ('DOOR', 'landmark_8')
    """

    optional: ClassVar[bool] = True

    def __init__(self) -> None:
        super().__init__(
            {
                "kind": ((), torch.int64),
                "number": ((), torch.int64),
                "corners": ((MOST_CORNERS,), torch.int64),
                "name": ((NAME_BYTES,), torch.uint8),
                "words": ((WORDS_BYTES,), torch.uint8),
            }
        )
        self.entries: tuple[LandmarkWords, ...] = ()
        """All rows, decoded."""
        self._by_number: dict[int, LandmarkWords] = {}

    def update(self, entries: Iterable[LandmarkWords]) -> None:
        """Add entries; they replace those of the same number or name.

        Raises:
            SourceError: If an entry is invalid.
        """
        new = checked_words(entries, "words of landmarks")
        names = {entry.name.upper() for entry in new}
        numbers = {entry.number for entry in new if entry.kind == "landmark"}
        kept = [
            entry
            for entry in self.entries
            if entry.name.upper() not in names
            and not (entry.kind == "landmark" and entry.number in numbers)
        ]
        rows = [*kept, *new]
        if rows:
            corners = [[*r.corners, *[-1] * (MOST_CORNERS - len(r.corners))] for r in rows]
            self.replace(
                kind=torch.tensor([KINDS.index(r.kind) for r in rows]),
                number=torch.tensor([r.number for r in rows]),
                corners=torch.tensor(corners),
                name=torch.stack([_bytes_of(r.name, NAME_BYTES) for r in rows]),
                words=torch.stack([_bytes_of(r.words, WORDS_BYTES) for r in rows]),
            )
        self.index()

    def index(self) -> None:
        """Decode :attr:`entries` from the columns."""
        columns = [self[name].tolist() for name in ("name", "words", "kind", "number", "corners")]
        self.entries = tuple(
            LandmarkWords(
                _text_of(name),
                _text_of(words),
                KINDS[min(max(kind, 0), len(KINDS) - 1)],  # verify reports others
                number,
                tuple(corner for corner in corners if corner >= 0),
            )
            for name, words, kind, number, corners in zip(*columns, strict=True)
        )
        self._by_number = {e.number: e for e in self.entries if e.kind == "landmark"}

    def name_of(self, kind: int, number: int) -> str:
        """Return the name of a landmark: from the table, else made of its kind and number."""
        entry = self._by_number.get(number) if kind == NAMED else None
        return f"{_KINDS[kind]}_{number}" if entry is None else entry.name

    def words_of(self, kind: int, number: int) -> str:
        """Return the expression of a landmark's attributes; empty if it has none."""
        entry = self._by_number.get(number) if kind == NAMED else None
        return "" if entry is None else entry.words


def _bytes_of(text: str, length: int) -> Tensor:
    return torch.tensor(list(text.encode().ljust(length, b"\0")), dtype=torch.uint8)


def _text_of(values: list[int]) -> str:
    return bytes(values).rstrip(b"\0").decode("utf-8", "replace")


class SemanticState(Scalars):
    """Present state of semantic cells.

    Attributes:
        heading_rad: Heading of the robot.
        owed_s: Time since the last whole step of the simulation.
        frame: Number of the last frame.
        told: Landmark that has given the robot's position in this turn of attention, or -1.
    """

    heading_rad: float
    owed_s: float
    frame: int
    told: int

    def __init__(self, heading_rad: float) -> None:
        super().__init__(heading_rad=heading_rad, owed_s=0.0, frame=-1, told=-1)


def landmark_pointer(config: SemanticConfig, kind: int, number: int) -> Tensor:
    """Return the pointer of a landmark: random, of length 1, the same in every session."""
    draw = torch.Generator().manual_seed((config.seed * 3 + kind) * 1_000_003 + number)
    vector = torch.randn(config.key_features, generator=draw)
    return vector / vector.norm()
