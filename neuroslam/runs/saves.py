"""Saves of a folder: locked while it is written, and each save becomes visible as a whole.

A save is prepared in ``.saving`` inside the folder. Renaming that to ``.saved`` commits it: before,
the folder holds the earlier save; after, the new one, whose files only need to be moved up. A
process that is killed while it moves them leaves that to the next command (:func:`settle`).
"""

import contextlib
import errno
import json
import os
import re
import shutil
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

from neuroslam.errors import RunError, WriteError
from neuroslam.state.files import sync_folder

try:
    import fcntl
except ImportError:  # not a POSIX system: folders are not locked there
    fcntl = None

LOCK, STAGED, COMMITTED = ".lock", ".saving", ".saved"
_REMOVED = ".removed"  # in a save: names that the folder loses with it, as JSON
_LAST = "manifest.json"  # moved last: readers notice by it that a save came between

_PARTIAL = re.compile(r"\..+\.[a-z0-9_]{8}\.tmp")
"""Temporary files of :func:`~neuroslam.state.files.write_atomically`."""

_WAIT_S = 10.0
"""Longest wait for another process that is moving the files of a save, which takes milliseconds."""


class Folder:
    """A folder that this process has locked; see :func:`writing`."""

    def __init__(self, out: Path) -> None:
        self.out = out

    @property
    def staged(self) -> Path:
        """Folder in which the next save is prepared, created if missing."""
        staged = self.out / STAGED
        staged.mkdir(exist_ok=True)
        return staged

    def commit(self, remove: Iterable[str] = ()) -> None:
        """Replace files and folders by those in ``staged``; all of them, or none if it fails.

        Args:
            remove: Names that do not belong to the new save; missing ones are ignored.
        """
        staged = self.staged
        new = {path.name for path in staged.iterdir()}
        for name in new:
            if (self.out / name).is_dir() and not (staged / name).is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), name)
        (staged / _REMOVED).write_text(json.dumps(sorted(set(remove) - new)), encoding="utf-8")
        _sync(staged)
        staged.rename(self.out / COMMITTED)
        sync_folder(self.out)
        _install(self.out)


@contextlib.contextmanager
def writing(out: Path) -> Iterator[Folder]:
    """Lock a folder, created if missing, for as long as a command writes into it.

    What a killed process left behind is finished or removed first. The kernel releases the lock
    when the process ends, however it ends.

    Raises:
        RunError: If another process has locked it.
        WriteError: If it cannot be written.
    """
    new = not out.exists()
    try:
        with _locked(out) as held:
            if not held:
                raise RunError(
                    f"{out}: another process is writing there; wait for its end or choose another "
                    "folder"
                )
            try:
                _recover(out)
                yield Folder(out)
            finally:
                _discard(out / STAGED)
    except OSError as error:
        raise WriteError(f"{out}: cannot be written ({error.strerror or error})") from None
    finally:
        if new:
            with contextlib.suppress(OSError):
                out.rmdir()  # only if nothing was written


def settle(out: Path) -> None:
    """Finish the save of a process that was killed in it, and remove one that was not committed.

    Every command calls it before it reads a folder.

    Raises:
        RunError: If a save cannot be finished: the folder cannot be written, or another process
            has been saving for ten seconds; or if the folder holds a device or a pipe, which would
            be read for ever.
    """
    _refuse_devices(out)
    late = time.monotonic() + _WAIT_S
    while any(os.path.lexists(out / name) for name in (COMMITTED, STAGED, LOCK)):
        try:
            with _locked(out) as held:
                if held:
                    _recover(out)
                    return
        except OSError as error:
            if not os.path.lexists(out / COMMITTED):
                return  # an unfinished save that cannot be removed does no harm
            raise RunError(
                f"{out}: its last save has to be finished, which takes write permission "
                f"({error.strerror or error})"
            ) from None
        if not os.path.lexists(out / COMMITTED):
            return  # a living process prepares its next save
        if time.monotonic() > late:
            raise RunError(f"{out}: another process is saving there; try again later")
        time.sleep(0.005)


def _refuse_devices(out: Path) -> None:
    with contextlib.suppress(OSError), os.scandir(out) as entries:
        for entry in entries:
            if not (entry.is_file() or entry.is_dir()) and os.path.exists(entry.path):
                raise RunError(f"{entry.path}: is a device or a pipe; expected a regular file")


@contextlib.contextmanager
def _locked(out: Path) -> Iterator[bool]:
    """Yield whether this process has the lock of a folder; it has no file when it is free."""
    handle = None
    while handle is None:
        out.mkdir(parents=True, exist_ok=True)
        try:
            handle = os.open(out / LOCK, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0))
        except FileNotFoundError:  # removed by another process since mkdir
            continue
        if not _lock(handle):
            os.close(handle)
            yield False
            return
        if not os.fstat(handle).st_nlink:  # released, and removed, by another process
            os.close(handle)
            handle = None
    try:
        yield True
    finally:
        with contextlib.suppress(OSError):
            (out / LOCK).unlink()
        os.close(handle)


def _lock(handle: int) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        return True
    return True


def _recover(out: Path) -> None:
    """Finish a committed save and remove one that was not committed; needs the lock."""
    if (out / COMMITTED).is_symlink():
        _discard(out / COMMITTED)
    if (out / COMMITTED).exists():
        _install(out)
    _discard(out / STAGED)
    for path in out.iterdir():
        if _PARTIAL.fullmatch(path.name):
            path.unlink(missing_ok=True)


def _install(out: Path) -> None:
    """Move a committed save up into its folder; a second call continues after a first."""
    saved = out / COMMITTED
    for name in _removed(saved / _REMOVED):
        _discard(out / name)
    sync_folder(out)
    (saved / _REMOVED).unlink(missing_ok=True)
    for path in sorted(saved.iterdir(), key=lambda path: path.name == _LAST):
        target = out / path.name
        if path.name.startswith("."):  # no save has such files
            _discard(path)
            continue
        if path.is_dir() or target.is_dir():
            _discard(target)
        path.replace(target)
    sync_folder(out)
    saved.rmdir()


def _removed(path: Path) -> list[str]:
    """Read which names a save removes: plain names only, in case the folder was received."""
    try:
        names = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, ValueError):
        return []
    names = names if isinstance(names, list) else []
    return [
        name
        for name in names
        if isinstance(name, str) and name and Path(name).name == name and name[0] != "."
    ]


def _sync(folder: Path) -> None:
    """Write a folder to the disk, but for runs in it: they are there since they were saved."""
    for path in folder.iterdir():
        if not path.is_dir():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        elif not (path / _LAST).exists():
            _sync(path)
    sync_folder(folder)


def _discard(path: Path) -> None:
    if not path.is_dir() or path.is_symlink():
        path.unlink(missing_ok=True)
        return
    for _ in range(100):  # a process whose parent was killed may still write there
        shutil.rmtree(path, ignore_errors=True)
        if not path.exists():
            return
        time.sleep(0.02)
    shutil.rmtree(path)


def final(path: Path) -> Path:
    """Return where a path will be once the save that it is prepared in is committed.

    Example:
        >>> final(Path("out/.saving/sessions/1")).as_posix()
        'out/sessions/1'
    """
    return Path(*(part for part in path.parts if part != STAGED))
