"""Local view cells: recognition of familiar views by template matching."""

from neuroslam.view.templates import LocalViewCells

__all__ = ["LocalViewCells"]
