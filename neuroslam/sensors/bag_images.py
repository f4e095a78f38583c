"""Images in messages of ROS bags: encodings, conversion to grey, and what kind of image it is."""

from typing import Any, NamedTuple

import cv2
import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.images import decode
from neuroslam.sensors.pixels import PixelScale
from neuroslam.types import GreyRule


class _Encoding(NamedTuple):
    """Channels of a pixel, bytes of a channel, conversion to luma, and to three channels."""

    channels: int
    size: int = 1
    to_luma: int | None = None
    to_bgr: int | None = None


_COLOUR = {
    "bgr": _Encoding(3, 1, cv2.COLOR_BGR2GRAY),
    "rgb": _Encoding(3, 1, cv2.COLOR_RGB2GRAY),
    "bgra": _Encoding(4, 1, cv2.COLOR_BGRA2GRAY, cv2.COLOR_BGRA2BGR),
    "rgba": _Encoding(4, 1, cv2.COLOR_RGBA2GRAY, cv2.COLOR_RGBA2RGB),
    "bayer_rggb": _Encoding(1, 1, cv2.COLOR_BayerBG2GRAY, cv2.COLOR_BayerBG2BGR),
    "bayer_bggr": _Encoding(1, 1, cv2.COLOR_BayerRG2GRAY, cv2.COLOR_BayerRG2BGR),
    "bayer_gbrg": _Encoding(1, 1, cv2.COLOR_BayerGR2GRAY, cv2.COLOR_BayerGR2BGR),
    "bayer_grbg": _Encoding(1, 1, cv2.COLOR_BayerGB2GRAY, cv2.COLOR_BayerGB2BGR),
}

ENCODINGS: dict[str, _Encoding] = {
    "mono8": _Encoding(1),
    "8UC1": _Encoding(1),
    "mono16": _Encoding(1, 2),
    "16UC1": _Encoding(1, 2),
    "8UC3": _COLOUR["bgr"],
    "8UC4": _COLOUR["bgra"],
    "16UC3": _COLOUR["bgr"]._replace(size=2),
    "16UC4": _COLOUR["bgra"]._replace(size=2),
    "yuv422": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_UYVY, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": _Encoding(2, 1, cv2.COLOR_YUV2GRAY_YUY2, cv2.COLOR_YUV2BGR_YUY2),
}
"""Encodings of ``sensor_msgs/Image`` that can be read."""

ENCODINGS["uyvy"], ENCODINGS["yuyv"] = ENCODINGS["yuv422"], ENCODINGS["yuv422_yuy2"]
ENCODINGS |= {f"{name}8": encoding for name, encoding in _COLOUR.items()}
ENCODINGS |= {f"{name}16": encoding._replace(size=2) for name, encoding in _COLOUR.items()}


def encoding_of(message: Any) -> str:  # noqa: ANN401
    """Return the encoding of an image message: of ``Image``, or the format of a compressed one."""
    return str(message.format if hasattr(message, "format") else message.encoding)


def pixels_of(message: Any) -> np.ndarray:  # noqa: ANN401
    """Return the pixels of an image message, with the bits that it has.

    Returns:
        ``uint8`` or ``uint16``, ``(h, w)`` or ``(h, w, channels)`` in the encoding of the message;
        of a compressed image BGR.

    Raises:
        BadFrame: If the message is damaged, or its encoding cannot be read.
    """
    encoding = encoding_of(message)
    if hasattr(message, "format"):
        pixels = None if "compressedDepth" in encoding else decode(bytes(message.data))
        if pixels is None:
            raise BadFrame(f"its {encoding!r} image is corrupt; expected a JPEG or PNG")
        return pixels
    if encoding not in ENCODINGS:
        raise BadFrame(f"encoding {encoding!r}; expected one of {', '.join(ENCODINGS)}")
    channels, size = ENCODINGS[encoding][:2]
    dtype = np.dtype(f"u{size}").newbyteorder(">" if message.is_bigendian else "<")
    h, w, used = message.height, message.width, message.width * channels * size
    data = np.frombuffer(message.data, np.uint8)  # an array, or bytes as ROS 1 has them
    if not used or not h or message.step < used or len(data) < h * message.step:
        raise BadFrame(
            f"{len(data)} bytes in rows of {message.step} for {w} x {h} px {encoding}; "
            "the message is damaged"
        )
    rows = np.ascontiguousarray(data[: h * message.step].reshape(h, message.step)[:, :used])
    pixels = rows.view(dtype).reshape((h, w) if channels == 1 else (h, w, channels))
    return pixels.astype(dtype.newbyteorder("="))


def grey_of(
    message: Any,  # noqa: ANN401
    rule: GreyRule,
    scale: PixelScale,
    index: int = 0,
) -> np.ndarray:
    """Return an image message as grey, ``uint8``, ``(h, w)``.

    Args:
        message: ``sensor_msgs/Image`` or ``CompressedImage``.
        rule: How colour becomes grey.
        scale: Scale of 16-bit images.
        index: Number of the image in its topic.

    Raises:
        BadFrame: If the message is damaged, or its encoding cannot be read.
    """
    pixels = scale(pixels_of(message), index)
    if hasattr(message, "format"):
        return to_grey(pixels, rule, "bgr")
    encoding = ENCODINGS[message.encoding]
    if encoding.to_luma is None:
        return pixels
    try:
        if rule == "luma":  # in one step, without rounding in between
            return cv2.cvtColor(pixels, encoding.to_luma)
        colour = pixels if encoding.to_bgr is None else cv2.cvtColor(pixels, encoding.to_bgr)
    except cv2.error:  # such as YUV 4:2:2 of an odd width
        (h, w), name = pixels.shape[:2], message.encoding
        raise BadFrame(f"{w} x {h} px cannot be {name}; the message is damaged") from None
    return to_grey(colour, rule)
