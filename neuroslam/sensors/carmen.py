r"""Logs of CARMEN: a laser scanner and wheel odometry, the format of many published robot logs.

A text file, also compressed by gzip or bzip2, with a message on each line: name, values, then
``ipc_timestamp hostname logger_timestamp``.

===============  =================================================================================
``ODOM``         x y theta, speed, turn rate, acceleration
``FLASER``       number of beams, ranges over half a turn, pose of the laser, pose of the robot
``ROBOTLASER1``  the beams' first angle, field of view, step and largest range, the ranges, and
                 the poses of the laser and of the robot
``PARAM``        name and value; used: ``robot_frontlaser_offset``, ``laser_max_range``
===============  =================================================================================

There is a frame for each scan; its motion is the change of the robot's odometry since the scan
before. A log without scans has a frame for each ``ODOM``. Times are those of the measurement,
``ipc_timestamp``, or ``logger_timestamp`` where those stand still. The messages are in the order in
which the robot measured; a stamp that is later than one further down is replaced by interpolation.
``RLASER``, ``TRUEPOS``, ``NMEA`` and others are not read.
"""

import bz2
import codecs
import gzip
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.geometry import wrap_angles
from neuroslam.limits import (
    MOST_FILE_BYTES,
    NotReadableError,
    budget_bytes,
    check_regular,
    fits,
    is_bomb,
    too_much,
)
from neuroslam.sensors.full_turn import full_turn
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.times import in_seconds, unit_note
from neuroslam.sensors.tracks import MAX_SPEED, SLOWEST_S, Clock
from neuroslam.types import Frame, GreyRule, Velocity

MAX_RANGE_M = 80.0
"""Ranges of FLASER from here on mean that nothing was hit, as in SICK scanners, unless the log has
``laser_max_range``."""

_LASERS = (b"FLASER", b"ROBOTLASER1")
_PER_BYTE = 12  # bytes of memory for each of a log: its lines, their poses
_LOOKED_AT = 50  # lines that show what a file is
_SCANS = 20  # of which the ranges are looked at


