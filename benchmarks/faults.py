"""What a killed process, a full disk, a second writer and damaged bytes do to saved maps.

``python -m benchmarks.faults`` (``make faults``) prints the table of docs/reliability.md; it is not
part of the tests. All choices follow from one seed. Each command runs in a forked process, which an
audit hook kills just before a chosen change of a file or folder: an open for writing, a rename, a
removal, a new folder. The disk that is full is a tmpfs, which takes permission to mount one.
"""

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuroslam.cli import main
from neuroslam.interrupts import handling
from neuroslam.threads import limit_threads

SEED = 18
KILLS, SIZES, WRITERS, DAMAGES = 100, 20, 20, 500
LONGEST_S = 120.0  # of any command here; they take a second on an idle machine
WORLD = "world:ellipse?laps=2&width=128&height=32"
SHORT = "world:ellipse?laps=0.1&width=64&height=32"
QUIET = "--no-tensorboard"
MERGEABLE = ("--preset", "ratslam")  # `auto` may choose other settings for each
_CHANGES = {"open", "os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate"}


class Done(NamedTuple):
    """A command that ended: its exit code (negative: a signal), what it printed, its changes."""

    code: int
    err: str
    changes: int


class Command(NamedTuple):
    """A command under test.

    Attributes:
        arguments: Its arguments; it is called in a folder that holds the runs ``a`` and ``b``.
        out: The folder that it writes.
        earlier: Folder whose copy is ``out`` at first; empty: there is none.
        reads: Whether it changes nothing that was saved.
    """

    arguments: tuple[str, ...]
    out: str
    earlier: str = ""
    reads: bool = False


MAP = ("run", WORLD, QUIET, "--stop", "40")
SWEEP = ("sweep", WORLD, "--vary", "map.loops=1,2", "--stop", "12")
FLEET = ("fleet", f"{SHORT}&noise=0.01", f"{SHORT}&noise=0.02")
COMMANDS = {
    "run": Command((*MAP, "-o", "new", "--save-every", "0.01"), "new"),
    "run --overwrite": Command(
        (*MAP, "-o", "old", "--overwrite", "--save-every", "0.05"), "old", "a"
    ),
    "run --overwrite, one save": Command((*MAP, "-o", "old", "--overwrite"), "old", "a"),
    "run --overwrite, events": Command(
        ("run", WORLD, "--stop", "40", "-o", "old", "--overwrite", "--save-every", "0.1"),
        "old", "a",
    ),
    "resume": Command(
        ("resume", "old", QUIET, "--stop", "240", "--save-every", "0.03"), "old", "a"
    ),
    "merge": Command(("merge", "a", "b", "-o", "new"), "new"),
    "merge --overwrite": Command(("merge", "a", "b", "-o", "old", "--overwrite"), "old", "b"),
    "sweep --overwrite": Command((*SWEEP, "-o", "old", "--overwrite"), "old", "sweep"),
    "fleet --overwrite": Command((*FLEET, "-o", "old", "--overwrite"), "old", "fleet"),
    "plot": Command(("plot", "old"), "old", "a", reads=True),
    "report": Command(("report", "old"), "old", "a", reads=True),
    "export": Command(("export", "old", "old/map.g2o"), "old", "a", reads=True),
}  # fmt: skip


# --- processes ----------------------------------------------------------------------------------


def start(arguments: Sequence[str], folder: Path, kill_at: int = 0) -> tuple[int, Path]:
    """Begin a command in a forked process, which is killed just before its change ``kill_at``."""
    said = Path(tempfile.mkdtemp(prefix="said"))
    child = os.fork()
    if child:
        return child, said
    try:
        os.chdir(folder)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(said / name, os.O_WRONLY | os.O_CREAT), number)
        _watch(folder, kill_at, said / "changes")
        code = main(list(arguments))
    except BaseException:  # a traceback, which the campaign counts
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _watch(folder: Path, kill_at: int, counter: Path) -> None:
    """Count the changes of files inside a folder, and kill this process before one of them."""
    within, count = str(folder), 0
    handle = os.open(counter, os.O_WRONLY | os.O_CREAT)

    def hook(event: str, values: tuple[Any, ...]) -> None:
        nonlocal count
        if event not in _CHANGES:
            return
        if event == "open" and not values[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            return
        if not isinstance(values[0], str) or not os.path.abspath(values[0]).startswith(within):
            return
        count += 1
        os.pwrite(handle, b"%d" % count, 0)
        if count == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)


