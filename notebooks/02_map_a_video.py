# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a video to a map
# A robot drives two laps of an office corridor. Its odometry drifts; its camera sees doors, posters
# and plants. RatSLAM combines both in one map. The corridor is rendered here, so the ground truth is known
# and nothing has to be downloaded; the last cell maps your own video.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.figures.maps import (
    contact_sheet,
    plot_frame_and_template,
    plot_map,
    plot_pose_cells,
    plot_signals,
)
from neuroslam.figures.style import (
    INK,
    LOOP,
    MAP,
    ODOMETRY,
    ROBOT,
    STYLE,
    legend_below,
    write_title,
)
from neuroslam.geometry import integrate_velocities
from neuroslam.types import Pose

torch.set_num_threads(1)
plt.rcParams.update(STYLE | {"figure.constrained_layout.use": True, "figure.dpi": 100})
source = open_source("world:corridor?laps=2&noise=0.05")
frames = list(source.frames())
lap = source.frames_per_lap
print(f"{len(frames)} frames of {frames[0].image.shape}, {frames[-1].time_s:.0f} s, {lap} a lap")

same = sum(np.array_equal(frames[i].image, frames[i + lap].image) for i in range(len(frames) - lap))
print(f"{same} of the {len(frames) - lap} images of the second lap are equal to those of the first")

# %% [markdown]
# Only odometry is noisy here. The second lap shows the images of the first again, pixel by pixel: the
# easiest case of view matching. A drive with changing light and passers-by follows below.
#
# **What to see:** on the left the first lap; on the right the same places, a lap later.

# %%
shown = [i + later for i in (20, 130, 240) for later in (0, lap)]
contact_sheet([frames[i].image for i in shown], [f"frame {i}" for i in shown])

# %% [markdown]
# ## Frame by frame
# `brain(frame)` does everything: odometry, view cells, pose cells, map. Each result holds the view match
# and the action on the map: `none`, `create` an experience, or `link` to a known one. The loop also
# stores what is drawn below.

# %%
brain = NavigationBrain(BrainConfig())
results, offsets, corrections, maps = [], [], [], []
for frame in frames[:400]:
    results.append(brain(frame))
    offsets.append(brain.map.offset)
    corrections.append(brain.map.largest_correction)
    maps.append((brain.map.poses, brain.map.links, brain.map.pose))
closed = next(r.frame for r in results if r.action == "link")
print(f"frame {closed}: loop closed at experience {results[closed].experience}")
print(f"{brain.view.n} templates, {brain.map.n} experiences, {brain.map.n_links} links")
results[closed]

# %% [markdown]
# A template is 600 bytes: grey, downsampled, normalised. **What to see:** the frame, and the matching
# template of the first lap.

# %%
last = results[-1]
plot_frame_and_template(
    frames[399].image,
    brain.view.template_image(last.view.template),
    last.view.error,
    last.view.template,
)

# %% [markdown]
# How different are views? **What to see:** every tenth frame of both laps against every other: dark
# along the diagonal is a frame and itself; the dark line a lap away is the corridor seen again.
# Both are exactly 0, as the images are equal.

# %%
every = range(0, len(frames), 10)
views = np.stack([brain.view.encode(frames[i].image) for i in every])
difference = np.abs(views[:, None] - views[None]).mean(axis=(2, 3))
figure, axes = plt.subplots(figsize=(5.8, 4.8))
edges = (-5, every[-1] + 5, every[-1] + 5, -5)
drawn = axes.imshow(difference, "magma", extent=edges, vmin=0, vmax=0.2)
axes.annotate(
    "a lap later", (230, lap + 235), (70, 500), bbox={"fc": "white", "ec": "none"},
    arrowprops={"arrowstyle": "->", "color": "white", "lw": 2},
)  # fmt: skip
axes.grid(visible=False)
axes.set(xlabel="frame", ylabel="frame", title="Match error between views")
figure.colorbar(drawn, label="mean absolute difference (grey, 0 to 1)", extend="max")
plt.show()

# %% [markdown]
# **What to see:** the activity of the pose cells is one compact packet: the pose estimate is unambiguous.

# %%
plot_pose_cells(brain.pose_cells.activity.numpy(), brain.pose_cells.estimate)

