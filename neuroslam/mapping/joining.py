"""Merge of two maps: partial experiences moved, their links rerouted, ids renamed."""

import numpy as np
import torch

from neuroslam.geometry import TWO_PI, rotate, rotate_points, wrap_angle, wrap_angles
from neuroslam.mapping.tables import ALIAS_COLUMNS, Links, origin_key
from neuroslam.state.join import Join
from neuroslam.state.mergeable import State, renamed
from neuroslam.types import NO_TEMPLATE

_GONE = ("session", "number", "first_frame", "experience")
_PROVENANCE = ("first_frame", "session", "number")


def merge_maps(loaded: State, partial: State, join: Join) -> State:
    """Place the partial experiences in the loaded map and reroute all their links.

    Loaded experiences and links come first. Links keep their measurements; where an end becomes
    part of an experience with another heading, the link becomes relative to that heading. A link
    between experiences that the loaded map has linked already is left out. Pose, time and goals
    are those of the partial session, which goes on.

    (Multisession RatSLAM, Eqs. 13-17. All links of the matched experience are rerouted here;
    the paper speaks of the last one only.)
    """
    ids, kept = join.experiences, join.kept_experiences
    old = _arrays(partial)
    pose = join.place(old["experiences.pose"])
    pose[:, 2] = wrap_angles(pose[:, 2] - join.turns_rad)
    cell = join.experience_cells.copy()
    n_theta = join.torus[2]
    turned = (cell[:, 2] - join.turns_rad * n_theta / TWO_PI) % n_theta
    cell[:, 2] = np.where(turned >= n_theta, 0.0, turned)  # a tiny negative rounds up to n
    moved = {
        "pose": pose[kept],
        "cell": cell[kept],
        # An experience without a view has -1, which indexes the last entry: none again.
        "template": np.append(join.views, NO_TEMPLATE)[old["experiences.template"][kept]],
        **{name: old[f"experiences.{name}"][kept] for name in _PROVENANCE},
    }
    merged = _append(loaded, "experiences", moved)
    known = _arrays(loaded)
    merged |= _append(loaded, "links_table", _rerouted(old, known, join)._asdict())
    merged |= _append(loaded, "aliases", _aliases(old, known, join))
    merged |= {name: tensor for name, tensor in partial.items() if name.startswith("state.")}
    merged |= {name: tensor for name, tensor in partial.items() if name.startswith("goals.")}
    merged["goals.experience"] = torch.from_numpy(ids[old["goals.experience"]])
    merged["state.current"] = renamed(partial["state.current"], ids)
    dx, dy = rotate(old["state.dx_m"].item(), old["state.dy_m"].item(), join.rotation_rad)
    facing = wrap_angle(old["state.facing_rad"].item() + join.rotation_rad)
    for name, value in (("dx_m", dx), ("dy_m", dy), ("facing_rad", facing)):
        merged[f"state.{name}"] = torch.tensor(value, dtype=torch.float64)
    merged["state.at_rest"] = torch.tensor(0)
    return merged | _usage(known, old, join) | _forgotten(known, old, join)


def _usage(
    known: dict[str, np.ndarray], old: dict[str, np.ndarray], join: Join
) -> dict[str, torch.Tensor]:
    """Join the use of experiences: that of the loaded ones lies before the partial session."""
    if "usage.at" not in old:
        return {}
    n, rows = join.n_experiences, {}
    sizes = n, len(join.experiences)
    for name in ("visits", "at", "near", "missed"):
        column, before = old[f"usage.{name}"], known.get(f"usage.{name}", np.empty(0))
        joined = np.zeros(n + len(join.kept_experiences), column.dtype)
        joined[: min(sizes[0], len(before))] = before[: sizes[0]]
        if name in ("at", "near"):
            joined -= int(known["usage.at"].max(initial=0)) if "usage.at" in known else 0
        ids = join.experiences[: len(column)]
        combine = np.add if name == "visits" else np.maximum
        combine.at(joined, ids, column)
        rows[f"usage.{name}"] = torch.from_numpy(joined)
    return rows


