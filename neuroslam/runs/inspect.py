"""What is in a brain file or a run's folder, and is it sound?"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from neuroslam.brain import NavigationBrain, load_brain, read_checkpoint
from neuroslam.config import BrainConfig
from neuroslam.errors import NeuroslamError, counted
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.tables import Links, closes_loop
from neuroslam.runs.files import (
    LANDMARKS_FILE,
    TEXT_COLUMNS,
    brain_file,
    experiences_csv,
    frame_rows,
    landmarks_csv,
    links_csv,
    missing_rows,
    read_metrics,
    read_plan,
    read_trace,
    trajectory,
)
from neuroslam.state.population import State
from neuroslam.state.sessions import Session, session_name
from neuroslam.state.tables import GrowingTable

_SUM_TOLERANCE = {torch.float32: 1e-4, torch.float64: 1e-9}

# Infinite where there is none: a gap before this frame, and the end of a goal's time.
_MAY_BE_INFINITE = ("clock.after_gap_s", "map.goals.until_s")

_SHOWN = 5


def inspect(path: str | Path) -> list[tuple[str, str]]:
    """Describe a brain for a reader: what it holds, and where that comes from.

    Args:
        path: Brain file, or folder of a run.

    Returns:
        Name and value, a fact a row: file, counts, extent, parameters, then a row for each
        session, each merge and each stored map that is not joined yet.

    Raises:
        CheckpointError: If the brain cannot be read; one line says why.
    """
    file = brain_file(path)
    brain = load_brain(file)
    with safe_open(file, framework="pt") as opened:
        about = json.loads(opened.metadata()["neuroslam"])
    status, config, log = file.stat(), brain.config, brain.sessions
    written = datetime.fromtimestamp(status.st_mtime, UTC)
    places = brain.map.poses[:, :2]
    width, height = np.ptp(places, axis=0) if len(places) else (0.0, 0.0)
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
        *(_views(config) if config.has("pose") else []),
    ]
    origins = brain.map.origins()
    made = Counter(origins.session.tolist())
    own = Counter(brain.map.experiences["session"].tolist())
    for session in log.sessions:
        rows.append((f"session {session.name}", _session(session, made, own)))
    rows += [_merge(report) for report in log.merges]
    rows.append(("refused merges", str(len(log.refusals))))
    for i, one in enumerate(brain.stored):
        names = ", ".join(session.name for session in one.sessions.sessions)
        counts = ", ".join(f"{value} {name}" for name, value in _counts(one))
        rows.append((f"stored map {i}, not joined", f"sessions {names}: {counts}"))
    return rows


def _counts(brain: NavigationBrain) -> list[tuple[str, str]]:
    links = brain.map.links
    return [
        *([("views", str(brain.view.n))] if brain.config.has("pose") else []),
        ("experiences", str(brain.map.n)),
        ("links", str(brain.map.n_links)),
        ("loop closures", str(int(closes_loop(links.source, links.target).sum()))),
        *_navigation_counts(brain),
        *([("landmarks", str(brain.semantic.n))] if brain.config.has("semantic") else []),
    ]


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


def _navigation_counts(brain: NavigationBrain) -> list[tuple[str, str]]:
    if not brain.config.has("place"):
        return []
    cells = brain.navigation
    return [
        ("place cells", str(int(cells.place.n_cells))),
        ("stretches of wall", str(int(cells.walls.n_walls))),
        ("activated boundary cells", str(int(cells.familiarity.n_activated()))),
        ("lost for", f"{cells.now.lost_s:.1f} s"),
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
            + (f" ({known} of them known)" if known else ""),
            f"began: {session.began}",
        ]
    )


def _merge(report: dict[str, Any]) -> tuple[str, str]:
    at = "" if report["at_frame"] is None else f" at frame {report['at_frame']}"
    shift = ", ".join(f"{cells:.2f}" for cells in report["cell_shift"])
    cells = "" if report["match"]["error"] is None else f"pose cells moved by {shift}, "
    return f"merge{at}", (
        f"session {report['partial_sessions'][-1]} into {', '.join(report['loaded_sessions'])}, "
        f"{counted(report['match']['places'], 'place agrees', 'places agree')}, {cells}"
        f"map turned by {math.degrees(report['rotation_rad']):.1f} degrees"
    )


def verify(path: str | Path) -> list[str]:
    """Look for faults in a brain, and where a run's folder disagrees with its brain.

    A digest tells that a file is as it was written; this tells whether what was written makes
    sense: every id leads somewhere, every number is finite, every place has one origin, the map
    hangs together, the pose cells hold a belief.

    Args:
        path: Brain file, or folder of a run.

    Returns:
        A line for each kind of fault and where it is; empty if there is none.
    """
    path = Path(path)
    try:
        config, state = read_checkpoint(brain_file(path))
    except NeuroslamError as error:
        return [str(error)]
    model = NavigationBrain(config)
    numbers = {int(n.split(".")[1]) for n in state if re.match(r"stored\.\d+\.", n)}
    parts = [("", {n: t for n, t in state.items() if not re.match(r"stored\.\d+\.", n)})]
    for i in sorted(numbers):
        inside = f"stored.{i}."
        part = {n.removeprefix(inside): t for n, t in state.items() if n.startswith(inside)}
        parts.append((f"stored map {i}: ", part))
    faults = [f"{where}{fault}" for where, part in parts for fault in _misfits(part, model)]
    if numbers != set(range(len(numbers))):
        faults.append(f"stored maps are numbered {sorted(numbers)}, expected 0, 1, ...")
    if faults:
        return faults  # nothing else could be looked at
    faults = [f"{where}{fault}" for where, part in parts for fault in _faults(part, config)]
    told = len(state["recognition.tally.alike"])
    if told != len(numbers):
        faults.append(f"recognition: knows of {told} stored maps, there are {len(numbers)}")
    if path.is_dir() and not faults:  # a brain with faults agrees with nothing
        model.load_state_dict(state)
        faults = list(_folder_faults(path, model))
    return faults


def _misfits(state: State, model: NavigationBrain) -> Iterator[str]:
    """Say where a state has not the tensors, dtypes and shapes that such a brain has."""
    fresh = {n: t for n, t in model.state_dict().items() if not n.startswith("stored.")}
    for name in sorted(fresh.keys() ^ state.keys()):
        yield f"{name}: {'missing' if name in fresh else 'not part of a brain'}"
    tables = {n: t.columns for n, t in model.named_modules() if isinstance(t, GrowingTable)}
    columns = {f"{table}.{name}" for table, names in tables.items() for name in names}
    fixed = ("pose_cells.origin", "pose_cells.slip")
    for name in sorted(fresh.keys() & state.keys()):
        has, expected = state[name], fresh[name]
        if has.dtype != expected.dtype:
            yield f"{name}: {has.dtype}, expected {expected.dtype}"
        entry = slice(1 if name in columns else 0, None)
        same = has.dim() == expected.dim()
        if name in columns or name in fixed:
            same = same and has.shape[entry] == expected.shape[entry]
        if not same:
            yield f"{name}: shape {tuple(has.shape)}, like {tuple(expected.shape)} expected"
    for table, names in tables.items():
        lengths = {name: state[f"{table}.{name}"].shape[:1] for name in names
                   if f"{table}.{name}" in state}  # fmt: skip
        if len(set(lengths.values())) > 1:
            told = ", ".join(f"{name} {length[0]}" for name, length in lengths.items() if length)
            yield f"{table}: columns of different lengths: {told}"
    try:
        log = json.loads(bytes(state["sessions.text"].tolist()) or b'{"sessions": []}')
        wrong = [s for s in log["sessions"] if {f.name for f in fields(Session)} != s.keys()]
    except (KeyError, ValueError, TypeError, AttributeError):
        wrong = ["no list"]
    if wrong:
        yield "sessions.text: not a log of sessions"


def _faults(state: State, config: BrainConfig) -> Iterator[str]:
    """Say what makes no sense in the state of one map; its tensors fit the config."""
    s = {name: tensor.numpy(force=True) for name, tensor in state.items()}
    for name, tensor in state.items():
        if tensor.is_floating_point():
            wrong = tensor.isnan() if name in _MAY_BE_INFINITE else ~tensor.isfinite()
            if wrong.any():
                rows = np.unique(wrong.numpy().nonzero()[0]) if tensor.dim() else []
                yield f"{name}: not finite" + (f" in rows {_some(rows)}" if tensor.dim() else "")
    n_views, n = len(s["view.templates.pixels"]), len(s["map.experiences.template"])
    bound = len(s["pose_cells.bindings.x"])
    if bound != n_views:
        yield f"{n_views} views, {bound} of them bound to pose cells"
    for name, limit, what in (
        ("map.experiences.template", n_views, "views"),
        ("map.links_table.source", n, "experiences"),
        ("map.links_table.target", n, "experiences"),
        ("map.goals.experience", n, "experiences"),
        ("map.aliases.experience", n, "experiences"),
    ):
        lowest = -1 if not config.has("pose") and name.endswith("template") else 0
        rows = np.flatnonzero((s[name] < lowest) | (s[name] >= limit))
        if len(rows):
            yield f"{_row(name, rows)}: {name.split('.')[-1]} {_some(s[name][rows])}, " + (
                f"there are {limit} {what}"
            )
    for name, limit in (
        ("map.state.current", n), ("view.last.template", n_views), ("pose_cells.last.view", n_views)
    ):  # fmt: skip
        lowest = 0 if n and name == "map.state.current" else -1
        if not lowest <= s[name] < limit:
            yield f"{name}: is {s[name]}, expected {lowest} to {limit - 1}"
    yield from _link_faults(s, n)
    yield from _cell_faults(state, config)
    if config.has("place"):
        yield from _navigation_faults(s, n if not config.has("pose") else None)
    if config.has("semantic"):
        yield from _semantic_faults(s, n)
    yield from _origin_faults(s, n)


def _semantic_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    pointers, kinds = len(s["semantic.slam.pointers"]), len(s["semantic.known.kind"])
    if pointers != max(1, kinds):
        yield f"{kinds} landmarks, {pointers} pointers; each should have its own"
    at = s["semantic.known.experience"]
    rows = np.flatnonzero((at < -1) | (at >= n))
    if len(rows):
        yield f"landmarks {_some(rows)}: met at experiences {_some(at[rows])}, there are {n}"


def _link_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    links = Links(*(s[f"map.links_table.{name}"] for name in Links._fields))
    loops = np.flatnonzero(links.source == links.target)
    if len(loops):
        yield f"links {_some(loops)}: lead from a place to itself, {_some(links.source[loops])}"
    for name in ("distance_m", "duration_s"):
        rows = np.flatnonzero(getattr(links, name) < 0)
        if len(rows):
            yield f"links {_some(rows)}: {name} {_some(getattr(links, name)[rows])} is negative"
    there = (np.stack(links[:2]) >= 0).all(0) & (np.stack(links[:2]) < n).all(0)
    ends = links.source[there], links.target[there]
    parts, label = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(n, n)))
    if parts > 1:
        first = np.unique(label, return_index=True)[1]
        sizes = sorted(np.bincount(label).tolist(), reverse=True)
        yield (
            f"the map falls into {parts} parts, of {_some(sizes)} experiences; "
            f"they begin at {_some(np.sort(first))}"
        )


def _navigation_faults(s: dict[str, np.ndarray], n_experiences: int | None) -> Iterator[str]:
    n_cells, n_walls = (
        int(s[f"navigation.{name}"][0]) for name in ("place.n_cells", "walls.n_walls")
    )
    if n_experiences not in (None, n_cells):
        yield f"{n_cells} place cells, {n_experiences} experiences; each should be the other"
    linked = s["navigation.place.neighbours"][0, :n_cells]
    rows = np.unique(np.nonzero((linked < -1) | (linked >= n_cells))[0])
    if len(rows):
        yield f"place cells {_some(rows)}: linked to cells that are not there; there are {n_cells}"
    norms = np.linalg.norm(s["navigation.place.weights"][0, :n_cells], axis=1)
    rows = np.flatnonzero(np.abs(norms - 1.0) > 1e-3)
    if len(rows):
        yield f"place cells {_some(rows)}: weights of norm {_some(norms[rows])}, expected 1"
    active = s["navigation.walls.active"][0]
    rows = np.flatnonzero((active < -1) | (active >= n_walls))
    if len(rows):
        yield f"active walls {_some(rows)}: not remembered; there are {n_walls}"
    covariance = s["navigation.walls.covariance"][0]
    if (np.diag(covariance) < 0).any():
        yield "navigation.walls.covariance: a variance is negative"


def _cell_faults(state: State, config: BrainConfig) -> Iterator[str]:
    window, origin = state["pose_cells.window"], state["pose_cells.origin"].tolist()
    torus = (config.pose_cells.n_theta, config.pose_cells.n_xy, config.pose_cells.n_xy)
    sizes = tuple(window.shape)
    if not all(0 < size <= limit for size, limit in zip(sizes, torus, strict=True)):
        yield f"pose_cells.window: {sizes} cells do not fit the torus of {torus}"
    if not all(0 <= at < limit for at, limit in zip(origin, torus, strict=True)):
        yield f"pose_cells.origin: {tuple(origin)} is not on the torus of {torus}"
    if (window < 0).any():
        cell = tuple(torch.nonzero(window < 0)[0].tolist())
        yield f"pose_cells.window: {int((window < 0).sum())} cells are negative, the first {cell}"
    total = window.sum(dtype=torch.float64).item()
    if abs(total - 1.0) > _SUM_TOLERANCE[window.dtype]:
        yield f"pose_cells.window: adds up to {total:.6g}, expected 1"
    places = {f"pose_cells.bindings.{x}": state[f"pose_cells.bindings.{x}"] for x in ("x", "y")}
    places["pose_cells.bindings.theta"] = state["pose_cells.bindings.theta"]
    places |= {f"map.experiences.cell[{i}]": state["map.experiences.cell"][:, i] for i in range(3)}
    for (name, at), limit in zip(places.items(), 2 * torus[::-1], strict=True):
        rows = np.flatnonzero(((at < 0) | (at > limit)).numpy())
        if len(rows):
            yield f"{name}: rows {_some(rows)} are not on the torus of {torus}"


def _origin_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    """Every place that a session made is there once: as an experience or as an alias of one."""
    text = bytes(s["sessions.text"].tolist())
    log = [session["id"] for session in json.loads(text)["sessions"]] if text else []
    twice = [session_name(one) for one, count in Counter(log).items() if count > 1]
    if twice:
        yield f"sessions.text: session {', '.join(twice)} is there twice"
    here, made = int(s["map.state.session"]), int(s["map.state.made"])
    if here != (log[-1] if log else 0):
        last = session_name(log[-1]) if log else "none"
        yield f"map.state.session: is {session_name(here)}, the last in the log is {last}"
    keys = {}
    for table in ("experiences", "aliases"):
        session, number = (s[f"map.{table}.{name}"] for name in ("session", "number"))
        keys[table] = list(zip(session.tolist(), number.tolist(), strict=True))
        unknown = np.flatnonzero(~np.isin(session, log))
        if len(unknown):
            names = sorted({session_name(one) for one in session[unknown].tolist()})
            yield f"{table} {_some(unknown)}: of a session that is not in the log, {_some(names)}"
        wrong = np.flatnonzero((number < 0) | ((session == here) & (number >= made)))
        if len(wrong):
            yield (
                f"{table} {_some(wrong)}: number {_some(number[wrong])} in their session, "
                f"which has made {made}"
            )
        for key, count in Counter(keys[table]).items():
            if count > 1:
                rows = [i for i, other in enumerate(keys[table]) if other == key]
                yield f"{table} {_some(rows)}: each is place {key[1]} of {session_name(key[0])}"
    own = {key: i for i, key in enumerate(keys["experiences"])}
    for i, key in enumerate(keys["aliases"]):
        now = int(s["map.aliases.experience"][i])
        if key in own and own[key] != now:  # its heading may have changed: then it names itself
            yield f"aliases {i}: experience {own[key]} is said to be part of experience {now}"


def _folder_faults(out: Path, brain: NavigationBrain) -> Iterator[str]:
    """Say where the files of a run disagree with its brain, or cannot be read."""
    for read in (read_plan, read_metrics):
        try:
            read(out)
        except NeuroslamError as error:
            yield str(error)
    expected = {
        "experiences.csv": experiences_csv(brain),
        "links.csv": links_csv(brain.map.links),
    }
    if brain.config.has("semantic"):
        expected[LANDMARKS_FILE] = landmarks_csv(brain)
    for name, text in expected.items():
        fault = _table_fault(out / name, text)
        if fault:
            yield f"{out / name}: {fault}"
    seen = brain.clock.frames_seen
    try:
        rows = len(frame_rows(out))
    except NeuroslamError as error:
        yield str(error)
        return
    if rows == 0 and brain.sessions.merges:
        return  # two brains were merged: no frame was seen, and there is no track
    if rows < seen:
        yield missing_rows(out, rows, seen)
    elif rows > seen:
        yield (
            f"{out / 'frames.csv'}: {counted(rows, 'row')}, the brain has seen "
            f"{counted(seen, 'frame')}; resume the run, which was cut off"
        )
    try:
        poses = trajectory(brain, read_trace(out, seen))
        on_map = np.isfinite(poses[:, 0])
        if not on_map.any():
            return  # all was seen on maps that are not joined
        track = read_tum(out / "trajectory.tum")
    except NeuroslamError as error:
        yield str(error)
        return
    if len(track.poses) != on_map.sum():
        yield f"{out / 'trajectory.tum'}: {len(track.poses)} poses, expected {on_map.sum()}"
        return
    apart = track.poses - poses[on_map]
    apart[:, 2] = wrap_angles(apart[:, 2])
    wrong = np.flatnonzero((np.abs(apart) > 1e-6).any(1))
    if len(wrong):
        yield f"{out / 'trajectory.tum'}: poses {_some(wrong)} are not where the brain has them"


def _table_fault(path: Path, expected: str) -> str:
    columns, *should = expected.splitlines()
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
        if header != columns:
            return f"its columns are {header!r}, expected {columns!r}"
        rows = [_values(line, columns) for line in lines]
    except (OSError, ValueError) as error:
        return f"cannot be read ({_why(error)})"
    if len(rows) != len(should):
        return f"{counted(len(rows), 'row')}, the brain has {len(should)}"
    differ = [
        i for i, (row, line) in enumerate(zip(rows, should, strict=True))
        if row != _values(line, columns)
    ]  # fmt: skip
    return f"rows {_some(differ)} differ from the brain" if differ else ""


def _values(line: str, columns: str) -> list[str | float]:
    """Parse a row of a CSV table: text in the columns that hold text, numbers in all others.

    Raises:
        ValueError: If the row has too few or too many values, or one is not a number.
    """
    names, cells = columns.split(","), line.split(",")
    if len(cells) != len(names):
        raise ValueError(f"a row has {counted(len(cells), 'value')}, expected {len(names)}")
    return [
        cell if name in TEXT_COLUMNS else float(cell)
        for name, cell in zip(names, cells, strict=True)
    ]


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _row(name: str, rows: np.ndarray) -> str:
    table = name.split(".")[1].removesuffix("_table")
    return f"{table} {_some(rows)}"


def _some(values: Any) -> str:  # noqa: ANN401 - whatever can be listed
    values = list(values.tolist() if hasattr(values, "tolist") else values)
    shown = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values[:_SHOWN])
    more = len(values) - _SHOWN
    return f"{shown} and {more} more" if more > 0 else shown
