"""Where a run and the lap truth of a drive differ: which of them do the images support?

``python -m benchmarks.check_laps RUN FRAMES.tar LAPS.csv``. Lap truth (columns ``lap``, ``phase``)
is made from images, too, and can be wrong. Both say which place of the first lap a frame shows. A
similarity transform of scale-invariant features (SIFT, Lowe 2004) decides, which neither of them
uses: one place has at least ``LEAD`` more inliers, at about the same distance, or it is left open.
"""

import csv
import sys
import tarfile
from pathlib import Path

import cv2
import numpy as np

APART = 0.05  # of a lap: beyond it, two frames show different places
FAR = 0.08
LEAD = 4  # inliers
SCALES = 0.8, 1.25  # of a frame at about the same distance
FIRST, EVERY = 450, 5  # checked frames; of the recordings of a track, the first lap is before them


class Images:
    """Features of the upper part of the frames of a tar file, where the ground is not."""

    def __init__(self, path: Path) -> None:
        self._tar = tarfile.open(path)  # noqa: SIM115
        files = (m for m in self._tar.getmembers() if m.isfile())
        self._members = sorted(files, key=lambda m: m.name)
        self._sift = cv2.SIFT.create(contrastThreshold=0.02)
        self._known: dict[int, tuple] = {}

    def features(self, frame: int) -> tuple:
        if frame not in self._known:
            file = self._tar.extractfile(self._members[frame])
            assert file is not None, self._members[frame].name
            image = cv2.imdecode(np.frombuffer(file.read(), np.uint8), cv2.IMREAD_GRAYSCALE)
            assert image is not None, self._members[frame].name
            upper = cv2.resize(image[: 5 * len(image) // 8], None, fx=2, fy=2)
            self._known[frame] = self._sift.detectAndCompute(upper, None)
        return self._known[frame]

    def inliers(self, one: int, other: int) -> int:
        """Return how many features of two frames fit one similarity transform."""
        (points, some), (targets, others) = self.features(one), self.features(other)
        if min(len(points), len(targets)) < 8:
            return 0
        pairs = cv2.BFMatcher().knnMatch(some, others, 2)
        good = [a for a, b in (p for p in pairs if len(p) == 2) if a.distance < 0.8 * b.distance]
        if len(good) < 6:
            return 0
        here = np.array([points[m.queryIdx].pt for m in good], np.float32)
        there = np.array([targets[m.trainIdx].pt for m in good], np.float32)
        found, fits = cv2.estimateAffinePartial2D(here, there, ransacReprojThreshold=4)
        if found is None or not SCALES[0] < np.hypot(found[0, 0], found[1, 0]) < SCALES[1]:
            return 0
        return int(fits.sum())


def column(path: Path, name: str) -> np.ndarray:
    with path.open(newline="") as file:
        return np.array([float(row[name]) for row in csv.DictReader(file)])


def apart(a: np.ndarray | float, b: np.ndarray | float) -> np.ndarray:
    return np.abs((a - b + 0.5) % 1.0 - 0.5)


def check(run: Path, frames: Path, laps: Path) -> str:
    images, phase = Images(frames), column(laps, "lap") + column(laps, "phase")
    first = column(run / "experiences.csv", "first_frame").astype(int)
    at = column(run / "frames.csv", "experience").astype(int)
    number = column(run / "frames.csv", "frame").astype(int)
    begin = int(number[0])
    mapped = first[first < begin + FIRST]  # the map of the first lap
    lap = np.arange(begin + 60, mapped.max() + 1)

    def best(frame: int, place: int) -> int:
        near = range(max(place - 4, begin), min(place + 5, lap[-1] + 1), 2)
        return max(images.inliers(frame, one) for one in near)

    n, found = 0, []
    for frame, experience in zip(number[FIRST::EVERY], at[FIRST::EVERY], strict=True):
        if not 0 <= experience < len(mapped):
            continue
        n += 1
        off = float(apart(phase[first[experience]], phase[frame]))
        if off >= APART:
            truth = int(lap[apart(phase[lap], phase[frame]).argmin()])
            found.append((off, best(frame, int(first[experience])), best(frame, truth)))
    off, ours, theirs = np.array(found).reshape(-1, 3).T
    lines = [f"{n} frames"]
    for limit in (APART, FAR):
        some = off >= limit
        run_right, laps_right = some & (ours >= theirs + LEAD), some & (theirs >= ours + LEAD)
        lines.append(
            f"{some.sum()} differ by {limit} of a lap: the run is right in {run_right.sum()}, "
            f"the lap truth in {laps_right.sum()}"
        )
    return "; ".join(lines)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    cv2.setNumThreads(1)
    print(check(*(Path(argument) for argument in sys.argv[1:])))
