"""Checks of a frame's data: a wrong shape or type is a one-line error before the data is used."""

import math
import numbers
import operator
from typing import Any

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.types import Frame, Velocity

_KINDS = {"U": "text", "S": "text", "O": "objects", "b": "booleans", "c": "complex numbers"}
_LARGEST_INDEX = 2**63

_FASTEST = 1e6
"""In m/s or rad/s: no robot is faster, and far beyond it cells can no longer be counted."""


def checked_array(
    value: Any,  # noqa: ANN401
    what: str,
    shape: tuple[int | None, ...],
    meaning: str,
) -> np.ndarray:
    """Convert a value to a ``float64`` array and check its shape.

    An empty list is an array without rows.

    Args:
        value: Array or array-like.
        what: Plural name of the value, for the error.
        shape: Expected shape; ``None`` stands for any length.
        meaning: Meaning of the numbers, for the error.

    Returns:
        ``float64`` array of that shape, copied only if necessary.

    Raises:
        BadFrame: If the value has another shape, or does not consist of real numbers.

    Example:
        >>> checked_array([[0.2, 1]], "walls", (None, 2), "distance and bearing").shape
        (1, 2)
        >>> checked_array([0.2, 1], "walls", (None, 2), "distance and bearing")
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: walls have shape (2,); expected (n, 2): distance and bearing
    """
    sides = ["n" if side is None else str(side) for side in shape]
    expected = f"({', '.join(sides)}{',' if len(sides) == 1 else ''})"
    try:
        array = np.asarray(value)
    except (ValueError, TypeError, RuntimeError):  # ragged lists, tensors of another device
        array = None
    if array is None or array.dtype.kind not in "iuf":
        got = _described(value if array is None or array.ndim == 0 else array)
        raise BadFrame(f"{what} are {got}; expected numbers of shape {expected}: {meaning}")
    if array.shape == (0,):
        array = array.reshape([0 if side is None else side for side in shape])
    fits = len(array.shape) == len(shape) and all(
        side in (None, length) for side, length in zip(shape, array.shape, strict=True)
    )
    if not fits:
        raise BadFrame(f"{what} have shape {array.shape}; expected {expected}: {meaning}")
    return array.astype(np.float64, copy=False)


def checked_number(value: object, what: str, unit: str) -> float:
    """Convert a value to a finite ``float``.

    Args:
        value: Python or numpy number.
        what: Name of the value, for the error.
        unit: Unit of the value, for the error.

    Raises:
        BadFrame: If the value is no number, or not finite.

    Example:
        >>> checked_number("north", "heading", "rad")
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: heading is 'north'; expected a number, in rad
    """
    if not _is_number(value):
        raise BadFrame(f"{what} is {_described(value)}; expected a number, in {unit}")
    number = _as_float(value)
    if not math.isfinite(number):
        raise BadFrame(f"{what} {number} {unit}; expected a finite number")
    return number


def checked_odometry(velocity: Any) -> Velocity:  # noqa: ANN401
    """Convert measured self-motion to a :class:`Velocity` of two finite numbers up to 1e6.

    Raises:
        BadFrame: If it is anything else.

    Example:
        >>> checked_odometry((1, 0.5))
        Velocity(v_m_s=1.0, w_rad_s=0.5)
        >>> checked_odometry(0.5)
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: odometry is 0.5; expected speed (m/s) and turn rate (rad/s)
    """
    try:
        v, w = velocity
    except (TypeError, ValueError):  # not a sequence, or of another length
        v = w = None
    if not (_is_number(v) and _is_number(w)):
        raise BadFrame(
            f"odometry is {_described(velocity)}; expected speed (m/s) and turn rate (rad/s)"
        )
    v, w = _as_float(v), _as_float(w)
    if not (math.isfinite(v) and math.isfinite(w)):
        raise BadFrame(f"odometry v = {v} m/s, w = {w} rad/s; expected finite numbers")
    if max(abs(v), abs(w)) > _FASTEST:
        raise BadFrame(
            f"odometry v = {v} m/s, w = {w} rad/s; expected at most {_FASTEST:g}: check the "
            "units of the source"
        )
    return Velocity(v, w)


def check_instant(frame: Frame) -> None:
    """Check the index and the time of a frame.

    Raises:
        BadFrame: If the index is no whole number, or the time no finite number.

    Example:
        >>> check_instant(Frame(0, math.nan))
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: time nan s; times must rise and be finite numbers
    """
    try:
        valid = -_LARGEST_INDEX <= operator.index(frame.index) < _LARGEST_INDEX
    except TypeError:
        valid = False
    if not valid:
        raise BadFrame(
            f"its index is {_described(frame.index)}; expected a whole number of 64 bits"
        )
    if not _is_number(frame.time_s):
        raise BadFrame(f"its time is {_described(frame.time_s)}; expected a number, in s")
    time_s = _as_float(frame.time_s)
    if not math.isfinite(time_s):
        raise BadFrame(f"time {time_s} s; times must rise and be finite numbers")


def check_image(image: object, user: str = "") -> None:
    """Check that an image is ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB, and not empty.

    Args:
        image: The image.
        user: Component that needs the image; the error starts with it.

    Raises:
        BadFrame: If the image has another type or shape.
    """
    if isinstance(image, np.ndarray):
        fits = image.ndim == 2 or image.shape[2:] == (3,)
        if image.dtype == np.uint8 and fits and image.size:
            return
        got = f"{image.dtype} {image.shape}"
    else:
        got = f"{_described(image)}, not a numpy array"
    user = f"{user}: " if user else ""
    raise BadFrame(f"{user}image is {got}; expected uint8, (h, w) or (h, w, 3)")


def _is_number(value: object) -> bool:
    """Return whether a value is one real number: Python's, numpy's, or a 0-d array."""
    if isinstance(value, np.ndarray):
        return value.shape == () and value.dtype.kind in "iuf"
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _as_float(value: Any) -> float:  # noqa: ANN401
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 300 digits
        return math.inf


def _described(value: Any) -> str:  # noqa: ANN401
    """Describe a value of a wrong type in a few words."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        kind = _KINDS.get(getattr(value.dtype, "kind", ""), str(value.dtype))
        return f"an array of {kind} of shape {tuple(value.shape)}"
    if value is None or isinstance(value, str | bytes | numbers.Number):
        text = repr(value)
        return text if len(text) <= 40 else f"{text[:37]}..."
    return f"of type {type(value).__name__}"