def end(process: tuple[int, Path]) -> Done:
    """Wait for a command; one that does not end is killed, and counts as hung (code -99)."""
    child, said = process
    late = time.monotonic() + LONGEST_S
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > late:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            break
        time.sleep(0.002)
    code = os.waitstatus_to_exitcode(ended[1]) if ended[0] else -99
    changes = int((said / "changes").read_text() or 0) if (said / "changes").exists() else 0
    err = (said / "err").read_text(errors="replace")
    shutil.rmtree(said)
    return Done(code, err, changes)


def call(*arguments: object, folder: Path, kill_at: int = 0) -> Done:
    """Run a command to its end."""
    return end(start([str(argument) for argument in arguments], folder, kill_at))


# --- what became of a folder --------------------------------------------------------------------


def contents(out: Path) -> dict[str, str]:
    """Digest of every file of a folder."""
    return {
        str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(out.rglob("*"))
        if path.is_file()
    }


def run_folders(out: Path) -> list[Path]:
    """Return the folders of runs in a folder, or itself."""
    return sorted({path.parent for path in out.rglob("frames.csv")})


def outcome(out: Path, before: dict[str, str], wholes: bool = True) -> str:
    """Say what there is in a folder after a fault: ``old``, ``new``, ... or ``LOST: why``.

    Args:
        out: The folder.
        before: Its contents before.
        wholes: Whether a new state may be a run that goes on with ``resume``.
    """
    if not out.exists():
        return "LOST: no folder" if before else "nothing yet"
    first = call("verify", out, folder=out.parent)  # finishes and cleans up too
    if "Traceback" in first.err or first.code == -99:
        return f"LOST: verify: {first.err[-300:]}"
    # A temporary file of `plot` or `report` stays until the folder is locked to be written again.
    left = [str(path) for path in out.rglob(".*") if path.suffix != ".tmp"]
    if left:
        return f"LOST: left over: {left}"
    now = contents(out)
    if before and before.items() <= now.items():
        return "old"
    runs = run_folders(out)
    if not before and not any((run / "brain.safetensors").exists() for run in runs):
        return "nothing yet"
    if not runs:
        return "LOST: no run"
    resumed = False
    for run in runs:
        done = call("verify", run, folder=out.parent)
        if done.code == 0:
            continue
        if "the run was cut off" not in done.err or not wholes:
            return f"LOST: {done.err}"
        stop = json.loads((run / "metrics.json").read_text())["frames"] + 3
        again = call("resume", run, QUIET, "--stop", stop, folder=out.parent)
        done = call("verify", run, folder=out.parent)
        if again.code or done.code:
            return f"LOST: {again.err}{done.err}"
        resumed = True
    for table in (out / "sweep.json", out / "fleet.json"):
        if table.exists():
            content = json.loads(table.read_text())
            for row in content.get("runs") or content["sessions"]:
                folder = out / str(row.get("run") or row["folder"])
                figures = json.loads((folder / "metrics.json").read_text())
                if figures["seconds"] != row["seconds"]:
                    return f"LOST: {table} is not of the run in {folder}"
    return "new, resumed" if resumed else "new"