class CarmenSource(IndexedSource):
    """Scans and wheel odometry of a CARMEN log.

    Attributes:
        odometry: Poses of the robot by its wheels at each frame, m and rad, ``(n, 3)``, NaN where
            a line is damaged.
        laser_ahead_m: Distance of the laser ahead of the robot's centre; ranges and walls are
            those at the laser.
    """

    odometry: np.ndarray
    laser_ahead_m: float

    def __init__(self, name: str, text: bytes) -> None:
        self.name = name
        kinds: dict[bytes, list[bytes]] = {kind: [] for kind in (*_LASERS, b"ODOM")}
        parameters: dict[bytes, bytes] = {}
        for line in text.removeprefix(codecs.BOM_UTF8).splitlines():
            kind, *rest = line.split(None, 1)[:2] or [b""]
            if kind in kinds:
                kinds[kind].append(rest[0] if rest else b"")
            elif kind == b"PARAM":
                key, *value = b"".join(rest).split()[:2] or [b""]
                parameters[key] = value[0] if value else b""
        self.kind = max(_LASERS, key=lambda kind: len(kinds[kind]))
        if not kinds[self.kind]:
            self.kind = b"ODOM"
        self._lines = kinds[self.kind]
        if not self._lines:
            raise SourceError(
                f"{name}: has no FLASER, ROBOTLASER1 or ODOM message; expected a CARMEN log"
            )
        ahead = _number(parameters.get(b"robot_frontlaser_offset", b"0"))
        self.laser_ahead_m = ahead if np.isfinite(ahead) else 0.0
        most = _number(parameters.get(b"laser_max_range", b""))
        self._max_m = most if most > 0 else MAX_RANGE_M
        rows = np.array([_pose_and_times(line, self.kind) for line in self._lines])
        self.odometry = rows[:, :3]
        seconds, unit = in_seconds(_times(rows[:, 3:]), slowest_s=SLOWEST_S)
        times, late = _rising_times(seconds)
        self.clock = Clock(name, times, 20.0)
        self.n_frames = len(rows)
        self.frame_rate_hz = self.clock.frame_rate_hz
        what = self.kind.decode()
        self.notes = (
            f"{name}: {counted(len(rows), f'{what} message')}; its motion is the change of the "
            "odometry between them",
        )
        if unit != "s":
            self.notes += (unit_note(name, None, unit),)
        if late:
            what = counted(late, "time that did not rise was", "times that did not rise were")
            self.notes += (f"{name}: {what} interpolated",)
        if self.kind != b"ODOM" and not self._any_range():
            self.notes += (
                f"{name}: no beam of the scans looked at is below {self._max_m:g} m: are the "
                "ranges in centimetres or millimetres?",
            )
        if self.laser_ahead_m and self.kind != b"ODOM":
            self.notes += (
                f"{name}: the laser is {self.laser_ahead_m:g} m ahead of the robot's centre; "
                "ranges are those at the laser",
            )

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        here = self.odometry[index]
        if not np.isfinite(here).all():
            raise BadFrame(
                f"{self.name}: frame {index}: its {self.kind.decode()} line ends with "
                f"{self._lines[index][-40:].decode(errors='replace')!r}; expected a pose and times"
            )
        velocity = self._velocity(index)
        if not (abs(velocity.v_m_s) <= MAX_SPEED and abs(velocity.w_rad_s) <= MAX_SPEED):
            raise BadFrame(
                f"{self.name}: frame {index}: its odometry jumps by {velocity.v_m_s:.3g} m/s; "
                f"expected at most {MAX_SPEED:,.0f} m/s"
            )
        try:
            return Frame(index, time_s, velocity=velocity, ranges=self._ranges(index))
        except BadFrame as error:
            raise BadFrame(f"{self.name}: frame {index}: {error}") from None

    def _any_range(self) -> bool:
        """Return whether a beam of some scans hits anything, or no scan can be read."""
        scans = []
        for index in np.linspace(0, self.n_frames - 1, min(_SCANS, self.n_frames)).astype(int):
            with suppress(BadFrame):
                scans.append(self._ranges(int(index)))
        return not scans or any(np.isfinite(scan).any() for scan in scans if scan is not None)

    def _velocity(self, index: int) -> Velocity:
        """Return speed and turn rate from the last sound pose before a frame to its own."""
        times, before = self.clock.times_s, index - 1
        assert times is not None
        while before >= 0 and not (
            np.isfinite(self.odometry[before]).all() and times[before] < times[index]
        ):
            before -= 1
        if before < 0:
            return Velocity(0.0, 0.0)
        dt_s = float(times[index] - times[before])
        dx, dy, turn = (self.odometry[index] - self.odometry[before]).tolist()
        turn = float(wrap_angles(turn))
        middle = self.odometry[before, 2] + 0.5 * turn
        return Velocity(float(dx * np.cos(middle) + dy * np.sin(middle)) / dt_s, turn / dt_s)

    def _ranges(self, index: int) -> np.ndarray | None:
        if self.kind == b"ODOM":
            return None
        words = self._lines[index].split()
        try:
            if self.kind == b"FLASER":
                n = int(words[0])
                first, step, most, at = -np.pi / 2, np.pi / max(n - n % 2, 1), self._max_m, 1
            else:
                first, step, most = float(words[1]), float(words[3]), float(words[4])
                n, at = int(words[7]), 8
            beams = np.array([float(word) for word in words[at : at + n]])
            if len(beams) != n:
                raise ValueError("beams")
        except (ValueError, IndexError):
            raise BadFrame(
                f"its {self.kind.decode()} line holds no scan; expected a number of beams and as "
                "many ranges"
            ) from None
        return full_turn(beams, first, step, 0.0, np.nextafter(most, 0.0))


