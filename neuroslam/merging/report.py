"""Reports of merges."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from neuroslam.errors import counted


@dataclass
class MergeReport:
    """Result of a merge, or the reason of its refusal.

    Attributes:
        merged: Whether the maps were merged.
        reason: Reason of the refusal, or what the merge added.
        at_frame: Frame at which a running session joined the map; ``None``: finished sessions.
        loaded_sessions: Sessions of the loaded map.
        partial_sessions: Sessions of the partial map.
        match: Ids, frames, match error of the match and of its runner-up, number of matched
            experiences.
        cell_shift: Shift of the partial session's pose cells along x, y, theta, in cells.
        rotation_rad: Rotation of its map.
        translation_m: Displacement of its matched experience, x and y.
        counts: Templates (``views``), experiences and links of both maps and of the merged one.
        residual_before_m: RMS residual of all links before the merge.
        residual_after_m: RMS residual of all links after the trial relaxation.
        largest_correction_m: Largest displacement of an experience by that relaxation.
        found: How the match was found; empty for a match that was given.
    """

    merged: bool
    reason: str
    at_frame: int | None = None
    loaded_sessions: list[str] = field(default_factory=list)
    partial_sessions: list[str] = field(default_factory=list)
    match: dict[str, Any] = field(default_factory=dict)
    cell_shift: list[float] = field(default_factory=list)
    rotation_rad: float | None = None
    translation_m: list[float] = field(default_factory=list)
    counts: dict[str, dict[str, float]] = field(default_factory=dict)
    residual_before_m: float | None = None
    residual_after_m: float | None = None
    largest_correction_m: float | None = None
    found: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, for ``metrics.json``."""
        return asdict(self)

    def lines(self, unit: str = "m") -> list[str]:
        """Return the report as text, one fact per line.

        Args:
            unit: Of lengths; ``arbitrary unit`` for maps of one camera alone.
        """
        lines = [f"{'merged' if self.merged else 'not merged'}: {self.reason}"]
        m = self.match or {}
        if m:
            lines.append(
                f"match: experience {m['partial_experience']} (frame {m['partial_frame']}) is "
                f"experience {m['loaded_experience']} (frame {m['loaded_frame']}); "
                f"{counted(m['places'], 'experience agrees', 'experiences agree')}"
            )
        if self.found:
            lines.append(f"found: {self.found}")
        by_views = m.get("error") is not None
        if by_views:
            runner_up = "none" if m["runner_up"] is None else f"{m['runner_up']:.4f}"
            lines.append(f"match error: {m['error']:.4f}, smallest elsewhere {runner_up}")
        if self.cell_shift and by_views:
            x, y, theta = self.cell_shift
            lines.append(f"pose cells moved by {x:.2f}, {y:.2f}, {theta:.2f} cells (x, y, theta)")
        if self.rotation_rad is not None:
            x, y = self.translation_m
            lines.append(
                f"map turned by {np.degrees(self.rotation_rad):.1f} degrees, "
                f"matched experience moved by {x:.2f}, {y:.2f} {unit}"
            )
        for what, n in self.counts.items():
            into = f" -> {n['merged']}" if "merged" in n else ""
            lines.append(f"{what.replace('_', ' ')}: {n['loaded']} + {n['partial']}{into}")
        if self.residual_after_m is not None:
            lines.append(
                f"residual of links {self.residual_before_m:.4f} {unit} before, "
                f"{self.residual_after_m:.4f} {unit} after relaxation (RMS); "
                f"largest correction {self.largest_correction_m:.3f} {unit}"
            )
        return lines
