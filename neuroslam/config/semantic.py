"""Sections of the config of a semantic map: space, neurons, path integrator, memory."""
# Sections are frozen, hence only read: a subclass may narrow the type of a field.
# pyright: reportIncompatibleVariableOverride=false

import math
from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, model_validator

from neuroslam.config.bounds import (
    LARGEST_SEED,
    MOST_AXES,
    MOST_FREQUENCIES,
    MOST_MODULES,
    MOST_NEURONS,
)
from neuroslam.config.section import Section


class SSPSpaceConfig(Section):
    """Space of the semantic pointers: the frequencies and length scale that encode positions."""

    kind: Literal["hexagonal", "random", "rectangular"] = Field(
        default="hexagonal",
        description="choice of frequencies; hexagonal: modules of grid cells; random: drawn from "
        "seed; rectangular: separate axes",
    )
    dimension: int = Field(
        default=2,
        ge=1,
        le=MOST_AXES,
        description="dimensions of the space; if not set, as many as length_scale_m or reach_m has "
        "numbers",
    )
    n_rotations: int = Field(
        default=3,
        ge=1,
        le=MOST_MODULES,
        description="orientations of the grid modules; larger: sharper similarity, more neurons",
    )
    n_scales: int = Field(
        default=3,
        ge=1,
        le=MOST_MODULES,
        description="spacings of the grid modules for each orientation; larger: fewer side lobes, "
        "more neurons",
    )
    n_random: int = Field(
        default=27,
        ge=1,
        le=MOST_FREQUENCIES,
        description="frequencies of a random space; larger: fewer side lobes, more neurons",
    )
    scale_min: float = Field(
        default=1.0,
        gt=0,
        description="lowest frequency, in rad for each length scale; larger: positions repeat at "
        "shorter distances",
    )
    scale_max: float = Field(
        default=math.pi,
        gt=0,
        description="highest frequency, in rad for each length scale; larger: sharper similarity, "
        "more side lobes",
    )
    scale_spacing: Literal["linear", "log", "random"] = Field(
        default="linear", description="spacing of the frequencies between scale_min and scale_max"
    )
    length_scale_m: float | tuple[float, ...] = Field(
        default=0.2,
        description="width of the similarity of positions, one number or one for each axis; "
        "larger: broader; a larger space needs a larger one",
    )
    reach_m: float | tuple[float, ...] = Field(
        default=1.0,
        description="positions are decoded in [-reach, reach], one number or one for each axis; "
        "larger: a larger space, slower decoding",
    )
    seed: int = Field(
        default=0, ge=0, le=LARGEST_SEED, description="seed of random frequencies and rotations"
    )

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
            raise ValueError(
                f"scale_max {self.scale_max} is below scale_min {self.scale_min}; exchange them"
            )
        for name in ("length_scale_m", "reach_m"):
            value = getattr(self, name)
            each = value if isinstance(value, tuple) else (value,)
            if len(each) not in (1, self.dimension) or min(each) <= 0:
                raise ValueError(
                    f"{name} is {value}; expected one positive number or {self.dimension} of them"
                )
        return self


class NeuronConfig(Section):
    """Model of the neurons, and the ranges from which their tuning is drawn."""

    model: Literal["lif", "stepped_lif", "lif_rate", "relu"] = Field(
        default="lif",
        description="lif: leaky integrate-and-fire, spikes; stepped_lif: the same as a "
        "neuromorphic chip computes it; lif_rate: its firing rate, no spikes; relu: rectified "
        "linear rate",
    )
    tau_rc_s: float = Field(
        default=0.02, gt=0, description="membrane time constant; larger: slower neurons"
    )
    tau_ref_s: float = Field(
        default=0.002,
        ge=0,
        description="refractory period after a spike; larger: lower largest rate",
    )
    max_rate_hz: tuple[float, float] = Field(
        default=(200.0, 400.0),
        description="range of firing rates for an input at the preferred direction; larger: less "
        "noise, more spikes",
    )
    intercept: tuple[float, float] = Field(
        default=(-1.0, 0.9),
        description="range of projections on the preferred direction above which neurons fire; "
        "larger: sparser activity",
    )
    weight_bits: int = Field(
        default=0,
        ge=0,
        le=24,
        description="bits of the neurons' weights, for which decoders are then solved; larger: "
        "finer; 0: floating point; quantised sets 8",
    )

    @model_validator(mode="after")
    def _rates_can_be_reached(self) -> Self:
        if self.weight_bits == 1:
            raise ValueError("weight_bits is 1; expected 0, or 2 to 24: one bit is the sign")
        low, high = self.max_rate_hz
        if not 0 < low <= high or high * self.tau_ref_s >= 1:
            raise ValueError(
                f"max_rate_hz is {self.max_rate_hz}; expected 0 < first <= second < 1 / tau_ref_s"
            )
        if not -1 <= self.intercept[0] <= self.intercept[1] < 1:
            raise ValueError(f"intercept is {self.intercept}; expected -1 <= first <= second < 1")
        return self


