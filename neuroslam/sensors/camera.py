"""A live camera: ``camera:0``, or the address of a stream, ``camera:rtsp://...``."""

import re
import time
from collections.abc import Iterator
from pathlib import Path

import cv2

from neuroslam.errors import BadFrame, SourceError
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.images import quiet_opencv, require_shape
from neuroslam.sensors.source import OnBadFrame, Source
from neuroslam.types import Frame, GreyRule

_MAX_FAILURES = 10
"""Consecutive failed reads after which the camera counts as disconnected."""


class CameraSource(Source):
    """Grey images of a live camera; it has no end, so stop it with Ctrl-C.

    Times are Unix times in seconds, so that a resumed run continues at a later time. The camera
    does not wait: frames that arrive while the brain is busy are lost.

    Args:
        device: Number of a camera of this machine, or address of a stream.
        grey: How colour becomes grey.

    Raises:
        SourceError: If ``device`` is no number and no address, or the camera cannot be opened.
    """

    def __init__(self, device: str, grey: GreyRule = "luma") -> None:
        self.grey: GreyRule = grey
        self.name = f"camera:{device}"
        self.device: int | str = int(device) if device.isdecimal() else device
        self.n_frames = None
        self.live = True
        if device == "":
            raise SourceError("camera: has no number; expected camera:0 or an address")
        if not (device.isdecimal() or re.search(r"[/!]", device) or Path(device).exists()):
            raise SourceError(
                f"{self.name}: {device!r} is neither a number nor an address; expected camera:0 "
                "or, as an address, camera:rtsp://HOST/PATH"
            )
        capture = self._capture()
        rate = capture.get(cv2.CAP_PROP_FPS)
        self.frame_rate_hz = rate if 0.0 < rate < 1e4 else None
        capture.release()

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield images from now on; the first gets the number ``start``.

        Raises:
            SourceError: If the camera stops delivering images.
        """
        capture = self._capture()
        epoch_s, began_s = time.time(), time.monotonic()
        index, missed, shape = start, 0, None
        try:
            while stop is None or index < stop:
                with quiet_opencv():
                    success, image = capture.read()
                if not success:
                    missed += 1
                    if missed >= _MAX_FAILURES:
                        raise SourceError(
                            f"{self.name}: delivers no more images after {index - start}; "
                            "expected a live stream; check that the camera is plugged in"
                        )
                    continue
                missed = 0
                time_s = epoch_s + time.monotonic() - began_s
                grey = to_grey(image, self.grey, "bgr")
                shape = shape or grey.shape
                try:
                    require_shape(grey, shape, self.name, index)
                except BadFrame as fault:
                    if on_bad_frame is None:
                        raise
                    on_bad_frame(fault)
                else:
                    yield Frame(index, time_s, image=grey)
                index += 1
        finally:
            capture.release()

    def _capture(self) -> cv2.VideoCapture:
        with quiet_opencv():
            capture = cv2.VideoCapture(self.device)
        if not capture.isOpened():
            capture.release()
            raise SourceError(
                f"{self.name}: cannot be opened; check that it is plugged in and that no other "
                "program uses it"
            )
        return capture
