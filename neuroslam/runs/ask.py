"""Questions to the semantic map of a run, a brain file, or a map of its own."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from safetensors import SafetensorError, safe_open

from neuroslam.brain import load_brain
from neuroslam.errors import RunError
from neuroslam.figures.answers import plot_answer
from neuroslam.limits import parse_json
from neuroslam.runs.files import brain_file
from neuroslam.runs.reading import length_unit
from neuroslam.sensors.landmarks import read_landmarks
from neuroslam.spiking.ask import Answer, ask
from neuroslam.spiking.files import load_semantic_map
from neuroslam.spiking.semantic import SemanticCells
from neuroslam.spiking.slam import SSPSLAM


class AskedMap:
    """A semantic map that answers questions in words and pictures.

    Args:
        path: Folder of a run, brain file, or file of
            :func:`~neuroslam.spiking.files.save_semantic_map`.
        landmarks: File of words for its landmarks, see
            :func:`~neuroslam.sensors.landmarks.read_landmarks`; ``None``: those it was made with.

    Raises:
        CheckpointError: If the map cannot be loaded.
        RunError: If it has no semantic map.
        SourceError: If the words cannot be read.

    Attributes:
        unit: Of lengths on the map: ``m``, or ``arbitrary unit`` for one camera alone.
    """

    def __init__(self, path: str | Path, landmarks: str | Path | None = None) -> None:
        file = brain_file(path)
        self.name = Path(path).name or str(path)
        self.positions_m, self.links = np.empty((0, 2)), np.empty((0, 2), dtype=np.int64)
        self.cells: SemanticCells | SSPSLAM
        self.unit = "m"
        if _is_semantic_map(file):
            if landmarks is not None:
                raise RunError(f"{file}: its landmarks have names of their own; no file of words")
            self.cells = load_semantic_map(file)
            return
        brain = load_brain(file).largest
        self.unit = length_unit(path)
        cells = brain.populations.get("semantic")
        if not isinstance(cells, SemanticCells):
            raise RunError(
                f"{path}: has no semantic map, its cells are {'+'.join(brain.config.cells)}; run "
                "with semantic among the cells"
            )
        if landmarks is not None:
            cells.name_landmarks(read_landmarks(landmarks))
        self.cells = cells
        self.positions_m = brain.map.poses[:, :2]
        self.links = np.column_stack(brain.map.links[:2])

    def ask(self, question: str, within_m: float | None = None) -> Answer:
        """Answer a question; see :func:`neuroslam.spiking.ask.ask`."""
        return ask(self.cells, question, within_m, self.unit)

    def draw(self, answer: Answer) -> Figure:
        """Draw the map and an answer."""
        return plot_answer(answer, self.positions_m, self.links, self.unit)


def _is_semantic_map(file: Path) -> bool:
    try:
        with safe_open(file, framework="pt") as opened:
            about = parse_json((opened.metadata() or {}).get("neuroslam", "{}"))
    except (OSError, SafetensorError, ValueError):  # load_brain says why
        return False
    return isinstance(about, dict) and about.get("kind") == "semantic map"