class PathIntegratorConfig(Section):
    """Velocity-controlled oscillators: one population of neurons for each frequency."""

    neurons: int = Field(
        default=800,
        ge=10,
        le=MOST_NEURONS,
        description="neurons of each oscillator; larger: less drift",
    )
    max_speed_m_s: float = Field(
        default=0.5,
        gt=0,
        description="largest speed represented; higher speeds are cut to it; larger: lower "
        "resolution of speed",
    )
    tau_s: float = Field(
        default=0.1,
        gt=0,
        description="time constant of the recurrent synapse; larger: less drift, corrections act "
        "more slowly",
    )
    input_tau_s: float = Field(
        default=0.005,
        gt=0,
        description="time constant of the synapse of corrections; larger: smoother, later",
    )
    output_tau_s: float = Field(
        default=0.005,
        gt=0,
        description="time constant of the synapse of the read-out; larger: smoother, later",
    )
    stabilise: float = Field(
        default=1.0,
        ge=0,
        description="strength of the attraction to the unit circle (Eq. 19); larger: faster "
        "return; 0: none",
    )
    amplitude_range: tuple[float, float] = Field(
        default=(0.8, 1.2),
        description="amplitudes for which the decoders are solved; from 0: the whole disc",
    )
    decoder_noise: float = Field(
        default=0.005,
        gt=0,
        description="noise for which the decoders are solved, as a share of the highest rate; "
        "larger: robuster, less exact",
    )
    coupling: Literal["none", "modules", "manifold"] = Field(
        default="manifold",
        description="how oscillators correct each other; none: not at all; modules: the phases of "
        "each module; manifold: all oscillators agree on one position",
    )
    coupling_gain: float = Field(
        default=1.0,
        ge=0,
        description="strength of that coupling (its rate is coupling_gain / tau_s); larger: phases "
        "agree sooner",
    )
    velocity_neurons: int = Field(
        default=0,
        ge=0,
        le=MOST_NEURONS,
        description="neurons that represent the velocity, in tiers of neurons; larger: less "
        "noise; 0: the exact velocity",
    )
    phase_noise_rad: float = Field(
        default=0.0,
        ge=0,
        description="algebraic tier: phase noise, in rad for a square root of a second; larger: "
        "more drift",
    )


class SemanticMapConfig(Section):
    """Associative memory from the pointers of landmarks to the pointers of their positions."""

    neurons: int = Field(
        default=550,
        ge=10,
        le=MOST_NEURONS,
        description="neurons each of memory, recall and error; larger: more landmarks, less noise",
    )
    intercept: float = Field(
        default=0.1,
        ge=-1,
        lt=1,
        description="similarity above which memory neurons fire; larger: landmarks interfere less",
    )
    relay: bool = Field(
        default=False, description="pass the recalled pointer through a population of its own"
    )
    pes_rate: float = Field(
        default=5e-3,
        ge=0,
        description="learning rate of the recalled pointer (PES); larger: faster, less stable",
    )
    voja_rate: float = Field(
        default=1e-4,
        ge=0,
        description="learning rate of the encoders towards the keys (Voja); 0: encoders are the "
        "keys from the start",
    )
    plasticity: Literal["novelty", "constant"] = Field(
        default="novelty",
        description="novelty: known landmarks are learnt more slowly; constant: all at the same "
        "rate",
    )
    least_plasticity: float = Field(
        default=0.01,
        ge=0,
        le=1,
        description="share of the learning rate that is left for known landmarks; larger: they "
        "follow changes faster",
    )
    learning_rate_s: float = Field(
        default=8.0,
        gt=0,
        description="algebraic tier: learning rate for each second in view; larger: faster, "
        "noisier",
    )