# %% [markdown]
# ## The map grows
# **What to see:** after 150 frames half a rectangle; just before the lap is complete, the
# error of odometry leaves it open; at frame 399 it is closed, and the second lap follows the experiences
# of the first, while odometry alone (grey) drifts away from them.

# %%
odometry = integrate_velocities(
    *np.array([r.motion for r in results]).T, start=Pose(0.0, 0.0, np.pi / 2)
)


def draw_links(panel, poses, links, **style):
    ends = np.stack([links.source, links.target], axis=1)
    panel.plot(*poses[ends, :2].transpose(2, 1, 0), **style)


figure, panels = plt.subplots(1, 3, figsize=(10.5, 5.4), sharex=True, sharey=True)
for panel, index in zip(panels, (150, closed - 1, 399), strict=True):
    poses, links, pose = maps[index]
    panel.plot(*odometry[: index + 1, :2].T, color=ODOMETRY, lw=1)
    draw_links(panel, poses, links, color=MAP, lw=2)
    panel.plot(*pose[:2], "o", ms=9, color=ROBOT, mec=INK)
    panel.set(xlabel="x (m)", aspect="equal")
    write_title(panel, f"Frame {index}", f"{len(poses)} experiences")
panels[0].set_ylabel("y (m)")
handles = (
    panels[1].plot([], [], color=colour, label=name, **style)[0]
    for colour, name, style in (
        (MAP, "map", {"lw": 2}),
        (ODOMETRY, "odometry alone", {"lw": 1}),
        (ROBOT, "robot now", {"ls": "none", "marker": "o", "mec": INK}),
    )
)
figure.legend(handles=list(handles), loc="outside lower center", ncols=3)
plt.show()

# %% [markdown]
# ## A loop closes, the map relaxes
# The new link states that two experiences are next to each other; on the map they are not. Relaxation
# distributes the residual over all links, twenty loops per frame, until the map is at rest.
#
# **What to see:** left, the link (orange) spans a gap; sixty frames later the gap is gone, and every
# experience has moved a little from its old position (grey). Right, the corrections decay.

# %%
before, after = maps[closed - 1][0], maps[-1][0]
ends = [results[closed - 1].experience, results[closed].experience]
figure, panels = plt.subplots(1, 3, figsize=(11.5, 5.2))
for panel, poses, title in zip(
    panels, (before, after), (f"Frame {closed - 1}", "Frame 399"), strict=False
):
    draw_links(panel, before, maps[closed - 1][1], color=ODOMETRY, lw=1)
    panel.plot([], color=ODOMETRY, lw=1, label=f"frame {closed - 1}")
    panel.plot(*poses[:, :2].T, ".", ms=4, color=MAP, label="experiences")
    panel.plot(*poses[ends, :2].T, "o-", ms=5, lw=2.5, color=LOOP, label="the new link")
    panel.set(xlabel="x (m)", aspect="equal", xlim=(-8, 3), ylim=(-7, 7))
    spans = np.hypot(*np.diff(poses[ends, :2], axis=0)[0])
    write_title(panel, title, f"link spans {spans:.2f} m")
panels[1].legend(loc="center")
panels[0].set_ylabel("y (m)")
panels[2].semilogy(range(closed, 400), corrections[closed:], ".-", color=MAP)
panels[2].set(xlabel="frame", ylabel="largest correction (m or rad)", box_aspect=14 / 11)
panels[2].set_title("Largest correction until rest")
plt.show()

# %% [markdown]
# ## Save, load, continue
# One file holds the whole brain. The loaded brain continues bit for bit like one that never stopped.

# %%
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "corridor.safetensors"
    save_brain(brain, file)
    print(f"{file.stat().st_size / 1024:.0f} kB")
    loaded = load_brain(file)
print("the same at the next frame:", loaded(frames[400]) == (here := brain(frames[400])))
results.append(here)
offsets.append(brain.map.offset)
for frame in frames[401:]:
    results.append(brain(frame))
    offsets.append(brain.map.offset)
print(f"{brain.view.n} templates, {brain.map.n} experiences: the second lap was known")

# %% [markdown]
# **What to see:** new views (orange) come in the first lap only; then memory stays as it is.

