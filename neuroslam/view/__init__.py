"""Recognising places by what they look like."""

from neuroslam.view.templates import LocalViewCells

__all__ = ["LocalViewCells"]
