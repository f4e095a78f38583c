"""Checks of what a frame holds: a wrong shape or type is told in one line, before it is used."""

import math
import numbers
import operator

import numpy as np

from neuroslam.errors import BadFrame
from neuroslam.types import Frame, Velocity

_KINDS = {"U": "text", "S": "text", "O": "objects", "b": "booleans", "c": "complex numbers"}
_LARGEST_INDEX = 2**63

_FASTEST = 1e6
"""In m/s or rad/s: no robot is faster, and far beyond it cells can no longer be counted."""


def checked_array(
    value: object, what: str, shape: tuple[int | None, ...], meaning: str
) -> np.ndarray:
    """Return an array of numbers, if it is one and has the shape that is expected.

    An empty list stands for an array without rows.

    Args:
        value: Array, or what numpy makes one of.
        what: Name of the value in an error, plural.
        shape: Expected shape; ``None`` stands for any length.
        meaning: Of the numbers in it, for the error.

    Returns:
        ``float64``, of that shape; not a copy where none is needed.

    Raises:
        BadFrame: If it has another shape, or holds no real numbers.

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
    """Return a number, if it is a finite one.

    Args:
        value: Number of Python or numpy.
        what: Name of it in an error.
        unit: Its unit.

    Raises:
        BadFrame: If it is no number, or not finite.

    Example:
        >>> checked_number("north", "heading", "rad")
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: heading is 'north'; expected a number, in rad
    """
    if not _is_number(value):
        raise BadFrame(f"{what} is {_described(value)}; expected a number, in {unit}")
    number = _as_float(value)
    if not math.isfinite(number):
        raise BadFrame(f"{what} {number:g} {unit}; expected a finite number")
    return number


def checked_odometry(velocity: object) -> Velocity:
    """Return measured self-motion, if it is one: two finite numbers of at most 1e6.

    Raises:
        BadFrame: If it is not.

    Example:
        >>> checked_odometry((1, 0.5))
        Velocity(v_m_s=1.0, w_rad_s=0.5)
        >>> checked_odometry(0.5)
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: odometry is 0.5; expected speed (m/s) and turn rate (rad/s)
    """
    try:
        v, w = velocity
        right = _is_number(v) and _is_number(w)
    except (TypeError, ValueError):  # not a sequence, or of another length
        right = False
    if not right:
        raise BadFrame(
            f"odometry is {_described(velocity)}; expected speed (m/s) and turn rate (rad/s)"
        )
    v, w = _as_float(v), _as_float(w)
    if not (math.isfinite(v) and math.isfinite(w)):
        raise BadFrame(f"odometry v = {v:g} m/s, w = {w:g} rad/s; expected finite numbers")
    if max(abs(v), abs(w)) > _FASTEST:
        raise BadFrame(
            f"odometry v = {v:g} m/s, w = {w:g} rad/s; expected at most {_FASTEST:g}: check the "
            "units of the source"
        )
    return Velocity(v, w)


def check_instant(frame: Frame) -> None:
    """Check number and time of a frame.

    Raises:
        BadFrame: If the number is not whole, or the time no finite number.

    Example:
        >>> check_instant(Frame(0, math.nan))
        Traceback (most recent call last):
        neuroslam.errors.BadFrame: time nan s; times must rise, and be finite numbers
    """
    try:
        right = -_LARGEST_INDEX <= operator.index(frame.index) < _LARGEST_INDEX
    except TypeError:
        right = False
    if not right:
        raise BadFrame(
            f"its index is {_described(frame.index)}; expected a whole number of 64 bits"
        )
    if not _is_number(frame.time_s):
        raise BadFrame(f"its time is {_described(frame.time_s)}; expected a number, in s")
    time_s = _as_float(frame.time_s)
    if not math.isfinite(time_s):
        raise BadFrame(f"time {time_s:g} s; times must rise, and be finite numbers")


def check_picture(image: object, who: str = "") -> None:
    """Check that a picture is ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB, not empty.

    Args:
        image: The picture.
        who: What it is for, at the start of the error.

    Raises:
        BadFrame: If it is of another type or shape.
    """
    if isinstance(image, np.ndarray):
        right = image.ndim == 2 or image.shape[2:] == (3,)
        if image.dtype == np.uint8 and right and image.size:
            return
        got = f"{image.dtype} {image.shape}"
    else:
        got = f"{_described(image)}, no array of numpy"
    who = f"{who}: " if who else ""
    raise BadFrame(f"{who}picture is {got}; expected uint8, (h, w) or (h, w, 3)")


def _is_number(value: object) -> bool:
    """Tell whether a value is one real number: of Python, of numpy, or an array of one."""
    if isinstance(value, np.ndarray):
        return value.shape == () and value.dtype.kind in "iuf"
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


def _as_float(value: numbers.Real) -> float:
    try:
        return float(value)
    except OverflowError:  # a whole number of more than 300 digits
        return math.inf


def _described(value: object) -> str:
    """Describe a value of a wrong type in a few words."""
    if hasattr(value, "dtype") and hasattr(value, "shape"):
        kind = _KINDS.get(getattr(value.dtype, "kind", ""), str(value.dtype))
        return f"an array of {kind} of shape {tuple(value.shape)}"
    if value is None or isinstance(value, str | bytes | numbers.Number):
        said = repr(value)
        return said if len(said) <= 40 else f"{said[:37]}..."
    return f"of type {type(value).__name__}"
