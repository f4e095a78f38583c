"""Pictures in a folder, in a tar, or named in a list; beside them their times and motion.

A folder or a tar (also ``.tar.gz``, ``.tar.bz2``, ``.tar.xz``) holds pictures, taken in the natural
order of their names (2.jpg before 10.jpg). It may hold ``times.txt`` or ``times.csv``, a time in
seconds a line, and ``odometry.csv``, a motion CSV (:mod:`neuroslam.sensors.tracks`), each with as
many lines as there are pictures.

An image list is a text or CSV file whose lines are ``time_s path`` or ``path time_s``, separated by
a comma or blanks, or the path alone. Paths are relative to the list; lines that start with ``#``
and a header line do not count.
"""

import lzma
import re
import tarfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.tracks import Clock, Track, parse_motion
from neuroslam.types import Frame, Pose

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
_PNG_HEAD = b"\x89PNG\r\n\x1a\n"


class Picture(NamedTuple):
    """Where the bytes of a picture are: a file, a part of a file, or already here."""

    name: str
    path: Path
    offset: int = 0
    size: int = -1
    data: bytes | None = None

    def read(self) -> bytes:
        """Return the encoded picture."""
        if self.data is not None:
            return self.data
        with self.path.open("rb") as file:
            file.seek(self.offset)
            return file.read(self.size)


class ImageSource(IndexedSource):
    """Frames with a picture each.

    Args:
        name: The source, for messages.
        pictures: In the order of the frames.
        times_s: Their times, or ``None``: those of the motion, or else ``index / frame_rate_hz``.
        frame_rate_hz: Frames per second where there are no times.
        motion: Measured motion, a row a picture.
        truth: True poses, ``(n, 3)``, NaN where unknown; ``None``: those of the motion, if any.

    Raises:
        SourceError: If no picture can be decoded, or the times or the motion are not as many.
    """

    def __init__(
        self,
        name: str,
        pictures: list[Picture],
        times_s: np.ndarray | None,
        frame_rate_hz: float,
        motion: Track | None = None,
        truth: np.ndarray | None = None,
    ) -> None:
        self.name = name
        self.truth = truth if truth is not None or motion is None else motion.truth
        self.pictures = pictures
        self.n_frames = len(pictures)
        self.motion = motion
        if motion is not None:
            self._require_as_many(len(motion.velocities), f"lines of motion in {motion.name}")
            times_s = motion.times_s if times_s is None else times_s
        if times_s is not None:
            self._require_as_many(len(times_s), "times")
        self.clock = Clock(name, times_s, frame_rate_hz)
        self.frame_rate_hz = self.clock.frame_rate_hz
        self.image_shape = self._first_shape()

    def frame(self, index: int) -> Frame:
        """Make the frame of that number, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        velocity = None if self.motion is None else self.motion.velocity(index)
        truth = None if self.truth is None else self.truth[index]
        truth = None if truth is None or not np.isfinite(truth).all() else Pose(*truth.tolist())
        image = self._decoded(index)
        require_shape(image, self.image_shape, self.name, index, self.pictures[index].name)
        return Frame(index, time_s, image=image, velocity=velocity, truth=truth)

    def _decoded(self, index: int) -> np.ndarray:
        picture = self.pictures[index]
        try:
            image = decode_grey(picture.read())
        except OSError as error:
            raise BadFrame(
                f"{self.name}: frame {index}: {picture.name} cannot be read ({error.strerror})"
            ) from None
        if image is None:
            raise BadFrame(
                f"{self.name}: frame {index}: {picture.name} is corrupt or not a picture"
            )
        return image

    def _first_shape(self) -> tuple[int, ...]:
        first_fault = None
        for index in range(self.n_frames):
            try:
                return self._decoded(index).shape
            except BadFrame as fault:
                first_fault = first_fault or fault
        others = f"; and so are all {self.n_frames} frames" if self.n_frames > 1 else ""
        raise SourceError(f"{first_fault}{others}") from None

    def _require_as_many(self, n: int, what: str) -> None:
        if n != self.n_frames:
            raise SourceError(
                f"{self.name}: {n} {what} for {counted(self.n_frames, 'picture')}; "
                "expected one each"
            )


def require_shape(
    image: np.ndarray, expected: tuple[int, ...], source: str, index: int, picture: str = ""
) -> None:
    """Refuse a frame that is not as large as the others.

    Raises:
        BadFrame: Names the frame and both sizes.
    """
    if image.shape != expected:
        (h, w), (h0, w0) = image.shape[:2], expected[:2]
        raise BadFrame(
            f"{source}: frame {index}{f' ({picture})' if picture else ''} is {w} x {h} px; "
            f"expected {w0} x {h0} px as before it"
        )


def decode_grey(data: bytes) -> np.ndarray | None:
    """Decode a picture to grey, by way of colour: a JPEG's own luminance is rounded otherwise.

    Returns:
        ``uint8``, ``(h, w)``, or ``None`` if the bytes are not a whole picture.

    Example:
        >>> decode_grey(cv2.imencode(".png", np.full((2, 3), 7, np.uint8))[1].tobytes()).tolist()
        [[7, 7, 7], [7, 7, 7]]
    """
    if not data or not _is_whole(data):
        return None
    with quiet_opencv():
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        except cv2.error:
            return None
    return None if image is None else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def _is_whole(data: bytes) -> bool:
    """Tell a cut JPEG or a damaged PNG, of which decoders show what there is, and print."""
    if data.startswith(b"\xff\xd8"):  # the end marker comes after the last start of a scan
        return data.rfind(b"\xff\xd9") > data.rfind(b"\xff\xda")
    if data.startswith(_PNG_HEAD):
        at, kind = len(_PNG_HEAD), b""
        while kind != b"IEND":
            size = int.from_bytes(data[at : at + 4], "big")
            kind, checked = data[at + 4 : at + 8], data[at + 4 : at + 8 + size]
            if zlib.crc32(checked).to_bytes(4, "big") != data[at + 8 + size : at + 12 + size]:
                return False
            at += 12 + size
    return True


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from printing: what goes wrong is said once, by us."""
    log = cv2.utils.logging
    before = log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        log.setLogLevel(before)


