"""A video file as a source of frames.

The time of a frame is its presentation time, which the container states for each frame: phones and
screen recorders have variable frame rates, and pauses are gaps. Only a raw stream has no
presentation times; its frames are ``1 / fps`` apart.
"""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from neuroslam.errors import BadFrame, SourceError, counted, require_utf8
from neuroslam.sensors.avi import half_pictures
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.images import check_pixels, quiet_opencv, require_shape
from neuroslam.sensors.mp4 import read_mp4
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.sensors.tracks import time_text
from neuroslam.types import Frame, GreyRule

VIDEO_SUFFIXES = (
    *(".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".ogv", ".mjpeg", ".mjpg", ".3gp"),
)

# These containers store their number of frames, and so do those of read_mp4. For the others the
# decoder estimates it from the duration and the frame rate: the true number may differ.
_COUNTED = (".avi",)
_RETRIES = 256
"""Pictures in succession that cannot be decoded, beyond which a video is at its end."""

_ROUNDING_S = 1e-6
"""A presentation time this near to a multiple of the frame period is that multiple."""


class VideoSource(Source):
    """Grey frames of a video, at their presentation times in seconds.

    Args:
        path: The file.
        frame_rate_hz: Frame rate, if the container states neither times nor a rate.
        grey: How colour becomes grey.

    Raises:
        SourceError: If the file is not a video or has no frames.
    """

    def __init__(self, path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> None:
        self.grey: GreyRule = grey
        self.path = Path(path)
        self.name = str(path)
        require_utf8(path, SourceError)
        with self._capture() as capture:
            width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
            height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
            try:
                check_pixels(height, width)
            except BadFrame as error:
                raise SourceError(f"{self.name}: {error}") from None
            fps = capture.get(cv2.CAP_PROP_FPS)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            with quiet_opencv():
                success, image = _grab(capture) is not None, None
                if success:
                    success, image = capture.retrieve()
                first_s = _presented_s(capture)
                self._has_times = capture.grab() and _presented_s(capture) > first_s
        if not success or image is None:
            raise SourceError(
                f"{self.name}: no frame can be decoded; expected a complete video file"
            )
        self.image_shape = image.shape[:2]
        self._rate_hz = fps if math.isfinite(fps) and fps > 0 else frame_rate_hz
        self.frame_rate_hz = self._rate_hz
        is_counted = self.path.suffix.lower() in _COUNTED and count > 0
        self._mp4 = read_mp4(self.path)
        if self._mp4 is not None:
            self.n_frames = self._mp4.n_frames
        else:
            self.n_frames = int(count) if is_counted else None

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`.

        Frames before ``start`` are decoded and dropped, as seeking is not exact. A damaged picture,
        or half of one in a Motion-JPEG AVI, is a bad frame. A video with fewer
        frames than its container states ends with one bad frame.
        """
        with self._capture() as capture:
            index, latest_s = 0, -math.inf
            half = half_pictures(self.path)
            while stop is None or index < stop:
                lost = _grab(capture)
                if lost is None:
                    break
                for _ in range(lost):
                    next(half, False)
                    if index >= start and (stop is None or index < stop):
                        fault = BadFrame(
                            f"{self.name}: frame {index} is damaged, it cannot be decoded"
                        )
                        if on_bad_frame is None:
                            raise fault
                        on_bad_frame(fault)
                    index += 1
                if stop is not None and index >= stop:
                    break
                time_s = self._time_s(capture, index, latest_s)
                try:
                    if next(half, False):
                        raise BadFrame(f"{self.name}: frame {index} is cut short")
                    if not time_s > latest_s:
                        raise BadFrame(
                            f"{self.name}: frame {index}: its time {time_text(time_s)} is not "
                            f"after {time_text(latest_s)}; times must rise"
                        )
                    latest_s = time_s
                    frame = self._retrieve(capture, index, time_s) if index >= start else None
                except BadFrame as error:
                    if index >= start:
                        if on_bad_frame is None:
                            raise
                        on_bad_frame(error)
                else:
                    if frame is not None:
                        yield frame
                index += 1
        missing = self._missing(index, latest_s)
        if missing and (stop is None or index < stop):
            fault = BadFrame(
                f"{self.name}: frame {index} is missing; expected {missing}, as the container "
                "states; check that the file is complete"
            )
            if on_bad_frame is None:
                raise fault
            on_bad_frame(fault)

    def _time_s(self, capture: cv2.VideoCapture, index: int, latest_s: float) -> float:
        """Return the presentation time of the frame that was grabbed last.

        OpenCV gives 0 for a frame without one, such as the last of an MPEG program stream: it is
        one period after the frame before it.
        """
        regular_s = index / self._rate_hz
        if not self._has_times:
            return regular_s
        time_s = _presented_s(capture)
        if time_s == 0.0 and index > 0:
            time_s = latest_s + 1.0 / self._rate_hz
        return regular_s if abs(time_s - regular_s) <= _ROUNDING_S else time_s

    def _missing(self, n_frames: int, latest_s: float) -> str:
        """Return what the container states, if there are fewer frames than that."""
        if self.n_frames is not None and n_frames < self.n_frames:
            return counted(self.n_frames, "frame")
        edited = None if self._mp4 is None else self._mp4.edited
        if edited is not None and latest_s < edited.duration_s - 1.5 * edited.longest_frame_s:
            return f"frames until {time_text(edited.duration_s)}"
        return ""

    def _retrieve(self, capture: cv2.VideoCapture, index: int, time_s: float) -> Frame:
        with quiet_opencv():
            decoded, image = capture.retrieve()
        if not decoded:
            raise BadFrame(f"{self.name}: frame {index} cannot be decoded")
        require_shape(image[..., 0], self.image_shape, self.name, index)
        return Frame(index, time_s, image=to_grey(image, self.grey, "bgr"))

    @contextmanager
    def _capture(self) -> Iterator[cv2.VideoCapture]:
        # FFmpeg only, if available: OpenCV's other readers print their errors.
        ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
        with quiet_opencv(), _quiet_ffmpeg():
            # The whole path: what stands before a colon would be taken for a protocol.
            name = str(self.path.resolve())
            capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG if ffmpeg else cv2.CAP_ANY)
        try:
            if not capture.isOpened():
                raise SourceError(
                    f"{self.name}: cannot be read; expected a complete video file; "
                    f"copy it again, or convert it: ffmpeg -i {self.path.name} copy.mp4"
                )
            yield capture
        finally:
            capture.release()


def _grab(capture: cv2.VideoCapture) -> int | None:
    """Grab the next picture that can be decoded.

    Returns:
        Number of damaged pictures before it; ``None`` at the end of the video.
    """
    with quiet_opencv():
        for lost in range(_RETRIES):
            if capture.grab():
                return lost
    return None


def _presented_s(capture: cv2.VideoCapture) -> float:
    """Return the presentation time of the frame that was grabbed last, in seconds."""
    return capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0


@contextmanager
def _quiet_ffmpeg() -> Iterator[None]:
    """Keep FFmpeg from printing; it reads this variable when it opens the first video."""
    key = "OPENCV_FFMPEG_LOGLEVEL"
    if key in os.environ:
        yield
        return
    os.environ[key] = "-8"
    try:
        yield
    finally:
        del os.environ[key]
