"""A video file as a source of frames."""

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.images import quiet_opencv, require_shape
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.types import Frame, GreyRule

VIDEO_SUFFIXES = (
    *(".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".mts"),
    *(".wmv", ".flv", ".ogv", ".mjpeg", ".mjpg", ".3gp"),
)

# These containers store their number of frames. For the others the decoder estimates it from the
# duration and the frame rate, and the true number may be lower or higher.
_COUNTED = (".avi", ".mp4", ".m4v", ".mov", ".3gp")


class VideoSource(Source):
    """Grey frames of a video, at times ``index / fps``.

    Args:
        path: The file.
        frame_rate_hz: Frame rate, if the container states none.
        grey: How colour becomes grey.

    Raises:
        SourceError: If the file is not a video or has no frames.
    """

    def __init__(self, path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> None:
        self.grey: GreyRule = grey
        self.path = Path(path)
        self.name = str(path)
        with self._capture() as capture:
            fps = capture.get(cv2.CAP_PROP_FPS)
            count = capture.get(cv2.CAP_PROP_FRAME_COUNT)
            with quiet_opencv():
                success, image = capture.read()
        if not success:
            raise SourceError(
                f"{self.name}: no frame can be decoded; expected a complete video file"
            )
        self.image_shape = image.shape[:2]
        self._rate_hz = fps if math.isfinite(fps) and fps > 0 else frame_rate_hz
        self.frame_rate_hz = self._rate_hz
        is_counted = self.path.suffix.lower() in _COUNTED and count > 0
        self.n_frames = int(count) if is_counted else None

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`.

        Frames before ``start`` are decoded and dropped, as seeking is not exact. A video with fewer
        frames than its container states ends with one bad frame.
        """
        with self._capture() as capture:
            index = 0
            while stop is None or index < stop:
                with quiet_opencv():
                    success = capture.grab()
                if not success:
                    break
                if index >= start:
                    try:
                        frame = self._retrieve(capture, index)
                    except BadFrame as error:
                        if on_bad_frame is None:
                            raise
                        on_bad_frame(error)
                    else:
                        yield frame
                index += 1
        n_frames = index if self.n_frames is None else self.n_frames
        if index < n_frames and (stop is None or index < stop):
            missing = BadFrame(
                f"{self.name}: frame {index} is missing; expected {counted(n_frames, 'frame')}, as "
                "the container states; check that the file is complete"
            )
            if on_bad_frame is None:
                raise missing
            on_bad_frame(missing)

    def _retrieve(self, capture: cv2.VideoCapture, index: int) -> Frame:
        with quiet_opencv():
            decoded, image = capture.retrieve()
        if not decoded:
            raise BadFrame(f"{self.name}: frame {index} cannot be decoded")
        require_shape(image[..., 0], self.image_shape, self.name, index)
        return Frame(index, index / self._rate_hz, image=to_grey(image, self.grey, "bgr"))

    @contextmanager
    def _capture(self) -> Iterator[cv2.VideoCapture]:
        # FFmpeg only, if available: OpenCV's other readers print their errors.
        ffmpeg = cv2.videoio_registry.hasBackend(cv2.CAP_FFMPEG)
        with quiet_opencv(), _quiet_ffmpeg():
            capture = cv2.VideoCapture(self.name, cv2.CAP_FFMPEG if ffmpeg else cv2.CAP_ANY)
        try:
            if not capture.isOpened():
                raise SourceError(f"{self.name}: cannot be read; expected a complete video file")
            yield capture
        finally:
            capture.release()


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
