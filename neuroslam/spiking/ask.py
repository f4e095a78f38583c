"""Questions in words to a semantic map: parsed, answered from the memory, with coordinates."""

import math
import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.errors import SourceError, SpaceError, did_you_mean
from neuroslam.sensors.landmarks import KINDS, Kind, products
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.extents import area_share, distance_to, length_share
from neuroslam.spiking.semantic import CLEAR, SemanticCells
from neuroslam.spiking.sightings import VIEW
from neuroslam.spiking.slam import SSPSLAM

EXAMPLES = (
    "what is at 2,1",
    "what is in 0,0,4,2",
    "where is DOOR",
    "which landmarks are blue",
    "the whole map",
)
_LEAST_STRENGTH = 0.1  # of a recall, below which a landmark is not known
_NUMBER = r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)"
_COMMA = r"\s*[,\s]\s*"
_FORMS = (
    ("at", rf"what(?: is|'s| are)? at {_NUMBER}{_COMMA}{_NUMBER}"),
    ("box", rf"what(?: is|'s| are)? in(?: the)?(?: box)? {_COMMA.join([_NUMBER] * 4)}"),
    ("where", r"where(?: is|'s| are)(?: the)? (.+)"),
    ("which", r"which(?: landmarks)?(?: are| is) (.+)"),
    ("map", r"(?:the )?(?:whole )?map"),
)


class Question(NamedTuple):
    """A parsed question.

    Attributes:
        form: ``at``, ``box``, ``where``, ``which`` or ``map``.
        numbers: Coordinates in metres: x, y, or those of two corners.
        words: What is asked for; empty for none.
        text: The question as it was asked.
    """

    form: str
    numbers: tuple[float, ...]
    words: str
    text: str


class Found(NamedTuple):
    """A landmark, wall or region in an answer.

    Attributes:
        name: Its name.
        kind: What it is.
        words: Expression of its attributes; empty for none.
        position_m: As the memory recalls it; of walls and regions the mean of their corners.
        corners_m: Corners of a wall or region, ``(n, 2)``; none for a landmark.
        distance_m: From the position asked for; NaN if none was.
        share: Share of it in the box asked for; NaN if none was.
        strength: Strength of its recall, 1 for a whole one; of the weakest corner.
        covariance_m2: Covariance of the position of a landmark, rows of ``(2, 2)``, see
            :meth:`~neuroslam.spiking.slam.SSPSLAM.uncertainty`; none if sightings are exact.
    """

    name: str
    kind: Kind
    words: str
    position_m: tuple[float, float]
    corners_m: tuple[tuple[float, float], ...] = ()
    distance_m: float = math.nan
    share: float = math.nan
    strength: float = 1.0
    covariance_m2: tuple[tuple[float, float], ...] = ()

    @property
    def sigma_m(self) -> tuple[float, float]:
        """Standard deviations along the longer and the shorter axis of its uncertainty ellipse.

        Example:
            >>> rows = (1.0, 0.0), (0.0, 4.0)
            >>> Found("DOOR", "landmark", "", (0.0, 0.0), covariance_m2=rows).sigma_m
            (2.0, 1.0)
        """
        if not self.covariance_m2:
            return math.nan, math.nan
        small, large = np.sqrt(np.linalg.eigvalsh(self.covariance_m2).clip(0.0)).tolist()
        return large, small

    def to_dict(self) -> dict[str, Any]:
        """Return the fields that are known, for JSON."""
        fields = {k: list(v) if k == "position_m" else v for k, v in self._asdict().items()}
        fields["corners_m"] = [list(corner) for corner in self.corners_m]
        fields["covariance_m2"] = [list(row) for row in self.covariance_m2]
        if not self.covariance_m2:
            del fields["covariance_m2"]
        return {k: v for k, v in fields.items() if not (isinstance(v, float) and math.isnan(v))}


