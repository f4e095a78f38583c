"""Cells whose activity says where the animal is."""

from neuroslam.cells.boundary import BoundaryCells
from neuroslam.cells.convolve import circular_convolve, gaussian_kernel
from neuroslam.cells.familiarity import Familiarity
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.interference import OscillatoryInterference
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.cells.sheet import GridSheet
from neuroslam.cells.walls import WallMemory

__all__ = [
    "BoundaryCells",
    "CompetitiveHebbianPlaceCells",
    "Familiarity",
    "GridSheet",
    "LAHNGridCells",
    "NavigationCells",
    "OscillatoryInterference",
    "PoseCellNetwork",
    "VelocityOscillators",
    "WallMemory",
    "circular_convolve",
    "gaussian_kernel",
]
