"""Sources of images: a folder, a tar, or an image list; with times and motion if there are any.

A folder or a tar (also ``.tar.gz``, ``.tar.bz2``, ``.tar.xz``) contains images in the natural order
of their names (2.jpg before 10.jpg); names that are times, as ``str(time.time())`` writes them, are
in the order of time. It may contain ``times.txt`` or ``times.csv``, one time in seconds per line
(also ms, us or ns, :mod:`neuroslam.sensors.times`), and ``odometry.csv``, a motion CSV
(:mod:`neuroslam.sensors.tracks`), each with one line per image. Without either, names that are Unix
times are the times of the images.

An image list is a text or CSV file whose lines are ``time_s path`` or ``path time_s``, separated by
a comma or blanks, or the path alone. Paths are relative to the list; a header line and lines that
start with ``#`` are skipped.
"""

import re
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import cv2
import numpy as np

from neuroslam.errors import BadFrame, SourceError, counted
from neuroslam.limits import (
    MOST_PIXELS,
    NotReadableError,
    fits,
    read_table,
    too_much,
)
from neuroslam.sensors.archives import ImageFile, read_tar
from neuroslam.sensors.grey import to_grey
from neuroslam.sensors.image_size import image_size
from neuroslam.sensors.pixels import PixelScale, spread
from neuroslam.sensors.source import IndexedSource
from neuroslam.sensors.times import (
    UNIT_NAMES,
    Unit,
    decimal_names,
    in_seconds,
    time_column,
    times_of_names,
    unit_note,
)
from neuroslam.sensors.tracks import SLOWEST_S, Clock, Track, parse_motion
from neuroslam.types import Frame, GreyRule, Pose

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm")
_PER_PIXEL = 16  # bytes at work: colour of 16 bits, grey, and copies
_PNG_HEAD = b"\x89PNG\r\n\x1a\n"


class ImageSource(IndexedSource):
    """Source whose every frame has an image.

    Args:
        name: Name of the source, for messages.
        images: Image of each frame, in order.
        times_s: Time of each frame; ``None``: the motion's times, or else
            ``index / frame_rate_hz``.
        frame_rate_hz: Frames per second if there are no times.
        motion: Measured motion, one row per image.
        truth: True poses, ``(n, 3)``, NaN where unknown; ``None``: those of the motion, if any.
        grey: How colour becomes grey.
        notes: How the times or the truth were read, one line each.

    Raises:
        SourceError: If no image can be decoded, or the number of times or of motions differs from
            that of the images.
    """

    def __init__(
        self,
        name: str,
        images: list[ImageFile],
        times_s: np.ndarray | None,
        frame_rate_hz: float,
        motion: Track | None = None,
        truth: np.ndarray | None = None,
        grey: GreyRule = "luma",
        notes: tuple[str, ...] = (),
    ) -> None:
        self.name = name
        self.grey: GreyRule = grey
        self.notes = notes
        self.truth = truth if truth is not None or motion is None else motion.truth
        self.images = images
        self.n_frames = len(images)
        self.motion = motion
        if motion is not None:
            self._require_one_each(len(motion.velocities), f"lines of motion in {motion.name}")
            self.notes += motion.notes
            times_s = motion.times_s if times_s is None else times_s
        if times_s is None and (stamped := times_of_names([_stem(i.name) for i in images])):
            times_s, unit = stamped
            self.notes += (
                f"{name}: the names of the images are their times, in {UNIT_NAMES[unit]}",
            )
        if times_s is not None:
            self._require_one_each(len(times_s), "times")
        self.clock = Clock(name, times_s, frame_rate_hz)
        self.notes += self.clock.notes
        self.frame_rate_hz = self.clock.frame_rate_hz
        self.scale: PixelScale | None = None  # of images of more than 8 bits, once there is one
        self._scale_note = ""
        self.image_shape = self._first_shape()

    def frame(self, index: int) -> Frame:
        """Return the frame of that index, see :meth:`IndexedSource.frame`."""
        time_s = self.clock.at(index)
        velocity = None if self.motion is None else self.motion.velocity(index)
        truth = None if self.truth is None else self.truth[index]
        truth = None if truth is None or not np.isfinite(truth).all() else Pose(*truth.tolist())
        image = self._decoded(index)
        require_shape(image, self.image_shape, self.name, index, self.images[index].name)
        turn_rate = climb = None
        if self.motion is not None:
            turn_rate, climb = self.motion.turn_rate(index), self.motion.speed_upwards(index)
        return Frame(
            index,
            time_s,
            image=image,
            velocity=velocity,
            truth=truth,
            turn_rate_rad_s=turn_rate,
            v_z_m_s=climb,
        )

    def _decoded(self, index: int) -> np.ndarray:
        pixels = self._pixels(index)
        if pixels.dtype == np.uint8:
            return to_grey(pixels, self.grey, "bgr")
        self.scale = self.scale or self._scale_of_all()
        try:
            image = to_grey(self.scale(pixels, index), self.grey, "bgr")
        except BadFrame as error:
            raise BadFrame(
                f"{self.name}: frame {index}: {self.images[index].name}: {error}"
            ) from None
        note, before = self.scale.note(), self._scale_note
        if note != before:
            label = f"{self.name}: "
            kept = tuple(line for line in self.notes if not before or line != label + before)
            self.notes, self._scale_note = (*kept, label + note), note
        return image

    def _pixels(self, index: int) -> np.ndarray:
        """Return a decoded image with the bits that it has."""
        file = self.images[index]
        try:
            pixels = decode(file.read())
        except (BadFrame, NotReadableError) as error:
            raise BadFrame(f"{self.name}: frame {index}: {file.name} {error}") from None
        except (OSError, ValueError) as error:  # ValueError: a NUL in a name
            reason = getattr(error, "strerror", None) or error
            raise BadFrame(
                f"{self.name}: frame {index}: {file.name} cannot be read ({reason})"
            ) from None
        if pixels is None:
            raise BadFrame(f"{self.name}: frame {index}: {file.name} is corrupt or not an image")
        return pixels

    def _first_shape(self) -> tuple[int, ...]:
        first_fault = None
        for index in range(self.n_frames):
            try:
                return self._decoded(index).shape
            except BadFrame as fault:
                first_fault = first_fault or fault
        others = f"; and so are all {self.n_frames} frames" if self.n_frames > 1 else ""
        raise SourceError(f"{first_fault}{others}") from None

    def _scale_of_all(self) -> PixelScale:
        examined = []
        for index in spread(self.n_frames):
            with suppress(BadFrame):  # reported when it is read
                pixels = self._pixels(index)
                if pixels.dtype == np.uint16:
                    examined.append(pixels)
        return PixelScale.of(examined)

    def _require_one_each(self, n: int, what: str) -> None:
        if n != self.n_frames:
            raise SourceError(
                f"{self.name}: {n} {what} for {counted(self.n_frames, 'image')}; "
                "expected one per image"
            )


