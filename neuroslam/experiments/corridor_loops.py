"""A map from odometry and scored loop matches, most of which are outliers.

Data: TUC SLAM, "Corridor" (P. Neubert, S. Schubert, P. Protzel, "A neurologically inspired sequence
processing model for mobile robot place recognition", IEEE RA-L, 2019). A robot drives a corridor to
and fro; the heading of odometry drifts by 250 degrees; most matches are wrong. A match states that
two instants show the same place, but not the relative heading: in the truth, correct matches have
equal or opposite headings. So least squares constrains only the position of a match. The paper's
relaxation corrects headings by facings only; there a match has equal headings, as in RatSLAM.
"""

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from neuroslam.errors import SourceError
from neuroslam.evaluation.trajectory import absolute_trajectory_error, align
from neuroslam.figures.style import LOOP, MAP, ODOMETRY, OTHER, TRUTH, save
from neuroslam.geometry import integrate_velocities, rotate_points, wrap_angles
from neuroslam.mapping.least_squares import solve_pose_graph
from neuroslam.mapping.relax import Relaxation
from neuroslam.state.files import write_atomically

SCORES = (0.0, 0.5, 0.7, 0.8, 0.9)
"""Least scores of the matches that are used."""

SPEED_SIGMA_M_S, TURN_SIGMA_RAD_S = 0.05, 0.01
"""Standard deviations of speed and turn rate in the recording, as errors constant over a link."""

MATCH_SIGMA_M = 0.5
"""Half the distance of two experiences, about 0.9 m: the accuracy of a match."""

RELAX_LOOPS, RELAX_REST = 5000, 1e-4
"""Longest relaxation, and the movement (m, rad) that ends it earlier."""

WRONG_M = 5.0
"""True distance of the ends of a match above which it is wrong; used in the results only."""


class Corridor(NamedTuple):
    """The recording.

    Attributes:
        times_s: Times of the odometry, ``(n,)``.
        odometry: Dead-reckoned poses, m and rad, ``(n, 3)``.
        matches_s: Earlier and later time of each match, ``(matches, 2)``.
        scores: Scores of the matches in [0, 1].
        truth_s: Times of the truth, ``(t,)``.
        truth_m: True positions, ``(t, 2)``.
    """

    times_s: np.ndarray
    odometry: np.ndarray
    matches_s: np.ndarray
    scores: np.ndarray
    truth_s: np.ndarray
    truth_m: np.ndarray


class Graph(NamedTuple):
    """A pose graph: experiences at the times of matches; links of odometry, then matches.

    Attributes:
        frames: Odometry index of every experience, ``(n,)``.
        poses: Their dead-reckoned poses, ``(n, 3)``.
        source: Experience at which each link begins, ``(links,)``.
        target: Experience at which it ends.
        distance_m: Distance between them; 0 for a match.
        heading_rad: Direction of the target seen from the source.
        facing_rad: Heading of the target seen from the source; NaN for a match.
        sigma_m: Standard deviation of a link's position.
        sigma_rad: Standard deviation of its facing.
        confidence: Score of a match, 1 for odometry.
        is_match: Which links are matches.
    """

    frames: np.ndarray
    poses: np.ndarray
    source: np.ndarray
    target: np.ndarray
    distance_m: np.ndarray
    heading_rad: np.ndarray
    facing_rad: np.ndarray
    sigma_m: np.ndarray
    sigma_rad: np.ndarray
    confidence: np.ndarray
    is_match: np.ndarray


def read_corridor(folder: Path) -> Corridor:
    """Read ``Corridor_Input.txt`` and ``Corridor_GT.txt``.

    Raises:
        SourceError: If a file is missing or a line is invalid.
    """
    rows: dict[str, list[list[float]]] = {"odom2": [], "loop": [], "point2": [], "angle": []}
    for name in ("Corridor_Input.txt", "Corridor_GT.txt"):
        path = Path(folder) / name
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except OSError:
            raise SourceError(
                f"corridor_loops: {path} cannot be read; expected a file of TUC SLAM's Corridor"
            ) from None
        for number, line in enumerate(lines, start=1):
            try:
                kind, *values = line.split()
                rows[kind].append([float(value) for value in values[:4]])
            except (ValueError, KeyError):
                raise SourceError(
                    f"corridor_loops: line {number} of {path} is {line[:40]!r}, "
                    f"expected one of {', '.join(rows)} and numbers"
                ) from None
    odometry, matches, truth = (np.array(rows[kind]) for kind in ("odom2", "loop", "point2"))
    dt_s = np.diff(odometry[:, 0], prepend=odometry[0, 0])
    return Corridor(
        odometry[:, 0],
        integrate_velocities(odometry[:, 1], odometry[:, 3], dt_s),
        np.sort(matches[:, :2], axis=1),
        matches[:, 2],
        truth[:, 0],
        truth[:, 1:3],
    )


