"""Open a source of frames by the name that a user gives on the command line."""

import csv
import math
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

from neuroslam.errors import SourceError, did_you_mean
from neuroslam.sensors.camera import CameraSource
from neuroslam.sensors.carmen import is_carmen, open_carmen
from neuroslam.sensors.datasets import open_dataset
from neuroslam.sensors.images import (
    is_image_name,
    open_folder,
    open_image_list,
    open_tar,
    read_text,
)
from neuroslam.sensors.mrclam import is_mrclam, open_mrclam
from neuroslam.sensors.options import split_track
from neuroslam.sensors.rosbag import is_bag, open_bag
from neuroslam.sensors.sightings import (
    SightingsSource,
    WithSightings,
    is_sightings,
    parse_sightings,
)
from neuroslam.sensors.source import Source
from neuroslam.sensors.streams import Streams
from neuroslam.sensors.tracks import (
    TrackSource,
    has_positions,
    header_and_rows,
    parse_motion,
    read_positions,
    read_track,
)
from neuroslam.sensors.video import VIDEO_SUFFIXES, VideoSource
from neuroslam.types import GreyRule

DEFAULT_FRAME_RATE_HZ = 20.0

_TAR_SUFFIXES = (".tar", ".tar.gz", ".tgz", ".tar.bz2", ".tbz2", ".tar.xz", ".txz")
_KINDS = (
    "a video, a folder or tar of images, an image list or motion CSV, an .npz or .npy track, "
    "a TUM, KITTI, EuRoC or MRCLAM folder, a donkeycar tub, a CARMEN log, a ROS bag, camera:0, "
    "world:NAME, arena:NAME, a CSV of landmark sightings beside motion, "
    "or a camera and motion as drive.avi+motion.csv"
)
_OFFSET = re.compile(r"(.*)[?&]offset=([+-]?[^&?+]*)", re.DOTALL)
_PREFIXES = ("world:", "arena:", "camera:", "track:")


def open_source(
    spec: str | Path, frame_rate_hz: float | None = None, grey: GreyRule = "luma"
) -> Source:
    """Open the source that ``spec`` names.

    ===================================  ========================================================
    ``drive.avi``, ``.mp4``, ``.mkv``    video
    ``frames/``, ``frames.tar``,         images, with times and motion if there are any
    ``frames.tar.gz``                    (:mod:`neuroslam.sensors.images`)
    ``list.txt``, ``list.csv``           image list (:mod:`neuroslam.sensors.images`)
    ``motion.csv``                       speed and turn rate (:mod:`neuroslam.sensors.tracks`)
    ``rat.csv``, with x and y            as ``track:rat.csv``
    ``path.npz``, ``path.npy``           positions (:mod:`neuroslam.sensors.tracks`)
    ``rat.npz`` with an arena in it      positions and walls (:mod:`neuroslam.worlds.rodent`)
    TUM, KITTI, EuRoC, TUM-VI folder     images and truth (:mod:`neuroslam.sensors.datasets`)
    ``log.clf``, ``.log``, ``.bz2``      scans of a CARMEN log (:mod:`neuroslam.sensors.carmen`)
    MRCLAM folder, ``?robot=2``          odometry and landmarks (:mod:`neuroslam.sensors.mrclam`)
    tub of donkeycar                     images, times, controls (:mod:`neuroslam.sensors.tub`)
    ``drive.bag``, ``.mcap``, ``.db3``   a ROS 1 or 2 bag (:mod:`neuroslam.sensors.rosbag`)
    ``camera:0``, ``camera:rtsp://...``  a live camera (:mod:`neuroslam.sensors.camera`)
    ``world:NAME``                       rendered world (:mod:`neuroslam.worlds.world`)
    ``track:rat.csv?units=cm,deg``       track of an animal (:mod:`neuroslam.worlds.animal_tracks`)
    ``arena:NAME``, ``arena:rat.npz``    walk with noisy senses (:mod:`neuroslam.worlds.senses`)
    ``drive.avi+motion.csv``             two sources merged by time: a camera and motion
                                         (:mod:`neuroslam.sensors.streams`); with ``?offset=S``, S
                                         seconds are added to the times of the motion
    ``motion.csv+sightings.csv``         motion and landmarks (:mod:`neuroslam.sensors.sightings`)
    ===================================  ========================================================

    Args:
        spec: A path, or ``kind:name``.
        frame_rate_hz: Frames per second if the source has no times; ``None``: 20.
        grey: How the colour of recordings and cameras becomes grey.

    Raises:
        SourceError: If the source is missing, of no known kind, or cannot be read.

    Example:
        >>> open_source("nowhere.avi")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        neuroslam.errors.SourceError: nowhere.avi: no such file or folder; expected a video, ...
    """
    rate = DEFAULT_FRAME_RATE_HZ if frame_rate_hz is None else frame_rate_hz
    if not (math.isfinite(rate) and rate > 0):
        raise SourceError(f"{spec}: frame rate is {rate} Hz; expected a number above 0")
    if spec == "":  # as a path it would name the working folder
        raise SourceError(f"the name of the source is empty; expected {_KINDS}")
    try:
        pair, offset = split_offset(str(spec))
        if parts := _parts(pair):
            offset_s = _offset_s(pair, offset)
            first, second = (open_source(part, frame_rate_hz, grey) for part in parts)
            for source, table in ((first, second), (second, first)):
                if isinstance(table, SightingsSource):
                    return WithSightings(source, table, offset_s)
            return Streams(first, second, offset_s)
        if isinstance(spec, str) and spec.startswith("world:"):
            from neuroslam.worlds.world import open_world  # here: worlds import this package

            return open_world(spec)
        if isinstance(spec, str) and spec.startswith("arena:"):
            from neuroslam.worlds.senses import open_arena

            return open_arena(spec)
        if isinstance(spec, str) and spec.startswith("track:"):
            from neuroslam.worlds.animal_tracks import open_animal_track

            return open_animal_track(spec)
        if isinstance(spec, str) and spec.startswith("camera:"):
            return CameraSource(spec.removeprefix("camera:"), grey)
        path, topics = _bag_topics(str(spec))
        if is_bag(path) and path.exists():
            return open_bag(path, topics, grey)
        folder, _, query = str(spec).partition("?")
        if is_mrclam(Path(folder)):
            return open_mrclam(Path(folder), query)
        path = Path(spec)
        if not path.exists():
            if "://" in str(spec):
                raise SourceError(f"{spec}: is an address; open it as a camera: camera:{spec}")
            beside = path.parent.iterdir() if path.parent.is_dir() else ()
            near = did_you_mean(path.name, (one.name for one in beside))
            raise SourceError(f"{path}: no such file or folder{near}; expected {_KINDS}")
        return _opener(path)(path, rate, grey)
    except OSError as error:
        raise SourceError(f"{spec}: cannot be read ({error.strerror or error})") from None


