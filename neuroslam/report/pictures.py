"""Small pictures of frames, taken from the sources of a run where they can still be opened."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.errors import SourceError
from neuroslam.report.reading import FinishedRun, session_plans
from neuroslam.runs.files import RunPlan
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame

MOST = 4000
"""Pictures on a page, at most."""

_SIDE_PX = (192, 128)  # a picture is shrunk to fit, a panorama to half as wide again
_QUALITY = 60  # of WebP: 1 to 3 kB a picture
_BLIND_AFTER = 20  # frames without an image: a source without a camera


class Wanted(NamedTuple):
    """A frame of a source.

    Attributes:
        source: Spec of the source.
        frame: Its number there.
    """

    source: str
    frame: int


class Pictures(NamedTuple):
    """Pictures of a page, in the order of source and frame.

    Attributes:
        files: Each as a WebP file.
        at: What each shows.
        place: Picture of each experience, as it was when it was made, or -1, ``(n_places,)``.
        row: For the pictures of the run's own frames, their number in the source and the picture,
            ``(n, 2)``, in the order of frames.
        notes: What is missing, and why.
    """

    files: list[bytes]
    at: list[Wanted]
    place: np.ndarray
    row: np.ndarray
    notes: list[str]


def take_pictures(run: FinishedRun, budget_bytes: int) -> Pictures:
    """Take pictures of the places, and of frames at even distances.

    Where they are more than the budget allows, some at even distances are kept.

    Args:
        run: Whose frames.
        budget_bytes: All pictures together, as base64 text; 0: none, no source is opened.
    """
    n_places, notes = run.brain.map.n, []
    places, missing = _of_places(run)
    taken: dict[Wanted, bytes] = {}
    if budget_bytes:
        if missing:
            notes.append(
                f"No pictures of {missing:,} places: the run of the session that made them is "
                "not where it was."
            )
        sources: dict[str, set[int]] = defaultdict(set)
        for wanted in _thinned([*filter(None, places)], MOST // 2):
            sources[wanted.source].add(wanted.frame)
        frames = run.frames["frame"].astype(np.int64).tolist()
        if frames:
            sources[run.plan.source].update(_thinned(frames, MOST // 2))
        for spec, numbers in sources.items():
            found, note = _from_source(spec, sorted(numbers), run.brain.config.frame_rate_hz)
            taken |= {Wanted(spec, number): file for number, file in found.items()}
            notes += [note] if note else []
        n_taken, taken = len(taken), _within(taken, budget_bytes)
        if len(taken) < n_taken:
            notes.append(
                f"{len(taken):,} of {n_taken:,} pictures are on this page, at even distances, "
                f"to keep it small."
            )
    else:
        notes.append("Pictures of frames were left out when this page was made.")
    at = sorted(taken)
    number = {wanted: i for i, wanted in enumerate(at)}
    place = np.array([number.get(wanted, -1) for wanted in places], np.int32)
    row = np.array(
        [(wanted.frame, i) for i, wanted in enumerate(at) if wanted.source == run.plan.source],
        np.int32,
    ).reshape(-1, 2)
    assert len(place) == n_places
    return Pictures([taken[wanted] for wanted in at], at, place, row, notes)


def _of_places(run: FinishedRun) -> tuple[list[Wanted | None], int]:
    """The frame that made each place; ``None`` where its source is not known, and how many."""
    plans, table = session_plans(run), run.brain.map.experiences
    rows = zip(table["session"].tolist(), table["first_frame"].tolist(), strict=True)
    places = [
        Wanted(plans[session].source, frame) if session in plans else None
        for session, frame in rows
    ]
    return places, places.count(None)


def _from_source(
    spec: str, numbers: list[int], frame_rate_hz: float
) -> tuple[dict[int, bytes], str]:
    """Take the pictures of these frames; and say what is missing, or nothing."""
    name = RunPlan(spec).name
    found: dict[int, bytes] = {}
    seen, fault = 0, ""
    try:
        source = open_source(spec, frame_rate_hz)
        if source.live:
            return found, f"No pictures of {name}: a live camera shows something else by now."
        for frame in _frames(source, numbers):
            seen += 1
            if frame.image is not None:
                found[frame.index] = thumbnail(frame.image)
            elif not found and seen >= _BLIND_AFTER:
                break
    except SourceError:
        fault = "it cannot be read to its end" if seen else "it cannot be opened any more"
    if seen and not found:
        fault = fault or "it has no camera"
    if not found:
        return found, f"No pictures of {name}: {fault or 'its frames are not there any more'}."
    missing = len(numbers) - len(found)
    why = f": {fault}" if fault else ""
    return found, f"{missing:,} frames of {name} have no picture any more{why}." if missing else ""


def _frames(source: Source, numbers: list[int]) -> Iterator[Frame]:
    """Yield these frames of a source, but for those that cannot be used."""
    if isinstance(source, IndexedSource):
        for number in numbers:
            yield from source.frames(number, number + 1, lambda _: None)
        return
    wanted = set(numbers)
    for frame in source.frames(numbers[0], numbers[-1] + 1, lambda _: None):
        if frame.index in wanted:
            yield frame


def thumbnail(image: np.ndarray) -> bytes:
    """Shrink a picture and write it as a WebP file.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.

    Example:
        >>> thumbnail(np.zeros((480, 640, 3), np.uint8))[8:12]
        b'WEBP'
    """
    height, width = image.shape[:2]
    most_width = _SIDE_PX[0] * (3 if width > 3 * height else 2) // 2
    shrink = max(1.0, width / most_width, height / _SIDE_PX[1])
    if shrink > 1.0:
        size = (max(1, round(width / shrink)), max(1, round(height / shrink)))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    return cv2.imencode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])[1].tobytes()


def _within(taken: dict[Wanted, bytes], budget_bytes: int) -> dict[Wanted, bytes]:
    """Keep as many as fit, at even distances."""
    keys = sorted(taken)
    while keys:
        size = sum(base64_size(len(taken[key])) for key in keys)
        if size <= budget_bytes:
            break
        keys = _thinned(keys, min(len(keys) - 1, int(len(keys) * budget_bytes / size)))
    return {key: taken[key] for key in keys}


def base64_size(n_bytes: int) -> int:
    """Return how many letters of base64 so many bytes take.

    Example:
        >>> base64_size(4)
        8
    """
    return 4 * -(-n_bytes // 3)


def _thinned(items: list, most: int) -> list:
    """Keep some at even distances, the first and the last among them."""
    if len(items) <= most:
        return items
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]