def build_graph(corridor: Corridor, least_score: float) -> Graph:
    """Return a graph with an experience at the time of every match, and links of good matches."""
    matched = np.searchsorted(corridor.times_s[:-1], corridor.matches_s - 0.05)
    frames = np.unique(np.append(matched, 0))
    poses = corridor.odometry[frames]
    chosen = corridor.scores >= least_score
    ends = np.searchsorted(frames, matched[chosen])
    n, n_matches = len(frames), len(ends)
    step = np.diff(poses, axis=0)
    dt_s = np.diff(corridor.times_s[frames])
    zeros = np.zeros(n_matches)
    return Graph(
        frames,
        poses,
        np.append(np.arange(n - 1), ends[:, 0]),
        np.append(np.arange(1, n), ends[:, 1]),
        np.append(np.hypot(step[:, 0], step[:, 1]), zeros),
        np.append(wrap_angles(np.arctan2(step[:, 1], step[:, 0]) - poses[:-1, 2]), zeros),
        np.append(wrap_angles(step[:, 2]), zeros + np.nan),
        np.append(SPEED_SIGMA_M_S * dt_s, zeros + MATCH_SIGMA_M),
        np.append(TURN_SIGMA_RAD_S * dt_s, zeros + 1.0),
        np.append(np.ones(n - 1), corridor.scores[chosen]),
        np.arange(n - 1 + n_matches) >= n - 1,
    )


