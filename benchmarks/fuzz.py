"""Damaged and crafted inputs over all readers: ``python -m benchmarks.fuzz``.

Each input is read in a process of its own, under a limit of time and of memory. A reader may read
it, or refuse it in one line; anything else is a fault: a traceback, a hang, a crash, more memory
than the limit. Crafted brains have a valid digest; one that ``verify`` calls sound must do in every
command. Seeds are fixed. ``--keep DIR`` keeps the inputs that found faults; ``--only NAME,NAME``
takes the kinds whose name contains one of them.
"""

import argparse
import contextlib
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.fuzz_brains import CRAFTED, commands_of, crafted, sound_run
from benchmarks.fuzz_inputs import Target, command, damage, targets
from neuroslam.errors import NeuroslamError
from neuroslam.limits import MAX_MEMORY

INPUTS = 2000
SECONDS = 20
"""Limit of processor time for an input; ten times it on the clock, for a machine may be shared."""
MEGABYTES = 1024
"""Limit of memory for an input, beyond what the program itself takes."""
RUN_KIND = "run: "
"""Begin of the names of the kinds that are files of a run."""
READ, REFUSED, FAULTS = "read", "refused", ("traceback", "hang", "crash", "memory")
_READ, _REFUSED, _TRACEBACK = 0, 2, 1
_BASE_MB = [0]


def outcome(read: Callable[[], object], log: Path) -> tuple[str, float, int]:
    """Read an input in a forked process; return what became of it, seconds and megabytes."""
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _in_child(read, log)
    status, used = 0, None
    while time.monotonic() - began < 10 * SECONDS:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.002)
    else:
        os.kill(child, signal.SIGKILL)
        _, status, used = os.wait4(child, 0)
        return "hang", SECONDS, 0
    seconds, mb = used.ru_utime + used.ru_stime, max(0, used.ru_maxrss // 1024 - _BASE_MB[0])
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU:
        return "hang", seconds, mb
    if os.WIFSIGNALED(status):
        return "crash", seconds, mb
    code = os.WEXITSTATUS(status)
    text = log.read_text(errors="replace")
    if code not in (_READ, _REFUSED, 3) or "Traceback" in text:
        return "traceback", seconds, mb
    if mb > MEGABYTES:
        return "memory", seconds, mb
    return (READ if code == _READ else REFUSED), seconds, mb


def _in_child(read: Callable[[], object], log: Path) -> None:
    code = _TRACEBACK
    try:
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, 1)
        os.dup2(file, 2)
        sys.stdout, sys.stderr = (open(k, "w", closefd=False) for k in (1, 2))  # noqa: SIM115
        space = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
        limit = space + 2 * MEGABYTES * 2**20  # hard: a fault above it does not harm the machine
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS + 5))
        found = read()
        code = found if isinstance(found, int) else _READ
    except NeuroslamError as error:
        code = _REFUSED if "\n" not in str(error) else _TRACEBACK
        print(error)
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def note_base() -> None:
    """Note the memory of a process that reads nothing."""
    child = os.fork()
    if child == 0:
        os._exit(0)
    _BASE_MB[0] = os.wait4(child, 0)[2].ru_maxrss // 1024


def damaged_inputs(folder: Path, keep: Path | None, n: int, only: str) -> dict[str, Counter[str]]:
    """Damage the inputs of all readers, in turn."""
    (folder / "sound").mkdir()
    words = only.split(",")
    kinds = targets(folder / "sound")
    if any(word in RUN_KIND or RUN_KIND in word for word in words):
        kinds += run_folder(folder)
    note_base()
    kinds = [kind for kind in kinds if any(word in kind.name for word in words)]
    table: dict[str, Counter[str]] = defaultdict(Counter)
    for kind in kinds:  # a sound input must be read
        found, _, _ = outcome(lambda kind=kind: kind.read(laid(folder, kind, {})), folder / "log")
        if found != READ and not kind.name.startswith("config"):
            raise SystemExit(f"{kind.name}: sound, but {found}:\n{(folder / 'log').read_text()}")
    for number in range(n):
        kind = kinds[number % len(kinds)]
        draw = np.random.default_rng(number)
        if number % 100 == 0:
            print(f"{number} of {n} inputs", file=sys.stderr, flush=True)
        name = kind.damaged[int(draw.integers(len(kind.damaged)))]
        changed = {name: damage(kind.files[name], kind.is_text, draw)}
        at = laid(folder, kind, changed)
        found, seconds, mb = outcome(lambda kind=kind, at=at: kind.read(at), folder / "log")
        noted(
            table[kind.name], found, seconds, mb, at, keep, f"{kind.name}-{number}", folder / "log"
        )
    return table


def laid(folder: Path, kind: Target, changed: dict[str, bytes]) -> Path:
    """Write the files of an input, some of them changed, into an empty folder."""
    at = folder / "input"
    shutil.rmtree(at, ignore_errors=True)
    for name, data in (kind.files | changed).items():
        (at / name).parent.mkdir(parents=True, exist_ok=True)
        (at / name).write_bytes(data)
    return at


