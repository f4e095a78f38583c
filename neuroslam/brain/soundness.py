"""Checks of the content of a brain: every id exists, numbers are finite, tables fit each other.

A brain is checked at every load, and almost always sound: each check first asks whether all is well
in the cheapest exact way, and only otherwise searches what is wrong.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch

from neuroslam.brain.brain import NavigationBrain
from neuroslam.brain.stored_sequence import StoredSequence
from neuroslam.brain.tracker import SequenceTracker
from neuroslam.config import BrainConfig
from neuroslam.errors import counted, first_line, listed
from neuroslam.mapping.tables import Links, origin_key
from neuroslam.merging.report import MergeReport
from neuroslam.state.mergeable import State
from neuroslam.state.registry import leading_class, population_classes
from neuroslam.state.sessions import ID_BITS, Session, session_name
from neuroslam.state.tables import GrowingTable, Scalars

_SESSION_TYPES = {field.name: field.type for field in fields(Session)}

_MAY_BE_INFINITE = ("map.goals.until_s",)  # a goal without an end time
_OF_THREE = ("pose_cells.origin", "pose_cells.slip")


def faults_of(state: State, model: NavigationBrain) -> list[str]:
    """Return the faults of a state: what is missing or misshapen, else what is wrong in it.

    Args:
        state: As :meth:`~torch.nn.Module.state_dict` returns it; it is not changed.
        model: A new brain of the config of the state.

    Returns:
        One line for each kind of fault, with its location; empty if there is none.
    """
    stored: dict[int, State] = {}
    own = dict(state)
    for name in [name for name in state if name.startswith("stored.")]:
        if match := re.match(r"stored\.(\d+)\.", name):
            stored.setdefault(int(match[1]), {})[name[match.end() :]] = own.pop(name)
    numbers = set(stored)
    parts = [("", own), *((f"stored map {i}: ", stored[i]) for i in sorted(stored))]
    expected, faults, logs = _expected(model), [], []
    for where, part in parts:
        if not _fits(part, expected):
            faults += [f"{where}{fault}" for fault in _misfits(part, model)]
        logs.append(_log(part))
        if logs[-1] is None:
            faults.append(f"{where}sessions.text: not a log of sessions and their merges")
    if numbers != set(range(len(numbers))):
        faults.append(f"stored maps are numbered {sorted(numbers)}; expected 0, 1, ...")
    if faults:
        return faults  # other checks need complete tensors
    for (where, part), log in zip(parts, logs, strict=True):
        try:
            with np.errstate(over="ignore", invalid="ignore"):
                faults += [f"{where}{fault}" for fault in _faults(part, log or {}, model.config)]
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            faults.append(f"{where}cannot be checked ({first_line(error)})")
    tallies = len(state["recognition.tally.alike"])
    if tallies != len(numbers):
        faults.append(
            f"recognition.tally: {counted(tallies, 'row')}; "
            f"expected {counted(len(numbers), 'row')}, one per stored map"
        )
    if "recognition.sequence.evidence.cost" in own:
        n = sum(len(part["map.experiences.pose"]) for part in stored.values())
        own_part = {
            key.removeprefix("recognition.sequence."): np.asarray(value)
            for key, value in own.items()
            if key.startswith("recognition.sequence.")
        }
        faults += StoredSequence.faults(own_part, n)
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
    for name in sorted(fresh.keys() & state.keys()):
        has, expected = state[name], fresh[name]
        if has.dtype != expected.dtype:
            yield f"{name}: {has.dtype}; expected {expected.dtype}"
        entry = slice(1 if name in columns else 0, None)
        same = has.dim() == expected.dim()
        if name in columns or name in _OF_THREE:
            same = same and has.shape[entry] == expected.shape[entry]
        if not same:
            yield f"{name}: shape {tuple(has.shape)}; expected one like {tuple(expected.shape)}"
    for table, names in tables.items():
        lengths = {name: state[f"{table}.{name}"].shape[:1] for name in names
                   if f"{table}.{name}" in state}  # fmt: skip
        if len(set(lengths.values())) > 1:
            each = ", ".join(f"{name} {length[0]}" for name, length in lengths.items() if length)
            yield f"{table}: columns of different lengths: {each}"


class _Expected(NamedTuple):
    """Type and shape without rows of each tensor of a state, columns of tables, optional tables."""

    tensors: dict[str, tuple[torch.dtype, int, torch.Size]]
    tables: list[list[str]]
    optional: list[list[str]]


def _expected(model: NavigationBrain) -> _Expected:
    found = _Expected({}, [], [])
    for path, module in model.named_modules():
        inside = f"{path}." if path else ""
        if isinstance(module, GrowingTable):
            columns = [inside + name for name in module.columns]
            (found.optional if module.optional else found.tables).append(columns)
        elif isinstance(module, Scalars):
            for name, kind in module.kinds.items():
                found.tensors[inside + name] = _kind(
                    torch.zeros((), dtype=torch.int64 if kind is int else torch.float64)
                )
        for own in (module._parameters, module._buffers):
            for name, tensor in own.items():
                if tensor is not None and name not in module._non_persistent_buffers_set:
                    found.tensors[inside + name] = _kind(tensor)
    return found


def _kind(tensor: torch.Tensor) -> tuple[torch.dtype, int, torch.Size]:
    return tensor.dtype, tensor.dim(), tensor.shape[1:]


def _fits(state: State, expected: _Expected) -> bool:
    """Return whether a state surely has the tensors that it should have."""
    tensors, tables = expected.tensors, expected.tables
    for columns in expected.optional:
        if columns[0] in state:
            tables = [*tables, columns]
        else:
            tensors = {name: kind for name, kind in tensors.items() if name not in columns}
    return (
        {name: _kind(tensor) for name, tensor in state.items()} == tensors
        and all(len({len(state[name]) for name in columns}) == 1 for columns in tables)
        and all(state[name].shape == (3,) for name in _OF_THREE if name in state)
    )


def _log(state: State) -> dict[str, Any] | None:
    """Return the log of sessions and merges; ``None`` if there is none or it is damaged."""
    try:
        log: dict[str, Any] = json.loads(state["sessions.text"].numpy().tobytes() or b"{}")
        for row in log.setdefault("sessions", []):
            if row.keys() != _SESSION_TYPES.keys() or row["id"] >> ID_BITS:
                return None
            for name, kind in _SESSION_TYPES.items():
                if type(row[name]) is not kind and not (kind is float and type(row[name]) is int):
                    return None
        for report in (*log.get("merges", ()), *log.get("refusals", ())):
            MergeReport(**report).lines()
    except (ArithmeticError, LookupError, TypeError, ValueError, AttributeError, RecursionError):
        return None
    return log


def _faults(state: State, log: Mapping[str, Any], config: BrainConfig) -> Iterator[str]:
    """Yield the faults in the state of one map, whose tensors fit the config."""
    s = {name: tensor.numpy(force=True) for name, tensor in state.items()}
    for name, array in s.items():
        # A sum is finite only if all its terms are, and is found much faster.
        if array.dtype.kind == "f" and not _has_finite_sum(array):
            wrong = np.isnan(array) if name in _MAY_BE_INFINITE else ~np.isfinite(array)
            if wrong.any():
                where = f" in rows {listed(np.unique(wrong.nonzero()[0]))}" if array.ndim else ""
                yield f"{name}: not finite{where}"
    n_views, n = len(s["view.templates.pixels"]), len(s["map.experiences.template"])
    for name, limit, what in (
        ("map.experiences.template", n_views, "templates"),
        ("map.links_table.source", n, "experiences"),
        ("map.links_table.target", n, "experiences"),
        ("map.goals.experience", n, "experiences"),
        ("map.aliases.experience", n, "experiences"),
        ("map.forgotten.experience", n, "experiences"),
    ):
        if name not in s:  # a table that is empty
            continue
        lowest = -1 if name.endswith("template") and not leading_class(config).relaxes_map else 0
        if not _within(s[name], lowest, limit - 1):
            rows = np.flatnonzero((s[name] < lowest) | (s[name] >= limit))
            yield f"{_row(name, rows)}: {name.split('.')[-1]} {listed(s[name][rows])}, " + (
                f"the map has {limit} {what}"
            )
    for name, limit in (("map.state.current", n), ("view.last.template", n_views)):
        lowest = 0 if n and name == "map.state.current" else -1
        if not lowest <= s[name] < limit:
            yield f"{name}: is {s[name]}; expected {lowest} to {limit - 1}"
    used = len(s.get("map.usage.at", ()))
    if used > n:
        yield f"map.usage: {used} rows for {n} experiences"
    yield from _link_faults(s, n)
    yield from _bound_faults(s["map.experiences.cell"], config)
    for population in population_classes(config):
        own = f"{population.name}."
        part = {key.removeprefix(own): v for key, v in s.items() if key.startswith(own)}
        yield from population.faults(part, config, n_views, n)
    if config.map.closure == "sequence":
        own = "tracker."
        part = {key.removeprefix(own): v for key, v in s.items() if key.startswith(own)}
        yield from SequenceTracker.faults(part, n) if part else ()
    yield from _origin_faults(s, log["sessions"])


def _has_finite_sum(array: np.ndarray) -> bool:
    if not array.ndim:
        return math.isfinite(array)
    return math.isfinite(np.add.reduce(array, axis=None))


def _within(values: np.ndarray, least: int, most: int) -> bool:
    return not values.size or bool(values.min() >= least and values.max() <= most)


def _bound_faults(bound: np.ndarray, config: BrainConfig) -> Iterator[str]:
    """Yield the experiences whose pose cells are not on the torus."""
    cells = config.pose_cells
    torus = (cells.n_theta, cells.n_xy, cells.n_xy)
    for axis, limit in enumerate(torus[::-1]):
        if not _within(bound[:, axis], 0, limit):
            rows = np.flatnonzero((bound[:, axis] < 0) | (bound[:, axis] > limit))
            name = f"map.experiences.cell[{axis}]"
            yield f"{name}: rows {listed(rows)} are not on the torus of {torus}"


def _link_faults(s: dict[str, np.ndarray], n: int) -> Iterator[str]:
    links = Links(*(s[f"map.links_table.{name}"] for name in Links._fields))
    if (links.source == links.target).any():
        loops = np.flatnonzero(links.source == links.target)
        yield (
            f"links {listed(loops)}: lead from an experience to itself, "
            f"{listed(links.source[loops])}"
        )
    for name in ("distance_m", "duration_s"):
        if (getattr(links, name) < 0).any():
            rows = np.flatnonzero(getattr(links, name) < 0)
            yield f"links {listed(rows)}: {name} {listed(getattr(links, name)[rows])} is negative"
    if _surely_connected(links, n):
        return
    from scipy.sparse import coo_array  # slow to import, and rarely needed
    from scipy.sparse.csgraph import connected_components

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


def _surely_connected(links: Links, n: int) -> bool:
    """Return whether every experience but the first is linked to an earlier one.

    So it is in a map as robots make it, and such a map is connected.
    """
    if not (_within(links.source, 0, n - 1) and _within(links.target, 0, n - 1)):
        return False
    linked = np.zeros(n, dtype=bool)
    linked[np.maximum(links.source, links.target)[links.source != links.target]] = True
    return bool(linked[1:].all())


def _origin_faults(s: dict[str, np.ndarray], sessions: list[dict[str, Any]]) -> Iterator[str]:
    """Yield experiences of sessions that are missing, duplicated or of an unknown session."""
    log = [session["id"] for session in sessions]
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
        keys[table] = origin_key({"session": session, "number": number})
        plain = log == [here] and _within(session, here, here) and _within(number, 0, made - 1)
        if plain and (keys[table][1:] > keys[table][:-1]).all():
            continue
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
        different, counts = np.unique(keys[table], return_counts=True)
        for key in different[counts > 1]:
            rows = np.flatnonzero(keys[table] == key)
            yield (
                f"{table} {listed(rows)}: each is experience {number[rows[0]]} of session "
                f"{session_name(int(session[rows[0]]))}"
            )
    if not len(keys["aliases"]):
        return
    _, own, twin = np.intersect1d(keys["experiences"], keys["aliases"], return_indices=True)
    now = s["map.aliases.experience"][twin]
    for i in np.flatnonzero(own != now):  # an alias of itself records a changed heading
        yield f"aliases {twin[i]}: experience {own[i]} is an alias of experience {now[i]} too"


def _row(name: str, rows: np.ndarray) -> str:
    table = name.split(".")[1].removesuffix("_table")
    return f"{table} {listed(rows)}"
