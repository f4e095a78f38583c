"""States of the pose cells of four degrees of freedom: how two become one, and what is wrong."""

from collections.abc import Iterator, Mapping
from typing import cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.cells.attractor import path_integrate
from neuroslam.cells.convolve import Cell, Packet
from neuroslam.cells.yaw_height import shift_sheet
from neuroslam.config import PoseCellConfig
from neuroslam.errors import listed
from neuroslam.state.join import Join
from neuroslam.state.match import Pairs
from neuroslam.state.mergeable import State, renamed

_SUM_TOLERANCE = {"float32": 1e-4, "float64": 1e-9}


def height_shifts(loaded: State, partial: State, join: Join) -> tuple[float, float]:
    """Return by how much a partial session moves in height, in metres and in cells.

    Of the matched pairs of experiences the one of median difference decides; 0 without a pair.
    """
    of_pair = np.flatnonzero(join.experiences < join.n_experiences)
    if not len(of_pair):
        return 0.0, 0.0
    there = join.experiences[of_pair]
    apart = loaded["levels.z_m"].numpy()[there] - partial["levels.z_m"].numpy()[of_pair]
    middle = int(np.argsort(apart, kind="stable")[len(apart) // 2])
    cells = (state["levels.cell_z"].numpy() for state in (loaded, partial))
    first, second = cells
    return float(apart[middle]), float(first[there[middle]] - second[of_pair[middle]])


def merge_pose_3d(
    loaded: State, partial: State, join: Join, cell_height_m: float, n_z: int
) -> State:
    """Move the partial session on the torus and in height, and merge bindings, heights and rises.

    Loaded rows come first. Activity, fatigue and the rise since the last experience are those of
    the partial session, which goes on. A rise between experiences that the loaded map has linked
    already is left out.

    Args:
        loaded: State of the population that is merged into.
        partial: State of the one whose session continues.
        join: How ids and coordinates change.
        cell_height_m: Height of a cell.
        n_z: Cells along height.
    """
    up_m, up = height_shifts(loaded, partial, join)
    kept_views, kept = (torch.from_numpy(k) for k in (join.kept_views, join.kept_experiences))
    x, y, theta = torch.from_numpy(join.view_cells).unbind(1)
    columns: dict[str, Tensor] = {"x": x, "y": y, "theta": theta}
    columns |= {"z": _on_ring(partial["bindings.z"] + up, n_z), "decay": partial["bindings.decay"]}
    merged = {
        f"bindings.{name}": torch.cat([loaded[f"bindings.{name}"], column[kept_views]])
        for name, column in columns.items()
    }
    moved = {
        "z_m": partial["levels.z_m"] + up_m,
        "cell_z": _on_ring(partial["levels.cell_z"] + up, n_z),
    }
    merged |= {
        f"levels.{name}": torch.cat([loaded[f"levels.{name}"], column[kept]])
        for name, column in moved.items()
    }
    merged |= _merged_rises(loaded, partial, join)
    n_x, n_y, _ = join.torus
    dx, dy, turn = join.cell_shift
    origin = cast(Cell, tuple(partial["grid.origin"].tolist()))
    packet = path_integrate(
        Packet(partial["grid.window"], origin, (n_z, n_y, n_x)), 0.0, up, (dx, dy)
    )
    return merged | {
        "grid.window": packet.values,
        "grid.origin": torch.tensor(packet.origin),
        "sheet.activity": shift_sheet(partial["sheet.activity"], up, turn),
        "slip": partial["slip"],
        "now.view": renamed(partial["now.view"], join.views),
        "now.rise_m": partial["now.rise_m"],
        "now.at": renamed(partial["now.at"], join.experiences),
        "now.at_rest": torch.tensor(0),
        "now.injected": partial["now.injected"],
    }


def _on_ring(cells: Tensor, n: int) -> Tensor:
    around = cells % n
    return around.where(around < n, torch.zeros_like(around))  # a tiny negative rounds up to n


def _merged_rises(loaded: State, partial: State, join: Join) -> State:
    def keys(source: np.ndarray, target: np.ndarray) -> np.ndarray:
        return (np.maximum(source, target) << 32) | np.minimum(source, target)

    ends = [join.experiences[partial[f"rises.{name}"].numpy()] for name in ("source", "target")]
    known = [loaded[f"rises.{name}"].numpy() for name in ("source", "target")]
    new = (ends[0] != ends[1]) & ~np.isin(keys(*ends), keys(*known))
    columns = {
        "source": torch.from_numpy(ends[0]),
        "target": torch.from_numpy(ends[1]),
        "rise_m": partial["rises.rise_m"],
    }
    mask = torch.from_numpy(new)
    return {
        f"rises.{name}": torch.cat([loaded[f"rises.{name}"], column[mask]])
        for name, column in columns.items()
    }


def differing_heights(loaded: State, partial: State, pairs: Pairs, gate_m: float) -> str:
    """Say why two sessions cannot be one where their matched pairs are on different storeys.

    Pairs of one alignment differ in height by one amount; if storeys look alike they may not.

    Args:
        loaded: State of the population that would be merged into.
        partial: State of the other one.
        pairs: Experiences that look the same.
        gate_m: Largest spread of the differences.

    Returns:
        The reason; empty if there is none.
    """
    apart = (
        loaded["levels.z_m"].numpy()[pairs.loaded] - partial["levels.z_m"].numpy()[pairs.partial]
    )
    spread = float(np.ptp(apart)) if len(apart) else 0.0
    if spread <= gate_m:
        return ""
    return (
        f"experiences that look the same differ in height by {apart.min():.1f} to "
        f"{apart.max():.1f} m; expected one difference within pose_3d.gate_m = {gate_m} m: storeys "
        "that look alike were taken for each other"
    )


def state_faults(
    state: Mapping[str, np.ndarray], cells: PoseCellConfig, n_z: int, n_views: int, n: int
) -> Iterator[str]:
    """Yield activity, bindings, heights and rises that are invalid.

    Args:
        state: State of the population.
        cells: Sizes of the networks along x, y and heading.
        n_z: Along height.
        n_views: Views of the brain.
        n: Experiences of its map.
    """
    torus, sheet = (n_z, cells.n_xy, cells.n_xy), (n_z, cells.n_theta)
    window, origin = state["grid.window"], state["grid.origin"].tolist()
    if not all(0 < size <= limit for size, limit in zip(window.shape, torus, strict=True)):
        yield f"pose_3d.grid.window: {window.shape} cells do not fit the torus of {torus}"
    if len(origin) != 3 or not all(
        0 <= at < limit for at, limit in zip(origin, torus, strict=False)
    ):
        yield f"pose_3d.grid.origin: {tuple(origin)} is not on the torus of {torus}"
    if state["sheet.activity"].shape != sheet:
        yield f"pose_3d.sheet.activity: {state['sheet.activity'].shape}; expected {sheet}"
    if state["slip"].shape != (5,):
        yield f"pose_3d.slip: {state['slip'].shape}; expected (5,)"
    for name in ("grid.window", "sheet.activity"):
        values = state[name]
        if (values < 0).any():
            yield f"pose_3d.{name}: {int((values < 0).sum())} cells are negative"
        total = values.sum(dtype=np.float64).item()
        if not abs(total - 1.0) <= _SUM_TOLERANCE[values.dtype.name]:
            yield f"pose_3d.{name}: adds up to {total:.6g}, expected 1"
    bound = len(state["bindings.x"])
    if bound != n_views:
        yield f"{n_views} views, {bound} of them bound to pose_3d"
    if not -1 <= state["now.view"] < n_views:
        yield f"pose_3d.now.view: is {state['now.view']}, expected -1 to {n_views - 1}"
    if not -1 <= state["now.at"] < n:
        yield f"pose_3d.now.at: is {state['now.at']}, expected -1 to {n - 1}"
    sizes = {"x": cells.n_xy, "y": cells.n_xy, "z": n_z, "theta": cells.n_theta}
    for axis, limit in sizes.items():
        at = state[f"bindings.{axis}"]
        rows = np.flatnonzero((at < 0) | (at > limit))
        if len(rows):
            yield f"pose_3d.bindings.{axis}: rows {listed(rows)} are not on the ring of {limit}"
    if len(state["levels.z_m"]) != n:
        yield f"{n} experiences, {len(state['levels.z_m'])} of them with a height in pose_3d"
    for name in ("source", "target"):
        ends = state[f"rises.{name}"]
        rows = np.flatnonzero((ends < 0) | (ends >= n))
        if len(rows):
            yield f"pose_3d.rises.{name}: rows {listed(rows)} name no experience"
