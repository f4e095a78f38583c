"""Recorders that watch a run: TensorBoard, or none; the brain does not depend on them."""

import contextlib
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Self

import cv2
import numpy as np
import torch

from neuroslam.errors import RunError
from neuroslam.figures.maps import plot_map
from neuroslam.figures.style import render
from neuroslam.figures.views import template_picture
from neuroslam.runs.panels import PANELS, Panels
from neuroslam.state.answers import gathered, pictures_of, scalars_of
from neuroslam.state.population import Picture
from neuroslam.types import Frame, StepResult

if TYPE_CHECKING:
    from neuroslam.brain.brain import NavigationBrain

_WIDTH = 320  # pixels of a recorded image: a 60x10 template is too small to see
_MOST_PIXELS = 1600  # of a side of a coloured image: a row of many cells is long
_FIRST_MAP = 50  # frames until the map is first drawn
_THUMBNAIL = 48  # pixels of a template's side in the projector, whose sprite must stay small


class Recorder(ABC):
    """Records every frame after the step of the brain. Usable in a ``with`` statement."""

    @abstractmethod
    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Record one frame."""

    @abstractmethod
    def close(self) -> None:
        """Write what is pending; a second call does nothing."""

    @contextlib.contextmanager
    def moving_to(self, folder: Path) -> Iterator[None]:
        """Let the block move the files to ``folder``, where recording continues."""
        yield

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()


class NullRecorder(Recorder):
    """Records nothing."""

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Do nothing."""

    def close(self) -> None:
        """Do nothing."""


class TensorBoardRecorder(Recorder):
    """Writes event files that TensorBoard shows during the run.

    Scalars: ``view/match_error``, ``view/templates``, ``cells/peak`` (largest activity),
    ``map/experiences``, ``map/links``, ``map/largest_correction`` (relaxation residual, m or rad)
    and ``run/frames_per_s``. Images: ``view/frame_and_template``, ``cells/activity`` (x-y, and
    x-heading) and ``map/experiences_and_links``. When it closes, the templates go to the projector.

    A brain with place cells adds: counts of place cells, activated boundary cells and walls,
    boundary activity, position uncertainty, ``gridness/...`` of each module; and the images
    ``cells/grid_rate_maps``, ``cells/boundary_response``, ``cells/place_map``,
    ``cells/boundary_cells`` (with excitation and inhibition, where a sheet senses the walls) and
    ``cells/place_bump``, at growing intervals because their cost grows.

    A brain with a semantic map adds: the count of landmarks, for how long they disagree with the
    estimated pose, and of the last step of SSP-SLAM ``ssp/recall``, ``ssp/agreement``, ``ssp/gate``
    and ``ssp/lost``; rates of its spiking populations; and, at the same intervals, the images
    ``ssp/map``, the recall of the landmarks seen most often, and ``ssp/spikes``.

    Args:
        folder: Folder of the event files; created if missing.
        scalars_every: Frames between two points of a curve.
        images_every: Frames between two images of view and cells.
        maps_every: Frames between two drawings of the map, the slowest part (0.1 s); the first ones
            are after 50, 100, 200, ... frames.
        projected: Most templates, evenly sampled, for the projector.
        panels_share: Part of the time of a run that the panels of cells may take before its end;
            drawing them once takes about a second.

    Raises:
        RunError: If the folder cannot be written.
    """

    def __init__(
        self,
        folder: Path,
        scalars_every: int = 10,
        images_every: int = 200,
        maps_every: int = 1000,
        projected: int = 2000,
        panels_share: float = 0.1,
    ) -> None:
        from torch.utils.tensorboard import SummaryWriter  # slow to import, not always needed

        self.scalars_every = scalars_every
        self.images_every = images_every
        self.maps_every = maps_every
        self.projected = projected
        self.panels_share = panels_share
        self._last: tuple[int, NavigationBrain] | None = None
        self._drawn = -1
        self._clock = (time.perf_counter(), 0)
        self._begun_s = self._clock[0]
        self._seen = 0
        self._measured = False
        self._panels: dict[str, Panels] = {}
        self._map_due = min(maps_every, _FIRST_MAP)  # frames seen
        self._panels_due = 0  # the same
        self._drawing_s = 1.0  # of all panels so far, and the first
        try:
            self._writer = SummaryWriter(str(folder), max_queue=1000)  # short queues block the loop
        except OSError as error:
            raise RunError(f"{folder}: TensorBoard events cannot be written ({error})") from None

    def step(self, result: StepResult, frame: Frame, brain: "NavigationBrain") -> None:
        """Write the scalars and images that are due at this frame."""
        self._last = (result.frame, brain)
        self._seen += 1
        measured = frame.velocity is not None and brain.config.odometry.use != "visual"
        self._measured |= measured
        for kind, population in brain.populations.items():
            if kind in PANELS:
                if kind not in self._panels:
                    self._panels[kind] = PANELS[kind](self._writer)
                self._panels[kind].note(population, frame)
        if result.frame % self.scalars_every == 0:
            self._write_scalars(result, brain)
        if result.frame % self.images_every == 0:
            if frame.image is not None:
                known = 0 <= result.view.template < brain.view.n
                template = template_picture(brain.view, result.view.template) if known else None
                picture = frame_beside_template(frame.image, template)
                self._write_picture("view/frame_and_template", picture, result.frame)
            for tag, activity in gathered(brain.populations.values(), pictures_of).items():
                self._write_picture(tag, coloured(activity), result.frame)
        if self._seen > self._map_due:
            self._map_due += min(self.maps_every, self._map_due)
            self._write_map(result.frame, brain)
            self._writer.flush()  # to be seen while the run goes on

    @contextlib.contextmanager
    def moving_to(self, folder: Path) -> Iterator[None]:
        """Close the files, and begin another in ``folder`` after the block."""
        if str(folder) == self._writer.log_dir:
            yield
            return
        self._writer.close()
        yield
        self._writer.log_dir = str(folder)  # a closed writer opens a file there when it needs one

    def close(self) -> None:
        """Draw the final map, write the templates for the projector, and close the files."""
        if self._last is not None:
            frame, brain = self._last
            self._last = None
            if self._drawn != frame:
                self._write_map(frame, brain, last=True)
            if brain.view.n:
                self._write_projector(frame, brain)
        for panels in self._panels.values():
            panels.close()
        self._writer.close()

    def _write_scalars(self, result: StepResult, brain: "NavigationBrain") -> None:
        now, (then, seen) = time.perf_counter(), self._clock
        self._clock = (now, self._seen)
        values = {
            "view/templates": result.n_templates,
            "map/experiences": result.n_experiences,
            "map/links": result.n_links,
            "map/largest_correction": brain.map.largest_correction,
            "run/frames_per_s": (self._seen - seen) / max(now - then, 1e-9),
        }
        if result.view.error >= 0:
            values["view/match_error"] = result.view.error
        values |= gathered(brain.populations.values(), scalars_of)
        for panels in self._panels.values():
            panels.write_scalars(result.frame)
        for tag, value in values.items():
            self._writer.add_scalar(tag, value, result.frame)

    def _write_map(self, frame: int, brain: "NavigationBrain", last: bool = False) -> None:
        links = brain.map.links
        figure = plot_map(
            brain.map.poses,
            np.column_stack([links.source, links.target]),
            current=brain.map.pose,
            landmarks=brain.landmarks_m,
            unit="m" if self._measured else "arbitrary unit",
        )
        self._write_picture("map/experiences_and_links", render(figure), frame)
        now_s = time.perf_counter()
        affordable = self._drawing_s <= self.panels_share * (now_s - self._begun_s)
        if last or (self._seen >= self._panels_due and affordable):
            self._panels_due = self._seen + self._seen // 2
            for panels in self._panels.values():
                panels.write_figures(frame)
            self._drawing_s += time.perf_counter() - now_s
        self._drawn = frame

    def _write_picture(self, tag: str, picture: np.ndarray, frame: int) -> None:
        self._writer.add_image(tag, picture, frame, dataformats="HWC")

    def _write_projector(self, frame: int, brain: "NavigationBrain") -> None:
        n = brain.view.n
        ids = np.unique(np.linspace(0, n - 1, min(n, self.projected)).round().astype(int))
        images = [brain.view.template_image(int(i)) for i in ids]
        pictures = [template_picture(brain.view, int(i)) for i in ids]
        size = (_THUMBNAIL, _THUMBNAIL)  # the projector draws square sprites
        thumbnails = np.stack([cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in pictures])
        self._writer.add_embedding(
            np.stack(images).reshape(len(ids), -1),
            metadata=[f"template {i}" for i in ids],
            label_img=torch.from_numpy(thumbnails)[:, None].expand(-1, 3, -1, -1) / 255.0,
            global_step=frame,
            tag="templates",
        )


