"""Draws docs/img/sign_conventions.png: a turn to the left, from above and through the camera."""

from pathlib import Path

import cv2
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Arc, FancyArrowPatch, Polygon, Wedge

from neuroslam.config import OdometryConfig
from neuroslam.odometry.visual import match_profiles, motion_from_match, profile

FOV_DEG = 90.0
TURN_DEG = 15.0
WIDTH, HEIGHT = 240, 90
THINGS = (("door", 26.0, 9.0, "#c0392b"), ("window", -4.0, 12.0, "#2e86c1"))
THINGS += (("shelf", -27.0, 8.0, "#1e8449"),)


def through_camera(heading_deg: float) -> np.ndarray:
    """Draw what a camera sees that looks along a heading, RGB; its columns are angles."""
    image = np.full((HEIGHT, WIDTH, 3), 238, np.uint8)
    image[HEIGHT * 2 // 3 :] = 205
    per_deg = WIDTH / FOV_DEG
    for _, bearing, width, colour in THINGS:
        middle = WIDTH / 2 - (bearing - heading_deg) * per_deg
        left, right = (round(middle + side * width * per_deg / 2) for side in (-1, 1))
        rgb = tuple(int(colour[i : i + 2], 16) for i in (1, 3, 5))
        cv2.rectangle(image, (left, 18), (right, HEIGHT * 2 // 3 + 6), rgb, -1)
    return image


def draw_from_above(axes: Axes) -> None:
    """Show the axes of the world, the robot before and after the turn, and what it looks at."""
    for name, bearing, width, colour in THINGS:
        axes.add_patch(
            Wedge((0, 0), 3.1, bearing - width / 2, bearing + width / 2, width=0.22, color=colour)
        )
        at = 3.45 * np.exp(1j * np.radians(bearing))
        axes.text(at.real, at.imag, name, color=colour, ha="left", va="center")
    for heading, colour, label in ((0.0, "0.65", "before"), (TURN_DEG, "black", "after")):
        turn = np.exp(1j * np.radians(heading))
        corners = np.array([0.5, -0.3 + 0.28j, -0.3 - 0.28j]) * turn
        axes.add_patch(
            Polygon(np.column_stack([corners.real, corners.imag]), fc="none", ec=colour, lw=1.6)
        )
        tip = 2.7 * turn
        axes.plot([0.5 * turn.real, tip.real], [0.5 * turn.imag, tip.imag], ":", color=colour)
        axes.text(1.25 * turn.real, 1.25 * turn.imag + 0.1, label, color=colour, rotation=heading)
    axes.add_patch(Arc((0, 0), 4.6, 4.6, theta1=0, theta2=TURN_DEG, color="black", lw=1.6))
    end = 2.3 * np.exp(1j * np.radians(TURN_DEG))
    axes.add_patch(
        FancyArrowPatch(
            (end.real + 0.02, end.imag - 0.1),
            (end.real, end.imag),
            arrowstyle="->",
            mutation_scale=14,
        )
    )
    axes.text(1.52, 0.78, r"$\omega > 0$", fontsize=12)
    for tip, name in (((1.3, -2.0), "x forward"), ((0.0, -0.7), "y left")):
        axes.annotate("", tip, (0, -2.0), arrowprops={"arrowstyle": "->", "lw": 1.4})
        axes.text(tip[0] + 0.1, tip[1] - 0.05, name)
    axes.set(
        xlim=(-0.8, 4.6), ylim=(-2.3, 2.3), xlabel="x (m)", ylabel="y (m)", aspect="equal",
        title="From above: the robot turns left",
    )  # fmt: skip


def draw(path: Path) -> None:
    """Draw the whole figure into a file."""
    figure, axes = plt.subplot_mosaic(
        [["above", "before"], ["above", "after"], ["above", "profiles"]],
        figsize=(11, 5.6), width_ratios=(1.05, 1), layout="constrained",
    )  # fmt: skip
    draw_from_above(axes["above"])
    before, after = through_camera(0.0), through_camera(TURN_DEG)
    region = (0, WIDTH, 0, HEIGHT // 2)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (before, after)]
    profiles = [profile(image, region) for image in grey]
    shift, difference = match_profiles(profiles[1], profiles[0], 80)
    velocity = motion_from_match(shift, difference, WIDTH, 1.0, OdometryConfig(fov_deg=FOV_DEG))
    for name, image in (("before", before), ("after", after)):
        axes[name].imshow(image, aspect="auto")
        axes[name].set(xticks=[], yticks=[], title=f"Through the camera: {name}")
    per_deg = WIDTH / FOV_DEG
    start = WIDTH / 2 + 4.0 * per_deg
    axes["after"].annotate(
        "", (start + TURN_DEG * per_deg, 10), (start, 10), arrowprops={"arrowstyle": "->", "lw": 2}
    )
    axes["after"].text(start - 4, 10, "the picture moves right", ha="right", va="center")
    axes["profiles"].plot(profiles[0], color="0.65", label="before")
    axes["profiles"].plot(profiles[1], color="black", label="after")
    axes["profiles"].set(
        xlim=(-0.5, WIDTH - 0.5), ylim=(0.4, 1.0), xlabel="column (px)",
        ylabel="mean grey (0 to 1)",
        title=f"Best match: s = {shift:+d} px, so a turn of {np.degrees(velocity.w_rad_s):+.1f}°",
    )  # fmt: skip
    axes["profiles"].legend(loc="lower right", frameon=False, ncols=2)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(__file__).parent / "img" / "sign_conventions.png")