# %%
table = {
    "time_s": np.array([r.time_s for r in results]),
    "match_error": np.array([r.view.error for r in results]),
    "n_templates": np.array([r.n_templates for r in results]),
    "n_experiences": np.array([r.n_experiences for r in results]),
    "n_links": np.array([r.n_links for r in results]),
}
plot_signals(table, brain.config.view.threshold)

# %% [markdown]
# ## How good is it?
# Every frame keeps its offset from its experience, so the trajectory moves with the map. The absolute
# trajectory error (ATE) is the RMSE after the trajectory was aligned with the truth.
#
# **What to see:** left, odometry alone; right, the map on the truth (dashed), between the walls.

# %%
track = np.array([brain.place(r.experience, at) for r, at in zip(results, offsets, strict=True)])
truth = np.array([frame.truth for frame in frames])
odometry = integrate_velocities(
    *np.array([r.motion for r in results]).T, start=Pose(0.0, 0.0, np.pi / 2)
)
for mode in ("similarity", "rigid"):
    odometry_error, map_error = (
        absolute_trajectory_error(found[:, :2], truth[:, :2], mode).rmse
        for found in (odometry, track)
    )
    print(f"{mode}: odometry {odometry_error:.2f} m, map {map_error:.2f} m (ATE, RMSE)")
links = brain.map.links
plot_map(
    brain.map.poses,
    np.stack([links.source, links.target], axis=1),
    odometry_xy=odometry[:, :2],
    track_xy=track[:, :2],
    truth_xy=truth[:, :2],
    walls=source.world.segments,
    current=brain.map.pose,
)

# %% [markdown]
# Without scaling (rigid) the error is larger: the scale comes from odometry, and loop closures cannot
# correct it. The figure scales truth and walls, and states the factor.
#
# ## A harder drive
# The same two laps, but the light changes and four people walk about.
#
# **What to see:** people occlude known views, so there are more experiences, and the map bends a little
# more; its loops still close. This is one drive, not a benchmark.

# %%
harder = open_source("world:corridor?laps=2&noise=0.05&light=0.3&people=4")
other, steps = NavigationBrain(BrainConfig()), []
for frame in harder.frames():
    steps.append((other(frame), other.map.offset))
again = np.array([other.place(r.experience, at) for r, at in steps])
error = absolute_trajectory_error(again[:, :2], truth[:, :2], "rigid").rmse
late = sum(r.view.is_new for r, _ in steps[lap + 1 :])
print(f"{other.view.n} templates ({late} of them new in the second lap), {other.map.n} experiences")
print(f"rigid: odometry {odometry_error:.2f} m, map {error:.2f} m (ATE, RMSE)")
links = other.map.links
plot_map(
    other.map.poses,
    np.stack([links.source, links.target], axis=1),
    track_xy=again[:, :2],
    truth_xy=truth[:, :2],
    walls=harder.world.segments,
    current=other.map.pose,
)

# %% [markdown]
# ## Use the map
# Links store durations, so the fastest path to an experience is a shortest path in the graph.
#
# **What to see:** the path (orange) from the robot to an experience a third of the lap away.

# %%
goal = brain.map.n // 3
plan = brain.map.plan(goal)
distance, bearing = brain.map.distance_and_bearing(goal)
print(f"experience {goal} is {distance:.1f} m away, at {np.degrees(bearing):.0f}° to the left")
xy = brain.map.poses[:, :2]
figure, axes = plt.subplots(figsize=(5.2, 6.4))
axes.plot(*xy.T, ".", color=MAP, label="experiences")
axes.plot(*xy[plan.path].T, color=LOOP, lw=4, alpha=0.7, label="fastest path")
axes.plot(*xy[goal], "*", ms=15, ls="none", color=ROBOT, mec=INK, label="goal")
axes.plot(*brain.map.pose[:2], "o", ms=9, ls="none", color="white", mec=INK, label="robot")
axes.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
write_title(axes, f"To experience {goal}", f"{len(plan.path)} experiences, {plan.duration_s:.0f} s")
legend_below(axes, columns=4)
plt.show()

# %% [markdown]
# ## Your own video
# ```python
# from neuroslam import run
# summary = run("drive.mp4", "out")            # map.png, CSVs, the brain, TensorBoard events
# print(summary.counts)
# ```
# or `neuroslam run drive.mp4 -o out`. If too many or too few views match, change
# `view.threshold`; [docs/parameters.md](../docs/parameters.md) has them all.
