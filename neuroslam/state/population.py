"""The protocol by which a brain is composed of populations of cells.

A frame passes through a population in this order: ``observe`` and ``check`` (nothing changes, the
frame may be refused), ``step`` (self-motion and the population's own senses), ``vetoes`` (before
the map closes a loop), ``follow`` (corrections by other populations), ``learn`` and ``recall`` (its
memory). An error after ``check`` leaves the frame half taken: the brain takes no other until a
state is loaded.
One population leads: it decides which experience of the map the robot is at.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, Self, cast

import numpy as np

from neuroslam.config import BrainConfig, Section
from neuroslam.geometry import rotate
from neuroslam.state.join import Join, MovedCells
from neuroslam.state.match import Match, Pairs
from neuroslam.state.mergeable import (
    Mergeable,
    Rule,
    State,
    merge_by_rules,
    renumbered_by_rules,
)
from neuroslam.state.renumbering import Renumbering
from neuroslam.state.tables import GrowingTable
from neuroslam.types import (
    Frame,
    Motion,
    Pose,
    PoseEstimate,
    Tracking,
    ViewMatch,
)

Action = Literal["none", "create", "link", "set"]
Observation = Any
"""What a population finds in a frame: arrays, numbers or a tuple of them; ``None``: nothing."""


Picture = np.ndarray | tuple[np.ndarray, ...]
"""Activity, ``(h, w)`` of any scale, or layers side by side; or ``uint8``, ``(h, w, 3)``."""


class StepInput(NamedTuple):
    """What every population gets of a frame.

    Attributes:
        frame: Number of the frame.
        motion: Self-motion since the last frame.
        view: View that the frame shows; template -1 where the brain has no views, or shows none.
        compass_rad: Heading by a compass; ``None``: it has none.
        vetoed: A population contradicts that the robot is where the view was learnt.
        tracking: What the sequence of views says; ``None``: each view decides by itself.
        cells_heading_rad: Heading that a population represents; ``None``: none does.
        cells_speed_m_s: Speed that a population represents, likewise.
        v_z_m_s: Measured speed upwards; that of ``motion`` is then horizontal. 0 in the plane.
    """

    frame: int
    motion: Motion
    view: ViewMatch
    compass_rad: float | None = None
    vetoed: bool = False
    tracking: Tracking | None = None
    cells_heading_rad: float | None = None
    cells_speed_m_s: float | None = None
    v_z_m_s: float = 0.0


class Correction(NamedTuple):
    r"""By how much a population corrects where the robot is believed to be.

    Every population may keep a frame of its own: a follower whose heading is :math:`\theta_f` moves
    by :math:`R(\theta_f - \theta_a)\,d`, with :math:`\theta_a` the author's heading.

    Attributes:
        dx_m: Displacement :math:`d` along x in the author's frame.
        dy_m: And along y.
        turn_rad: Turn of the heading, counter-clockwise.
        heading_rad: Heading of the robot in the author's frame, :math:`\theta_a`.
        position_m: Where the robot is in the leader's frame, where that is known absolutely.
        sigma_m: Standard deviation of that position.
        variance_m2: Variance of the robot's position when the author learnt what it recalls.
        relocalises: The robot was kidnapped or lost: followers go there at once.
    """

    dx_m: float = 0.0
    dy_m: float = 0.0
    turn_rad: float = 0.0
    heading_rad: float = 0.0
    position_m: tuple[float, float] | None = None
    sigma_m: float = 0.0
    variance_m2: float = 0.0
    relocalises: bool = False

    def displacement(self, heading_rad: float) -> tuple[float, float]:
        """Return the displacement in the frame of a follower that has this heading.

        Example:
            >>> east = Correction(dx_m=0.1, heading_rad=0.0)
            >>> [round(x, 9) for x in east.displacement(np.pi / 2)]  # its own frame is turned
            [0.0, 0.1]
        """
        return rotate(self.dx_m, self.dy_m, heading_rad - self.heading_rad)

    @property
    def moves(self) -> bool:
        """Whether it displaces or turns at all."""
        return bool(self.dx_m or self.dy_m or self.turn_rad)

    @property
    def is_nothing(self) -> bool:
        """Whether no one has to follow."""
        return not self.moves and self.position_m is None and not self.relocalises


def total(corrections: Sequence[Correction]) -> Correction:
    """Add corrections of one instant, at least one.

    Turns add; displacements do in the frame of the first that moves; the first absolute position
    counts.

    Example:
        >>> total([Correction(turn_rad=0.1), Correction(0.2, 0.0, 0.1, heading_rad=1.0)])[:4]
        (0.2, 0.0, 0.2, 1.0)
    """
    if len(corrections) == 1:
        return corrections[0]
    moving = [c for c in corrections if c.dx_m or c.dy_m] or corrections[:1]
    heading, dx, dy, turn = moving[0].heading_rad, moving[0].dx_m, moving[0].dy_m, 0.0
    for more in moving[1:]:
        x, y = more.displacement(heading)
        dx, dy = dx + x, dy + y
    for correction in corrections:
        turn += correction.turn_rad
    absolute = next((c for c in corrections if c.position_m is not None), moving[0])
    relocalises = any(c.relocalises for c in corrections)
    return absolute._replace(
        dx_m=dx, dy_m=dy, turn_rad=turn, heading_rad=heading, relocalises=relocalises
    )


class Belief(NamedTuple):
    """Where the leading population believes the robot to be.

    Attributes:
        pose: Of the robot.
        variance_m2: Mean variance of x and y.
        experience: That the robot is at, on a map that relaxes; -1: there is none.
        poses: Of all experiences of such a map, ``(n, 3)``.
    """

    pose: Pose
    variance_m2: float = 0.0
    experience: int = -1
    poses: np.ndarray = np.empty((0, 3))

    @property
    def at(self) -> np.ndarray:
        """Pose of the experience that the robot is at, ``(3,)``."""
        pose: np.ndarray = self.poses[self.experience]
        return pose


class Decision(NamedTuple):
    """What the leader does on the map in a frame.

    Attributes:
        action: ``none``, ``create``, ``link`` or ``set``.
        experience: That the robot is at then, -1 before the first.
    """

    action: Action
    experience: int


class Population(Mergeable):
    """A population of cells that takes part in a brain; a subclass overrides what it needs.

    Class attributes say what a brain has to know without knowing the population by name.

    Attributes:
        kind: Name in ``cells`` of the config; :func:`~neuroslam.state.registry.register` sets it.
        name: Attribute of the brain, and prefix of the population's part of the state; the kind, if
            not given.
        config_section: Its parameters: table ``[kind]`` of the config.
        merge_sections: Sections that must be equal in two brains that merge.
        merge_rules: What becomes of a tensor of the state in a merge, by name or by the first part
            of it; see :mod:`~neuroslam.state.mergeable`.
        rank: Of the populations in a brain, the one of highest rank leads; 0: it cannot.
        relaxes_map: As leader it decides by views before corrections, on a map that integrates
            odometry and relaxes; else by position after them, on a map that shows its own cells.
        needs_views: The brain makes views of its pictures.
        compass: ``uses`` the compass; ``corrects``: tells the others what it says, too.
        rate_units: Unit of the activity that is recorded under a name; "1" where none is given.
    """

    kind: ClassVar[str] = ""
    name: ClassVar[str] = ""
    config_section: ClassVar[type[Section] | None] = None
    merge_sections: ClassVar[tuple[str, ...]] = ()
    merge_rules: ClassVar[Mapping[str, Rule]] = {}
    rank: ClassVar[int] = 0
    relaxes_map: ClassVar[bool] = False
    needs_views: ClassVar[bool] = False
    compass: ClassVar[Literal["ignores", "uses", "corrects"]] = "ignores"
    rate_units: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def build(cls, config: BrainConfig, leader: "type[Population]") -> Self:
        """Make the population of a brain.

        Args:
            config: Of the brain.
            leader: Class of the population that leads it.
        """
        make = cast(Callable[..., Self], cls)  # a subclass takes its section of the config
        return make(config.section(cls.kind)) if cls.config_section else make()

    def continue_from(self, before: "Population") -> None:
        """Take over from the population of the map before what a new map of the run shares.

        Args:
            before: The population of the same kind, when a brain begins a new map.
        """

    # --- a frame -------------------------------------------------------------------------------

    def observe(self, frame: Frame) -> Observation | None:
        """Find in a frame what the population senses; a pure function.

        Raises:
            BadFrame: If the frame holds what cannot be.
        """

    def check(self, now: StepInput, observation: Observation, belief: Belief | None) -> None:
        """Refuse a frame that the population cannot take; nothing has changed yet.

        Raises:
            BadFrame, MapError: If so.
        """

    def step(self, now: StepInput, observation: Observation) -> Correction | None:
        """Advance by self-motion and the population's own senses; return what those corrected."""

    def inform(self, now: StepInput) -> StepInput:
        """Add the self-motion that the population represents, for the steps of the others.

        A population that overrides this steps before those that do not.
        """
        return now

    def excludes(self) -> np.ndarray | None:
        """Return at which experiences the robot cannot be, ``bool (n,)``; ``None``: at any.

        Their views do not match: storeys that look alike are distinguished by it.
        """

    def vetoes(self, view: ViewMatch) -> bool:
        """Tell whether the robot cannot be where a view was learnt."""
        return False

    def weigh(
        self,
        errors: np.ndarray,
        map_: "LeadableMap",
        motion: Motion,
        tracks: bool,
        alarm: bool,
    ) -> None:
        """Weigh where on the robot's own map it is; a population that overrides this votes.

        It is asked in every frame with a view, before loops are closed by sequences of views, which
        the brain then does whatever ``map.closure`` is.

        Args:
            errors: Match error of the frame with the view of every experience, ``(n,)``.
            map_: The map.
            motion: Since the last frame.
            tracks: Whether the robot is believed on known ground.
            alarm: Whether the view changed too abruptly for driving.
        """

    def supports(self, experience: int) -> bool:
        """Vote on whether the robot is at an experience; -1: on ground that is not mapped."""
        return True

    def reaches(self, experience: int) -> bool:
        """Vote on whether it can have driven there: else it was kidnapped, and no link is made."""
        return True

    def proposes(self) -> int | None:
        """Return the experience that the robot is at for sure.

        Returns:
            Its id; -1: the robot is on ground that is not mapped; ``None``: it is not sure.
        """

    def splits(self, map_: "LeadableMap") -> bool:
        """Vote for an experience on unknown ground although the view did not change."""
        return False

    def follow(self, correction: Correction) -> None:
        """Follow what another population has corrected."""

    def learn(self, now: StepInput, observation: Observation) -> None:
        """Bind what is seen to the population's own position."""

    def recall(
        self, now: StepInput, observation: Observation, belief: Belief | None
    ) -> Correction | None:
        """Correct the robot's pose from memory.

        Args:
            now: The frame.
            observation: What :meth:`observe` found in it.
            belief: Of the leader; ``None`` for the leader itself.
        """

    # --- leading -------------------------------------------------------------------------------

    def decide(self, map_: "LeadableMap", now: StepInput) -> Decision:
        """Create, link or set an experience of the map; of a leader only."""
        raise NotImplementedError(f"{type(self).__name__} cannot lead")

    def belief(self, map_: "LeadableMap") -> Belief:
        """Return where the population believes the robot to be; of a leader only."""
        raise NotImplementedError(f"{type(self).__name__} cannot lead")

    @property
    def estimate(self) -> Any:  # noqa: ANN401 - of a batch it is a tensor
        """Where the cells have the robot: columns ``pose_x``, ``pose_y``, ``pose_theta``."""
        raise NotImplementedError(f"{type(self).__name__} cannot lead")

    @property
    def lost(self) -> bool:
        """Whether its senses contradict what it knows of the place."""
        return False

    # --- questions of other parts ----------------------------------------------------------------

    @property
    def rates(self) -> np.ndarray | None:
        """Activity of the cells in a fixed order, ``(n_cells,)``; ``None``: nothing to record."""
        return None

    def recorded(self) -> Mapping[str, np.ndarray]:
        """Return the activity to record by name, each ``(n_cells,)``, in a fixed order.

        Cells that are recruited are appended. The default is :attr:`rates` under the kind; a
        population that holds several kinds of cells names each. The arrays are copied at once.
        """
        rates = self.rates
        return {} if rates is None else {self.kind: rates}

    def record_into(
        self, buffers: Mapping[str, np.ndarray], widths: dict[str, int], row: int
    ) -> bool:
        """Write what :meth:`recorded` returns into a row of the buffers, where that is faster.

        Args:
            buffers: Tables by recorded name, ``(rows, n)`` float32, as wide as they were so far.
            widths: Number of cells by recorded name, to raise where cells were recruited.
            row: Of the tables; its columns are 0.

        Returns:
            Whether all was written; if not, :meth:`recorded` is asked.
        """
        return False

    def rates_at(
        self, position_m: np.ndarray, heading_rad: np.ndarray, speed_m_s: np.ndarray
    ) -> Mapping[str, np.ndarray]:
        """Compute the activity by recorded name at some poses, with the cells as they are now.

        Figures of a run that recorded no activity use it; nothing changes.

        Args:
            position_m: In the frame of the cells, ``(t, 2)``.
            heading_rad: Likewise, ``(t,)``.
            speed_m_s: Speed at each pose, ``(t,)``.

        Returns:
            Each ``(t, n_cells)``; nothing where that cannot be computed.
        """
        return {}

    def cell_properties(self) -> Mapping[str, Mapping[str, np.ndarray]]:
        """Return what each recorded cell is tuned to: columns ``(n_cells,)`` by recorded name.

        The name of a column ends with its unit, as ``preferred_rad``.
        """
        return {}

    def counts(self) -> dict[str, float]:
        """Return what was learnt, in numbers: ``metrics.json``, ``inspect``, reports of merges."""
        return {}

    def scalars(self) -> dict[str, float]:
        """Return curves of TensorBoard: a value now for each tag."""
        return {}

    def images(self) -> dict[str, Picture]:
        """Return pictures of TensorBoard, plots and the report, by tag."""
        return {}

    def tables(self) -> dict[str, str]:
        """Return CSV files of a run's folder by name; the first line has the columns."""
        return {}

    def frame_columns(self) -> dict[str, float]:
        """Return further columns of ``frames.csv`` with their values now, the same names always."""
        return {}

    def experience_columns(self) -> dict[str, np.ndarray]:
        """Return further columns of ``experiences.csv``, each ``(n_experiences,)``."""
        return {}

    def points_m(self) -> np.ndarray | None:
        """Return points to draw on the map, ``(n, 2)``."""
        return None

    @classmethod
    def faults(
        cls, state: Mapping[str, np.ndarray], config: BrainConfig, n_views: int, n_experiences: int
    ) -> Iterator[str]:
        """Say what makes no sense in a state of the population, whose shapes fit the config."""
        return iter(())

    # --- merging -------------------------------------------------------------------------------

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Merge two states by :attr:`merge_rules`; a population with other needs overrides this."""
        return merge_by_rules(self.merge_rules, loaded, partial, join)

    def contradicts(self, loaded: State, partial: State, pairs: Pairs) -> str:
        """Say why two sessions cannot merge by these pairs; empty if nothing is against it.

        Args:
            loaded: State of the population in the map that would be merged into.
            partial: State of it in the session that goes on.
            pairs: Experiences of both that look the same.
        """
        return ""

    def renumber(self, change: Renumbering) -> None:
        """Follow a map that forgets, by :attr:`merge_rules`; one with other needs overrides this.

        Raises:
            MapError: If a rule is not of :mod:`~neuroslam.state.mergeable`.
        """
        state = self.state_dict()
        changed = renumbered_by_rules(self.merge_rules, state, change)
        if changed:
            self.load_state_dict(state | changed)

    def frames(self, loaded: State, partial: State, join: Join) -> tuple[Pose, Pose] | None:
        """Say how the frames lie in which two sessions keep positions, where it is not the map's.

        Returns:
            A pose in the partial session's frame, and the same in the loaded one's.
        """

    def moved_cells(
        self, loaded: State, partial: State, match: Match, config: BrainConfig
    ) -> MovedCells | None:
        """Move what experiences and views are bound to, given the states of two whole brains."""

    def match(
        self, loaded: "Population", maps: tuple[np.ndarray, np.ndarray], config: BrainConfig
    ) -> tuple[Match | None, str]:
        """Find where the maps of two sessions meet, where this population leads without views.

        Args:
            loaded: The population of the other brain.
            maps: Poses of the experiences of the loaded map and of this one, ``(n, 3)``.
            config: Of both.

        Returns:
            Where they meet, or ``None``; and how that was found, or why not, for a reader.
        """
        return None, f"{self.kind} has no way to find where two maps meet"


class LeadableMap(Protocol):
    """What a leader uses of :class:`~neuroslam.mapping.experience.ExperienceMap`.

    Attributes:
        links_table: Its links: ``source``, ``target``, ``distance_m``, ``facing_rad``.
    """

    links_table: GrowingTable

    @property
    def n(self) -> int:
        """Number of experiences."""
        ...

    @property
    def current(self) -> int:
        """Id of the experience the robot is at, -1 before the first."""
        ...

    @property
    def pose(self) -> Pose:
        """Pose of the robot."""
        ...

    @property
    def pose_table(self) -> np.ndarray:
        """Poses of all experiences, ``(n, 3)``, to read only."""
        ...

    def visit(
        self, place: int, pose: Pose, elapsed_s: float, frame: int, at: Pose | None = None
    ) -> tuple[Action, int]:
        """Go to an experience by position."""
        ...

    def __call__(
        self,
        motion: Motion,
        view: ViewMatch,
        cells: PoseEstimate,
        frame: int,
        *,
        kidnapped: bool,
        tracking: Tracking | None,
    ) -> tuple[Action, int]:
        """Integrate odometry, and go to an experience by view."""
        ...
