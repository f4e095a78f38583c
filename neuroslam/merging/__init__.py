"""Merging of maps: matching experiences, checking the match, and merging two states."""

from neuroslam.merging.match import Found, find_match, shared_history
from neuroslam.merging.merge import Merged, merge
from neuroslam.merging.report import MergeReport
from neuroslam.state.match import Match

__all__ = ["Found", "Match", "MergeReport", "Merged", "find_match", "merge", "shared_history"]
