"""Tuning: the parameters of a video from the video itself, without ground truth."""

from neuroslam.tuning.tune import Tuning, tune

__all__ = ["Tuning", "tune"]