class Answer(NamedTuple):
    """The answer of a map to a question.

    Attributes:
        question: What was asked.
        found: What answers it: landmarks, then walls, then regions; at a position the nearest
            of each first, else in the order of the map.
        note: One line on what was not found; empty for none.
        everything: All that the map knows, to draw it.
    """

    question: Question
    found: tuple[Found, ...]
    note: str
    everything: tuple[Found, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return question and answer, for JSON."""
        return {
            "question": self.question.text,
            "found": [one.to_dict() for one in self.found],
            "note": self.note,
        }


class Contents(NamedTuple):
    """All that a semantic map knows.

    Attributes:
        found: Landmarks, walls and regions with their recalled positions.
        missing: Name in capitals -> why what has this name is not among them.
        words: All words in capitals, also of what is not among them.
    """

    found: tuple[Found, ...]
    missing: dict[str, str]
    words: frozenset[str]


def parse_question(text: str) -> Question:
    """Parse a question.

    Args:
        text: In one of the forms of ``EXAMPLES``; case and a question mark do not matter.

    Raises:
        SpaceError: If it has none of them; one line with examples.

    Example:
        >>> parse_question("What is in the box 0,0, 4,2?")[:2]
        ('box', (0.0, 0.0, 4.0, 2.0))
        >>> parse_question("what is blue")
        Traceback (most recent call last):
        neuroslam.errors.SpaceError: cannot read 'what is blue'; ask, for example: what is at 2,1; \
what is in 0,0,4,2; where is DOOR; which landmarks are blue; the whole map
        >>> parse_question("which landmarks are blue")[2]
        'blue'
    """
    plain = " ".join(text.strip().rstrip("?!. ").split())
    for form, pattern in _FORMS:
        match = re.fullmatch(pattern, plain, re.IGNORECASE)
        if match is None:
            continue
        if form in ("where", "which"):
            return Question(form, (), match[1], text)
        numbers = tuple(map(float, match.groups()))
        if not all(map(math.isfinite, numbers)):
            raise SpaceError(f"cannot read {text!r}: a coordinate is not a finite number")
        if form == "box" and not (numbers[0] <= numbers[2] and numbers[1] <= numbers[3]):
            raise SpaceError(
                f"cannot read {text!r}: a box is x0,y0,x1,y1, the lower corner first; got "
                f"{', '.join(f'{x:g}' for x in numbers)}"
            )
        return Question(form, numbers, "", text)
    raise SpaceError(f"cannot read {text!r}; ask, for example: {'; '.join(EXAMPLES)}")


def ask(
    semantic_map: SemanticCells | SSPSLAM,
    question: str | Question,
    within_m: float | None = None,
    unit: str = "m",
) -> Answer:
    """Answer a question from the memory of a semantic map.

    Every position is recalled: the pointer of a landmark is the key, and the vector that the memory
    returns is decoded, if it is like that of one position. Names and attributes select the
    pointers. Walls and regions have their corners at recalled landmarks. Views and landmarks that
    were seen only once or twice are left out.

    Args:
        semantic_map: Semantic cells of a brain, or a map of its own in the plane.
        question: See :func:`parse_question`.
        within_m: Distance up to which something is at a position; ``None``: ``same_m`` of the
            cells, or one length scale of the map.
        unit: Of lengths on the map; ``arbitrary unit`` for one camera alone.

    Raises:
        SpaceError: If the question cannot be read, or a name or word is not known to the map.

    Example:
        >>> from neuroslam.config.semantic import SemanticConfig
        >>> from neuroslam.sensors.landmarks import LandmarkWords
        >>> from neuroslam.spiking.sightings import Sightings
        >>> from neuroslam.types import Motion
        >>> cells = SemanticCells(SemanticConfig())
        >>> cells.name_landmarks([LandmarkWords("DOOR", "BLUE * TALL", number=7)])
        >>> for _ in range(20):
        ...     update = cells.advance(
        ...         Motion(0.0, 0.0, 0.1), Sightings.of(np.array([[7.0, 2.0, 0.0]]))
        ...     )
        >>> [(one.name, round(one.position_m[0], 1)) for one in ask(cells, "which are blue").found]
        [('DOOR', 2.0)]
    """
    asked = parse_question(question) if isinstance(question, str) else question
    known = contents(semantic_map)
    everything = known.found
    if within_m is None:
        within_m = (
            semantic_map.config.same_m
            if isinstance(semantic_map, SemanticCells)
            else float(semantic_map.space.length_scale_m.max())
        )
    note = ""
    match asked.form:
        case "at":
            found, note = _at(everything, asked.numbers, within_m, unit)
        case "box":
            found = _in_box(everything, asked.numbers)
            note = "" if found else "nothing is in the box"
        case "map":
            found = list(everything)
            note = "" if found else "the map knows no landmarks"
        case _:
            found, note = _described(known, asked)
    return Answer(asked, tuple(found), note, everything)


def contents(semantic_map: SemanticCells | SSPSLAM) -> Contents:
    """Recall all that a map knows.

    Args:
        semantic_map: As for :func:`ask`.
    """
    cells = semantic_map if isinstance(semantic_map, SemanticCells) else None
    slam = semantic_map.slam if isinstance(semantic_map, SemanticCells) else semantic_map
    if slam.space.dimension != 2:
        raise SpaceError(
            f"ask: a map of {slam.space.dimension} dimensions; questions are about the plane"
        )
    with torch.inference_mode():
        z = slam.space.to_fourier(slam.map.read(slam.pointers)[0])
        strength = z.abs().square().mean(-1).sqrt().tolist()
        whole = slam.wholeness(z).tolist()
        decoded = PositionDecoder(slam.space)(z)
        at, clear = decoded.position_m.tolist(), decoded.similarity.tolist()
        spread = slam.uncertainty(z)
    rows = range(len(slam.names)) if cells is None else _confirmed(cells)
    found: list[Found] = []
    by_number: dict[int, Found] = {}
    missing: dict[str, str] = {}
    for row in rows:
        name, words, number = slam.names[row], "", -1
        if cells is not None:
            kind, number = (int(cells.known[c][row]) for c in ("kind", "number"))
            words = cells.words.words_of(kind, number)
        if strength[row] < _LEAST_STRENGTH or clear[row] < CLEAR * whole[row]:
            missing[name.upper()] = f"{name} is not recalled clearly, strength {strength[row]:.2f}"
            continue
        x, y = at[row]
        one = Found(name, "landmark", words, (x, y), strength=strength[row])
        if spread is not None:
            (xx, xy), (yx, yy) = spread.covariance_m2[row].tolist()
            one = one._replace(
                strength=float(spread.strength[row]), covariance_m2=((xx, xy), (yx, yy))
            )
        found.append(one)
        if cells is not None and kind == 0:
            by_number[number] = one
    if cells is not None:
        for entry in cells.words.entries:
            if entry.kind == "landmark":
                if entry.number not in by_number:
                    missing.setdefault(entry.name.upper(), f"{entry.name} was not seen")
                continue
            unknown = [str(n) for n in entry.corners if n not in by_number]
            if unknown:
                missing[entry.name.upper()] = (
                    f"{entry.name} has corners that were not seen: {', '.join(unknown)}"
                )
                continue
            corners = [by_number[n] for n in entry.corners]
            x, y = np.mean([c.position_m for c in corners], axis=0).tolist()
            found.append(
                Found(
                    entry.name,
                    entry.kind,
                    entry.words,
                    (x, y),
                    tuple(c.position_m for c in corners),
                    strength=min(c.strength for c in corners),
                )
            )
    entries = () if cells is None else cells.words.entries
    every = [products(entry.words) for entry in entries if entry.words]
    vocabulary = frozenset(word for each in every for product in each for word in product)
    return Contents(tuple(found), missing, vocabulary)


def _confirmed(cells: SemanticCells) -> list[int]:
    rows = cells.known.confirmed() & (cells.known["kind"] != VIEW)
    return [int(row) for row in rows.nonzero()]


def _at(
    everything: Sequence[Found], at: Sequence[float], within_m: float, unit: str
) -> tuple[list[Found], str]:
    here = np.array(at)
    apart = [
        one._replace(
            distance_m=distance_to(
                np.array(one.corners_m or [one.position_m]), one.kind == "region", here
            )
        )
        for one in everything
    ]
    apart.sort(key=lambda one: one.distance_m)
    found = [one for one in apart if one.distance_m <= within_m]
    if found:  # landmarks first: those at the corners of a region are more than the region
        return sorted(found, key=lambda one: KINDS.index(one.kind)), ""
    note = f"nothing is within {within_m:g} {unit} of {at[0]:g},{at[1]:g}"
    if apart:
        x, y = apart[0].position_m
        note += (
            f"; the nearest is {apart[0].name} at {x:.2f},{y:.2f}, "
            f"{apart[0].distance_m:.2f} {unit} away"
        )
    return [], note


def _in_box(everything: Sequence[Found], box: Sequence[float]) -> list[Found]:
    low, high = np.array(box[:2]), np.array(box[2:])
    found = [one._replace(share=_share_in(one, low, high)) for one in everything]
    return [one for one in found if one.share > 0.0]


def _share_in(one: Found, low_m: np.ndarray, high_m: np.ndarray) -> float:
    """Return the share of a landmark (0 or 1), of a wall's length or a region's area in a box."""
    if not one.corners_m:
        at = np.array(one.position_m)
        return float(((at >= low_m) & (at <= high_m)).all())
    share = area_share if one.kind == "region" else length_share
    return share(np.array(one.corners_m), low_m, high_m)


def _described(known: Contents, asked: Question) -> tuple[list[Found], str]:
    """Find what has a name or attributes."""
    text = asked.words.strip().upper()
    named = [one for one in known.found if one.name.upper() == text.replace(" ", "_")]
    if named:
        return named, ""
    if reason := known.missing.get(text.replace(" ", "_")):
        return [], reason
    words = set(known.words) | {kind.upper() for kind in KINDS}
    alternatives = _alternatives(text, asked.text)
    names = [one.name.upper() for one in known.found]
    for word in sorted({w for each in alternatives for product in each for w in product}):
        if word not in words and _singular(word) not in words:
            raise SpaceError(
                f"the map knows no name or word {word}{did_you_mean(word, [*names, *words])}; "
                f"it has the words {', '.join(sorted(words))}"
            )
    found = [
        one
        for one in known.found
        if any(all(_has(one, product, words) for product in each) for each in alternatives)
    ]
    return found, "" if found else f"nothing on the map is {asked.words}"


def _alternatives(text: str, question: str) -> list[list[frozenset[str]]]:
    """Return what to find: of several alternatives, each with products that all must be there.

    Words side by side must all be there, bound or not; an expression means what it says.
    """
    parts = text.split()
    if all(part.isidentifier() for part in parts):
        return [[frozenset([part]) for part in parts]]
    try:
        return [[product] for product in products(text)]
    except SourceError as error:
        raise SpaceError(f"cannot read {question!r}: {error}") from None


def _has(one: Found, product: frozenset[str], words: set[str]) -> bool:
    wanted = {word if word in words else _singular(word) for word in product}
    its = products(one.words) if one.words else (frozenset[str](),)
    return any(wanted <= (each | {one.kind.upper()}) for each in its)


def _singular(word: str) -> str:
    return word.removesuffix("S")
