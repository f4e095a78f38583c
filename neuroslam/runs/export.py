"""Export of a map: trajectories, pose graphs, graph files, MCAP and neuromorphic networks."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from neuroslam.brain import NavigationBrain, load_brain
from neuroslam.errors import ConfigError, RunError
from neuroslam.evaluation.trajectory import Track, read_tum, write_tum
from neuroslam.runs.files import brain_file
from neuroslam.runs.heights import map_heights, rises_of_links
from neuroslam.runs.mcap import export_mcap
from neuroslam.runs.reading import track_file
from neuroslam.spiking.export import export_nir
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.state.files import write_atomically
from neuroslam.state.sessions import session_name

_UPRIGHT = 10.0  # how much better roll and pitch are known than the heading


def export(
    path: str | Path,
    to: str | Path,
    kind: str | None = None,
    source: str | Path | None = None,
    on_note: Callable[[str], object] = lambda _note: None,
) -> Path:
    r"""Write a map in the format of another program.

    - ``tum``: for a run folder its ``trajectory.tum``, one pose per frame; for a brain file the
      poses of its experiences in order of their ids. The time column holds the number of the frame
      that created the experience; where the numbers of another session start again from a lower
      one, the column counts on, because times must rise. The column z has heights where the brain
      measures them.
    - ``g2o``: a ``VERTEX_SE2`` for each experience, an ``EDGE_SE2`` for each link with its
      measurement :math:`(d \cos h,\; d \sin h,\; f)` of distance, heading and facing, and the
      information matrix :math:`\mathrm{diag}(\sigma_m^{-2}, \sigma_m^{-2}, \sigma_{rad}^{-2})`
      of the config; vertex 0 is fixed, in the last line. Of a brain that measures heights
      ``VERTEX_SE3:QUAT`` and ``EDGE_SE3:QUAT``, with the rise of each link; gravity fixes roll and
      pitch, to :math:`\sigma_{rad} / 10`.
    - ``graphml``: a node for each experience with its pose, its view and its origin, a directed
      edge for each link with its measurements; with heights ``z_m`` and ``rise_m``.
    - ``nir``: the spiking path integrator of a brain with semantic cells whose tier is ``spiking``
      (:func:`neuroslam.spiking.export.export_nir`, extra ``spiking-export``).
    - ``mcap``: a run folder with Foxglove's schemas: pictures, poses, path, graph and activity of
      cells (:func:`neuroslam.runs.mcap.export_mcap`, extra ``mcap``).

    Args:
        path: Brain file, or folder of a run.
        to: File to write, whole or not at all; an existing file is replaced.
        kind: ``tum``, ``g2o``, ``graphml``, ``nir`` or ``mcap``; default: the suffix of ``to``.
        source: Source of the pictures of ``mcap``; default: that of the run.
        on_note: Called with each line about what is left out.

    Returns:
        ``to``.

    Raises:
        CheckpointError: If the brain cannot be read.
        SourceError: If a run's trajectory or the given source cannot be read.
        RunError: If the kind is unknown, the map is empty or ``to`` cannot be written.
        ConfigError: If the extra of the kind is not installed, or ``nir`` is requested and the
            brain has no spiking neurons.
    """
    path, to = Path(path), Path(to)
    asked = kind or to.suffix.removeprefix(".").lower()
    if asked != "mcap" and asked not in _WRITERS:
        raise RunError(
            f"{to}: unknown export format {asked!r}; expected tum, g2o, graphml, nir or mcap as "
            "suffix or --kind"
        )
    if source is not None and asked != "mcap":
        raise RunError(f"--source {source}: is of use for mcap only, not for {asked}")
    stored = brain_file(path)
    if to.resolve() == stored.resolve():
        raise RunError(f"{to}: is the brain file to export; choose another output file")
    if asked == "tum" and path.is_dir():
        track = track_file(path)
        read_tum(track)  # a damaged file is not exported

        def write() -> None:
            text = track.read_bytes()
            write_atomically(to, lambda file: file.write_bytes(text))
    elif asked == "mcap":

        def write() -> None:
            for note in export_mcap(path, to, source):
                on_note(note)
    else:
        brain = load_brain(stored).largest
        if not brain.map.n and asked != "nir":
            raise RunError(f"{path}: its map is empty; nothing to export")
        write = partial(_WRITERS[asked], brain, to)
    try:
        write()
    except OSError as error:
        raise RunError(f"{to}: cannot be written ({error.strerror or error})") from None
    return to


def _write_tum(brain: NavigationBrain, to: Path) -> None:
    frames = brain.map.experiences["first_frame"].numpy()
    steps = np.diff(frames)
    steps[steps <= 0] = 1
    times = frames[0] + np.concatenate([[0], np.cumsum(steps)])
    write_tum(to, Track(times.astype(np.float64), brain.map.poses, map_heights(brain)))


def _write_g2o(brain: NavigationBrain, to: Path) -> None:
    links, config = brain.map.links, brain.config.map
    vertices = np.column_stack([np.arange(brain.map.n), brain.map.poses]).tolist()
    lines = [f"VERTEX_SE2 {int(i)} {x!r} {y!r} {theta!r}" for i, x, y, theta in vertices]
    position, turn = config.sigma_m**-2, config.sigma_rad**-2
    dx, dy = (
        links.distance_m * np.cos(links.heading_rad),
        links.distance_m * np.sin(links.heading_rad),
    )
    heights = map_heights(brain)
    if heights is not None:
        _write_g2o_3d(brain, heights, np.column_stack([dx, dy]), to)
        return
    columns = (links.source, links.target, dx, dy, links.facing_rad)
    lines += [
        f"EDGE_SE2 {i} {j} {x!r} {y!r} {facing!r} {position!r} 0 0 {position!r} 0 {turn!r}"
        for i, j, x, y, facing in zip(*(c.tolist() for c in columns), strict=True)
    ]
    lines.append("FIX 0")  # last: some readers stop at it
    text = "\n".join(lines) + "\n"
    write_atomically(to, lambda file: file.write_text(text, encoding="ascii"))


def _write_g2o_3d(
    brain: NavigationBrain, heights_m: np.ndarray, moved_m: np.ndarray, to: Path
) -> None:
    """Write the graph in x, y, z and heading, as poses of three dimensions that stand upright."""
    links, config = brain.map.links, brain.config.map
    lines = [
        f"VERTEX_SE3:QUAT {i} {x!r} {y!r} {z!r} 0 0 {math.sin(theta / 2)!r} {math.cos(theta / 2)!r}"
        for i, ((x, y, theta), z) in enumerate(
            zip(brain.map.poses.tolist(), heights_m.tolist(), strict=True)
        )
    ]
    position, turn = config.sigma_m**-2, config.sigma_rad**-2
    upright = (config.sigma_rad / _UPRIGHT) ** -2
    diagonal = (position, position, position, upright, upright, turn)
    information = " ".join(
        repr(diagonal[i]) if i == j else "0" for i in range(6) for j in range(i, 6)
    )
    columns = (links.source, links.target, *moved_m.T, rises_of_links(brain, heights_m))
    for i, j, x, y, z, facing in zip(
        *(c.tolist() for c in (*columns, links.facing_rad)), strict=True
    ):
        turned = f"0 0 {math.sin(facing / 2)!r} {math.cos(facing / 2)!r}"
        lines.append(f"EDGE_SE3:QUAT {i} {j} {x!r} {y!r} {z!r} {turned} {information}")
    text = "\n".join([*lines, "FIX 0"]) + "\n"
    write_atomically(to, lambda file: file.write_text(text, encoding="ascii"))


def _write_graphml(brain: NavigationBrain, to: Path) -> None:
    table, links = brain.map.experiences, brain.map.links
    x, y, theta = brain.map.poses.T.tolist()
    nodes = {
        "x_m": x,
        "y_m": y,
        "theta_rad": theta,
        "template": table["template"].tolist(),
        "session": [session_name(session) for session in table["session"].tolist()],
        "number": table["number"].tolist(),
        "first_frame": table["first_frame"].tolist(),
    }
    names = ("distance_m", "heading_rad", "facing_rad", "duration_s")
    edges = {name: getattr(links, name).tolist() for name in names}
    heights = map_heights(brain)
    if heights is not None:
        nodes["z_m"] = heights.tolist()
        edges["rise_m"] = rises_of_links(brain, heights).tolist()
    root = ElementTree.Element("graphml", xmlns="http://graphml.graphdrawing.org/xmlns")
    types = {int: "long", float: "double", str: "string"}
    for what, columns in (("node", nodes), ("edge", edges)):
        for name, values in columns.items():
            kind = types[type(values[0])] if values else "double"
            of = {"id": name, "for": what, "attr.name": name, "attr.type": kind}
            ElementTree.SubElement(root, "key", of)
    graph = ElementTree.SubElement(root, "graph", id="map", edgedefault="directed")
    for i in range(brain.map.n):
        _add_data(ElementTree.SubElement(graph, "node", id=f"n{i}"), nodes, i)
    for i, (source, target) in enumerate(zip(links.source, links.target, strict=True)):
        ends = {"id": f"e{i}", "source": f"n{source}", "target": f"n{target}"}
        _add_data(ElementTree.SubElement(graph, "edge", ends), edges, i)
    ElementTree.indent(root)
    tree = ElementTree.ElementTree(root)
    write_atomically(to, lambda file: tree.write(file, encoding="utf-8", xml_declaration=True))


def _write_nir(brain: NavigationBrain, to: Path) -> None:
    if "semantic" not in brain.populations or brain.config.semantic.tier != "spiking":
        raise ConfigError(
            f"{to}: the brain has no spiking neurons; run with semantic cells and "
            "--set semantic.tier=spiking"
        )
    export_nir(cast(PathIntegrator, brain.semantic.slam.integrator), to)


def _add_data(element: ElementTree.Element, columns: dict[str, list[Any]], row: int) -> None:
    for name, values in columns.items():
        ElementTree.SubElement(element, "data", key=name).text = str(values[row])


_WRITERS: dict[str, Callable[[NavigationBrain, Path], None]] = {
    "tum": _write_tum,
    "g2o": _write_g2o,
    "graphml": _write_graphml,
    "nir": _write_nir,
}
