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
# and plants. RatSLAM makes one map of both. The corridor is rendered here, so the truth is known and
# nothing has to be downloaded; your own video goes the same way (last cell).

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.evaluation.trajectory import absolute_trajectory_error
from neuroslam.geometry import integrate_velocities
from neuroslam.mapping.experience import closes_loop
from neuroslam.plotting import (
    contact_sheet,
    plot_frame_and_template,
    plot_map,
    plot_pose_cells,
    plot_signals,
)
from neuroslam.types import Pose

torch.set_num_threads(1)
source = open_source("world:corridor?laps=2&noise=0.05")
frames = list(source.frames())
print(f"{len(frames)} frames of {frames[0].image.shape}, {frames[-1].time_s:.0f} s")

# %% [markdown]
# **What to see:** the first lap above, the same places 340 frames later below.

# %%
shown = [20, 130, 240, 360, 470, 580]
contact_sheet([frames[i].image for i in shown], [f"frame {i}" for i in shown])

# %% [markdown]
# ## Frame by frame
# `brain(frame)` is the whole of it: odometry, view cells, pose cells, map. Each result says what was
# recognised and what was done about it: `none`, `create` a place, or `link` back to a known one.

# %%
brain = NavigationBrain(BrainConfig())
results, offsets, moments = [], [], {}
for frame in frames[:400]:
    results.append(brain(frame))
    offsets.append(brain.map.offset)
    if frame.index in (150, 335, 399):
        moments[frame.index] = (brain.map.poses, brain.map.links, brain.map.pose)
links = [r for r in results if r.action == "link"]
print(f"{brain.view.n} views, {brain.map.n} places, {brain.map.n_links} links")
print(f"first back at a known place: frame {links[0].frame}, place {links[0].experience}")

# %% [markdown]
# A view is a few hundred bytes: grey, cropped, shrunk, normalised. **What to see:** the frame, and
# the template of the first lap that it was recognised as.

# %%
last = results[-1]
plot_frame_and_template(
    frames[399].image,
    brain.view.template_image(last.view.template),
    last.view.error,
    last.view.template,
)

# %% [markdown]
# How different are views? **What to see:** dark beside the diagonal are neighbours in time; the dark
# line a lap away is the corridor seen again, up to the last frame that we have driven so far.

# %%
every = range(0, len(frames), 8)
views = np.stack([brain.view.encode(frames[i].image) for i in every])
difference = np.abs(views[:, None] - views[None]).mean(axis=(2, 3))
figure, axes = plt.subplots(figsize=(5.6, 4.6), layout="constrained")
drawn = axes.imshow(difference, cmap="magma", extent=(0, len(frames), len(frames), 0), vmax=0.25)
axes.set(xlabel="frame", ylabel="frame", title="Difference of views")
figure.colorbar(drawn, label="mean absolute difference (grey levels, 0 to 1)")
plt.show()

# %% [markdown]
# ## The map grows, and closes
# **What to see:** after 150 frames a bent line; just before the lap is complete, odometry's error has
# opened it; at frame 399 views have been recognised and the links have pulled it together.

# %%
figure, panels = plt.subplots(1, 3, figsize=(12, 4), layout="constrained", sharex=True, sharey=True)
for panel, (index, (poses, found, pose)) in zip(panels, moments.items(), strict=True):
    ends = np.stack([found.source, found.target], axis=1)
    panel.plot(*poses[ends, :2].transpose(2, 1, 0), color="#0072B2", lw=1.2)
    loop = closes_loop(found.source, found.target)
    if loop.any():
        panel.plot(*poses[ends[loop], :2].transpose(2, 1, 0), color="#D55E00", lw=3)
    panel.plot(*pose[:2], marker="o", ms=9, color="#E69F00", mec="#222222")
    panel.set(title=f"frame {index}: {len(poses)} places", xlabel="x (m)", aspect="equal")
panels[0].set_ylabel("y (m)")
plt.show()

# %% [markdown]
# **What to see:** activity in the pose cells is one compact packet: the robot is sure where it is.

# %%
plot_pose_cells(brain.pose_cells.activity.numpy(), brain.pose_cells.estimate)

# %% [markdown]
# ## Save, load, go on
# One file holds all of the brain. The loaded one goes on bit for bit as if it had never stopped.

# %%
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "corridor.safetensors"
    save_brain(brain, file)
    print(f"{file.stat().st_size / 1024:.0f} kB")
    brain = load_brain(file)
for frame in frames[400:]:
    results.append(brain(frame))
    offsets.append(brain.map.offset)
print(f"{brain.view.n} views, {brain.map.n} places: the second lap was known")

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
# Every frame keeps its offset from its place, so the track moves with the map. **What to see:** left,
# odometry alone; right, the map on the truth (dashed).

# %%
track = np.array([brain.place(r.experience, at) for r, at in zip(results, offsets, strict=True)])
truth = np.array([frame.truth for frame in frames])
odometry = integrate_velocities(
    *np.array([r.motion for r in results]).T, start=Pose(0.0, 0.0, np.pi / 2)
)
for name, found in (("odometry alone", odometry), ("map", track)):
    error = absolute_trajectory_error(found[:, :2], truth[:, :2], "rigid")
    print(f"{name}: {error.rmse:.2f} m off (ATE, RMSE)")
found = brain.map.links
plot_map(
    brain.map.poses,
    np.stack([found.source, found.target], axis=1),
    odometry_xy=odometry[:, :2],
    track_xy=track[:, :2],
    truth_xy=truth[:, :2],
    walls=source.world.segments,
    current=brain.map.pose,
)

# %% [markdown]
# ## Use the map
# Links know how long they took, so the quickest way anywhere is a shortest path. **What to see:** the
# way (orange) from the robot to a place at the other side of the building.

# %%
goal = brain.map.n // 2
plan = brain.map.plan(goal)
xy = brain.map.poses[:, :2]
figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
axes.plot(*xy.T, ".", color="#0072B2", label="places")
axes.plot(*xy[plan.path].T, color="#D55E00", lw=3, alpha=0.7, label="quickest way")
axes.plot(*xy[goal], "*", ms=16, color="#E69F00", mec="#222222", label="goal")
axes.plot(*brain.map.pose[:2], "o", ms=9, color="white", mec="#222222", label="robot")
axes.set(
    xlabel="x (m)", ylabel="y (m)", aspect="equal",
    title=f"To place {goal}: {len(plan.path)} places, {plan.duration_s:.0f} s",
)  # fmt: skip
axes.legend(frameon=False, loc="center")
plt.show()

# %% [markdown]
# ## Your own video
# ```python
# from neuroslam import run
# summary = run("drive.mp4", "out")            # map.png, CSVs, the brain, TensorBoard events
# print(summary.counts)
# ```
# or `neuroslam run drive.mp4 -o out`. If too many or too few places are recognised, move
# `view.threshold`; [docs/parameters.md](../docs/parameters.md) has them all.
