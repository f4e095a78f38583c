"""A run in the viewer rerun, while it goes on or as a recording; extra ``rerun``.

=======================  ====================================================================
``map/links``            links of the experience map; ``map/experiences`` their ends
``map/loop_closures``    links that close loops
``map/path``             poses of the frames, as they were estimated
``map/robot``            pose of the robot, an arrow
``camera/picture``       the picture of a frame; ``camera/template`` the template it matched
``cells/...``            activity of every population that draws any
``figures/...``          match error, and counts of templates, experiences and loop closures
``events``               loop closures as text
=======================  ====================================================================

Timelines: ``frame`` and ``time``, that of the source. Poses and figures have every frame. Pictures,
cells and the map follow at every tenth frame at most, and more rarely where they would take more
than a share of the time of the run.
"""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from neuroslam.errors import ConfigError, RunError
from neuroslam.figures.views import template_picture
from neuroslam.mapping.tables import closes_loop
from neuroslam.runs.files import more_columns
from neuroslam.runs.foxglove import jpeg, link_length
from neuroslam.runs.heights import map_heights
from neuroslam.runs.recording import Recorder, coloured
from neuroslam.state.answers import gathered, pictures_of
from neuroslam.types import Frame, StepResult

if TYPE_CHECKING:
    from neuroslam.brain import NavigationBrain

EVERY = 10
"""Frames between two pictures at least, and between two drawings of the map."""

SHARE = 0.03
"""Largest share of the time of the run that this takes."""

_ROWS = 500  # frames that are sent together
_WIDTH = 320  # pixels of a picture
_FIGURES = ("match_error", "templates", "experiences", "loop_closures")
_UNIX_S = 1e8  # times above are dates
_CLOSES, _LINKS, _NODES, _ROBOT, _PATH = (
    [214, 39, 40], [31, 119, 180], [230, 115, 25], [44, 160, 44], [150, 150, 150],
)  # fmt: skip