def split_offset(spec: str) -> tuple[str, str]:
    """Split the offset of the clocks from the name of two sources; empty if there is none.

    Example:
        >>> split_offset("drive.mp4+motion.csv?offset=-3.5")
        ('drive.mp4+motion.csv', '-3.5')
    """
    match = _OFFSET.fullmatch(spec)
    if match is None or "+" not in match[1] or Path(spec).exists():
        return spec, ""
    return match[1], match[2]


def with_offset(spec: str, offset: str | float) -> str:
    """Return the name of two sources with an offset of their clocks.

    Raises:
        SourceError: If the name is not that of two sources, or has an offset already.

    Example:
        >>> with_offset("world:ring+motion.csv", 2.0)  # doctest: +SKIP
        'world:ring+motion.csv?offset=2.0'
    """
    pair, before = split_offset(spec)
    if before:
        raise SourceError(f"{spec}: has an offset already; leave out one of the two")
    if _parts(spec) is None:
        raise SourceError(
            f"{spec}: an offset is between the clocks of two sources; expected a camera and motion "
            "as drive.avi+motion.csv"
        )
    return f"{pair}{'&' if '?' in pair.rpartition('+')[2] else '?'}offset={offset}"


def pair_of(spec: str) -> tuple[str, str] | None:
    """Return the names of the two sources that a name joins by ``+``, or ``None``."""
    return _parts(split_offset(spec)[0])


def _offset_s(pair: str, offset: str) -> float:
    try:
        offset_s = float(offset or 0.0)
    except ValueError:
        offset_s = math.nan
    if not math.isfinite(offset_s):
        hint = "; neuroslam.runs.clocks.resolve_offset finds 'auto'" if offset == "auto" else ""
        raise SourceError(f"{pair}: offset is {offset!r}; expected a number of seconds{hint}")
    return offset_s


def _bag_topics(spec: str) -> tuple[Path, dict[str, str]]:
    """Split ``drive.bag?image=/front`` into the path and the topics."""
    name, mark, query = spec.partition("?")
    if not mark or Path(spec).exists():
        return Path(spec), {}
    pairs = [part.partition("=") for part in query.split("&")]
    return Path(name), {key: topic for key, _, topic in pairs}


def absolute_spec(spec: str) -> str:
    """Return a name for the same source that is valid in any working folder.

    Example:
        >>> absolute_spec("world:town?laps=2"), absolute_spec("arena:square")
        ('world:town?laps=2', 'arena:square')
    """
    pair, offset = split_offset(spec)
    if parts := _parts(pair):
        whole = "+".join(map(absolute_spec, parts))
        return with_offset(whole, offset) if offset else whole
    if spec.startswith("arena:"):
        name, mark, query = spec.removeprefix("arena:").partition("?")
        name = str(Path(name).resolve()) if name.lower().endswith(".npz") else name
        return f"arena:{name}{mark}{query}"
    if spec.startswith("track:"):
        name, mark, query = split_track(spec)
        return f"track:{Path(name).resolve()}{mark}{query}"
    if spec.startswith(_PREFIXES) or ("://" in spec and not Path(spec).exists()):
        return spec
    path, topics = _bag_topics(spec)
    if topics and (is_bag(path) or is_mrclam(path)):
        return str(path.resolve()) + spec.removeprefix(str(path))
    return str(Path(spec).resolve())