class SSPSLAMConfig(Section):
    """SSP-SLAM: path integration, a semantic map, and corrections from it."""

    tier: Literal["algebraic", "rate", "spiking"] = Field(
        default="spiking",
        description="how it is computed; algebraic: vectors, no neurons; rate: firing rates of "
        "neurons; spiking: spikes",
    )
    time_step_s: float = Field(
        default=1e-3,
        gt=0,
        le=0.1,
        description="time step of the simulation; larger: faster, less exact",
    )
    seed: int = Field(
        default=0, ge=0, le=LARGEST_SEED, description="seed of neurons, noise and pointers"
    )
    space: SSPSpaceConfig = SSPSpaceConfig()
    neurons: NeuronConfig = NeuronConfig()
    integrator: PathIntegratorConfig = PathIntegratorConfig()
    map: SemanticMapConfig = SemanticMapConfig()
    binding: Literal["exact", "neurons"] = Field(
        default="neurons",
        description="circular convolution; neurons: by populations; exact: without neurons",
    )
    binding_neurons: int = Field(
        default=50,
        ge=2,
        le=MOST_NEURONS,
        description="neurons of each product of two numbers in a binding; larger: less noise",
    )
    vector_neurons: int = Field(
        default=550,
        ge=0,
        le=MOST_NEURONS,
        description="object-vector cells, which represent the displacement to a landmark; larger: "
        "less noise; 0: the exact displacement",
    )
    vector_reach_m: float = Field(
        default=0.3,
        gt=0,
        description="largest displacement that object-vector cells represent; larger: lower "
        "resolution",
    )
    places: bool = Field(
        default=False,
        description="also learn what is at each position, so that areas can be queried",
    )
    grid_neurons: int = Field(
        default=0,
        ge=0,
        le=MOST_NEURONS,
        description="grid cells that represent the position; larger: less noise; 0: the exact "
        "pointer",
    )
    attention: Literal["sum", "nearest", "turns"] = Field(
        default="turns",
        description="of several landmarks in view; sum: all at once; nearest: the nearest one; "
        "turns: one after another",
    )
    turn_s: float = Field(
        default=0.5,
        gt=0,
        description="time for which one landmark is attended to; larger: fewer switches",
    )
    gate: float = Field(
        default=0.2,
        description="similarity of recalled and believed position below which the map does not "
        "correct; larger: fewer corrections",
    )
    gain: float = Field(
        default=0.2,
        ge=0,
        description="strength of a correction (its rate is gain / integrator.tau_s); larger: "
        "faster correction",
    )
    relocalise_after_s: float = Field(
        default=0.5,
        ge=0,
        description="time for which known landmarks must contradict the position before the animal "
        "relocalises by them; larger: later, fewer mistakes; 0: never",
    )
    sigma_distance_m: float = Field(
        default=0.0,
        ge=0,
        description="standard deviation of a landmark's measured distance, learnt with its "
        "position; larger: broader memories, which correct less; 0: exact",
    )
    sigma_bearing_rad: float = Field(
        default=0.0,
        ge=0,
        description="the same of its measured bearing; larger: far landmarks are less certain "
        "across the line of sight; 0: exact",
    )
    quantised: bool = Field(
        default=False,
        description="weights of 8 bits and neurons of a neuromorphic chip, no function outside of "
        "neurons",
    )

    @property
    def has_uncertain_sightings(self) -> bool:
        """Whether sightings of landmarks have a standard deviation."""
        return self.sigma_distance_m > 0 or self.sigma_bearing_rad > 0

    @model_validator(mode="after")
    def _uncertainty_has_one_landmark(self) -> Self:
        if self.has_uncertain_sightings and (self.attention == "sum" or self.quantised):
            what = "quantised = true" if self.quantised else "attention = 'sum'"
            raise ValueError(
                f"sigma_distance_m is {self.sigma_distance_m}, sigma_bearing_rad "
                f"{self.sigma_bearing_rad}, with {what}; expected both 0 there: several landmarks "
                "as one, or neurons alone, have no uncertainty of their own"
            )
        return self