def require_shape(
    image: np.ndarray, expected: tuple[int, ...], source: str, index: int, file: str = ""
) -> None:
    """Check that an image has the size of the images before it.

    Raises:
        BadFrame: If it has another size; the message gives the frame and both sizes.
    """
    if image.shape != expected:
        (h, w), (h0, w0) = image.shape[:2], expected[:2]
        raise BadFrame(
            f"{source}: frame {index}{f' ({file})' if file else ''} is {w} x {h} px; "
            f"expected {w0} x {h0} px as in the frames before it"
        )


def decode_grey(
    data: bytes, rule: GreyRule = "luma", scale: PixelScale | None = None, index: int = 0
) -> np.ndarray | None:
    """Decode an image to grey by way of colour, as a JPEG's own luminance is rounded differently.

    Args:
        data: Encoded image.
        rule: How colour becomes grey.
        scale: Scale of images of more than 8 bits; default: what this image needs.
        index: Number of the image in its source.

    Returns:
        ``uint8``, ``(h, w)``, or ``None`` if the bytes are not a complete image.

    Raises:
        BadFrame: If the pixels are neither of 8 nor of 16 bits.

    Example:
        >>> decode_grey(cv2.imencode(".png", np.full((2, 3), 7, np.uint8))[1].tobytes()).tolist()
        [[7, 7, 7], [7, 7, 7]]
    """
    pixels = decode(data)
    if pixels is None:
        return None
    scale = PixelScale.of([pixels]) if scale is None else scale
    return to_grey(scale(pixels, index), rule, "bgr")


def decode(data: bytes) -> np.ndarray | None:
    """Decode an image with the bits that it has.

    Returns:
        ``(h, w, 3)`` BGR, ``uint8``, ``uint16`` or of the type of the file, or ``None`` if the
        bytes are not a complete image.

    Raises:
        BadFrame: If it has more pixels than memory allows.
    """
    size = image_size(data)
    if size is None:
        return None
    check_pixels(*size)
    if not is_complete(data):
        return None
    with quiet_opencv():
        for flags in (cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH, cv2.IMREAD_UNCHANGED):
            try:
                image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
            except cv2.error:
                return None
            if image is not None:  # some types, such as float32, are decoded unchanged only
                return image
    return None