class RerunRecorder(Recorder):
    """Sends a run to rerun.

    Args:
        path: File to write (``.rrd``); ``None``: none.
        spawn: Open the viewer.
        share: Largest share of the time of the run for pictures, cells and the map; 1: all of them.

    Raises:
        ConfigError: If the extra is not installed, or the viewer does not start.
        RunError: If the file cannot be written.
    """

    def __init__(self, path: Path | None = None, spawn: bool = False, share: float = SHARE) -> None:
        try:
            import rerun  # extra, imported when first used
        except ImportError:
            raise ConfigError(
                '--rerun and --rerun-save need the extra rerun; pip install "neuroslam[rerun]"'
            ) from None
        self.share = share
        self._rr: Any = rerun
        self._stream = rerun.RecordingStream("neuroslam")
        sinks: list[Any] = []
        if spawn:
            try:
                rerun.spawn(connect=False)
            except RuntimeError as error:
                raise ConfigError(f"--rerun: the viewer does not start ({error})") from None
            sinks.append(rerun.GrpcSink())
        if path is not None:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.open("wb").close()
            except OSError as error:
                raise RunError(f"{path}: cannot be written ({error.strerror or error})") from None
            sinks.append(rerun.FileSink(str(path)))
        self._stream.set_sinks(*sinks, default_blueprint=blueprint(rerun))
        self._stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name in _FIGURES:
            series = rerun.SeriesLines(names=name.replace("_", " "))
            self._stream.log(f"figures/{name}", series, static=True)
        self._rows: list[tuple[float, ...]] = []
        self._track: list[tuple[float, float]] = []
        self._closed_now: list[tuple[int, float, int]] = []
        self._closures = self._links = 0
        self._experiences = 1  # the first has no link
        self._begun_s = time.perf_counter()
        self._used_s = 0.0
        self._seen, self._due = 0, 0
        self._last: tuple[StepResult, Frame, NavigationBrain] | None = None

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Note a frame; send what is due."""
        view = result.view
        # A link to an experience made now closes no loop.
        closed = result.n_links - self._links - (result.n_experiences - self._experiences)
        if result.n_links > self._links and closed > 0:
            self._closures += closed
            self._closed_now.append((result.frame, result.time_s, result.experience))
        self._links, self._experiences = result.n_links, max(result.n_experiences, 1)
        error = view.error if view.error >= 0.0 else np.nan
        counts = result.n_templates, result.n_experiences, self._closures
        up = more_columns(brain).get("z_m", 0.0)
        self._rows.append((result.frame, result.time_s, *result.pose, up, error, *counts))
        self._last = result, frame, brain
        self._seen += 1
        if self._seen >= self._due or len(self._rows) >= _ROWS:
            begun_s = time.perf_counter()
            if self._seen >= self._due and self._used_s <= self.share * (begun_s - self._begun_s):
                self._due = self._seen + EVERY
                self._send_pictures(result, frame, brain)
                self._send_map(result, brain)
                self._send_rows()
            elif len(self._rows) >= _ROWS:
                self._send_rows()
            self._used_s += time.perf_counter() - begun_s

    def _at(self, result: StepResult) -> None:
        self._stream.set_time("frame", sequence=result.frame)
        key = "timestamp" if abs(result.time_s) > _UNIX_S else "duration"
        self._stream.set_time("time", **{key: float(result.time_s)})

    def _send_rows(self) -> None:
        if not self._rows:
            return
        rr, stream = self._rr, self._stream
        rows = np.array(self._rows, np.float64)
        self._rows = []
        self._track += rows[:, [2, 3, 5]].tolist()
        key = "timestamp" if abs(rows[0, 1]) > _UNIX_S else "duration"
        times = [
            rr.TimeColumn("frame", sequence=rows[:, 0].astype(np.int64)),
            rr.TimeColumn("time", **{key: rows[:, 1]}),
        ]
        x, y, heading, up = rows[:, 2:6].T
        flat = np.zeros(len(rows))
        ahead = self._arrow_m * np.column_stack([np.cos(heading), np.sin(heading), flat])
        robot = rr.Arrows3D.columns(origins=np.column_stack([x, y, up]), vectors=ahead)
        stream.send_columns("map/robot", times, robot)
        for name, values in zip(_FIGURES, rows[:, 6:].T, strict=True):
            stream.send_columns(f"figures/{name}", times, rr.Scalars.columns(scalars=values))
        for number, time_s, experience in self._closed_now:
            stream.set_time("frame", sequence=number)
            stream.set_time("time", **{key: float(time_s)})
            stream.log("events", rr.TextLog(f"loop closed at experience {experience}"))
        self._closed_now = []

    def _send_pictures(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        rr, stream = self._rr, self._stream
        self._at(result)
        if frame.image is not None:
            picture = rr.EncodedImage(contents=jpeg(_small(frame.image)), media_type="image/jpeg")
            stream.log("camera/picture", picture)
        if 0 <= result.view.template < brain.view.n:
            template = template_picture(brain.view, result.view.template)
            stream.log("camera/template", rr.Image(template, color_model="L"))
        for tag, activity in gathered(brain.populations.values(), pictures_of).items():
            name = tag.removeprefix("cells/")
            stream.log(f"cells/{name}", rr.Image(coloured(activity)))

    @property
    def _arrow_m(self) -> float:
        return 2.0 * link_length(self._last[2].map.links) if self._last else 1.0

    def _send_map(self, result: StepResult, brain: "NavigationBrain") -> None:
        rr, stream = self._rr, self._stream
        self._at(result)
        poses, links = brain.map.poses, brain.map.links
        heights = map_heights(brain)
        up = np.zeros(len(poses)) if heights is None else heights
        points = np.column_stack([poses[:, :2], up])
        size = 0.2 * link_length(links)
        ends = np.stack([points[links.source], points[links.target]], axis=1)
        closing = closes_loop(links.source, links.target)
        self._closures = int(closing.sum())
        for name, chosen, colour in (
            ("links", ends[~closing], _LINKS), ("loop_closures", ends[closing], _CLOSES),
        ):  # fmt: skip
            strips = rr.LineStrips3D(chosen, colors=[colour], radii=[0.3 * size])
            stream.log(f"map/{name}", strips)
        stream.log("map/experiences", rr.Points3D(points, colors=[_NODES], radii=[size]))
        path = np.array(self._track, np.float64).reshape(-1, 3) - (0.0, 0.0, size)  # below the map
        stream.log("map/path", rr.LineStrips3D([path], colors=[_PATH], radii=[0.2 * size]))

    def close(self) -> None:
        """Send what is pending, and the finished map; a second call does nothing."""
        if self._last is None:
            self._stream.disconnect()
            return
        result, frame, brain = self._last
        self._send_rows()
        self._send_pictures(result, frame, brain)
        self._send_map(result, brain)
        self._stream.send_blueprint(blueprint(self._rr, brain.map.poses[:, :2]), make_active=False)
        self._last = None
        self._stream.disconnect()


def blueprint(rr: Any, points: np.ndarray | None = None) -> Any:  # noqa: ANN401
    """Return the layout of the viewer: the map, the camera, cells and curves side by side.

    Args:
        rr: The module ``rerun``.
        points: Positions ``(n, 2)`` that the map is seen from above with; ``None``: unknown.
    """
    import rerun.blueprint as rrb

    eye = None
    if points is not None and len(points):
        low, high = points.min(axis=0), points.max(axis=0)
        x, y = (0.5 * (low + high)).tolist()
        height = 1.3 * max(float((high - low).max()), 1e-3)
        eye = rrb.EyeControls3D(
            position=(x, y - 1e-3 * height, height), look_target=(x, y, 0.0), eye_up=(0.0, 0.0, 1.0)
        )
    curves = [
        rrb.TimeSeriesView(origin=f"figures/{name}", name=name.replace("_", " "))
        for name in _FIGURES
    ]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="map", name="map", eye_controls=eye),
            rrb.Vertical(
                rrb.Spatial2DView(origin="camera/picture", name="camera"),
                rrb.Spatial2DView(origin="camera/template", name="matched template"),
                rrb.Spatial2DView(origin="cells", name="cells"),
                row_shares=[3, 2, 3],
            ),
            rrb.Vertical(rrb.Tabs(*curves), rrb.TextLogView(origin="events", name="loop closures")),
            column_shares=[4, 2, 2],
        ),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _small(image: np.ndarray) -> np.ndarray:
    """Return a picture of at most 320 pixels in width."""
    height, width = image.shape[:2]
    if width <= _WIDTH:
        return image
    size = _WIDTH, max(1, round(height * _WIDTH / width))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
