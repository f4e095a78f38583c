"""Upper bounds of the whole numbers in a config, and why; the sizes together are in ``size``.

A bound is far above what is useful and far below what a machine could not do: a config from
elsewhere, or a typing error, is refused in one line.
"""

MOST_PX = 4096
"""Sides and shifts in px: cameras of robots are narrower, and templates a small part of that."""

MOST_IMAGE_PX = 65_536
"""Sides of an image in px, more than a JPEG can have."""

MOST_CELLS = 1024
"""Cells along an axis: a full turn in steps of 0.35 degrees; OpenRatSLAM uses 36 at most."""

MOST_MODULES = 64
"""Modules, orientations and scales: rodents have about ten grid modules (Stensola et al. 2012)."""

MOST_AXES = 16
"""Axes of a space: a search on a grid with two points an axis takes 65,536 already."""

MOST_NEURONS = 20_000
"""Neurons of a population: its decoders are solved by a matrix of neurons by neurons, 3.2 GB."""

MOST_FREQUENCIES = 65_536
"""Frequencies and features of a vector: more than a network that keeps ten million pointers apart
needs."""

MOST_LOOPS = 10_000
"""Loops and steps within a frame: a relaxed map changes no more after some hundreds."""

MOST_STEPS = 10_000_000
"""Steps of development at the start: minutes, and ten thousand times the default."""

MOST_COUNT = 1_000_000
"""Experiences and views that are counted: a map of a million is weeks of driving."""

MOST_THREADS = 256
"""Threads: one is fastest for a single brain. More than the machine has processors are not used."""

LARGEST_SEED = 2**53 - 1
"""Seeds: the largest whole number that JSON readers keep exactly."""
