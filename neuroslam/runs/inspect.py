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
from neuroslam.config import BrainConfig
from neuroslam.errors import counted
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import brain_file
from neuroslam.state.answers import counts_of, gathered
from neuroslam.state.sessions import Session


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
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["neuroslam"])
    status, config, log = file.stat(), brain.config, brain.sessions
    written = datetime.fromtimestamp(status.st_mtime, UTC)
    positions = brain.map.poses[:, :2]
    width, height = np.ptp(positions, axis=0) if len(positions) else (0.0, 0.0)
    rows = [
        ("file", str(file)),
        ("format", str(about["format"])),
        ("SHA-256", str(about["sha256"])),
        ("size", f"{status.st_size} bytes"),
        ("written", f"{written:%Y-%m-%d %H:%M} UTC"),
        *_counts(brain),
        ("extent", f"{width:.2f} m x {height:.2f} m"),
        ("length of all links", f"{brain.map.links.distance_m.sum():.2f} m"),
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
    for i, stored in enumerate(brain.stored):
        names = ", ".join(session.name for session in stored.sessions.sessions)
        counts = ", ".join(f"{value} {name}" for name, value in _counts(stored))
        rows.append((f"stored map {i}, not joined", f"sessions {names}: {counts}"))
    return rows


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
            f"{view.template_width} x {view.template_height} px of {view.features}, "
            f"threshold {view.threshold}",
        ),
        ("pose cells", f"{cells.n_xy} x {cells.n_xy} x {cells.n_theta}, {cells.cell_size_m} m"),
    ]


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
