"""What a merge did, or why it was refused."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from neuroslam.errors import counted


@dataclass
class MergeReport:
    """What a merge did, or why it was refused.

    Attributes:
        merged: Whether the maps were joined.
        reason: Why not, or what it brought.
        at_frame: Frame of the session that goes on, where it was running.
        loaded_sessions: Sessions of the loaded map.
        partial_sessions: Sessions of the partial map.
        match: Ids, frames, likeness of the match and of its runner-up, number of equal places.
        cell_shift: By how many pose cells the partial session moved along x, y, theta.
        rotation_rad: By how much its map turned.
        translation_m: By how much its matched place moved, x and y.
        counts: Views, experiences and links of both maps and of the merged one.
        residual_before_m: RMS over all links of how far they are off, before.
        residual_after_m: The same after the merged map was relaxed, to see.
        largest_correction_m: How far that relaxation moved the place that it moved farthest.
        found: How it was found that the maps meet, where that was looked for.
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

    def lines(self) -> list[str]:
        """Write the report for a reader, a fact a line."""
        lines = [f"{'merged' if self.merged else 'not merged'}: {self.reason}"]
        m = self.match or {}
        if m:
            lines.append(
                f"match: place {m['partial_experience']} (frame {m['partial_frame']}) is place "
                f"{m['loaded_experience']} (frame {m['loaded_frame']}), "
                f"{counted(m['places'], 'place agrees', 'places agree')}"
            )
        if self.found:
            lines.append(f"found: {self.found}")
        by_views = m.get("error") is not None
        if by_views:
            runner_up = "none" if m["runner_up"] is None else f"{m['runner_up']:.4f}"
            lines.append(f"likeness: view difference {m['error']:.4f}, best elsewhere {runner_up}")
        if self.cell_shift and by_views:
            x, y, theta = self.cell_shift
            lines.append(f"pose cells moved by {x:.2f}, {y:.2f}, {theta:.2f} cells (x, y, theta)")
        if self.rotation_rad is not None:
            x, y = self.translation_m
            lines.append(
                f"map turned by {np.degrees(self.rotation_rad):.1f} degrees, "
                f"matched place moved by {x:.2f}, {y:.2f} m"
            )
        for what, n in self.counts.items():
            into = f" -> {n['merged']}" if "merged" in n else ""
            lines.append(f"{what.replace('_', ' ')}: {n['loaded']} + {n['partial']}{into}")
        if self.residual_after_m is not None:
            lines.append(
                f"links off by {self.residual_before_m:.4f} m before, "
                f"{self.residual_after_m:.4f} m after relaxation (RMS); "
                f"largest correction {self.largest_correction_m:.3f} m"
            )
        return lines
