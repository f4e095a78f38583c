"""The content of a brain file or a run folder, as a table."""

import json
import math
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import safe_open

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.config import BrainConfig, ViewConfig
from neuroslam.errors import RunError, counted
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import brain_file, write_text
from neuroslam.runs.reading import length_unit
from neuroslam.state.answers import counts_of, gathered
from neuroslam.state.sessions import Session
from neuroslam.state.tables import GrowingTable

_WIDEST = 16  # numbers of a row in one column


def inspect(path: str | Path) -> list[tuple[str, str]]:
    """List the content of a brain and its origin.

    Args:
        path: Brain file, or folder of a run.

    Returns:
        Rows of name and value: file, counts, extent, parameters, then one row for each session,
        each merge and each stored map that is not joined yet.

    Raises:
        CheckpointError: If the brain cannot be read.
    """
    file = brain_file(path)
    brain = load_brain(file)
    present, brain = brain, brain.largest
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["neuroslam"])
    status, config, log = file.stat(), brain.config, brain.sessions
    written = datetime.fromtimestamp(status.st_mtime, UTC)
    positions = brain.map.poses[:, :2]
    unit = length_unit(file)
    width, height = np.ptp(positions, axis=0) if len(positions) else (0.0, 0.0)
    rows = [
        ("file", str(file)),
        ("format", str(about["format"])),
        ("SHA-256", str(about["sha256"])),
        ("size", f"{status.st_size} bytes"),
        ("written", f"{written:%Y-%m-%d %H:%M} UTC"),
        *_counts(brain),
        ("extent", f"{width:.2f} {unit} x {height:.2f} {unit}"),
        ("length of all links", f"{brain.map.links.distance_m.sum():.2f} {unit}"),
        ("frames seen", f"{sum(session.frames for session in log.sessions)}"),
        ("cells", "+".join(config.cells)),
        *(_views(config) if "pose" in config.cells else []),
    ]
    origins = brain.map.origins()
    made = Counter(origins.session.tolist())
    own = Counter(brain.map.experiences["session"].tolist())
    for session in log.sessions:
        rows.append((f"session {session.name}", _session(session, made, own)))
    rows += [_merge(report) for report in log.merges]
    rows.append(("refused merges", str(len(log.refusals))))
    stored = [(f"stored map {i}", one) for i, one in enumerate(present.stored)]
    for name, other in [("present map", present), *stored]:
        if other is not brain:
            names = ", ".join(session.name for session in other.sessions.sessions)
            counts = ", ".join(f"{value} {what}" for what, value in _counts(other))
            rows.append((f"{name}, not joined", f"sessions {names}: {counts}"))
    return rows


def figures_of(path: str | Path) -> dict[str, Any]:
    """Return the content of a brain as plain values: counts, extent, sessions and merges.

    Args:
        path: Brain file, or folder of a run.

    Raises:
        CheckpointError: If the brain cannot be read.
    """
    file = brain_file(path)
    brain = load_brain(file)
    positions, links, log = brain.map.poses[:, :2], brain.map.links, brain.sessions
    made = Counter(brain.map.origins().session.tolist())
    return {
        "file": file,
        "bytes": file.stat().st_size,
        "cells": list(brain.config.cells),
        "unit": length_unit(file),
        "templates": brain.view.n,
        "experiences": brain.map.n,
        "links": brain.map.n_links,
        "loop_closures": int(closes_loop(links.source, links.target).sum()),
        **gathered(brain.populations.values(), counts_of),
        "extent": np.ptp(positions, axis=0).tolist() if len(positions) else [0.0, 0.0],
        "length_of_links": float(links.distance_m.sum()),
        "sessions": [vars(one) | {"experiences": made[one.id]} for one in log.sessions],
        "merges": log.merges,
        "refused_merges": log.refusals,
        "stored_maps_not_joined": [
            {
                "sessions": [one.name for one in stored.sessions.sessions],
                "experiences": stored.map.n,
            }
            for stored in brain.stored
        ],
    }


