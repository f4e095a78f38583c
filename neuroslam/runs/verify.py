"""Consistency checks of a brain file or a run folder."""

import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from neuroslam.brain import NavigationBrain, read_checkpoint
from neuroslam.brain.localiser import SequenceLocaliser
from neuroslam.config import BrainConfig
from neuroslam.errors import NeuroslamError, counted, first_line, listed
from neuroslam.evaluation.trajectory import read_tum
from neuroslam.geometry import wrap_angles
from neuroslam.mapping.tables import Links
from neuroslam.runs.files import (
    brain_file,
    experiences_csv,
    links_csv,
    missing_rows,
)
from neuroslam.runs.reading import frame_rows, read_metrics, read_plan, read_trace, trajectory
from neuroslam.state.answers import gathered, tables_of
from neuroslam.state.mergeable import State
from neuroslam.state.registry import leading_class, population_classes
from neuroslam.state.sessions import Session, session_name
from neuroslam.state.tables import GrowingTable

_MAY_BE_INFINITE = ("map.goals.until_s",)  # a goal without an end time


def verify(path: str | Path) -> list[str]:
    """Return the faults of a brain, or the contradictions between a run folder and its brain.

    The SHA-256 of a file shows that it is unaltered; ``verify`` checks its content: ids exist,
    numbers are finite, every experience has one origin, the map is connected, and every population
    finds its own state valid.

    Args:
        path: Brain file, or folder of a run.

    Returns:
        One line for each kind of fault, with its location; empty if there is none.
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
        faults.append(f"stored maps are numbered {sorted(numbers)}; expected 0, 1, ...")
    if faults:
        return faults  # other checks need complete tensors
    try:
        model.load_state_dict(state)
    except (RuntimeError, ValueError, KeyError, TypeError) as error:
        return [f"its state does not fit its config ({first_line(error)})"]
    faults = [f"{where}{fault}" for where, part in parts for fault in _faults(part, config)]
    tallies = len(state["recognition.tally.alike"])
    if tallies != len(numbers):
        faults.append(
            f"recognition.tally: {counted(tallies, 'row')}; "
            f"expected {counted(len(numbers), 'row')}, one per stored map"
        )
    if path.is_dir() and not faults:  # files cannot agree with a faulty brain
        faults = list(_folder_faults(path, model))
    return faults


def _misfits(state: State, model: NavigationBrain) -> Iterator[str]:
    """Yield the tensors of a state that are missing, unknown, or of a wrong dtype or shape."""
    fresh = {n: t for n, t in model.state_dict().items() if not n.startswith("stored.")}
    for table, module in model.named_modules():
        if isinstance(module, GrowingTable) and module.optional:
            own = {f"{table}.{c}": module[c][:0] for c in module.columns}
            fresh |= own if own.keys() & state.keys() else {}
    for name in sorted(fresh.keys() ^ state.keys()):
        yield f"{name}: {'missing' if name in fresh else 'not part of a brain'}"
    tables = {n: t.columns for n, t in model.named_modules() if isinstance(t, GrowingTable)}
    columns = {f"{table}.{name}" for table, names in tables.items() for name in names}
    fixed = ("pose_cells.origin", "pose_cells.slip")
    for name in sorted(fresh.keys() & state.keys()):
        has, expected = state[name], fresh[name]
        if has.dtype != expected.dtype:
            yield f"{name}: {has.dtype}; expected {expected.dtype}"
        entry = slice(1 if name in columns else 0, None)
        same = has.dim() == expected.dim()
        if name in columns or name in fixed:
            same = same and has.shape[entry] == expected.shape[entry]
        if not same:
            yield f"{name}: shape {tuple(has.shape)}; expected one like {tuple(expected.shape)}"
    for table, names in tables.items():
        lengths = {name: state[f"{table}.{name}"].shape[:1] for name in names
                   if f"{table}.{name}" in state}  # fmt: skip
        if len(set(lengths.values())) > 1:
            each = ", ".join(f"{name} {length[0]}" for name, length in lengths.items() if length)
            yield f"{table}: columns of different lengths: {each}"
    try:
        log = json.loads(bytes(state["sessions.text"].tolist()) or b'{"sessions": []}')
        wrong = [s for s in log["sessions"] if {f.name for f in fields(Session)} != s.keys()]
    except (KeyError, ValueError, TypeError, AttributeError):
        wrong = ["no list"]
    if wrong:
        yield "sessions.text: not a log of sessions"


def _faults(state: State, config: BrainConfig) -> Iterator[str]:
    """Yield the faults in the state of one map, whose tensors fit the config."""
    s = {name: tensor.numpy(force=True) for name, tensor in state.items()}
    for name, tensor in state.items():
        if tensor.is_floating_point():
            wrong = tensor.isnan() if name in _MAY_BE_INFINITE else ~tensor.isfinite()
            if wrong.any():
                where = ""
                if tensor.dim():
                    where = f" in rows {listed(np.unique(wrong.numpy().nonzero()[0]))}"
                yield f"{name}: not finite{where}"
    n_views, n = len(s["view.templates.pixels"]), len(s["map.experiences.template"])
    for name, limit, what in (
        ("map.experiences.template", n_views, "templates"),
        ("map.links_table.source", n, "experiences"),
        ("map.links_table.target", n, "experiences"),
        ("map.goals.experience", n, "experiences"),
        ("map.aliases.experience", n, "experiences"),
    ):
        lowest = -1 if name.endswith("template") and not leading_class(config).relaxes_map else 0
        rows = np.flatnonzero((s[name] < lowest) | (s[name] >= limit))
        if len(rows):
            yield f"{_row(name, rows)}: {name.split('.')[-1]} {listed(s[name][rows])}, " + (
                f"the map has {limit} {what}"
            )
    for name, limit in (("map.state.current", n), ("view.last.template", n_views)):
        lowest = 0 if n and name == "map.state.current" else -1
        if not lowest <= s[name] < limit:
            yield f"{name}: is {s[name]}; expected {lowest} to {limit - 1}"
    yield from _link_faults(s, n)
    yield from _bound_faults(s["map.experiences.cell"], config)
    for population in population_classes(config):
        own = f"{population.name}."
        part = {key.removeprefix(own): v for key, v in s.items() if key.startswith(own)}
        yield from population.faults(part, config, n_views, n)
    if config.map.closure == "sequence":
        own = "localiser."
        part = {key.removeprefix(own): v for key, v in s.items() if key.startswith(own)}
        yield from SequenceLocaliser.faults(part, n) if part else ()
    yield from _origin_faults(s, n)


def _bound_faults(bound: np.ndarray, config: BrainConfig) -> Iterator[str]:
    """Yield the experiences whose pose cells are not on the torus."""
    cells = config.pose_cells
    torus = (cells.n_theta, cells.n_xy, cells.n_xy)
    for axis, limit in enumerate(torus[::-1]):
        rows = np.flatnonzero((bound[:, axis] < 0) | (bound[:, axis] > limit))
        if len(rows):
            name = f"map.experiences.cell[{axis}]"
            yield f"{name}: rows {listed(rows)} are not on the torus of {torus}"


def _link_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    links = Links(*(s[f"map.links_table.{name}"] for name in Links._fields))
    loops = np.flatnonzero(links.source == links.target)
    if len(loops):
        yield (
            f"links {listed(loops)}: lead from an experience to itself, "
            f"{listed(links.source[loops])}"
        )
    for name in ("distance_m", "duration_s"):
        rows = np.flatnonzero(getattr(links, name) < 0)
        if len(rows):
            yield f"links {listed(rows)}: {name} {listed(getattr(links, name)[rows])} is negative"
    there = (np.stack(links[:2]) >= 0).all(0) & (np.stack(links[:2]) < n).all(0)
    ends = links.source[there], links.target[there]
    parts, label = connected_components(coo_array((np.ones(len(ends[0])), ends), shape=(n, n)))
    if parts > 1:
        first = np.unique(label, return_index=True)[1]
        sizes = sorted(np.bincount(label).tolist(), reverse=True)
        yield (
            f"the map is not connected: {parts} parts, of {listed(sizes)} experiences; "
            f"their first experiences are {listed(np.sort(first))}"
        )


def _origin_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    """Yield experiences of sessions that are missing, duplicated or of an unknown session."""
    text = bytes(s["sessions.text"].tolist())
    log = [session["id"] for session in json.loads(text)["sessions"]] if text else []
    twice = [session_name(session) for session, count in Counter(log).items() if count > 1]
    if twice:
        yield f"sessions.text: session {', '.join(twice)} is listed more than once"
    here, made = int(s["map.state.session"]), int(s["map.state.made"])
    if here != (log[-1] if log else 0):
        last = session_name(log[-1]) if log else "none"
        yield f"map.state.session: is {session_name(here)}; expected the last in the log, {last}"
    keys = {}
    for table in ("experiences", "aliases"):
        session, number = (s[f"map.{table}.{name}"] for name in ("session", "number"))
        keys[table] = list(zip(session.tolist(), number.tolist(), strict=True))
        unknown = np.flatnonzero(~np.isin(session, log))
        if len(unknown):
            names = sorted({session_name(number) for number in session[unknown].tolist()})
            yield f"{table} {listed(unknown)}: of a session that is not in the log, {listed(names)}"
        wrong = np.flatnonzero((number < 0) | ((session == here) & (number >= made)))
        if len(wrong):
            yield (
                f"{table} {listed(wrong)}: number {listed(number[wrong])} in their session, "
                f"which has created {made}"
            )
        for key, count in Counter(keys[table]).items():
            if count > 1:
                rows = [i for i, other in enumerate(keys[table]) if other == key]
                yield (
                    f"{table} {listed(rows)}: each is experience {key[1]} of session "
                    f"{session_name(key[0])}"
                )
    own = {key: i for i, key in enumerate(keys["experiences"])}
    for i, key in enumerate(keys["aliases"]):
        now = int(s["map.aliases.experience"][i])
        if key in own and own[key] != now:  # an alias of itself records a changed heading
            yield f"aliases {i}: experience {own[key]} is an alias of experience {now} too"


def _folder_faults(out: Path, brain: NavigationBrain) -> Iterator[str]:
    """Yield the files of a run that differ from its brain, or cannot be read."""
    for read in (read_plan, read_metrics):
        try:
            read(out)
        except NeuroslamError as error:
            yield str(error)
    expected = {
        "experiences.csv": experiences_csv(brain),
        "links.csv": links_csv(brain.map.links),
    }
    expected |= gathered(brain.populations.values(), tables_of)
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
        return  # merged from brain files: no frames, no trajectory
    if rows < seen:
        yield missing_rows(out, rows, seen)
    elif rows > seen:
        yield (
            f"{out / 'frames.csv'}: {counted(rows, 'row')}, the brain has seen "
            f"{counted(seen, 'frame')}; the run was cut off: resume it"
        )
    try:
        poses = trajectory(brain, read_trace(out, seen))
        on_map = np.isfinite(poses[:, 0])
        if not on_map.any():
            return  # all frames are on maps that were not joined
        track = read_tum(out / "trajectory.tum")
    except NeuroslamError as error:
        yield str(error)
        return
    if len(track.poses) != on_map.sum():
        yield f"{out / 'trajectory.tum'}: {len(track.poses)} poses; expected {on_map.sum()}"
        return
    apart = track.poses - poses[on_map]
    apart[:, 2] = wrap_angles(apart[:, 2])
    wrong = np.flatnonzero((np.abs(apart) > 1e-6).any(1))
    if len(wrong):
        yield f"{out / 'trajectory.tum'}: poses {listed(wrong)} differ from the brain"


def _table_fault(path: Path, expected: str) -> str:
    columns, *should = expected.splitlines()
    try:
        header, *lines = path.read_text(encoding="utf-8").splitlines() or [""]
        if header != columns:
            return f"its columns are {header!r}; expected {columns!r}"
        text = {i for line in should for i, cell in enumerate(line.split(",")) if _is_text(cell)}
        rows = [_values(line, columns, text) for line in lines]
    except (OSError, ValueError) as error:
        return f"cannot be read ({_why(error)})"
    if len(rows) != len(should):
        return f"{counted(len(rows), 'row')}; expected {len(should)} as in the brain"
    differ = [i for i, (row, line) in enumerate(zip(rows, should, strict=True))
              if row != _values(line, columns, text)]  # fmt: skip
    return f"rows {listed(differ)} differ from the brain" if differ else ""


def _values(line: str, columns: str, text: set[int]) -> list[str | float]:
    """Parse a row of a CSV table: text in the columns that hold text, numbers in all others.

    Raises:
        ValueError: If the row has too few or too many values, or one is not a number.

    Example:
        >>> _values("landmark_1,0.50,3", "name,x_m,seen", {0})
        ['landmark_1', 0.5, 3.0]
    """
    cells, n = line.split(","), columns.count(",") + 1
    if len(cells) != n:
        raise ValueError(f"a row has {counted(len(cells), 'value')}; expected {n}")
    return [cell if i in text else float(cell) for i, cell in enumerate(cells)]


def _is_text(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return True
    return False


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)


def _row(name: str, rows: np.ndarray) -> str:
    table = name.split(".")[1].removesuffix("_table")
    return f"{table} {listed(rows)}"
