"""Sample videos to try the commands on: a robot drives through a rendered corridor.

The two days show the same corridor from another start, with other passers-by and other light, so
that a second session can join the map of the first.
"""

from pathlib import Path

import cv2

from neuroslam.errors import RunError
from neuroslam.sensors import open_source

DAYS = {
    1: "world:corridor?laps=2.3&people=2&light=0.2",
    2: "world:corridor?laps=1.4&people=3&light=0.3&start=0.4&seed=2",
}
"""Day -> source of its pictures: 783 frames at 10 Hz, and 477."""

SUFFIXES = (".mp4", ".avi")


def write_sample(path: str | Path, day: int = 1, stop: int | None = None) -> int:
    """Write the video of one day and return its number of frames.

    Args:
        path: File to write, ``.mp4`` or ``.avi``; an earlier one is replaced.
        day: 1 or 2, see ``DAYS``.
        stop: Frame before which the video ends; ``None``: all of the day, in a few seconds.

    Raises:
        RunError: If there is no such day, the suffix is another, or the file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     write_sample(f"{folder}/monday.avi", day=1, stop=3)
        3
    """
    path = Path(path)
    if day not in DAYS:
        raise RunError(f"day {day}: there is no sample of that day; expected 1 or 2")
    if path.suffix.lower() not in SUFFIXES:
        raise RunError(f"{path}: expected a name that ends in {' or '.join(SUFFIXES)}")
    code = cv2.VideoWriter.fourcc(*("mp4v" if path.suffix.lower() == ".mp4" else "MJPG"))
    video, n = None, 0
    for frame in open_source(DAYS[day]).frames(stop=stop):
        assert frame.image is not None
        if video is None:
            height, width = frame.image.shape[:2]
            video = cv2.VideoWriter(str(path), code, 10.0, (width, height))
            if not video.isOpened():
                raise RunError(f"{path}: cannot be written; does its folder exist?")
        video.write(cv2.cvtColor(frame.image, cv2.COLOR_RGB2BGR))
        n += 1
    if video is not None:
        video.release()
    return n