@contextlib.contextmanager
def copies(base: Path, command: Command, size: int | None = None) -> Iterator[Path]:
    """Make a folder with what a command needs; on a disk with ``size`` free bytes, if given."""
    folder = Path(tempfile.mkdtemp(prefix="faults"))
    mounted = size is not None
    try:
        names = [name for name in ("a", "b") if command.arguments[0] == "merge"]
        if size is not None:
            used = sum(
                -(-path.stat().st_size // 4096) * 4096 + 4096
                for name in (*names, command.earlier)
                if name
                for path in (base / name).rglob("*")
            )
            _mount(folder, used + size)
        for name in names:
            shutil.copytree(base / name, folder / name)
        if command.earlier:
            shutil.copytree(base / command.earlier, folder / "old")
        yield folder
    finally:
        if mounted:
            subprocess.run(["umount", str(folder)], check=False)
        shutil.rmtree(folder, ignore_errors=True)


def _mount(folder: Path, size: int, how: str = "") -> None:
    mount: list[str] = ["mount", "-t", "tmpfs", "-o", f"{how}size={size}", "tmpfs", str(folder)]
    subprocess.run(mount, check=True, capture_output=True)


# --- the campaign -------------------------------------------------------------------------------


class Tally:
    """Counts of outcomes, a row for each kind of fault, and the failures in words."""

    def __init__(self) -> None:
        self.rows: dict[str, Counter[str]] = {}
        self.failures: list[str] = []

    def note(self, row: str, found: str, *where: object) -> None:
        """Count an outcome; one in capitals is a failure."""
        word, _, why = found.partition(":")
        self.rows.setdefault(row, Counter())[word] += 1
        if word.isupper():
            self.failures.append(f"{row} {where}: {word}{why}")
            print(self.failures[-1], file=sys.stderr, flush=True)

    def table(self) -> str:
        """Write all as Markdown."""
        lines = ["| fault | cases | outcome |", "|---|---|---|"]
        for name, counts in self.rows.items():
            words = ", ".join(f"{n} {word}" for word, n in sorted(counts.items()))
            lines.append(f"| {name} | {counts.total()} | {words} |")
        return "\n".join(lines)


def spoken(done: Done, codes: Sequence[int]) -> str:
    """Say what is wrong with how a command ended; empty if nothing is."""
    if done.code == -99:
        return "HUNG"
    if "Traceback" in done.err:
        return f"TRACEBACK: {done.err[-400:]}"
    if done.code not in codes:
        return f"WRONG EXIT: {done.code} {done.err[-200:]}"
    if done.code == 2 and done.err.count("\n") != 1:
        return f"MANY LINES: {done.err[-400:]}"
    return ""


def kills(base: Path, tally: Tally, n: int, rng: np.random.Generator) -> None:
    """Kill every command before chosen changes, and look at what is left."""
    changes: dict[str, int] = {}
    for k in rng.permutation(-(-n // len(COMMANDS)) * len(COMMANDS)).tolist():
        name = list(COMMANDS)[k % len(COMMANDS)]
        command = COMMANDS[name]
        if name not in changes:
            with copies(base, command) as folder:
                whole = call(*command.arguments, folder=folder)
                assert whole.code == 0, (name, whole)
            changes[name] = whole.changes
        kill_at = int(rng.integers(changes[name])) + 1
        with copies(base, command) as folder:
            out = folder / command.out
            before = contents(out) if command.earlier else {}
            done = call(*command.arguments, folder=folder, kill_at=kill_at)
            if command.reads:
                before.pop("map.png")
            found = outcome(out, before)
            if command.reads and found != "old":
                found = f"LOST: {found}"
            if done.code not in (0, -signal.SIGKILL):
                found = spoken(done, (0,)) or found
            elif not found.startswith("LOST"):
                over = ["--overwrite"] if "-o" in command.arguments else []
                again = [*command.arguments, *over]
                if command.arguments[0] == "resume":
                    again[again.index("--stop") + 1] = "260"
                found = spoken(call(*again, folder=folder), (0,)) or found
                if call("verify", run_folders(out)[0], folder=folder).code:
                    found = "LOST: not sound after the command was repeated"
            tally.note(f"SIGKILL in `{name}`", found, kill_at)


def full_disks(base: Path, tally: Tally, n: int, rng: np.random.Generator) -> None:
    """Run every command on disks of growing size, from none to what it needs."""
    for k in rng.permutation(n * len(COMMANDS)).tolist():
        name = list(COMMANDS)[k % len(COMMANDS)]
        command = COMMANDS[name]
        size = 4096 * (1 + (k // len(COMMANDS)) ** 2 // 2)  # 4 kB to 0.7 MB
        try:
            with copies(base, command, size) as folder:
                out = folder / command.out
                before = contents(out) if command.earlier else {}
                done = call(*command.arguments, folder=folder)
                found = spoken(done, (0, 2))
                _mount(folder, 1 << 28, "remount,")  # what is left must do once there is room
                if not found:
                    if command.reads:
                        before.pop("map.png", None)
                    found = _after_full(out, before, done)
        except subprocess.CalledProcessError:
            tally.note("disk full", "not tried (a tmpfs cannot be mounted)")
            return
        tally.note(f"disk full in `{name}`", found, size)


def _after_full(out: Path, before: dict[str, str], done: Done) -> str:
    left = [str(path) for path in out.rglob(".*")] if out.exists() else []
    if left:
        return f"LEFT OVER: {left}"
    found = outcome(out, before, wholes=False) if done.code == 0 else ""
    if found:
        return found
    now = contents(out) if out.exists() else {}
    if before and before.items() <= now.items():
        return "old"
    return outcome(out, before) if before or now else "nothing yet"


def two_writers(base: Path, tally: Tally, n: int) -> None:
    """Begin two commands in one folder at the same time: one does its work, one is refused."""
    both = [name for name in COMMANDS if name in ("run", "resume", "merge", "merge --overwrite")]
    for k in range(n):
        command = COMMANDS[both[k % len(both)]]
        with copies(base, command) as folder:
            started = [start(command.arguments, folder) for _ in range(2)]
            ended = [end(process) for process in started]
            codes = sorted(done.code for done in ended)
            found = next((s for s in (spoken(done, (0, 2)) for done in ended) if s), "")
            sound = call("verify", command.out, folder=folder).code == 0
            if not found:
                found = "one done, one refused" if codes == [0, 2] else f"LOST: exits {codes}"
                if codes == [0, 0] and "--overwrite" in command.arguments:
                    found = "one done after the other"
                if not sound:
                    found = "LOST: not sound"
            tally.note("two writers", found, k)


def damages(base: Path, tally: Tally, n: int, rng: np.random.Generator) -> None:
    """Flip a bit of a file of a run, or cut it: ``verify`` and what reads it have to notice."""
    names = sorted(path.name for path in (base / "a").iterdir() if path.suffix != ".png")
    continues = {"brain.safetensors", "config.toml", "metrics.json", "frames.csv", "trace.f64",
                 "manifest.json"}  # fmt: skip
    for k in range(n):
        name = names[k % len(names)]
        with copies(base, COMMANDS["resume"]) as folder:
            file = folder / "old" / name
            content = bytearray(file.read_bytes())
            if k // len(names) % 4 == 3:
                content = content[: rng.integers(0, len(content))]
            else:
                content[rng.integers(0, len(content))] ^= 1 << int(rng.integers(0, 8))
            file.write_bytes(content)
            done = call("verify", "old", folder=folder)
            found = "HUNG" if done.code == -99 else ""
            found = found or ("TRACEBACK: " + done.err if "Traceback" in done.err else "")
            found = found or ("UNSOUND ACCEPTED: by verify" if done.code != 2 else "")
            if not found and name in continues:  # tables are written again
                found = spoken(call("resume", "old", QUIET, "--stop", "203", folder=folder), (2,))
            tally.note(f"flips and cuts of `{name}`", found or "noticed", k)


def prepare(base: Path) -> None:
    """Make the runs that the commands work on, and load what forked processes will need."""
    for arguments in (
        ("run", WORLD, "--stop", "200", "-o", "a", QUIET, *MERGEABLE),
        ("run", WORLD, "--start", "100", "--stop", "300", "-o", "b", QUIET, *MERGEABLE),
        (*SWEEP, "-o", "sweep"),
        (*FLEET, "-o", "fleet"),
    ):
        with contextlib.chdir(base):
            assert main(list(arguments)) in (0, 3), arguments
    texts = ("merge a b -o c", "plot c", "report c", "verify c", "export c c/map.g2o")
    for text in texts:
        with contextlib.chdir(base):
            assert main(text.split()) == 0, text


def _stop(_number: int, _frame: object) -> None:
    raise KeyboardInterrupt


_STOPS = (signal.SIGTERM, signal.SIGALRM)


def campaign(scale: float = 1.0, only: str = "", seconds: float = 0.0, seed: int = SEED) -> Tally:
    """Run all parts, or those whose names contain ``only``.

    Args:
        scale: Share of the cases.
        only: Part of the names.
        seconds: Longest time of each part; cases come in random order; 0: no limit.
        seed: Of all choices.
    """
    tally, rng = Tally(), np.random.default_rng(seed)
    parts: dict[str, Callable[[Path], None]] = {
        "kills": lambda base: kills(base, tally, round(scale * KILLS), rng),
        "disks": lambda base: full_disks(base, tally, round(scale * SIZES), rng),
        "writers": lambda base: two_writers(base, tally, round(scale * WRITERS)),
        "damages": lambda base: damages(base, tally, round(scale * DAMAGES), rng),
    }
    with tempfile.TemporaryDirectory(prefix="faults") as name, limit_threads(1):
        prepare(Path(name))
        for part, go in parts.items():
            if only in part:
                began = time.monotonic()
                with contextlib.suppress(KeyboardInterrupt), handling(_stop, _STOPS):
                    signal.setitimer(signal.ITIMER_REAL, seconds)
                    go(Path(name))  # an end before the end shows what there is
                signal.setitimer(signal.ITIMER_REAL, 0)
                print(f"{part}: {time.monotonic() - began:.0f} s", file=sys.stderr, flush=True)
    return tally


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="share of the cases")
    parser.add_argument("--only", default="", help="kills, disks, writers or damages")
    parser.add_argument("--seconds", type=float, default=0.0, help="longest time of each part")
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    tally = campaign(options.scale, options.only, options.seconds, options.seed)
    print(tally.table())
    for line in tally.failures:
        print(line)
    sys.exit(bool(tally.failures))