def solve(graph: Graph, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Solve the map by ``odometry``, ``relax``, ``least_squares`` or ``least_squares_robust``.

    Returns:
        Poses of the experiences, and which links have a weight above 0.
    """
    links = graph.source, graph.target, graph.distance_m, graph.heading_rad
    if method == "odometry":
        return graph.poses, ~graph.is_match
    if method == "relax":
        relaxation = Relaxation(*links, np.nan_to_num(graph.facing_rad))
        poses, _ = relaxation.run(graph.poses, RELAX_LOOPS, 0.5, RELAX_REST)
        return poses, np.ones(len(graph.source), dtype=bool)
    poses, report = solve_pose_graph(
        graph.poses,
        *links,
        graph.facing_rad,
        sigma_m=graph.sigma_m,
        sigma_rad=graph.sigma_rad,
        confidence=graph.confidence,
        rejectable=graph.is_match if method == "least_squares_robust" else None,
    )
    return poses, report.weights > 0


def track_at_truth(corridor: Corridor, graph: Graph, poses: np.ndarray) -> np.ndarray:
    """Return positions on the solved map at the times of the truth, ``(t, 2)``."""
    own = np.searchsorted(graph.frames, np.arange(len(corridor.times_s)), side="right") - 1
    turn = (poses[:, 2] - graph.poses[:, 2])[own]
    offset = corridor.odometry[:, :2] - graph.poses[own, :2]
    track = poses[own, :2] + rotate_points(offset, turn)
    return np.column_stack(
        [np.interp(corridor.truth_s, corridor.times_s, axis) for axis in track.T]
    )


def corridor_loops(data_folder: Path, out_folder: Path) -> dict[str, Any]:
    """Map the corridor with each method from each subset of the matches.

    Writes ``results.json`` (one row per method and subset) and ``corridor_loops.png``. The truth is
    used for the results only. ATE is the RMSE after rigid alignment.

    Args:
        data_folder: Holds ``Corridor_Input.txt`` and ``Corridor_GT.txt``.
        out_folder: Folder to write.

    Returns:
        The content of ``results.json``.

    Raises:
        SourceError: If the data cannot be read.
    """
    corridor = read_corridor(data_folder)
    rows, tracks = [], {}
    graphs = {score: build_graph(corridor, score) for score in SCORES}
    for least_score, graph in graphs.items():
        true_m = np.column_stack(
            [
                np.interp(corridor.times_s[graph.frames], corridor.truth_s, axis)
                for axis in corridor.truth_m.T
            ]
        )
        apart_m = np.linalg.norm(true_m[graph.source] - true_m[graph.target], axis=1)
        wrong = graph.is_match & (apart_m > WRONG_M)
        for method in ("odometry", "relax", "least_squares", "least_squares_robust"):
            began_s = time.process_time()
            poses, used = solve(graph, method)
            cpu_s = time.process_time() - began_s
            track = track_at_truth(corridor, graph, poses)
            tracks[method, least_score] = track
            rows.append(
                {
                    "method": method,
                    "least_score": least_score,
                    "matches": int(graph.is_match.sum()),
                    "wrong_matches": int(wrong.sum()),
                    "believed_matches": int((graph.is_match & used).sum()),
                    "wrong_believed_matches": int((wrong & used).sum()),
                    "ate_rmse_m": absolute_trajectory_error(track, corridor.truth_m).rmse,
                    "cpu_s": round(cpu_s, 3),
                }
            )
    results = {
        "experiment": "corridor_loops",
        "experiences": len(graphs[SCORES[-1]].frames),
        "track_instants": len(corridor.truth_s),
        "rows": rows,
    }
    out = Path(out_folder)
    text = json.dumps(results, indent=1) + "\n"
    write_atomically(out / "results.json", lambda path: path.write_text(text, encoding="utf-8"))
    figure = draw(corridor.truth_m, tracks, rows)
    save(figure, out / "corridor_loops.png")
    return results


LOOKS = {
    "odometry": ("odometry alone", ODOMETRY),
    "relax": ("relaxation, all matches", OTHER),
    "least_squares": ("least squares, all matches", LOOP),
    "least_squares_robust": ("robust least squares, outliers rejected", MAP),
}


def draw(
    truth_m: np.ndarray,
    tracks: dict[tuple[str, float], np.ndarray],
    rows: Sequence[Mapping[str, Any]],
) -> Figure:
    """Draw the paths estimated from all matches, and the error over the subset of matches."""
    figure = Figure(figsize=(12, 6.5), layout="constrained")
    paths, errors = figure.subplots(1, 2, width_ratios=(1.25, 1))
    least_score = min(score for _, score in tracks)
    for method, (label, colour) in LOOKS.items():
        track = tracks[method, least_score]
        track = align(track, truth_m).apply(track)
        behind = method == "least_squares"  # both maps from all matches collapse to one position
        paths.plot(
            *track.T, color=colour, lw=1.2 - 0.6 * behind, zorder=1.5 + (not behind), label=label
        )
    paths.plot(*truth_m.T, color=TRUTH, lw=1.2, ls="--", label="truth")
    paths.set(
        aspect="equal",
        xlabel="x (m)",
        ylabel="y (m)",
        title="Paths from all matches; without outlier rejection the map collapses",
    )
    paths.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), frameon=False)
    for method, (label, colour) in LOOKS.items():
        own = [row for row in rows if row["method"] == method]
        errors.plot([row["ate_rmse_m"] for row in own], "o-", color=colour, label=label)
    errors.axhline(rows[0]["ate_rmse_m"] / 5, color="0.3", lw=1, ls="--")
    errors.text(4, rows[0]["ate_rmse_m"] / 5 * 1.05, "a fifth of the error of odometry", ha="right")
    names = [
        f"{'all' if row['least_score'] == 0 else '≥ ' + str(row['least_score'])}\n"
        f"{row['matches']}\n{100 * row['wrong_matches'] / row['matches']:.0f} %"
        for row in rows
        if row["method"] == "odometry"
    ]
    errors.set_xticks(range(len(names)), names)
    errors.set(
        yscale="log",
        ylim=(1.5, 100),
        xlabel="least score of the matches used, their number, share of wrong matches",
        ylabel="ATE, rigid alignment (m, RMSE)",
        title="Error of the map over the subset of matches",
    )
    errors.set_yticks([2, 5, 10, 20, 50, 100], ["2", "5", "10", "20", "50", "100"])
    errors.minorticks_off()
    errors.grid(alpha=0.3)
    return figure
