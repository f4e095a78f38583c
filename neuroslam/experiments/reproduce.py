"""All experiments of the four papers, and one page that compares them with what is printed."""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from neuroslam.errors import NeuroslamError, RunError
from neuroslam.experiments.claims import CLAIMS, NO_NUMBERS, PAPERS, QUICK, Claim, Size
from neuroslam.state.files import write_atomically

Run = Callable[[str, Path, Mapping[str, Any]], Any]
"""Runs an experiment by name into a folder, with arguments of its function."""


class Line(NamedTuple):
    """A line of the page.

    Attributes:
        claim: The claim.
        value: Ours; ``None``: the experiment was not run, failed, or has no such row.
        seconds: Wall time of the experiment; ``None`` if it was not run.
        note: Why there is no value.
    """

    claim: Claim
    value: float | None
    seconds: float | None
    note: str = ""


def reproduce(
    run: Run,
    out: Path,
    *,
    quick: bool = False,
    names: Sequence[str] | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Line]:
    """Run the experiments that hold values of the papers, and write the page.

    What a folder holds already, of the same size, is not run again: an interrupted call continues.
    An experiment that fails, for its recording is missing say, is a line of the page.

    Args:
        run: Runs one experiment.
        out: Folder to write: a folder for each experiment, ``reproduction.md`` and
            ``reproduction.json``.
        quick: The smaller size of :data:`~neuroslam.experiments.claims.QUICK`.
        names: Experiments to run; ``None``: all that have a claim. Others keep their results.
        say: Called with the name and size of each experiment before it runs.

    Raises:
        RunError: If a name has no claim.
    """
    out, size = Path(out), "quick" if quick else "full"
    known = list(dict.fromkeys(claim.experiment for claim in CLAIMS))
    if unknown := set(names or ()) - set(known):
        raise RunError(f"no claim is tested by {', '.join(sorted(unknown))}; {', '.join(known)} do")
    out.mkdir(parents=True, exist_ok=True)
    results: dict[str, dict[str, Any]] = {}
    seconds: dict[str, float] = {}
    notes: dict[str, str] = {}
    for name in known:
        if quick and name not in QUICK:
            notes[name] = "left out of the quick size"
            continue
        done = _done(out / name, size)
        if done is None and (names is None or name in names):
            say(f"{name} ({size})")
            started = time.monotonic()
            try:
                run(name, out / name, QUICK[name] if quick else {})
            except NeuroslamError as error:
                notes[name] = f"failed: {error}"
                continue
            taken = {"size": size, "seconds": round(time.monotonic() - started, 1)}
            _write(out / name / "seconds.json", json.dumps(taken))
            done = _done(out / name, size)
        if done is None:
            notes[name] = "not run"
            continue
        results[name], seconds[name] = done
    lines = [_line(claim, results, seconds, notes, size) for claim in CLAIMS]
    _write(out / "reproduction.md", page(lines, size))
    _write(out / "reproduction.json", json.dumps(_rows(lines, size), indent=1) + "\n")
    return lines


def _write(path: Path, text: str) -> None:
    write_atomically(path, lambda file: file.write_text(text, encoding="utf-8"))


def _done(folder: Path, size: str) -> tuple[dict[str, Any], float] | None:
    """Return results and seconds of an experiment that has ended at this size."""
    taken, file = folder / "seconds.json", folder / "results.json"
    if not (taken.is_file() and file.is_file()):
        return None
    about = json.loads(taken.read_text())
    if about["size"] != size:
        return None
    results = json.loads(file.read_text())
    return results | {"whole": dict(results)}, float(about["seconds"])


def _line(
    claim: Claim,
    results: Mapping[str, Mapping[str, Any]],
    seconds: Mapping[str, float],
    notes: Mapping[str, str],
    size: Size,
) -> Line:
    name = claim.experiment
    if name not in results:
        return Line(claim, None, None, notes[name])
    value = claim.value(results[name])
    if value is not None:
        return Line(claim, value, seconds[name])
    late = size == "quick" and claim.only_full
    return Line(claim, None, seconds[name], "needs the full size" if late else "no such row")


def _met(line: Line, size: Size) -> bool | None:
    """Tell whether a line meets its target; ``None``: it has no value, or not of that size."""
    if line.value is None or (size == "quick" and line.claim.only_full):
        return None
    return line.claim.met(line.value)


def _rows(lines: Sequence[Line], size: Size) -> list[dict[str, Any]]:
    return [
        {
            "paper": line.claim.paper,
            "item": line.claim.item,
            "says": line.claim.says,
            "experiment": line.claim.experiment,
            "size": size,
            "printed": line.claim.printed,
            "target": None if line.claim.target() is None else _target(line.claim),
            "ours": line.value if line.value is None or isfinite(line.value) else str(line.value),
            "met": _met(line, size),
            "stored": line.claim.stored(size),
            "as_stored": None if line.value is None else line.claim.same(line.value, size),
            "seconds": line.seconds,
            "note": line.note,
        }
        for line in lines
    ]


def _target(claim: Claim) -> str:
    target = claim.target()
    if target is None:
        return "-"
    within = f" ± {claim.within:g}" if claim.within else ""
    return f"{claim.rule} {target:g}{within}"


def page(lines: Sequence[Line], size: Size) -> str:
    """Return the page as Markdown: a table for each paper, and counts of what is met."""
    met = [_met(line, size) for line in lines]
    full = [
        line.claim.met(line.claim.full)
        for line, is_met in zip(lines, met, strict=True)
        if is_met is None and line.claim.full is not None
    ]
    same = [line.claim.same(line.value, size) for line in lines if line.value is not None]
    text = [
        f"# Reproduction, {size} size",
        "",
        f"{len(lines)} values of the papers: {met.count(True)} met, {met.count(False)} not met, "
        f"{met.count(None)} not decided here; of these, by stored values of the full size, "
        f"{full.count(True)} are met and {full.count(False)} are not. Of values with a stored one "
        f"of this size {same.count(True)} are as stored, {same.count(False)} are not.",
        "",
        "`target` is the printed value, or ours where the paper prints none or its recording is "
        "not public. `s` is the wall time of the whole experiment.",
    ]
    for paper, title in PAPERS.items():
        text += ["", f"## {title}", ""]
        if paper in NO_NUMBERS:
            text += [NO_NUMBERS[paper]]
            continue
        text += [
            "| item | value | experiment | printed | target | ours | met | stored | s |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        text += [_markdown(line, size) for line in lines if line.claim.paper == paper]
    return "\n".join(text) + "\n"


def _markdown(line: Line, size: Size) -> str:
    claim, value = line.claim, line.value
    words = {True: "yes", False: "**no**", None: "-"}
    ours, met = f"{value:.4g}" if value is not None else line.note, words[_met(line, size)]
    if _met(line, size) is None and claim.full is not None:
        met = f"{words[claim.met(claim.full)]}, full size: {claim.full:g}"
    stored = claim.stored(size)
    kept = "-" if stored is None else f"{stored:g}"
    if value is not None and claim.same(value, size) is False:
        kept += " (differs)"
    printed = "-" if claim.printed is None else f"{claim.printed:g}"
    seconds = "-" if line.seconds is None else f"{line.seconds:.0f}"
    cells = [claim.item, claim.says, f"`{claim.experiment}`", printed, _target(claim), ours, met]
    return "| " + " | ".join(c.replace("|", "\\|") for c in [*cells, kept, seconds]) + " |"