class RoomSpaceConfig(SSPSpaceConfig):
    """The space of a robot among rooms: metres, not an arm's length."""

    n_rotations: int = Field(
        default=5,
        ge=1,
        le=MOST_MODULES,
        description="orientations of the grid modules; larger: sharper similarity, more neurons",
    )
    n_scales: int = Field(
        default=5,
        ge=1,
        le=MOST_MODULES,
        description="spacings of the grid modules for each orientation; larger: fewer side lobes, "
        "more neurons",
    )
    length_scale_m: float | tuple[float, ...] = Field(
        default=1.0,
        description="width of the similarity of positions, one number or one for each axis; "
        "larger: broader; a larger space needs a larger one",
    )
    reach_m: float | tuple[float, ...] = Field(
        default=20.0,
        description="the robot stays in [-reach, reach] of its start, one number or one for each "
        "axis; larger: a larger space, slower decoding",
    )


class RoomIntegratorConfig(PathIntegratorConfig):
    """Path integrator of a robot: higher speeds."""

    max_speed_m_s: float = Field(
        default=2.0,
        gt=0,
        description="largest speed represented; higher speeds are cut to it; larger: lower "
        "resolution of speed",
    )


class SemanticConfig(SSPSLAMConfig):
    """The semantic map of a brain: SSP-SLAM among rooms, and which landmarks it observes."""

    tier: Literal["algebraic", "rate", "spiking"] = Field(
        default="algebraic",
        description="how it is computed; algebraic: vectors, no neurons; rate: firing rates of "
        "neurons; spiking: spikes",
    )
    time_step_s: float = Field(
        default=0.05,
        gt=0,
        le=0.1,
        description="time step of the simulation; larger: faster, less exact; spiking needs 0.001",
    )
    space: RoomSpaceConfig = RoomSpaceConfig()
    integrator: RoomIntegratorConfig = RoomIntegratorConfig()
    vector_reach_m: float = Field(
        default=6.0,
        gt=0,
        description="largest displacement that object-vector cells represent; larger: lower "
        "resolution",
    )
    landmarks: tuple[Literal["given", "markers", "views"], ...] = Field(
        default=("given",),
        min_length=1,
        description="where landmarks come from; given: the source; markers: ArUco or AprilTag "
        "markers in the images; views: each matched view is a landmark",
    )
    markers: str = Field(
        default="4X4_50", description="OpenCV's name of the marker dictionary, without DICT_"
    )
    marker_size_m: float = Field(
        default=0.4,
        gt=0,
        description="side of a marker's black square; larger: the same marker in the image is "
        "farther away",
    )
    key_features: int = Field(
        default=256,
        ge=16,
        le=MOST_FREQUENCIES,
        description="length of a landmark's pointer; larger: more landmarks are distinguished",
    )
    same_m: float = Field(
        default=1.0,
        gt=0,
        description="distance within which an unnamed landmark is taken for a known one; larger: "
        "fewer landmarks, more confusions",
    )
    sigma_m: float = Field(
        default=0.15,
        gt=0,
        description="standard deviation of a position that a landmark gives; larger: landmarks "
        "correct other cells less",
    )
    heading_rate_hz: float = Field(
        default=0.2,
        ge=0,
        description="rate at which bearings of known landmarks correct an integrated heading; "
        "larger: faster, noisier",
    )

    @model_validator(mode="after")
    def _is_a_plane(self) -> Self:
        if self.space.dimension != 2:
            raise ValueError(
                f"space.dimension is {self.space.dimension}; expected 2: a brain maps a plane"
            )
        return self
