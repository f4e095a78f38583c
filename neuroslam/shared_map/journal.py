"""The journal of a shared map: offers are appended, and acknowledged once they are on the disk.

One SQLite file in a folder, with a write-ahead log: many processes of one machine write and read
it, without a server. An offer is committed with ``synchronous=FULL`` before its receipt is
returned, so what was acknowledged outlives a killed process and a power failure. The journal only
grows: the map is computed from the set of its offers, see :mod:`neuroslam.shared_map.fold`.
"""

import contextlib
import json
import sqlite3
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Protocol, Self

from neuroslam.config import BrainConfig, build_config
from neuroslam.errors import ConfigError, RenamedKeyWarning, SharedMapError, counted
from neuroslam.merging.mapped import differing_keys
from neuroslam.shared_map.messages import decode, digest_of
from neuroslam.state.sessions import session_name

FILE = "shared_map.sqlite"
FORMAT = 1
WAIT_S = 20.0
"""Longest wait for other processes that are writing."""

MOST_NAME = 100
"""Characters of the name of a robot."""

_TABLES = """
CREATE TABLE IF NOT EXISTS about (name TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS offers (
    id INTEGER PRIMARY KEY AUTOINCREMENT, digest BLOB NOT NULL UNIQUE, robot TEXT NOT NULL,
    received REAL NOT NULL, message BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS owners (session INTEGER PRIMARY KEY, robot TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS layouts (
    only INTEGER PRIMARY KEY CHECK (only = 1), digest TEXT NOT NULL, upto INTEGER NOT NULL,
    layout BLOB NOT NULL, report TEXT NOT NULL);
"""


class Receipt(NamedTuple):
    """Acknowledgement of an offer: it is on the disk.

    Attributes:
        number: Its number in the journal.
        digest: Content id of the offer, hexadecimal.
        known: Whether the journal had it already.
    """

    number: int
    digest: str
    known: bool


class Entry(NamedTuple):
    """An offer in the journal: its number, its robot, when it came (s since 1970), its message."""

    number: int
    robot: str
    received_s: float
    message: bytes


class Layout(NamedTuple):
    """The published fold: where the confirmed places lie.

    Attributes:
        digest: Digest of the set of offers that it was computed from.
        upto: Number of the last of them.
        layout: Poses of the places, packed; see :mod:`neuroslam.shared_map.fold`.
        report: What was merged and what is in quarantine, JSON.
    """

    digest: str
    upto: int
    layout: bytes
    report: str


class Offers(Protocol):
    """What robots need of a journal, wherever it is."""

    def offer(self, robot: str, message: bytes) -> Receipt:
        """Store an offer, and return once it is on the disk."""
        ...

    def since(self, number: int, most: int = 1000) -> list[Entry]:
        """Return the offers after a number, in the order in which they came."""
        ...

    def published(self) -> Layout | None:
        """Return the newest fold that was published."""
        ...


def shared_config(config: BrainConfig) -> BrainConfig:
    """Return the config of the shared map of robots with this config: views and pose cells.

    Robots may have further populations; what those learn stays with the robot.

    Raises:
        ConfigError: If the robot has no pose cells, or a network computes its views.

    Example:
        >>> shared_config(BrainConfig(cells=["pose"])).cells
        ('pose',)
    """
    if "pose" not in config.cells or config.view.features != "grey":  # pose cells lead, if any
        raise ConfigError(
            f"shared map: cells is {'+'.join(config.cells)}, view.features is "
            f"{config.view.features}; expected pose cells and grey views, which robots can compare"
        )
    if config.map.max_experiences or config.map.consolidate_passes:
        map_ = config.map.model_copy(update={"max_experiences": 0, "consolidate_passes": 0})
        config = config.model_copy(update={"map": map_})
    return config.model_copy(update={"cells": ("pose",)})