def write_tables(path: str | Path, out: str | Path) -> list[Path]:
    """Write the state of a brain as CSV files that a person can read.

    One file for each table that grows, ``PART.TABLE.csv``, such as ``pose_cells.bindings.csv``,
    ``map.experiences.csv`` and ``map.goals.csv``; one for the activity of each population,
    ``PART.rates.csv``; and those that populations write into the folder of a run. Your own
    populations take part. Columns wider than 16 numbers, the pixels of templates, are left out.

    Args:
        path: Brain file, or folder of a run.
        out: Folder to write; it is made if there is none.

    Returns:
        The files that were written.

    Raises:
        CheckpointError: If the brain cannot be read.
        RunError: If ``out`` is a file, or cannot be written.
    """
    brain, out = load_brain(brain_file(path)), Path(out)
    if out.is_file():
        raise RunError(f"{out}: is a file; expected a folder to write tables into")
    texts: dict[str, str] = {}
    for name, part in brain.named_modules():
        if isinstance(part, GrowingTable):
            texts[f"{name}.csv"] = _table_csv(part)
    for population in brain.populations.values():
        if population.rates is not None:
            rates = enumerate(population.rates.tolist())
            lines = [f"{cell},{rate!r}" for cell, rate in rates]
            texts[f"{population.name}.rates.csv"] = "\n".join(["cell,rate", *lines]) + "\n"
        texts |= population.tables()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(out / name, text)
    except OSError as error:
        raise RunError(f"{out}: cannot be written ({error.strerror or error})") from None
    return [out / name for name in texts]


def _table_csv(table: GrowingTable) -> str:
    columns: dict[str, list[Any]] = {}
    for name in table.columns:
        values = table[name].flatten(1) if table[name].dim() > 1 else table[name][:, None]
        width = values.shape[1]
        if width <= _WIDEST:
            parts = [name] if table[name].dim() == 1 else [f"{name}_{i}" for i in range(width)]
            columns |= dict(zip(parts, values.T.tolist(), strict=True))
    rows = zip(*columns.values(), strict=True)
    return "\n".join([",".join(columns), *(",".join(map(repr, row)) for row in rows)]) + "\n"


def _counts(brain: NavigationBrain) -> list[tuple[str, str]]:
    links = brain.map.links
    rows = [("templates", str(brain.view.n))] if brain.view.n or brain.leader.needs_views else []
    rows += [
        ("experiences", str(brain.map.n)),
        ("links", str(brain.map.n_links)),
        ("loop closures", str(int(closes_loop(links.source, links.target).sum()))),
    ]
    counts = gathered(brain.populations.values(), counts_of)
    return rows + [shown_count(name, value) for name, value in counts.items()]


def shown_count(name: str, value: float) -> tuple[str, str]:
    """Format a count; a suffix of its name can be its unit.

    Example:
        >>> shown_count("place_cells", 3), shown_count("lost_s", 1.25)
        (('place cells', '3'), ('lost', '1.2 s'))
    """
    if name.endswith(("_s", "_m", "_hz")):
        name, _, unit = name.rpartition("_")
        return name.replace("_", " "), f"{value:.1f} {unit}"
    return name.replace("_", " "), f"{value:g}"


def _views(config: BrainConfig) -> list[tuple[str, str]]:
    view, cells = config.view, config.pose_cells
    return [
        (
            "view",
            f"{view.template_width} x {view.template_height} px of {_content(view)}, "
            f"threshold {view.threshold}",
        ),
        ("pose cells", f"{cells.n_xy} x {cells.n_xy} x {cells.n_theta}, {cells.cell_size_m} m"),
    ]


def _content(view: ViewConfig) -> str:
    return f"{view.orientations} orientations" if view.orientations else view.features


def _session(session: Session, made: Counter[int], own: Counter[int]) -> str:
    known = made[session.id] - own[session.id]
    return ", ".join(
        [
            session.source or "source unknown",
            *([f"preset {session.preset}"] if session.preset else []),
            *([f"recorded {session.recorded}"] if session.recorded else []),
            f"{counted(session.frames, 'frame')} from frame {session.first_frame}",
            counted(made[session.id], "experience")
            + (f" ({known} merged into those of other sessions)" if known else ""),
            f"began: {session.began}",
        ]
    )


def _merge(report: dict[str, Any]) -> tuple[str, str]:
    at = "" if report["at_frame"] is None else f" at frame {report['at_frame']}"
    shift = ", ".join(f"{cells:.2f}" for cells in report["cell_shift"])
    cells = "" if report["match"]["error"] is None else f"pose cells moved by {shift}, "
    return f"merge{at}", (
        f"session {report['partial_sessions'][-1]} into {', '.join(report['loaded_sessions'])}, "
        f"{counted(report['match']['places'], 'experience agrees', 'experiences agree')}, {cells}"
        f"map turned by {math.degrees(report['rotation_rad']):.1f} degrees"
    )
