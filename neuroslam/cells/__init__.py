"""Cells whose activity says where the animal is."""

from neuroslam.cells.convolve import circular_convolve, gaussian_kernel
from neuroslam.cells.pose import PoseCellNetwork

__all__ = ["PoseCellNetwork", "circular_convolve", "gaussian_kernel"]
