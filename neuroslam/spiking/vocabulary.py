"""State of semantic cells: the vocabulary of known landmarks, their pointers, and the present."""

import numpy as np
import torch
from torch import Tensor

from neuroslam.config.semantic import SemanticConfig
from neuroslam.spiking.sightings import LEAST_SEEN, NAMELESS, VIEW
from neuroslam.state.tables import GrowingTable, Scalars


class Vocabulary(GrowingTable):
    """Known landmarks, one row for each.

    Columns: kind and number; position (``place_m``); number of sightings (``seen``); variance of
    the robot's position when the landmark was first seen; first frame; the experience at which it
    was first seen or that it is, -1 for none; its position in the frame of that experience
    (``offset_m``).
    """

    def __init__(self) -> None:
        super().__init__(
            {
                "kind": ((), torch.int64),
                "number": ((), torch.int64),
                "place_m": ((2,), torch.float64),
                "seen": ((), torch.int64),
                "variance_m2": ((), torch.float64),
                "first_frame": ((), torch.int64),
                "experience": ((), torch.int64),
                "offset_m": ((2,), torch.float64),
            }
        )
        self.row_of: dict[tuple[int, int], int] = {}
        """Row of each kind and number."""

    def confirmed(self) -> Tensor:
        """Return for each row whether it was seen often enough to be no outlier."""
        return (self["seen"] >= LEAST_SEEN) | (self["kind"] == VIEW)

    def nearest_nameless(self, place_m: np.ndarray, same_m: float) -> tuple[int, int]:
        """Find the nameless landmark at a position.

        Args:
            place_m: Position, ``(2,)``.
            same_m: Distance within which it is taken for a known one.

        Returns:
            Its row and 0; or -1 and the number for a new one; or -1 and -1 if it is ambiguous.
        """
        mine = np.flatnonzero(self["kind"].numpy() == NAMELESS)
        if not len(mine):
            return -1, 0
        away = np.linalg.norm(self["place_m"].numpy()[mine] - place_m, axis=1)
        order = np.argsort(away)
        if away[order[0]] > 2.0 * same_m:
            return -1, len(mine)
        ambiguous = len(away) > 1 and away[order[1]] < 2.0 * away[order[0]]
        if away[order[0]] > same_m or ambiguous:
            return -1, -1
        return int(mine[order[0]]), 0

    def index(self) -> None:
        """Rebuild :attr:`row_of` from the columns."""
        kinds, numbers = (self[c].tolist() for c in ("kind", "number"))
        self.row_of = {key: i for i, key in enumerate(zip(kinds, numbers, strict=True))}


class SemanticState(Scalars):
    """Present state of semantic cells.

    Attributes:
        heading_rad: Heading of the robot.
        owed_s: Time since the last whole step of the simulation.
        frame: Number of the last frame.
        told: Landmark that has given the robot's position in this turn of attention, or -1.
    """

    heading_rad: float
    owed_s: float
    frame: int
    told: int

    def __init__(self, heading_rad: float) -> None:
        super().__init__(heading_rad=heading_rad, owed_s=0.0, frame=-1, told=-1)


def landmark_pointer(config: SemanticConfig, kind: int, number: int) -> Tensor:
    """Return the pointer of a landmark: random, of length 1, the same in every session."""
    draw = torch.Generator().manual_seed((config.seed * 3 + kind) * 1_000_003 + number)
    vector = torch.randn(config.key_features, generator=draw)
    return vector / vector.norm()
