"""Semantic maps in spikes: spatial semantic pointers, populations of neurons, SSP-SLAM."""
