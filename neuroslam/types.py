"""The nouns that flow between the stages. SI units; x forward, y left, angles counter-clockwise."""

from typing import NamedTuple

import numpy as np

NO_TEMPLATE = -1
"""Template id of a frame that shows nothing to recognise (no image, or no contrast in it)."""

NO_EXPERIENCE = -1
"""Experience id before the first experience exists."""


class Pose(NamedTuple):
    """A place and a heading in the plane: metres, metres, radians."""

    x_m: float
    y_m: float
    theta_rad: float


class Velocity(NamedTuple):
    """Forward speed (m/s, backward negative) and turn rate (rad/s, to the left positive)."""

    v_m_s: float
    w_rad_s: float


class Motion(NamedTuple):
    """Self-motion since the previous frame: speed, turn rate, and for how many seconds."""

    v_m_s: float
    w_rad_s: float
    dt_s: float


class Frame(NamedTuple):
    """What a source delivers at one instant; ``None`` where it does not have it.

    Attributes:
        index: Number of the frame in its source, from 0.
        time_s: Time of the frame in seconds; rises strictly from frame to frame.
        image: ``uint8``, ``(h, w)`` grey or ``(h, w, 3)`` RGB.
        velocity: Measured self-motion over the interval that ends at this frame.
        ranges: Distances in metres, ``(n,)``, at bearings evenly over the full turn,
            counter-clockwise from straight ahead; ``inf`` where nothing is in reach.
        walls: Distance (m) and bearing (rad, relative to the heading) of the foot of the
            perpendicular on each wall seen, ``(n, 2)``.
        heading_rad: Heading measured by a compass, in the world.
        landmarks: Landmarks in sight, ``(n, 3)``: number (-1 where it has no name), distance in
            metres, bearing in radians relative to the heading.
        truth: True pose, where the source knows it. Never used by the brain, only by evaluation.
    """

    index: int
    time_s: float
    image: np.ndarray | None = None
    velocity: Velocity | None = None
    ranges: np.ndarray | None = None
    walls: np.ndarray | None = None
    heading_rad: float | None = None
    landmarks: np.ndarray | None = None
    truth: Pose | None = None


class ViewMatch(NamedTuple):
    """Which stored view a frame shows.

    Attributes:
        template: Id of the template, or ``NO_TEMPLATE`` if the frame shows nothing to recognise.
        error: Smallest mean absolute difference to a stored template (grey levels in [0, 1]);
            -1 where there was nothing to compare with. Of a new view among thousands it is that of
            a near template, above the threshold, not surely the nearest.
        relative_heading_rad: Heading now minus heading when the template was learnt (panoramic
            views), in (-pi, pi]; 0 for forward views.
        is_new: The template was created from this very frame.
    """

    template: int
    error: float
    relative_heading_rad: float
    is_new: bool


class PoseEstimate(NamedTuple):
    """Centre of the dominant activity packet, in cells, each from 0 to the size of its axis."""

    x: float
    y: float
    theta: float


class StepResult(NamedTuple):
    """What the brain says after one frame; but for ``lost``, the columns of ``frames.csv``."""

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