def check_pixels(height: int, width: int) -> None:
    """Check the size of an image before its pixels take memory.

    Raises:
        BadFrame: If it has more than ``MOST_PIXELS``, or they do not fit into the budget.
    """
    if height * width > MOST_PIXELS:
        raise BadFrame(f"is {width:,} x {height:,} px; expected at most {MOST_PIXELS:,} px in all")
    if not fits(needed := _PER_PIXEL * height * width):
        raise BadFrame(f"is {width:,} x {height:,} px, which {too_much(needed)}")


def is_complete(data: bytes) -> bool:
    """Return False for a truncated JPEG or a damaged PNG, which decoders accept with a warning."""
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
    """Keep OpenCV from printing: errors are reported once, as exceptions."""
    log = cv2.utils.logging
    before = log.setLogLevel(log.LOG_LEVEL_SILENT)
    try:
        yield
    finally:
        log.setLogLevel(before)


def open_folder(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open a folder of images.

    Raises:
        SourceError: If it contains no images, or its times or motion cannot be used.
    """
    names = {file.name: file for file in path.iterdir()}
    files = {name: file for name, file in names.items() if file.is_file()}
    left_out = sum(map(is_image_name, names.keys() - files.keys()))
    images = [ImageFile(name, file) for name, file in files.items() if is_image_name(name)]
    notes = {name: read_text(file) for name, file in files.items() if name in _NOTES}
    return _with_notes(str(path), images, notes, frame_rate_hz, grey, left_out)


def open_tar(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open a tar of images; nothing is unpacked to disk.

    The images of a plain tar are read in place; those of a compressed tar are kept in memory,
    encoded.

    Raises:
        SourceError: If the tar is damaged or contains no images.
    """
    members, left_out = read_tar(path, lambda name: is_image_name(name) or name in _NOTES)
    images = [member for member in members if is_image_name(member.name)]
    notes = {
        note: to_text(member.read(), f"{path}: {member.name}")
        for member in members
        if (note := member.name.rpartition("/")[2]) in _NOTES
    }
    return _with_notes(str(path), images, notes, frame_rate_hz, grey, left_out)


def open_image_list(path: Path, frame_rate_hz: float, grey: GreyRule = "luma") -> ImageSource:
    """Open an image list; the module's docstring describes its format.

    Raises:
        SourceError: If a line cannot be read, only some lines have times, or there are no lines.
    """
    entries = parse_image_list(read_text(path), str(path))
    images = [ImageFile(name, path.parent / name) for name, _ in entries]
    times = [time_s for _, time_s in entries]
    if times.count(None) not in (0, len(times)):
        without = images[times.index(None)].name
        raise SourceError(
            f"{path}: {without} has no time, but others do; expected a time for all or none"
        )
    known, notes = None, ()
    if None not in times:
        known, notes = _in_seconds(np.array(times), _stated_unit(read_text(path)), str(path))
    return ImageSource(str(path), images, known, frame_rate_hz, grey=grey, notes=notes)


def _stated_unit(text: str) -> Unit | None:
    """Return the unit that the first line of a list or of times states, if it is a header."""
    line = text.lstrip().partition("\n")[0]
    column = time_column(line.split(",") if "," in line or "[" in line else line.split())
    return None if column is None else column.unit


def _in_seconds(
    times: np.ndarray, stated: Unit | None, name: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """Convert times that are in seconds unless stated or shown otherwise; note what is not."""
    times_s, unit = in_seconds(times, stated, SLOWEST_S)
    return times_s, () if unit == "s" else (unit_note(name, stated, unit),)


def parse_image_list(text: str, name: str) -> list[tuple[str, float | None]]:
    r"""Read the paths and times of an image list.

    Raises:
        SourceError: If a line has another format, or there are no lines.

    Example:
        >>> parse_image_list("# time path\n0.5 a.png\nb/c d.png, 1.5\n", "list.txt")
        [('a.png', 0.5), ('b/c d.png', 1.5)]
    """
    entries: list[tuple[str, float | None]] = []
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        path, time_s = _path_and_time(line)
        if time_s is None and not is_image_name(path):
            if not entries and "." not in line:  # a header
                continue
            raise SourceError(
                f"{name}: line {number} is {line[:60]!r}; expected 'time_s path' or 'path time_s'"
            )
        entries.append((path, time_s))
    if not entries:
        raise SourceError(f"{name}: lists no images; expected lines like 'time_s path'")
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


def parse_times(text: str, name: str) -> tuple[np.ndarray, tuple[str, ...]]:
    r"""Read one time per line; a header and lines that start with ``#`` are skipped.

    Returns:
        Times in seconds, ``(n,)``; a note if they are not in seconds.

    Raises:
        SourceError: If a line is not a number.

    Example:
        >>> parse_times("time_s\n0.0\n0.5\n", "times.csv")[0].tolist()
        [0.0, 0.5]
    """
    lines = [(number, line.strip()) for number, line in enumerate(text.splitlines(), start=1)]
    lines = [(number, line) for number, line in lines if line and not line.startswith("#")]
    header = lines[0][1].strip('"') if lines else ""
    if _time(header) is None and (header.isidentifier() or time_column([header])):
        del lines[:1]
    times = [_time(line) for _, line in lines]
    if None in times:
        number, line = lines[times.index(None)]
        raise SourceError(f"{name}: line {number} is {line[:40]!r}; expected a time in seconds")
    return _in_seconds(np.array(times, dtype=np.float64), _stated_unit(text), name)


_NOTES = ("times.txt", "times.csv", "odometry.csv")


def _with_notes(
    name: str,
    images: list[ImageFile],
    notes: dict[str, str],
    frame_rate_hz: float,
    grey: GreyRule,
    left_out: int = 0,
) -> ImageSource:
    if not images:
        raise SourceError(
            f"{name}: contains no images; expected files like 000000{IMAGE_SUFFIXES[0]}"
        )
    file = next((note for note in ("times.txt", "times.csv") if note in notes), None)
    times_s, found = None, ()
    if file is not None:
        times_s, found = parse_times(notes[file], f"{name}: {file}")
    if left_out:
        what = counted(left_out, "image is", "images are")
        found = (*found, f"{name}: {what} left out: a link or no regular file")
    motion = notes.get("odometry.csv")
    return ImageSource(
        name,
        in_order(images),
        times_s,
        frame_rate_hz,
        None if motion is None else parse_motion(motion, f"{name}: odometry.csv"),
        grey=grey,
        notes=found,
    )


def in_order(images: list[ImageFile]) -> list[ImageFile]:
    """Sort images by name: decimal numbers by value, see :func:`decimal_names`, else naturally."""
    numbers = decimal_names([_stem(image.name) for image in images])
    folders = {image.name.rpartition("/")[0] for image in images}
    if numbers is None or len(folders) > 1:
        return sorted(images, key=lambda image: natural_key(image.name))
    order = sorted(range(len(images)), key=lambda k: (numbers[k], images[k].name))
    return [images[k] for k in order]


def _stem(name: str) -> str:
    """Return a file name without its folder and suffix."""
    return name.rpartition("/")[2].rpartition(".")[0]


def is_image_name(name: str) -> bool:
    """Return whether a file name is that of an image; hidden files do not count."""
    base = name.rpartition("/")[2]
    return base.lower().endswith(IMAGE_SUFFIXES) and not base.startswith(".")


def natural_key(name: str) -> tuple[list[float | str], str]:
    """Return a sort key that compares the numbers in names as numbers, Unix times as decimals.

    Example:
        >>> sorted(["10.jpg", "2.jpg", "a.jpg"], key=natural_key)
        ['2.jpg', '10.jpg', 'a.jpg']
        >>> sorted(["map.jpg", "1700000000.5.jpg", "1700000000.25.jpg"], key=natural_key)
        ['1700000000.25.jpg', '1700000000.5.jpg', 'map.jpg']
    """
    parts = re.split(r"(\d{9,10}\.\d+|\d+)", name)
    numbers = [float(part) if "." in part or len(part) > 300 else int(part) for part in parts[1::2]]
    key: list[float | str] = [part.lower() for part in parts]
    key[1::2] = numbers
    return key, name


def read_text(path: Path) -> str:
    """Read a UTF-8 text file.

    Raises:
        SourceError: If it cannot be read, or is not UTF-8.
    """
    try:
        return read_table(path)
    except NotReadableError as error:
        raise SourceError(f"{path}: {error}") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or error
        raise SourceError(f"{path}: cannot be read ({reason})") from None


def to_text(data: bytes, name: str) -> str:
    """Decode UTF-8 text.

    Raises:
        SourceError: If the bytes are not UTF-8.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise SourceError(f"{name}: is not a text file; expected UTF-8") from None
