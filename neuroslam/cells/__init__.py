"""Populations of cells whose activity encodes the pose of the animal."""

from neuroslam.cells.boundary import BoundaryCells
from neuroslam.cells.boundary_sheet import BoundarySheet
from neuroslam.cells.convolve import circular_convolve, gaussian_kernel, ring_convolve
from neuroslam.cells.familiarity import Familiarity
from neuroslam.cells.grid import LAHNGridCells
from neuroslam.cells.head_direction import HeadDirectionCells
from neuroslam.cells.interference import OscillatoryInterference
from neuroslam.cells.navigation import NavigationCells
from neuroslam.cells.oscillators import VelocityOscillators
from neuroslam.cells.place import CompetitiveHebbianPlaceCells
from neuroslam.cells.pose import PoseCellNetwork
from neuroslam.cells.pose_3d import PoseCells3D
from neuroslam.cells.sheet import GridSheet
from neuroslam.cells.speed import SpeedCells
from neuroslam.cells.walls import WallMemory

__all__ = [
    "BoundaryCells",
    "BoundarySheet",
    "CompetitiveHebbianPlaceCells",
    "Familiarity",
    "GridSheet",
    "HeadDirectionCells",
    "LAHNGridCells",
    "NavigationCells",
    "OscillatoryInterference",
    "PoseCellNetwork",
    "PoseCells3D",
    "SpeedCells",
    "VelocityOscillators",
    "WallMemory",
    "circular_convolve",
    "gaussian_kernel",
    "ring_convolve",
]
