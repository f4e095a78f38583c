"""Sections of the config of a semantic map: space, neurons, path integrator, map, loop closure."""

import math
from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, model_validator

from neuroslam.config.sections import Section


class SSPSpaceConfig(Section):
    """How positions become vectors: frequencies and the length scale of the space."""

    kind: Literal["hexagonal", "random", "rectangular"] = Field(
        "hexagonal", description="hexagonal: modules of grid cells, whose waves close"
    )
    dimension: int = Field(
        2,
        ge=1,
        description="of the space that is mapped; if it is not set, as many as length_scale_m or "
        "reach_m has numbers",
    )
    n_rotations: int = Field(3, ge=1, description="orientations of grid modules")
    n_scales: int = Field(3, ge=1, description="spacings of grid modules, for each orientation")
    n_random: int = Field(27, ge=1, description="frequencies of a random space")
    scale_min: float = Field(1.0, gt=0, description="lowest frequency, rad a length scale")
    scale_max: float = Field(math.pi, gt=0, description="highest; larger: sharper, more side lobes")
    scale_spacing: Literal["linear", "log", "random"] = Field("linear", description="in between")
    length_scale_m: float | tuple[float, ...] = Field(
        0.2, description="larger: broader bumps, in all directions or each; larger spaces need it"
    )
    reach_m: float | tuple[float, ...] = Field(
        1.0, description="positions are decoded in [-reach, reach], in all directions or each"
    )
    seed: int = Field(0, ge=0, description="of random frequencies and rotations")

    @model_validator(mode="before")
    @classmethod
    def _dimension_follows(cls, values: object) -> object:
        if not isinstance(values, Mapping) or "dimension" in values:
            return values
        each = (values.get(name) for name in ("length_scale_m", "reach_m"))
        lengths = [len(value) for value in each if isinstance(value, tuple | list)]
        return {**values, "dimension": max(lengths)} if max(lengths, default=1) > 1 else values

    @model_validator(mode="after")
    def _scales_rise(self) -> Self:
        if self.scale_max < self.scale_min:
            raise ValueError(f"scale_max {self.scale_max} is below scale_min {self.scale_min}")
        for name in ("length_scale_m", "reach_m"):
            value = getattr(self, name)
            each = value if isinstance(value, tuple) else (value,)
            if len(each) not in (1, self.dimension) or min(each) <= 0:
                raise ValueError(
                    f"{name} is {value}, must be positive, one number or {self.dimension} of them"
                )
        return self


class NeuronConfig(Section):
    """Neurons: their model and how their tuning is drawn."""

    model: Literal["lif", "stepped_lif", "lif_rate", "relu"] = Field(
        "lif", description="spikes; of a chip; rates without spikes; rectified units"
    )
    tau_rc_s: float = Field(0.02, gt=0, description="time constant of the membrane")
    tau_ref_s: float = Field(0.002, ge=0, description="pause after a spike")
    max_rate_hz: tuple[float, float] = Field((200.0, 400.0), description="rate at the encoder")
    intercept: tuple[float, float] = Field(
        (-1.0, 0.9), description="projection on the encoder above which it fires"
    )

    @model_validator(mode="after")
    def _rates_can_be_reached(self) -> Self:
        low, high = self.max_rate_hz
        if not 0 < low <= high or high * self.tau_ref_s >= 1:
            raise ValueError(
                f"max_rate_hz {self.max_rate_hz} must rise, be positive, and stay below "
                f"1 / tau_ref_s"
            )
        if not -1 <= self.intercept[0] <= self.intercept[1] < 1:
            raise ValueError(f"intercept {self.intercept} must rise within [-1, 1)")
        return self


class PathIntegratorConfig(Section):
    """Velocity-controlled oscillators: one population of neurons for each frequency."""

    neurons: int = Field(800, ge=10, description="of one oscillator; more: less drift")
    max_speed_m_s: float = Field(0.5, gt=0, description="faster is cut; larger: coarser rates")
    tau_s: float = Field(
        0.1, gt=0, description="recurrent synapse; longer: less drift, and corrections act slower"
    )
    input_tau_s: float = Field(0.005, gt=0, description="synapse of corrections")
    output_tau_s: float = Field(0.005, gt=0, description="synapse of what is read out")
    stabilise: float = Field(1.0, ge=0, description="pull to the unit circle, Eq. 19; 0: none")
    amplitude_range: tuple[float, float] = Field(
        (0.8, 1.2), description="amplitudes for which decoders are solved; (0, ...): a whole disc"
    )
    decoder_noise: float = Field(
        0.005, gt=0, description="of the highest rate, that decoders are solved against"
    )
    coupling: Literal["none", "modules", "manifold"] = Field(
        "manifold",
        description="modules: phases of each close; manifold: all agree on one position",
    )
    coupling_gain: float = Field(1.0, ge=0, description="of the pull; over tau_s, its rate")
    velocity_neurons: int = Field(
        0, ge=0, description="neurons that say the velocity, with their noise; 0: exact"
    )
    phase_noise_rad: float = Field(
        0.0, ge=0, description="algebraic tier: diffusion of each phase, rad over a root of seconds"
    )