def _forgotten(
    known: dict[str, np.ndarray], old: dict[str, np.ndarray], join: Join
) -> dict[str, torch.Tensor]:
    """Join what both maps have forgotten: the rows of the partial one follow its experiences."""
    if "forgotten.pose" not in old and "forgotten.pose" not in known:
        return {}
    tables = []
    for state in (known, old):
        table = {name: state.get(f"forgotten.{name}", np.empty(0, np.int64)) for name in _GONE}
        table["pose"] = state.get("forgotten.pose", np.empty((0, 3)))
        tables.append(table)
    at, pose = tables[1]["experience"], tables[1]["pose"].copy()
    turn = join.turns_rad[at]
    pose[:, :2] = rotate_points(pose[:, :2], turn)
    pose[:, 2] = wrap_angles(pose[:, 2] + turn)
    tables[1] |= {"experience": join.experiences[at], "pose": pose}
    fresh = ~np.isin(origin_key(tables[1]), origin_key(tables[0]))
    return {
        f"forgotten.{name}": torch.from_numpy(
            np.concatenate([tables[0][name], tables[1][name][fresh]])
        )
        for name in (*_GONE, "pose")
    }


def _arrays(state: State) -> dict[str, np.ndarray]:
    return {name: tensor.numpy(force=True) for name, tensor in state.items()}


def _append(loaded: State, table: str, rows: dict[str, np.ndarray]) -> State:
    merged = {}
    for name, values in rows.items():
        before = loaded[f"{table}.{name}"]
        merged[f"{table}.{name}"] = torch.cat([before, torch.from_numpy(values).to(before)])
    return merged


def links_kept(partial: Links, loaded: Links, join: Join) -> np.ndarray:
    """Return which partial links a merge keeps: those between experiences not yet linked."""
    source, target = join.experiences[partial.source], join.experiences[partial.target]
    linked = np.isin(_undirected(source, target), _undirected(loaded.source, loaded.target))
    kept: np.ndarray = (source != target) & ~linked
    return kept


def _rerouted(old: dict[str, np.ndarray], known: dict[str, np.ndarray], join: Join) -> Links:
    partial, loaded = (
        Links(*(state[f"links_table.{name}"] for name in Links._fields)) for state in (old, known)
    )
    kept = links_kept(partial, loaded, join)
    p = Links(*(column[kept] for column in partial))
    turn, turn_target = join.turns_rad[p.source], join.turns_rad[p.target]
    return p._replace(
        source=join.experiences[p.source],
        target=join.experiences[p.target],
        heading_rad=_turned(p.heading_rad, turn),
        facing_rad=_turned(p.facing_rad, turn - turn_target),
    )


def _turned(angle_rad: np.ndarray, by_rad: np.ndarray) -> np.ndarray:
    # An angle that does not turn stays equal to the last bit.
    return np.where(by_rad == 0.0, angle_rad, wrap_angles(angle_rad + by_rad))


def _undirected(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return one key for each pair of ids, in either order."""
    key: np.ndarray = (np.maximum(source, target) << 32) | np.minimum(source, target)
    return key


def _aliases(
    old: dict[str, np.ndarray], known: dict[str, np.ndarray], join: Join
) -> dict[str, np.ndarray]:
    """Return the partial aliases and those of this merge that the loaded map does not have."""
    before = {name: old[f"aliases.{name}"] for name in ALIAS_COLUMNS}
    into = before["experience"]
    before["turn_rad"] = wrap_angles(before["turn_rad"] + join.turns_rad[into])
    before["experience"] = join.experiences[into]
    gone = np.flatnonzero((join.experiences < join.n_experiences) | (join.turns_rad != 0.0))
    made = {name: old[f"experiences.{name}"][gone] for name in _PROVENANCE}
    made |= {"experience": join.experiences[gone], "turn_rad": join.turns_rad[gone]}
    fresh = ~np.isin(origin_key(made), origin_key(before))  # an earlier alias has been turned above
    both = {name: np.concatenate([before[name], made[name][fresh]]) for name in ALIAS_COLUMNS}
    there = np.concatenate(
        [
            origin_key({name: known[f"{table}.{name}"] for name in ("session", "number")})
            for table in ("experiences", "aliases")
        ]
    )
    new = ~np.isin(origin_key(both), there)
    return {name: column[new] for name, column in both.items()}
