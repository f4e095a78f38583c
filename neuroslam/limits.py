"""How much memory what comes from outside may take: files, archives, images, arrays and configs.

The budget is half of the memory that is free when it is first asked for, or what the environment
variable ``NEUROSLAM_MAX_MEMORY`` says, which ``--max-memory`` sets. What would take more is refused
before it is read.
"""

import json
import os
import re
import stat
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

MAX_MEMORY = "NEUROSLAM_MAX_MEMORY"
"""Environment variable of the budget, as ``2G``; processes of a sweep inherit it."""

MOST_FILE_BYTES = 512 * 2**20
"""Largest encoded image, and largest config or table that is read whole."""

MOST_CONFIG_BYTES = 2**20
"""Largest config file: a complete config has 5 kB."""

MOST_PIXELS = 2**26
"""Pixels of an image: 64 million, 200 MB in colour. Cameras of robots have a tenth of it."""

MOST_JSON_BYTES = 64 * 2**20
"""Largest JSON file."""

_PER_CHARACTER = 20
"""Bytes that a character of a table takes at most, as text and as a number."""

_MOST_RATIO = 100
_FREE_RATIO_BYTES = 256 * 2**20
"""Up to here data may be compressed to any degree, beyond it to a hundredth."""

_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40}


class NotReadableError(ValueError):
    """Why a file must not be read whole."""


def parse_bytes(text: str) -> int:
    """Read a size such as ``800M`` or ``2G``, in powers of 1024.

    Raises:
        ValueError: If it is no such size, or not above 0.

    Example:
        >>> parse_bytes("1.5G") == 1.5 * 2**30
        True
    """
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,15})?) *([KMGT]?)(?:i?B)?", text.strip().upper())
    n = round(float(match[1]) * _UNITS[match[2]]) if match else 0
    if n <= 0:
        raise ValueError(f"{text!r} is no size; expected a number of bytes, as 800M or 2G")
    return n


def size_text(n_bytes: float) -> str:
    """Write a size in MB or GB, of powers of 1024.

    Example:
        >>> size_text(3.2 * 2**30), size_text(204)
        ('3.2 GB', '1 MB')
    """
    n_bytes = float(min(n_bytes, 1e30))
    if n_bytes >= 2**30:
        return f"{n_bytes / 2**30:,.1f} GB"
    return f"{max(1, round(n_bytes / 2**20))} MB"


def budget_bytes() -> int:
    """Return the memory that what comes from outside may take."""
    set_by_user = os.environ.get(MAX_MEMORY)
    return parse_bytes(set_by_user) if set_by_user else _half_of_free()


def fits(n_bytes: float) -> bool:
    """Return whether so much is within the budget."""
    return n_bytes <= budget_bytes()


def too_much(n_bytes: float) -> str:
    """Return the end of a message about what exceeds the budget.

    Example:
        >>> too_much(2**60)  # doctest: +ELLIPSIS
        'needs about 1,073,741,824.0 GB; expected at most ... GB of memory, see --max-memory'
    """
    return (
        f"needs about {size_text(n_bytes)}; expected at most {size_text(budget_bytes())} of "
        "memory, see --max-memory"
    )


def is_bomb(compressed: int, whole: int) -> bool:
    """Return whether data is so large for its compressed size that it was made to fill memory.

    Example:
        >>> is_bomb(2**20, 2**27), is_bomb(2**20, 2**30)
        (False, True)
    """
    return whole > max(_FREE_RATIO_BYTES, _MOST_RATIO * compressed)


def check_regular(path: Path) -> int:
    """Return the size of a regular file in bytes; to open a pipe would wait for a writer.

    Raises:
        NotReadableError: If it is a folder, a device or a pipe.
        OSError: If there is none.
    """
    about = path.stat()
    if stat.S_ISDIR(about.st_mode):
        raise NotReadableError("is a folder; expected a file")
    if not stat.S_ISREG(about.st_mode):
        raise NotReadableError("is a device or a pipe; expected a regular file")
    return about.st_size


def read_bounded(path: Path, most: int = MOST_FILE_BYTES) -> bytes:
    """Read a whole file, if it is a regular one and not too large.

    Args:
        path: The file; a device or a pipe would never end.
        most: Largest size in bytes.

    Raises:
        NotReadableError: If it must not be read; the message says why.
        OSError: If it cannot be read.
    """
    size = check_regular(path)
    if size > most:
        raise NotReadableError(f"has {size_text(size)}; expected at most {size_text(most)}")
    with path.open("rb") as file:
        return file.read(most)


def parse_toml(text: str) -> dict[str, Any]:
    """Read TOML.

    Raises:
        ValueError: If it is none, nested too deeply, or has a number of thousands of digits.

    Example:
        >>> parse_toml("a = 1"), parse_toml("b.c = [1]")
        ({'a': 1}, {'b': {'c': [1]}})
    """
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply; expected a few levels") from None


def parse_json(text: str | bytes) -> Any:  # noqa: ANN401 - whatever it holds
    """Read JSON.

    Raises:
        ValueError: If it is none, nested too deeply, or has a number of thousands of digits.

    Example:
        >>> parse_json('{"a": [1]}')
        {'a': [1]}
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply; expected a few levels") from None


def read_table(path: Path) -> str:
    """Read a text file that becomes a table of numbers, if that fits into the budget.

    Raises:
        NotReadableError: If it must not be read, or is not UTF-8.
        OSError: If it cannot be read.
    """
    if not fits(needed := _PER_CHARACTER * path.stat().st_size):
        raise NotReadableError(too_much(needed))
    try:
        return read_bounded(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise NotReadableError("is not a text file; expected UTF-8") from None


@lru_cache(maxsize=1)
def _half_of_free() -> int:
    return max(2**26, free_bytes() // 2)


def free_bytes() -> int:
    """Return the memory that this process can still take: of the machine, its container, its limit.

    Where the system does not say, half of the memory of the machine counts as free.
    """
    found = [_available(), _container(), _address_space()]
    return min((n for n in found if n is not None), default=2**32)


def _available() -> int | None:
    try:
        text = Path("/proc/meminfo").read_text()
        return 1024 * int(re.findall(r"MemAvailable: +(\d+)", text)[0])
    except (OSError, IndexError, ValueError):
        pass
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return None


def _container() -> int | None:
    """Return what is left of the limit of the control group, version 2 or 1."""
    for most, used in (
        ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
        ("/sys/fs/cgroup/memory/memory.limit_in_bytes",
         "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
    ):  # fmt: skip
        try:
            return max(0, int(Path(most).read_text()) - int(Path(used).read_text()))
        except (OSError, ValueError):  # no such file, or "max"
            continue
    return None


def _address_space() -> int | None:
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit == resource.RLIM_INFINITY:
            return None
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        return max(0, limit - pages * os.sysconf("SC_PAGE_SIZE"))
    except (ImportError, OSError, ValueError):
        return None
