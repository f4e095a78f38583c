"""Scaling of images of 10, 12, 14 or 16 bits to 8 bits, the same for all images of a source.

Cameras and recorders store 10 or 12 bits in files of 16: the greatest value is then 1023 or 4095,
not 65535. How many bits a source uses is read from its images.
"""

from collections.abc import Iterable
from typing import Self

import numpy as np

from neuroslam.errors import BadFrame, counted

_DEPTHS = (8, 10, 12, 14, 16)

_OUTLIERS = 1e-3
"""Share of the pixels of an image that may exceed its depth: hot pixels, markers of no value."""


def bits_of(image: np.ndarray) -> int:
    r"""Return the number of bits that an image uses.

    The smallest :math:`b` of 8, 10, 12, 14 and 16 with :math:`p < 2^b` for all pixels :math:`p`
    but 0.1 %.

    Args:
        image: ``uint8`` or ``uint16``, of any shape.

    Raises:
        BadFrame: If the pixels are of another type, such as floating-point depths.

    Example:
        >>> bits_of(np.full((4, 4), 3472, np.uint16)), bits_of(np.full((4, 4), 9000, np.uint16))
        (12, 14)
    """
    if image.dtype == np.uint8:
        return 8
    if image.dtype != np.uint16:
        raise BadFrame(f"its pixels are {image.dtype}; expected whole numbers of 8 or 16 bits")
    allowed = int(_OUTLIERS * image.size)
    for bits in _DEPTHS[:-1]:
        if np.count_nonzero(image >> bits) <= allowed:
            return bits
    return 16


class PixelScale:
    r"""Converts the images of a source to 8 bits: :math:`\min(\lfloor p / 2^{b-8} \rfloor, 255)`.

    Args:
        bits: :math:`b`, bits that the images use, 8 to 16.
        n_examined: Number of images from which the bits are known; 0: each image is scaled by what
            it uses itself.

    Example:
        >>> scale = PixelScale.of([np.array([[0, 640], [3472, 4095]], np.uint16)])
        >>> scale.bits, scale(np.array([[640, 3472]], np.uint16)).tolist()
        (12, [[40, 217]])
        >>> scale.note()
        '16-bit images use 12 bits (1 image examined): 0 to 4,095 becomes 0 to 255'
    """

    def __init__(self, bits: int = 8, n_examined: int = 0) -> None:
        self.bits, self.n_examined = bits, n_examined
        self.clipped: set[int] = set()

    @classmethod
    def of(cls, images: Iterable[np.ndarray]) -> Self:
        """Return the scale that the images need, each ``uint8`` or ``uint16``.

        Raises:
            BadFrame: If the pixels of an image are of another type.
        """
        bits = [bits_of(image) for image in images]
        return cls(max(bits, default=8), len(bits))

    def __call__(self, image: np.ndarray, index: int = 0) -> np.ndarray:
        """Convert an image.

        Args:
            image: ``uint8``, returned as it is, or ``uint16``; of any shape.
            index: Number of the image in its source, with which :meth:`note` counts clipped images.

        Returns:
            ``uint8``, of the same shape.

        Raises:
            BadFrame: If the pixels are of another type.
        """
        if image.dtype == np.uint8:
            return image
        own = bits_of(image)
        bits = self.bits if self.n_examined else own
        if own > bits:
            self.clipped.add(index)
        return np.minimum(image >> (bits - 8), 255).astype(np.uint8)

    def note(self) -> str:
        """Return in a line how images are scaled; empty for images of 8 or of full 16 bits."""
        notes = []
        if self.n_examined and self.bits < 16:
            notes.append(
                f"16-bit images use {self.bits} bits ({counted(self.n_examined, 'image')} "
                f"examined): 0 to {2**self.bits - 1:,} becomes 0 to 255"
            )
        if self.clipped:
            notes.append(f"{counted(len(self.clipped), 'image')} with greater values clipped")
        return "; ".join(notes)


def spread(n: int, most: int = 32) -> list[int]:
    """Return at most ``most`` of the numbers 0 to ``n - 1``, evenly spaced, with both ends.

    Example:
        >>> spread(3), spread(9, 3)
        ([0, 1, 2], [0, 4, 8])
    """
    return [int(number) for number in np.linspace(0, n - 1, min(n, most)).round()]