def is_rendered(spec: str) -> bool:
    """Return whether a source is computed, so that opening it opens no file and no device.

    Example:
        >>> is_rendered("world:town?laps=2"), is_rendered("arena:rat.npz"), is_rendered("a.avi")
        (True, False, False)
    """
    if not spec.startswith(("world:", "arena:")) or "+" in spec:
        return False
    return not spec.partition("?")[0].lower().endswith(".npz")


def seeded_spec(spec: str, seed: int) -> str:
    """Return a name for the same source with a seed; the name of a recording stays.

    Raises:
        SourceError: If the name has a seed already.

    Example:
        >>> seeded_spec("world:town?laps=2", 7), seeded_spec("drive.avi", 7)
        ('world:town?laps=2&seed=7', 'drive.avi')
    """
    pair, offset = split_offset(spec)
    if parts := _parts(pair):
        whole = "+".join(seeded_spec(part, seed) for part in parts)
        return with_offset(whole, offset) if offset else whole
    if not spec.startswith(_PREFIXES) or spec.startswith("track:"):
        return spec
    name, _, query = spec.partition("?")
    options = list(filter(None, query.split("&")))
    if any(option.startswith("seed=") for option in options):
        raise SourceError(f"{spec}: has a seed already; leave out the seed or the number of seeds")
    return f"{name}?{'&'.join([*options, f'seed={seed}'])}"


def _parts(spec: str) -> tuple[str, str] | None:
    """Split ``camera+motion``, unless a file has that whole name; each part must name a source."""
    if "+" not in spec or Path(spec).exists():
        return None
    splits = [(spec[:at], spec[at + 1 :]) for at, letter in enumerate(spec) if letter == "+"]
    for parts in splits:
        if all(part.startswith(_PREFIXES) or _exists(part) for part in parts):
            return parts
    for parts in splits:
        for part, other in (parts, parts[::-1]):
            if _exists(part):
                raise SourceError(f"{spec}: {part} exists, {other!r} does not; expected {_KINDS}")
    return None


def _exists(part: str) -> bool:
    return part != "" and Path(part).exists()


def _opener(path: Path) -> Callable[[Path, float, GreyRule], Source]:
    name = path.name.lower()
    if path.is_dir():
        return _open_folder
    if is_carmen(path):
        return open_carmen
    if name.endswith(VIDEO_SUFFIXES):
        return VideoSource
    if name.endswith(_TAR_SUFFIXES):
        return open_tar
    if name.endswith((".csv", ".txt", ".lst")):
        return _open_table
    if name.endswith((".npz", ".npy")):
        return _open_positions
    if name.endswith(".nwb"):
        return _open_animal
    what = "is a single image" if is_image_name(name) else "is of no known kind"
    raise SourceError(f"{path}: {what}; expected {_KINDS}")


def _open_folder(path: Path, frame_rate_hz: float, grey: GreyRule) -> Source:
    """Open a folder as a dataset if it has the layout of one, else as a folder of images."""
    if (path / "brain.safetensors").is_file() and (path / "config.toml").is_file():
        raise SourceError(
            f"{path}: is the folder of a run, not a recording; expected what it was made from, or "
            f"continue it: neuroslam resume {path}"
        )
    return open_dataset(path, frame_rate_hz, grey) or open_folder(path, frame_rate_hz, grey)


def _open_table(path: Path, frame_rate_hz: float, grey: GreyRule) -> Source:
    """Open a text file: an image list if one of its first lines names an image, else by header."""
    text = read_text(path)
    for row in _first_rows(text, 10):
        if any(is_image_name(word) for field in row for word in field.split()):
            return open_image_list(path, frame_rate_hz, grey)
    header = header_and_rows(text, str(path))[0]
    if is_sightings(header):
        return parse_sightings(text, str(path))
    if has_positions(header):
        return _open_animal(path, frame_rate_hz, grey)
    return TrackSource(parse_motion(text, str(path)), frame_rate_hz)


def _first_rows(text: str, n: int) -> Iterator[list[str]]:
    """Yield the first rows of a table, as far as they can be read."""
    with suppress(csv.Error):  # its reader says what is wrong
        yield from csv.reader(text[:100_000].splitlines()[:n])


def _open_animal(path: Path, frame_rate_hz: float, _: GreyRule) -> Source:
    """Open the path of an animal, a table or a file of Neurodata Without Borders."""
    from neuroslam.worlds.animal_tracks import open_animal_track

    return open_animal_track(f"track:{path}")


def _open_positions(path: Path, frame_rate_hz: float, _: GreyRule) -> Source:
    """Open a track, and its walls if it has an arena."""
    from neuroslam.worlds.rodent import ARENA_KEYS, read_walk
    from neuroslam.worlds.senses import ArenaSource

    if any(key in read_positions(path)[0] for key in ARENA_KEYS):
        return ArenaSource(read_walk(path))
    return TrackSource(read_track(path, frame_rate_hz), frame_rate_hz)