def run_folder(folder: Path) -> list[Target]:
    """Return the files of a run as inputs of the commands that read a run."""
    out = sound_run(folder / "run")
    files = {str(f.relative_to(out)): f.read_bytes() for f in out.rglob("*") if f.is_file()}
    files.pop("manifest.json", None)  # an attacker can remove its digests
    texts = (
        "config.toml",
        "metrics.json",
        "frames.csv",
        "experiences.csv",
        "links.csv",
        "trajectory.tum",
    )
    events = next(name for name in files if name.startswith("events"))
    return [
        Target("run: texts, verify", files, texts, command("verify", "@"), True),
        Target("run: texts, report", files, texts, command("report", "@", "--pictures", "0"), True),
        Target(
            "run: texts, resume",
            files,
            texts,
            command("resume", "@", "--stop", "24", "--no-tensorboard"),
            True,
        ),
        Target(
            "run: trace and events",
            files,
            ("trace.f64", events),
            command("report", "@", "--pictures", "0"),
        ),
        Target("run: brain, inspect", files, ("brain.safetensors",), command("inspect", "@")),
        Target(
            "run: brain, verify",
            files,
            ("brain.safetensors",),
            command("verify", "@/brain.safetensors"),
        ),
    ]


def crafted_brains(folder: Path, keep: Path | None, n: int) -> Counter[str]:
    """Craft brains with a valid digest; what ``verify`` calls sound must do in every command."""
    table: Counter[str] = Counter()
    out = sound_run(folder / "whole")
    note_base()
    for number in range(n):
        at = folder / "crafted"
        shutil.rmtree(at, ignore_errors=True)
        shutil.copytree(out, at)
        if number % 20 == 0:
            print(f"{number} of {n} brains", file=sys.stderr, flush=True)
        name = crafted(at, number)
        found, seconds, mb = outcome(
            lambda at=at: command("verify", "@/brain.safetensors")(at), folder / "log"
        )
        sound, worst = found == READ, found if found in FAULTS else ""
        for words in commands_of(out):
            if worst:
                break
            found, more, more_mb = outcome(
                lambda at=at, words=words: command(*words)(at), folder / "log"
            )
            seconds, mb = max(seconds, more), max(mb, more_mb)
            if found in FAULTS:
                worst = "unsound accepted" if sound else found
            elif found == READ and not sound:
                worst = "unsound accepted"
                (folder / "log").write_text(f"{' '.join(words)} took what verify refuses\n")
        what = worst or ("sound in every command" if sound else REFUSED)
        noted(table, what, seconds, mb, at, keep, f"crafted-{number}-{name}", folder / "log")
    return table


def noted(
    row: Counter[str],
    found: str,
    seconds: float,
    mb: int,
    at: Path,
    keep: Path | None,
    name: str,
    log: Path,
) -> None:
    """Count an outcome; print and keep a fault."""
    row[found] += 1
    row["slowest ms"] = max(row["slowest ms"], round(1000 * seconds))
    row["most MB"] = max(row["most MB"], mb)
    if found in (*FAULTS, "unsound accepted"):
        text = log.read_text(errors="replace").strip().splitlines() or ["?"]
        print(f"{name}: {found}: {text[-1][:200]}", flush=True)
        if keep is not None:
            to = keep / "".join(c if c.isalnum() or c in "-." else "_" for c in name)
            shutil.rmtree(to, ignore_errors=True)
            shutil.copytree(at, to)
            shutil.copy(log, to / "LOG")


def written(table: dict[str, Counter[str]]) -> str:
    """Return the rows as a table in Markdown."""
    faults = (*FAULTS, "unsound accepted")
    lines = [
        "| input | inputs | read | refused in one line | tracebacks | hangs | crashes | above "
        f"{MEGABYTES} MB | unsound accepted | slowest (s) | most (MB) |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    total: Counter[str] = Counter()
    for name, row in table.items():
        lines.append(_row(name, row, faults))
        for key, value in row.items():
            total[key] = (
                max(total[key], value) if key in ("slowest ms", "most MB") else total[key] + value
            )
    return "\n".join([*lines, _row("all", total, faults)])


def _row(name: str, row: Counter[str], faults: tuple[str, ...]) -> str:
    taken = row[READ] + row["sound in every command"]
    cells = [taken, row[REFUSED], *(row[fault] for fault in faults)]
    return (
        f"| {name} | {sum(cells)} | {' | '.join(map(str, cells))} | "
        f"{row['slowest ms'] / 1000:.1f} | {row['most MB']} |"
    )


def main() -> int:
    """Run the campaign; 1 if there is a fault."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--inputs", type=int, default=INPUTS)
    parser.add_argument("--brains", type=int, default=CRAFTED)
    parser.add_argument("--only", default="")
    parser.add_argument("--keep", type=Path)
    given = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    os.environ["OPENCV_FFMPEG_LOGLEVEL"] = "-8"
    os.environ[MAX_MEMORY] = f"{MEGABYTES}M"
    table: dict[str, Counter[str]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if given.inputs:
            table |= damaged_inputs(folder, given.keep, given.inputs, given.only)
        if given.brains:
            table["crafted brain"] = crafted_brains(folder, given.keep, given.brains)
    print(written(table))
    return int(any(row[fault] for row in table.values() for fault in (*FAULTS, "unsound accepted")))


if __name__ == "__main__":
    sys.exit(main())
