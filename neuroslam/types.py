"""Types that flow between the stages. SI units; x forward, y left, angles counter-clockwise."""

from typing import Literal, NamedTuple

import numpy as np

NO_TEMPLATE = -1
"""Template id of a frame that cannot be matched: without an image, or without contrast in it."""

NO_EXPERIENCE = -1
"""Experience id before the first experience exists."""

GreyRule = Literal["luma", "mean"]
"""How colour becomes grey, see :func:`neuroslam.sensors.grey.to_grey`."""


class Pose(NamedTuple):
    """Position and heading in the plane: metres, metres, radians."""

    x_m: float
    y_m: float
    theta_rad: float


class Velocity(NamedTuple):
    """Forward speed (m/s, negative backward) and turn rate (rad/s, positive to the left)."""

    v_m_s: float
    w_rad_s: float


class Motion(NamedTuple):
    """Self-motion since the previous frame: speed, turn rate, and duration in seconds."""

    v_m_s: float
    w_rad_s: float
    dt_s: float


class Frame(NamedTuple):
    """The sensor data of one instant; ``None`` for a sensor that has no sample.

    Attributes:
        index: Number of the frame in its source, from 0.
        time_s: Time of the frame in seconds; strictly increasing from frame to frame.
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        velocity: Measured self-motion over the interval that ends at this frame.
        ranges: Distances in metres, ``(n,)``, at bearings evenly over the full turn,
            counter-clockwise from straight ahead; ``inf`` where nothing is in range.
        walls: Distance (m) and bearing (rad, relative to the heading) of the foot of the
            perpendicular on each visible wall, ``(n, 2)``.
        heading_rad: Heading in the world, measured by a compass.
        landmarks: Visible landmarks, ``(n, 3)``: number (-1 for one without a name), distance in
            metres, bearing in radians relative to the heading.
        truth: Ground-truth pose, if known. Used by evaluation, never by the brain.
        turn_rate_rad_s: Turn rate by a gyroscope over the interval that ends at this frame,
            positive to the left; used by ``odometry.use = "fused"``.
        v_z_m_s: Measured speed upwards over the same interval as ``velocity``, whose speed is then
            the horizontal one; ``None``: the robot moves in the plane.
    """

    index: int  # type: ignore[assignment] # hides tuple.index, which nothing calls
    time_s: float
    image: np.ndarray | None = None
    velocity: Velocity | None = None
    ranges: np.ndarray | None = None
    walls: np.ndarray | None = None
    heading_rad: float | None = None
    landmarks: np.ndarray | None = None
    truth: Pose | None = None
    turn_rate_rad_s: float | None = None
    v_z_m_s: float | None = None


class ViewMatch(NamedTuple):
    """Result of comparing a frame's view with the stored templates.

    Attributes:
        template: Id of the matching template, or ``NO_TEMPLATE`` if the frame cannot be matched.
        error: Match error: smallest mean absolute difference to a template (grey in [0, 1]); -1
            without a template to compare with. For a new view among thousands of templates the
            search may stop early: the error is then above the threshold, but not always the
            smallest.
        relative_heading_rad: Present heading minus heading at which the template was learnt
            (panoramic views), in (-pi, pi]; 0 for forward views.
        is_new: Whether the template was created from this frame.
    """

    template: int
    error: float
    relative_heading_rad: float
    is_new: bool


class Revoked(NamedTuple):
    """A loop closure that later frames contradict.

    Attributes:
        source: Experience at which its link begins.
        target: Experience at which it ends.
        offset: Pose of the robot relative to ``source``, by odometry alone.
    """

    source: int
    target: int
    offset: Pose


class Tracking(NamedTuple):
    """What a sequence of views says of where on its own map the robot is.

    Attributes:
        kind: ``at`` an experience; ``link``: a loop closure to it; ``set``: found there after a
            kidnapping; ``explore``: at places that the map does not know; ``leave``: the known
            places end here; ``wait``: in doubt, nothing is learnt; ``kidnapped``: a new map has to
            begin.
        experience: Of ``at``, ``link`` and ``set``; else the one where the robot was last.
        evidence: Lead of that experience in standard deviations; 0 where it is not known.
        rival: That of the best experience in any other part of the map.
        revoked: Loop closure to undo before.
    """

    kind: Literal["at", "link", "set", "explore", "leave", "wait", "kidnapped"]
    experience: int
    evidence: float = 0.0
    rival: float = 0.0
    revoked: Revoked | None = None


class PoseEstimate(NamedTuple):
    """Centre of the dominant activity packet in cells; each coordinate in [0, size of its axis)."""

    x: float
    y: float
    theta: float


class StepResult(NamedTuple):
    """Output of the brain after one frame: the columns of ``frames.csv``, and ``lost``."""

    frame: int
    time_s: float
    motion: Motion
    view: ViewMatch
    action: str
    experience: int
    pose: Pose
    cells: PoseEstimate
    n_templates: int
    n_experiences: int
    n_links: int
    lost: bool = False