class SemanticMapConfig(Section):
    """The associative memory from landmarks' pointers to their places."""

    neurons: int = Field(550, ge=10, description="of each of memory, recall and error")
    intercept: float = Field(0.1, ge=-1, lt=1, description="similarity at which memory fires")
    relay: bool = Field(False, description="what is recalled passes through neurons of its own")
    pes_rate: float = Field(5e-3, ge=0, description="learning of what is recalled")
    voja_rate: float = Field(1e-4, ge=0, description="encoders move to keys; 0: they are keys")
    plasticity: Literal["novelty", "constant"] = Field(
        "novelty", description="novelty: what is known is learnt slower"
    )
    least_plasticity: float = Field(
        0.01, ge=0, le=1, description="share of the rate that is left for what is known"
    )
    learning_rate_s: float = Field(
        8.0, gt=0, description="algebraic tier: share that is learnt in a second"
    )


class SSPSLAMConfig(Section):
    """SSP-SLAM: path integration, a semantic map, and corrections from it."""

    tier: Literal["algebraic", "rate", "spiking"] = Field(
        "spiking", description="vectors alone; rates of neurons; spikes"
    )
    time_step_s: float = Field(1e-3, gt=0, le=0.1, description="of the simulation")
    seed: int = Field(0, ge=0, description="of neurons, noise and pointers")
    space: SSPSpaceConfig = SSPSpaceConfig()
    neurons: NeuronConfig = NeuronConfig()
    integrator: PathIntegratorConfig = PathIntegratorConfig()
    map: SemanticMapConfig = SemanticMapConfig()
    binding: Literal["exact", "neurons"] = Field(
        "neurons", description="circular convolution in populations, or exactly"
    )
    binding_neurons: int = Field(50, ge=2, description="of each product of two numbers")
    vector_neurons: int = Field(550, ge=0, description="object-vector cells; 0: exact")
    vector_reach_m: float = Field(0.3, gt=0, description="how far object-vector cells reach")
    places: bool = Field(False, description="learn what is at places, too: areas can be asked for")
    grid_neurons: int = Field(0, ge=0, description="grid cells that say the position; 0: exact")
    attention: Literal["sum", "nearest", "turns"] = Field(
        "turns", description="of several landmarks in view: all at once, one, one after another"
    )
    turn_s: float = Field(0.5, gt=0, description="how long a landmark is attended to")
    gate: float = Field(0.2, description="similarity below which the map does not correct")
    gain: float = Field(0.2, ge=0, description="of a correction; over integrator.tau_s, its rate")
    relocalise_after_s: float = Field(
        0.5, ge=0, description="of a known landmark that contradicts, then it is believed; 0: never"
    )
    quantised: bool = Field(
        False, description="weights of 8 bits, neurons of a chip, no function outside of them"
    )


class RoomSpaceConfig(SSPSpaceConfig):
    """The space of a robot among rooms: metres in place of arm's lengths."""

    n_rotations: int = Field(5, ge=1, description="orientations of grid modules")
    n_scales: int = Field(5, ge=1, description="spacings of grid modules, for each orientation")
    length_scale_m: float | tuple[float, ...] = Field(
        1.0, description="larger: broader bumps, in all directions or each; larger spaces need it"
    )
    reach_m: float | tuple[float, ...] = Field(
        20.0, description="the robot stays in [-reach, reach] of where it starts"
    )


class RoomIntegratorConfig(PathIntegratorConfig):
    """The path integrator of a robot."""

    max_speed_m_s: float = Field(2.0, gt=0, description="faster is cut; larger: coarser rates")


class SemanticConfig(SSPSLAMConfig):
    """The semantic map of a brain: SSP-SLAM over rooms, and which landmarks it is told."""

    tier: Literal["algebraic", "rate", "spiking"] = Field(
        "algebraic", description="vectors alone; rates of neurons; spikes"
    )
    time_step_s: float = Field(0.05, gt=0, le=0.1, description="of the simulation; spikes: 0.001")
    space: RoomSpaceConfig = RoomSpaceConfig()
    integrator: RoomIntegratorConfig = RoomIntegratorConfig()
    vector_reach_m: float = Field(6.0, gt=0, description="how far object-vector cells reach")
    landmarks: tuple[Literal["given", "markers", "views"], ...] = Field(
        ("given",),
        min_length=1,
        description="given: the source's; markers: ArUco or AprilTag in its pictures; views: each "
        "known view is a landmark",
    )
    markers: str = Field(
        "4X4_50", description="dictionary of markers, as OpenCV calls them after DICT_"
    )
    marker_size_m: float = Field(0.4, gt=0, description="side of a marker's black square")
    key_features: int = Field(
        256, ge=16, description="length of a landmark's pointer; more: more landmarks told apart"
    )
    same_m: float = Field(
        1.0, gt=0, description="a landmark without a name is the known one within this distance"
    )
    sigma_m: float = Field(0.15, gt=0, description="error of a place that a landmark tells")
    heading_rate_hz: float = Field(
        0.2, ge=0, description="how fast bearings of landmarks correct an integrated heading"
    )

    @model_validator(mode="after")
    def _is_a_plane(self) -> Self:
        if self.space.dimension != 2:
            raise ValueError(f"space.dimension is {self.space.dimension}; a brain lives in 2")
        return self