def open_carmen(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> CarmenSource:
    """Open a CARMEN log; rate and grey are not needed.

    Raises:
        SourceError: If it is no CARMEN log, or cannot be unpacked.
    """
    del frame_rate_hz, grey
    return CarmenSource(str(path), _unpacked(path))


def is_carmen(path: Path) -> bool:
    """Return whether a file is a CARMEN log, by its suffix or its first messages."""
    name = path.name.lower()
    for packed in (".gz", ".bz2"):
        name = name.removesuffix(packed)
    if name.endswith((".clf", ".carmen")):
        return True
    if not name.endswith(".log"):
        return False
    lines = _unpacked(path, _LOOKED_AT << 14).splitlines()[:_LOOKED_AT]
    kinds = [line.split(None, 1)[:1] for line in lines]
    return any(kind in ([b"FLASER"], [b"ROBOTLASER1"], [b"ODOM"]) for kind in kinds)


def _unpacked(path: Path, most: int | None = None) -> bytes:
    """Return the bytes of a file, unpacked if it is compressed, or the first ``most``."""
    whole = most is None
    try:
        size = check_regular(path)
        name = path.name.lower()
        opener = bz2.open if name.endswith(".bz2") else gzip.open if name.endswith(".gz") else open
        if most is None:
            most = min(MOST_FILE_BYTES, budget_bytes() // _PER_BYTE)
        with opener(path, "rb") as file:
            text = bytes(file.read(most + 1))
    except (EOFError, zlib.error, OSError, ValueError) as error:
        what = error if isinstance(error, NotReadableError) else f"cannot be read ({error})"
        raise SourceError(f"{path}: {what}") from None
    if whole and is_bomb(size, len(text)):
        raise SourceError(f"{path}: unpacks to {len(text):,} bytes; expected a log")
    if whole and len(text) > most:
        needed = _PER_BYTE * max(len(text), size)
        why = too_much(needed) if not fits(needed) else f"has more than {most:,} bytes"
        raise SourceError(f"{path}: {why}")
    return text


def _pose_and_times(line: bytes, kind: bytes) -> list[float]:
    """Return x, y, heading of the robot, then the logger's time and that of IPC."""
    words = line.split()
    if kind == b"ODOM":
        chosen = words[:3]
    elif kind == b"FLASER":
        chosen = words[-6:-3]
    else:
        chosen = words[-11:-8]
    times = [words[-1], words[-3]] if len(words) >= 6 else [b"", b""]
    if len(chosen) != 3:
        return [np.nan] * 5
    return [_number(word) for word in (*chosen, *times)]


def _times(columns: np.ndarray) -> np.ndarray:
    """Choose the times of the measurements, or those of the logger where the others stand still."""
    logger, ipc = columns.T
    known = np.isfinite(ipc)
    stands = not known.any() or (len(ipc) > 1 and np.ptp(ipc[known]) == 0.0)
    return np.asarray(logger if stands else ipc)


def _rising_times(times_s: np.ndarray) -> tuple[np.ndarray, int]:
    """Replace times that a later line undercuts, by its number; return how many those are.

    Example:
        >>> _rising_times(np.array([0.0, 2.5, 1.0, 2.0]))
        (array([0. , 0.5, 1. , 2. ]), 1)
    """
    known = np.where(np.isfinite(times_s), times_s, np.inf)
    least_later = np.minimum.accumulate(np.append(known, np.inf)[::-1])[::-1][1:]
    sound = np.flatnonzero(known < least_later)
    if not len(sound):
        return times_s, 0
    rows = np.arange(len(times_s))
    repaired = np.interp(rows, sound, times_s[sound])
    after = rows > sound[-1]  # at the same pace, for lines without a time
    pace_s = np.ptp(times_s[sound]) / max(int(np.ptp(sound)), 1) or 0.1
    repaired[after] += pace_s * (rows[after] - sound[-1])
    before = rows < sound[0]
    repaired[before] -= pace_s * (sound[0] - rows[before])
    return repaired, len(times_s) - len(sound)


def _number(word: bytes) -> float:
    try:
        return float(word)
    except ValueError:
        return np.nan
