"""Small pictures of frames, from the sources of a run that can still be opened."""

from collections import defaultdict
from collections.abc import Iterator
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from neuroslam.config import BrainConfig
from neuroslam.errors import SourceError
from neuroslam.report.reading import FinishedRun, session_plans
from neuroslam.runs.files import RunPlan
from neuroslam.sensors import Source, open_source
from neuroslam.sensors.open import is_rendered
from neuroslam.sensors.source import IndexedSource
from neuroslam.types import Frame

MOST = 4000
"""Largest number of pictures on a page."""

_Item = TypeVar("_Item")

_SIDE_PX = (192, 128)  # size limits of a picture; a panorama may be 1.5 times as wide
_QUALITY = 60  # of WebP: 1 to 3 kB a picture
_BLIND_AFTER = 20  # frames without an image after which a source is taken to have no camera


class SourceFrame(NamedTuple):
    """A frame of a source.

    Attributes:
        source: Spec of the source.
        frame: Number of the frame in its source.
    """

    source: str
    frame: int


class Pictures(NamedTuple):
    """Pictures of a page, in the order of source and frame.

    Attributes:
        files: Contents of the WebP files.
        at: Frame of each picture.
        place: Picture of each experience's first frame, or -1, ``(n_experiences,)``.
        row: Pictures of the run's own frames: frame number and picture, ``(n, 2)``, in order.
        notes: Missing pictures, and why.
    """

    files: list[bytes]
    at: list[SourceFrame]
    place: np.ndarray
    row: np.ndarray
    notes: list[str]


def take_pictures(run: FinishedRun, budget_bytes: int, source: bool = True) -> Pictures:
    """Take pictures of the first frames of experiences, and of frames at regular intervals.

    If they exceed the budget, a regular subset is kept.

    Args:
        run: The run.
        budget_bytes: Largest size of all pictures, as base64 text; 0: no source is opened.
        source: Open what the run names; off: only rendered worlds.
    """
    notes: list[str] = []
    firsts, missing = _first_frames(run, source)
    taken: dict[SourceFrame, bytes] = {}
    if budget_bytes:
        if missing:
            why = "has been moved or deleted" if source else "is not opened without --source"
            notes.append(
                f"No pictures of {missing:,} experiences: the folder of the run that made them "
                f"{why}."
            )
        sources: dict[str, set[int]] = defaultdict(set)
        for wanted in _thinned([first for first in firsts if first is not None], MOST // 2):
            sources[wanted.source].add(wanted.frame)
        frames = run.frames["frame"].astype(np.int64).tolist()
        if frames:
            sources[run.plan.source].update(_thinned(frames, MOST // 2))
        for spec, numbers in sources.items():
            if not (source or is_rendered(spec)):
                notes.append(
                    f"No pictures of {RunPlan(spec).name}: the source of a run is opened only if "
                    "asked, with --source."
                )
                continue
            found, note = _from_source(spec, sorted(numbers), run.brain.config)
            taken |= {SourceFrame(spec, number): file for number, file in found.items()}
            notes += [note] if note else []
        n_taken, taken = len(taken), _within(taken, budget_bytes)
        if len(taken) < n_taken:
            notes.append(
                f"{len(taken):,} of {n_taken:,} pictures are on this page, at regular intervals, "
                "to limit its size."
            )
    else:
        notes.append("This page was made without pictures of frames.")
    at = sorted(taken)
    number = {frame: i for i, frame in enumerate(at)}
    place = np.array([-1 if first is None else number.get(first, -1) for first in firsts], np.int32)
    row = np.array(
        [(frame.frame, i) for i, frame in enumerate(at) if frame.source == run.plan.source],
        np.int32,
    ).reshape(-1, 2)
    assert len(place) == run.brain.map.n
    return Pictures([taken[wanted] for wanted in at], at, place, row, notes)


def _first_frames(run: FinishedRun, source: bool) -> tuple[list[SourceFrame | None], int]:
    """Return the first frame of each experience, ``None`` if its source is unknown; count those."""
    plans, table = session_plans(run, source), run.brain.map.experiences
    rows = zip(table["session"].tolist(), table["first_frame"].tolist(), strict=True)
    firsts = [
        SourceFrame(plans[session].source, frame) if session in plans else None
        for session, frame in rows
    ]
    return firsts, firsts.count(None)


def _from_source(
    spec: str, numbers: list[int], config: BrainConfig
) -> tuple[dict[int, bytes], str]:
    """Return pictures of these frames, and a note on those that are missing, or nothing."""
    name = RunPlan(spec).name
    found: dict[int, bytes] = {}
    seen, fault = 0, ""
    try:
        source = open_source(spec, config.frame_rate_hz, config.view.grey)
        if source.live:
            return found, f"No pictures of {name}: a live source cannot be read again."
        for frame in _frames(source, numbers):
            seen += 1
            if frame.image is not None:
                found[frame.index] = thumbnail(frame.image)
            elif not found and seen >= _BLIND_AFTER:
                break
    except SourceError:
        fault = "it cannot be read to its end" if seen else "it can no longer be opened"
    if seen and not found:
        fault = fault or "it has no camera"
    if not found:
        return found, f"No pictures of {name}: {fault or 'its frames are missing'}."
    missing = len(numbers) - len(found)
    why = f": {fault}" if fault else ""
    return found, f"Pictures of {missing:,} frames of {name} are missing{why}." if missing else ""


def _frames(source: Source, numbers: list[int]) -> Iterator[Frame]:
    """Yield these frames of a source; unusable frames are left out."""
    if isinstance(source, IndexedSource):
        for number in numbers:
            yield from source.frames(number, number + 1, lambda _: None)
        return
    chosen = set(numbers)
    for frame in source.frames(numbers[0], numbers[-1] + 1, lambda _: None):
        if frame.index in chosen:
            yield frame


def thumbnail(image: np.ndarray) -> bytes:
    """Reduce a picture and return it as a WebP file.

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


def _within(taken: dict[SourceFrame, bytes], budget_bytes: int) -> dict[SourceFrame, bytes]:
    """Return a regular subset that fits into the budget."""
    keys = sorted(taken)
    while keys:
        size = sum(base64_size(len(taken[key])) for key in keys)
        if size <= budget_bytes:
            break
        keys = _thinned(keys, min(len(keys) - 1, int(len(keys) * budget_bytes / size)))
    return {key: taken[key] for key in keys}


def base64_size(n_bytes: int) -> int:
    """Return the size of so many bytes as base64 text.

    Example:
        >>> base64_size(4)
        8
    """
    return 4 * -(-n_bytes // 3)


def _thinned(items: list[_Item], most: int) -> list[_Item]:
    """Return a regular subset with the first and the last item."""
    if len(items) <= most:
        return items
    return [items[i] for i in np.unique(np.linspace(0, len(items) - 1, most).round().astype(int))]
