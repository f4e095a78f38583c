"""Tar archives, also compressed ones: what is in them, read under a budget of memory."""

import bz2
import gzip
import lzma
import tarfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

from neuroslam.errors import SourceError
from neuroslam.limits import (
    MOST_FILE_BYTES,
    NotReadableError,
    fits,
    is_bomb,
    read_bounded,
    size_text,
    too_much,
)

_PER_MEMBER = 1000  # bytes that a member takes in a list
_OPENERS = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open, b"]\0\0": lzma.open}


class ImageFile(NamedTuple):
    """Location of an encoded image: a file, a part of a file, or bytes in memory."""

    name: str
    path: Path
    offset: int = 0
    size: int = -1
    data: bytes | None = None

    def read(self) -> bytes:
        """Return the bytes of the encoded image."""
        if self.data is not None:
            return self.data
        if self.size < 0:
            return read_bounded(self.path)
        with self.path.open("rb") as file:
            file.seek(self.offset)
            return file.read(self.size)


def read_tar(path: Path, wanted: Callable[[str], bool]) -> tuple[list[ImageFile], int]:
    """List the files of a tar that are wanted; nothing is unpacked to disk.

    Those of a plain tar are read in place; those of a compressed tar are kept in memory.

    Args:
        path: The archive.
        wanted: Called with the name of a file, without folders.

    Returns:
        The files, and how many wanted members are links or devices, which are left out.

    Raises:
        SourceError: If the archive is damaged or incomplete, or its files take too much memory.
    """
    try:
        try:
            return _members(path, wanted, None)
        except tarfile.ReadError:
            with _decompressed(path) as stream:
                return _members(path, wanted, stream)
    except NotReadableError as error:
        raise SourceError(f"{path}: {error}") from None
    except (
        *(tarfile.TarError, EOFError, OSError, zlib.error, lzma.LZMAError),
        *(ValueError, OverflowError, RecursionError),  # of damaged headers
    ) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise SourceError(
            f"{path}: is damaged or incomplete ({reason}); expected a tar file"
        ) from None


def _members(
    path: Path, wanted: Callable[[str], bool], stream: IO[bytes] | None
) -> tuple[list[ImageFile], int]:
    """List the files of a tar that are wanted, and count those that are none.

    Args:
        path: The archive.
        wanted: As for :func:`read_tar`.
        stream: Its content, if it is compressed; the images are then kept in memory.

    Raises:
        NotReadableError: If a member is sparse, or they take more memory than the budget.
    """
    found: dict[str, ImageFile] = {}
    needed = left_out = 0
    with tarfile.open(path, "r:", stream) as tar:
        for member in tar:
            tar.members = []  # type: ignore[attr-defined] - it would keep all of them
            if member.isdir() or not wanted(member.name.rpartition("/")[2]):
                continue
            if not member.isreg():
                left_out += 1
                continue
            if member.issparse() or member.size > MOST_FILE_BYTES:
                what = "is sparse" if member.issparse() else f"has {size_text(member.size)}"
                raise NotReadableError(
                    f"{member.name[:80]} {what}; expected a whole file of at most "
                    f"{size_text(MOST_FILE_BYTES)}"
                )
            needed += _PER_MEMBER + (0 if stream is None else member.size)
            if not fits(needed):
                raise NotReadableError(f"its images in memory alone {too_much(needed)}; unpack it")
            content = None if stream is None else tar.extractfile(member)
            data = None if content is None else content.read()
            found[member.name] = ImageFile(member.name, path, member.offset_data, member.size, data)
    return list(found.values()), left_out


@contextmanager
def _decompressed(path: Path) -> Iterator[IO[bytes]]:
    """Open a compressed file as what is in it."""
    with path.open("rb") as file:
        head = file.read(6)
        file.seek(0)
        opener = next((each for start, each in _OPENERS.items() if head.startswith(start)), None)
        if opener is None:
            raise tarfile.ReadError("neither a tar nor compressed by gzip, bzip2 or xz")
        with opener(file) as inside:
            yield cast(IO[bytes], _Measured(inside, path.stat().st_size))


class _Measured:
    """A decompressed stream that ends with an error where it was made to fill memory.

    Args:
        stream: What is decompressed.
        compressed: Its size in the file.
    """

    def __init__(self, stream: Any, compressed: int) -> None:  # noqa: ANN401 - of three types
        self.stream, self.compressed = stream, compressed

    def read(self, n: int = -1) -> bytes:
        """Read at most ``n`` bytes; never more than a file may have."""
        n = MOST_FILE_BYTES + 1 if n < 0 else n
        self._check(self.stream.tell() + min(n, MOST_FILE_BYTES))
        return self.stream.read(n)

    def seek(self, at: int, whence: int = 0) -> int:
        """Go to a position, by steps: what is skipped is decompressed too."""
        if whence == 0:
            while self.stream.tell() < at and self.read(min(2**20, at - self.stream.tell())):
                pass
            self._check(at if self.stream.tell() == at else 0)
        return self.stream.seek(at, whence)

    def tell(self) -> int:
        """Return the position."""
        return self.stream.tell()

    def _check(self, at: int) -> None:
        if is_bomb(self.compressed, at):
            raise NotReadableError(
                f"its {size_text(self.compressed)} become more than {size_text(at)}; expected "
                "images, which cannot be compressed so far; unpack it"
            )