class Journal:
    """The journal in a folder; made if missing and a config is given.

    Args:
        folder: Folder of the shared map, on a disk of this machine.
        config: Config of the robots; views and pose cells must be those of the journal.

    Raises:
        ConfigError: If the robots of the journal have another config.
        SharedMapError: If there is no journal, it is damaged, or cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder, Journal(folder, BrainConfig()) as journal:
        ...     journal.since(0), journal.published()
        ([], None)
    """

    def __init__(self, folder: str | Path, config: BrainConfig | None = None) -> None:
        self.folder = Path(folder)
        file = self.folder / FILE
        if config is None and not file.is_file():
            raise SharedMapError(f"{folder}: holds no shared map; offer a robot's places first")
        wanted = None if config is None else shared_config(config)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SharedMapError(f"{folder}: cannot be made ({error.strerror})") from None
        with self._errors():
            self._base = sqlite3.connect(file, timeout=WAIT_S, isolation_level=None)
            self._base.execute("PRAGMA journal_mode = WAL")
            self._base.execute("PRAGMA synchronous = FULL")
            self._base.executescript(_TABLES)
        self.config = self._agreed(wanted)

    def _agreed(self, wanted: BrainConfig | None) -> BrainConfig:
        """Return the config of the journal, which the first robot sets."""
        with self._writing():
            rows = dict(self._base.execute("SELECT name, value FROM about"))
            if not rows and wanted is not None:
                text = json.dumps(wanted.model_dump(mode="json"))
                about = [("format", str(FORMAT)), ("config", text)]
                self._base.executemany("INSERT INTO about VALUES (?, ?)", about)
                return wanted
        if rows.get("format") != str(FORMAT) or "config" not in rows:
            raise SharedMapError(
                f"{self.folder}: format {rows.get('format')!r} of a shared map; expected {FORMAT}"
            )
        with warnings.catch_warnings(action="ignore", category=RenamedKeyWarning):
            config = build_config(json.loads(rows["config"]), str(self.folder))
        apart = [] if wanted is None else differing_keys(config, wanted)
        if apart:
            raise ConfigError(
                f"{self.folder}: the robots of the shared map have another config: "
                f"{'; '.join(apart)}; run this one with theirs"
            )
        return config

    def offer(self, robot: str, message: bytes) -> Receipt:
        """Check an offer and store it; return once it is on the disk.

        The same content is stored once, however often it is sent.

        Args:
            robot: Name of the robot; a session belongs to the first robot that offers it.
            message: See :mod:`neuroslam.shared_map.messages`.

        Raises:
            SharedMapError: If the message is refused, or cannot be stored.
        """
        if not 0 < len(robot) <= MOST_NAME or not robot.isprintable():
            raise SharedMapError(
                f"robot {robot[:MOST_NAME]!r}: expected a printable name of 1 to {MOST_NAME} "
                "characters"
            )
        content = decode(message)
        view = self.config.view
        n_pixels = view.template_width * view.template_height
        if len(content.pixels) and content.pixels.shape[1] != n_pixels:
            raise SharedMapError(
                f"offer of {robot}: templates of {content.pixels.shape[1]} pixels; expected "
                f"{n_pixels}, those of the shared map"
            )
        cells = self.config.pose_cells
        torus = (cells.n_xy, cells.n_xy, cells.n_theta)
        if len(content.places) and (content.places["cell"].max(axis=0) > torus).any():
            raise SharedMapError(f"offer of {robot}: places.cell is not on the torus of {torus}")
        digest = digest_of(message)
        own = {content.sessions[k] for k in content.places["session"].tolist()}
        with self._writing():
            row = self._base.execute("SELECT id FROM offers WHERE digest = ?", (digest,)).fetchone()
            if row is not None:
                return Receipt(row[0], digest.hex(), True)
            for session in sorted(own):
                self._base.execute("INSERT OR IGNORE INTO owners VALUES (?, ?)", (session, robot))
                query = "SELECT robot FROM owners WHERE session = ?"
                (owner,) = self._base.execute(query, (session,)).fetchone()
                if owner != robot:
                    raise SharedMapError(
                        f"offer of {robot}: session {session_name(session)} is that of {owner}; "
                        "offer places of your own sessions only"
                    )
            done = self._base.execute(
                "INSERT INTO offers (digest, robot, received, message) VALUES (?, ?, ?, ?)",
                (digest, robot, time.time(), message),
            )
            number = done.lastrowid or 0
        return Receipt(number, digest.hex(), False)

    def since(self, number: int, most: int = 1000) -> list[Entry]:
        """Return at most ``most`` offers after a number, in the order in which they came."""
        query = "SELECT id, robot, received, message FROM offers WHERE id > ? ORDER BY id LIMIT ?"
        with self._errors():
            return [Entry(*row) for row in self._base.execute(query, (number, most))]

    def all(self) -> list[Entry]:
        """Return all offers."""
        found: list[Entry] = []
        while more := self.since(found[-1].number if found else 0):
            found += more
        return found

    def publish(self, layout: Layout) -> None:
        """Replace the published fold, unless a newer one is there."""
        with self._writing():
            self._base.execute(
                "INSERT INTO layouts VALUES (1, ?, ?, ?, ?) ON CONFLICT (only) DO UPDATE SET "
                "digest = excluded.digest, upto = excluded.upto, layout = excluded.layout, "
                "report = excluded.report WHERE excluded.upto >= layouts.upto",
                layout,
            )

    def published(self) -> Layout | None:
        """Return the published fold; ``None`` if there is none yet."""
        with self._errors():
            query = "SELECT digest, upto, layout, report FROM layouts"
            row = self._base.execute(query).fetchone()
        return None if row is None else Layout(*row)

    def faults(self) -> list[str]:
        """Check the file, and every message in it; return what is wrong."""
        with self._errors():
            rows = self._base.execute("PRAGMA integrity_check").fetchall()
            faults = [str(row[0]) for row in rows if row[0] != "ok"]
        for entry in self.all():
            try:
                decode(entry.message)
            except SharedMapError as error:
                faults.append(f"offer {entry.number} of {entry.robot}: {error}")
        return faults

    def close(self) -> None:
        """Close the file; what was acknowledged is in it already."""
        self._base.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        _error: BaseException | None,
        _trace: TracebackType | None,
    ) -> None:
        self.close()

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, sqlite3.Warning) as error:
            raise SharedMapError(
                f"{self.folder / FILE}: {error}; the robot can go on, and offer again later"
            ) from None

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        """Run a block as one transaction: all of it is on the disk afterwards, or none."""
        with self._errors():
            self._base.execute("BEGIN IMMEDIATE")
        try:
            with self._errors():
                yield
        except BaseException:
            with contextlib.suppress(sqlite3.Error):
                self._base.execute("ROLLBACK")
            raise
        with self._errors():
            self._base.execute("COMMIT")


def size_text(entries: Sequence[Entry]) -> str:
    """Write the number of offers and their bytes.

    Example:
        >>> size_text([Entry(1, "a", 0.0, b"12345")])
        '1 offer, 0.0 MB'
    """
    n_bytes = sum(len(entry.message) for entry in entries)
    return f"{counted(len(entries), 'offer')}, {n_bytes / 1e6:.1f} MB"
