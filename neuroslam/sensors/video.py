"""A video file as a source of frames."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.images import quiet_opencv, require_shape
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.types import Frame

VIDEO_SUFFIXES = (
    *(".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".ogv", ".mjpeg", ".mjpg", ".3gp"),
)

# These write down how many frames they hold. Of the others the decoder gives an estimate, from the
# duration and the frame rate, that a whole file may miss on either side.
_COUNTED = (".avi", ".mp4", ".m4v", ".mov", ".3gp")


class VideoSource(Source):
    """The frames of a video, in grey, at ``index / fps``.

    Args:
        path: The file.
        frame_rate_hz: Used where the container states no frame rate.

    Raises:
        SourceError: If it is not a video or has no frames.
    """

    def __init__(self, path: Path, frame_rate_hz: float) -> None:
        self.path = Path(path)
        self.name = str(path)
        with self._capture() as capture:
            fps = capture.get(cv2.CAP_PROP_FPS)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            with quiet_opencv():
                there_is_one, image = capture.read()
        if not there_is_one:
            raise SourceError(f"{self.name}: has no frames that can be decoded; is it truncated?")
        self.image_shape = image.shape[:2]
        self.frame_rate_hz = fps if math.isfinite(fps) and fps > 0 else frame_rate_hz
        counted = self.path.suffix.lower() in _COUNTED and count > 0
        self.n_frames = int(count) if counted else None

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`.

        Frames before ``start`` are decoded and dropped, as seeking is not exact. A video that ends
        before the number of frames that its container announces has one last bad frame.
        """
        with self._capture() as capture:
            index = 0
            while stop is None or index < stop:
                with quiet_opencv():
                    there_is_one = capture.grab()
                if not there_is_one:
                    break
                if index >= start:
                    try:
                        frame = self._retrieve(capture, index)
                    except BadFrame as fault:
                        if on_bad_frame is None:
                            raise
                        on_bad_frame(fault)
                    else:
                        yield frame
                index += 1
        missing = self.n_frames is not None and index < self.n_frames
        if missing and (stop is None or index < stop):
            fault = BadFrame(
                f"{self.name}: frame {index} is missing: it ends there, its container announces "
                f"{counted(self.n_frames, 'frame')}; is it truncated?"
            )
            if on_bad_frame is None:
                raise fault
            on_bad_frame(fault)

    def _retrieve(self, capture: cv2.VideoCapture, index: int) -> Frame:
        with quiet_opencv():
            decoded, image = capture.retrieve()
        if not decoded:
            raise BadFrame(f"{self.name}: frame {index} cannot be decoded")
        require_shape(image[..., 0], self.image_shape, self.name, index)
        grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return Frame(index, index / self.frame_rate_hz, image=grey)

    @contextmanager
    def _capture(self) -> Iterator[cv2.VideoCapture]:
        # FFmpeg alone, where there is one: OpenCV's other readers print what they cannot read.
        ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
        with quiet_opencv(), _quiet_ffmpeg():
            capture = cv2.VideoCapture(self.name, cv2.CAP_FFMPEG if ffmpeg else cv2.CAP_ANY)
        try:
            if not capture.isOpened():
                raise SourceError(f"{self.name}: is not a video that can be read, or is truncated")
            yield capture
        finally:
            capture.release()


@contextmanager
def _quiet_ffmpeg() -> Iterator[None]:
    """Keep FFmpeg from printing; it reads this variable when the first video is opened."""
    key = "OPENCV_FFMPEG_LOGLEVEL"
    if key in os.environ:
        yield
        return
    os.environ[key] = "-8"
    try:
        yield
    finally:
        del os.environ[key]