def open_folder(path: Path, frame_rate_hz: float) -> ImageSource:
    """Open a folder of pictures.

    Raises:
        SourceError: If there are none, or what lies beside them cannot be used.
    """
    files = {file.name: file for file in path.iterdir() if file.is_file()}
    pictures = [Picture(name, file) for name, file in files.items() if is_picture(name)]
    notes = {name: read_text(file) for name, file in files.items() if name in _NOTES}
    return _with_notes(str(path), pictures, notes, frame_rate_hz)


def open_tar(path: Path, frame_rate_hz: float) -> ImageSource:
    """Open a tar of pictures; nothing is unpacked to disk.

    A plain tar is read where the pictures lie in it. A compressed one cannot be, so its pictures
    are kept in memory, encoded as they are.

    Raises:
        SourceError: If the tar is damaged or holds no pictures.
    """
    try:
        try:
            members = _list_tar(path, "r:")
        except tarfile.ReadError:
            members = _list_tar(path, "r:*")
    except (tarfile.TarError, EOFError, OSError, zlib.error, lzma.LZMAError) as error:
        said = (str(error) or type(error).__name__).splitlines()[0]
        raise SourceError(f"{path}: is not a whole tar file ({said})") from None
    pictures = [member for member in members if is_picture(member.name)]
    notes = {
        note: to_text(member.read(), f"{path}: {member.name}")
        for member in members
        if (note := member.name.rpartition("/")[2]) in _NOTES
    }
    return _with_notes(str(path), pictures, notes, frame_rate_hz)


def _list_tar(path: Path, mode: str) -> list[Picture]:
    found = {}
    with tarfile.open(path, mode) as tar:
        for member in tar:
            wanted = is_picture(member.name) or member.name.rpartition("/")[2] in _NOTES
            if member.isreg() and wanted:
                data = None if mode == "r:" else tar.extractfile(member).read()
                found[member.name] = Picture(
                    member.name, path, member.offset_data, member.size, data
                )
    return list(found.values())


