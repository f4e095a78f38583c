"""Semantic maps in spikes: spatial semantic pointers, populations of neurons, SSP-SLAM."""

from neuroslam.spiking.algebra import bind, invert, make_unitary, similarity, unbind
from neuroslam.spiking.algebraic import AlgebraicIntegrator, AlgebraicMap
from neuroslam.spiking.associative import AssociativeMap
from neuroslam.spiking.binding import SpikingBinding
from neuroslam.spiking.decoding import LearnedDecoder, PositionDecoder
from neuroslam.spiking.density import DensityEstimator
from neuroslam.spiking.ensemble import NeuronArray
from neuroslam.spiking.files import load_semantic_map, save_semantic_map
from neuroslam.spiking.joining import merge_semantic_maps
from neuroslam.spiking.path_integrator import PathIntegrator
from neuroslam.spiking.pointers import SemanticPointers
from neuroslam.spiking.populations import VectorPopulation
from neuroslam.spiking.quantise import quantised
from neuroslam.spiking.slam import SSPSLAM, SSPStep
from neuroslam.spiking.space import SSPSpace

__all__ = [
    "SSPSLAM",
    "AlgebraicIntegrator",
    "AlgebraicMap",
    "AssociativeMap",
    "DensityEstimator",
    "LearnedDecoder",
    "NeuronArray",
    "PathIntegrator",
    "PositionDecoder",
    "SSPSpace",
    "SSPStep",
    "SemanticPointers",
    "SpikingBinding",
    "VectorPopulation",
    "bind",
    "invert",
    "load_semantic_map",
    "make_unitary",
    "merge_semantic_maps",
    "quantised",
    "save_semantic_map",
    "similarity",
    "unbind",
]