def frame_beside_template(image: np.ndarray, template: np.ndarray | None) -> np.ndarray:
    """Put a frame above its template, both 320 pixels wide.

    Args:
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        template: ``uint8``, ``(h, w)``; ``None``: only the frame is shown.

    Returns:
        ``uint8``, ``(h, 320, 3)``.

    Example:
        >>> frame_beside_template(np.zeros((12, 16), np.uint8), np.zeros((1, 6), np.uint8)).shape
        (301, 320, 3)
    """
    rows = [_widened(image)]
    if template is not None:
        rows += [np.full((8, _WIDTH, 3), 255, np.uint8), _widened(template)]
    return np.concatenate(rows)


def coloured(picture: Picture) -> np.ndarray:
    """Render the activity of a population as an image: dark is silent, yellow the peak of a layer.

    Every cell is a block of at least 200 / n pixels, n being the smallest side, or less where the
    image would be wider or higher than 1600; the first row is lowest.

    Args:
        picture: Activity ``(h, w)``; a tuple of such layers, drawn side by side; or an RGB image,
            ``uint8``, ``(h, w, 3)``, returned as it is.

    Returns:
        ``uint8``, ``(h, w, 3)``.

    Example:
        >>> coloured((np.ones((21, 21)), np.ones((36, 21)))).shape
        (210, 428, 3)
    """
    layers = picture if isinstance(picture, tuple) else (picture,)
    if layers[0].ndim == 3:
        return layers[0]
    block = math.ceil(200 / min(layers[0].shape))
    block = max(1, min(block, _MOST_PIXELS // max(layers[0].shape)))
    height, width = (side * block for side in layers[0].shape)
    gap, parts = np.full((height, 8, 3), 255, np.uint8), []
    for layer in layers:
        grey = (255.0 * layer / (layer.max() or 1.0)).round().clip(0, 255).astype(np.uint8)
        large = cv2.resize(grey[::-1], (width, height), interpolation=cv2.INTER_NEAREST)
        parts += [gap, cv2.applyColorMap(large, cv2.COLORMAP_VIRIDIS)[..., ::-1]]
    return np.concatenate(parts[1:], axis=1)


def _widened(image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    how = cv2.INTER_AREA if width > _WIDTH else cv2.INTER_NEAREST
    large = cv2.resize(image, (_WIDTH, max(1, round(height * _WIDTH / width))), interpolation=how)
    return np.repeat(large[..., None], 3, axis=2) if large.ndim == 2 else large