def open_image_list(path: Path, frame_rate_hz: float) -> ImageSource:
    """Open an image list, as the head of this module describes it.

    Raises:
        SourceError: If a line cannot be read, some have times and some not, or there are none.
    """
    entries = parse_image_list(read_text(path), str(path))
    pictures = [Picture(name, path.parent / name) for name, _ in entries]
    times = [time_s for _, time_s in entries]
    if times.count(None) not in (0, len(times)):
        without = pictures[times.index(None)].name
        raise SourceError(f"{path}: {without} has no time and others have; expected all or none")
    return ImageSource(
        str(path), pictures, None if None in times else np.array(times), frame_rate_hz
    )


def parse_image_list(text: str, name: str) -> list[tuple[str, float | None]]:
    r"""Read the paths and times of an image list.

    Raises:
        SourceError: If a line is neither, or there is none.

    Example:
        >>> parse_image_list("# time path\n0.5 a.png\nb/c d.png, 1.5\n", "list.txt")
        [('a.png', 0.5), ('b/c d.png', 1.5)]
    """
    entries = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        path, time_s = _path_and_time(line)
        if time_s is None and not is_picture(path):
            if not entries and "." not in line:  # a header
                continue
            raise SourceError(
                f"{name}: line {number} is {line[:60]!r}; expected 'time_s path' or 'path time_s'"
            )
        entries.append((path, time_s))
    if not entries:
        raise SourceError(f"{name}: names no pictures; expected lines like 'time_s path'")
    return entries


def _path_and_time(line: str) -> tuple[str, float | None]:
    for separator in (",", None):
        for parts in (line.split(separator, 1), line.rsplit(separator, 1)[::-1]):
            if len(parts) == 2 and (time_s := _time(parts[0])) is not None:
                return parts[1].strip().strip('"'), time_s
    return line.strip('"'), None


def _time(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


def parse_times(text: str, name: str) -> np.ndarray:
    r"""Read a time in seconds a line; lines that start with ``#`` and a header do not count.

    Raises:
        SourceError: If a line is not a number.

    Example:
        >>> parse_times("time_s\n0.0\n0.5\n", "times.csv").tolist()
        [0.0, 0.5]
    """
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    if lines and lines[0][1].strip('"').isidentifier() and _time(lines[0][1]) is None:
        del lines[0]
    times = [_time(line) for _, line in lines]
    if None in times:
        number, line = lines[times.index(None)]
        raise SourceError(f"{name}: line {number} is {line[:40]!r}; expected a time in seconds")
    return np.array(times, dtype=np.float64)


_NOTES = ("times.txt", "times.csv", "odometry.csv")


def _with_notes(
    name: str, pictures: list[Picture], notes: dict[str, str], frame_rate_hz: float
) -> ImageSource:
    if not pictures:
        raise SourceError(f"{name}: holds no pictures; expected files like {IMAGE_SUFFIXES[0]}")
    times = next((note for note in ("times.txt", "times.csv") if note in notes), None)
    motion = notes.get("odometry.csv")
    return ImageSource(
        name,
        sorted(pictures, key=lambda picture: natural_key(picture.name)),
        None if times is None else parse_times(notes[times], f"{name}: {times}"),
        frame_rate_hz,
        None if motion is None else parse_motion(motion, f"{name}: odometry.csv"),
    )


def is_picture(name: str) -> bool:
    """Tell whether a file is a picture, by its name; hidden files are none."""
    base = name.rpartition("/")[2]
    return base.lower().endswith(IMAGE_SUFFIXES) and not base.startswith(".")


def natural_key(name: str) -> tuple[list[int | str], str]:
    """Return what to sort names by so that numbers in them count as numbers.

    Example:
        >>> sorted(["10.jpg", "2.jpg", "a.jpg"], key=natural_key)
        ['2.jpg', '10.jpg', 'a.jpg']
    """
    parts = re.split(r"(\d+)", name)
    return [int(part) if part.isdecimal() else part.lower() for part in parts], name


def read_text(path: Path) -> str:
    """Read a text file.

    Raises:
        SourceError: If it is not text.
    """
    try:
        return to_text(path.read_bytes(), str(path))
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None


def to_text(data: bytes, name: str) -> str:
    """Decode UTF-8.

    Raises:
        SourceError: If it is not.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SourceError(f"{name}: is not a text file") from None
