"""Memory and work that a config asks for before the first frame, estimated from above.

Populations of your own are not counted.
"""

from neuroslam.config.brain import BrainConfig
from neuroslam.config.semantic import SemanticConfig, SSPSpaceConfig
from neuroslam.errors import ConfigError
from neuroslam.limits import fits, size_text, too_much

MOST_WORK = 3e12
"""Multiplications to solve the decoders of a network: some ten minutes of one processor."""

_NUMBER = 8  # bytes
_POSE_CELLS = 6  # arrays of the size of the network, at work
_TEMPLATES = 64  # that a view is compared with, at work
_POINTS = 3000  # at which decoders are solved


def check_size(config: BrainConfig) -> None:
    """Refuse a config that asks for more memory than the budget, or for endless work.

    Raises:
        ConfigError: With the section that asks for the most.

    Example:
        >>> check_size(BrainConfig())
    """
    sizes = estimated_bytes(config)
    most = max(sizes, key=lambda section: sizes[section])
    if not fits(sum(sizes.values())):
        raise ConfigError(
            f"config: {most} alone asks for {size_text(sizes[most])}, the brain "
            f"{too_much(sum(sizes.values()))}"
        )
    work = _decoder_work(config.semantic) if "semantic" in config.cells else 0.0
    if work > MOST_WORK:
        raise ConfigError(
            f"config: semantic has networks whose decoders take {work:.1g} multiplications; "
            f"expected at most {MOST_WORK:.1g}; use fewer neurons"
        )


def estimated_bytes(config: BrainConfig) -> dict[str, int]:
    """Estimate the memory that a brain takes before it has seen anything, by section.

    Example:
        >>> estimated_bytes(BrainConfig())["pose_cells"]
        381024
    """
    view, found = config.view, {}
    found["view"] = _NUMBER * _TEMPLATES * view.template_width * view.template_height
    if "pose" in config.cells:
        cells = config.pose_cells
        number = 4 if cells.precision == "float32" else 8
        found["pose_cells"] = number * _POSE_CELLS * cells.n_theta * cells.n_xy**2
    if "pose_3d" in config.cells:
        cells, n_z = config.pose_cells, config.section("pose_3d").model_dump()["n_z"]
        number = 4 if cells.precision == "float32" else 8
        found["pose_3d"] = number * _POSE_CELLS * n_z * (cells.n_xy**2 + cells.n_theta)
    if "place" in config.cells:
        grid, walls = config.grid_cells, config.boundary_cells
        modules = len(grid.spacings_m) * grid.n_cells * (grid.n_cells + 8 * grid.directions)
        sheets = walls.n_bearings * walls.n_distances + 64 * walls.sheet_bearings
        found["grid_cells"] = 4 * _NUMBER * modules
        found["boundary_cells"] = _POSE_CELLS * _NUMBER * sheets
    if "semantic" in config.cells:
        found["semantic"] = _semantic_bytes(config.semantic)
    return found


def n_frequencies(space: SSPSpaceConfig) -> int:
    """Return how many waves a space has.

    Example:
        >>> n_frequencies(SSPSpaceConfig(n_rotations=3, n_scales=3))
        27
    """
    if space.kind == "random":
        return space.n_random
    each = space.dimension + (space.kind == "hexagonal" and space.dimension > 1)
    return each * space.n_rotations * space.n_scales


def _semantic_bytes(c: SemanticConfig) -> int:
    k = n_frequencies(c.space)
    search = 2 * 20_000 * k  # waves at the points of a coarse search
    vectors = 64 * (2 * k + 1 + c.key_features)
    if c.tier == "algebraic":
        return _NUMBER * (search + vectors + 4 * k**2)
    largest, kept = 0, 0
    for groups, neurons, inputs in _ensembles(c):
        largest = max(largest, neurons * (3 * neurons + 6 * _POINTS))  # one group after the other
        kept += groups * neurons * (2 * inputs + 8)
    return _NUMBER * (search + vectors + largest + kept)


def _decoder_work(c: SemanticConfig) -> float:
    if c.tier == "algebraic":
        return 0.0
    return sum(
        groups * float(neurons) ** 2 * (_POINTS + neurons / 3)
        for groups, neurons, _ in _ensembles(c)
    )


def _ensembles(c: SemanticConfig) -> list[tuple[int, int, int]]:
    """Return groups, neurons of each, and numbers that each takes, of all networks of neurons."""
    k = n_frequencies(c.space)
    return [
        (k, c.integrator.neurons, 3),
        (1, c.integrator.velocity_neurons, c.space.dimension),
        (2, c.map.neurons, 2 * k + 1),
        (1, c.map.neurons, c.key_features),
        (1, c.vector_neurons, 2 * k),
        (1, c.grid_neurons, 2 * k),
        (16 * k if c.binding == "neurons" else 0, c.binding_neurons // 2, 1),
    ]
