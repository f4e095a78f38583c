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
# # Two days, one map
# On Monday a robot maps three quarters of a gallery and is switched off. On Tuesday it wakes somewhere
# else and does not know where. It starts a map of its own, until it recognises a place of Monday's;
# then the two become one. This is the multisession RatSLAM of Menezes et al. (2023), step by step.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.brain.matching import find_match
from neuroslam.brain.merge import MergeReport
from neuroslam.drawing import STYLE, legend_below, write_title
from neuroslam.evaluation.icp import fraction_of_diagonal, map_rmse
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.lives import Picture, bindings, live, stage, track
from neuroslam.merge_drawing import SESSIONS, plot_bindings, plot_overlay, plot_stages
from neuroslam.merging import join_brains
from neuroslam.plotting import contact_sheet, plot_frame_and_template, plot_map

torch.set_num_threads(1)
plt.rcParams.update(STYLE | {"figure.constrained_layout.use": True, "figure.dpi": 100})
config = BrainConfig()
source = open_source("world:ellipse?laps=3.8&width=256&height=64")
frames = list(source.frames())
lap = source.frames_per_lap
print(f"{len(frames)} frames, {lap} a lap")

# %% [markdown]
# ## Monday
# Frames 0 to 299: three quarters of a lap. The brain goes to the disk, all of it in one file.
#
# **What to see:** the path is open; the robot never came back to where it began.

# %%
monday = live(frames[:300], config, name="monday")
folder = Path(tempfile.mkdtemp())
save_brain(monday.brain, folder / "monday.safetensors")
stored = load_brain(folder / "monday.safetensors")
links = stored.map.links
plot_map(stored.map.poses, np.column_stack(links[:2]), title="Monday's map")

# %% [markdown]
# ## Tuesday: where am I?
# The new session begins at frame 320, beyond Monday's end. `store` gives the new brain Monday's map to
# recognise; nothing is known about where it lies. Until then every place is new.

# %%
brain = NavigationBrain(config)
brain.store(stored)
sightings, own = [], None
for frame in frames[320:]:
    own = brain.map  # the map of Tuesday alone, until it is joined
    brain(frame)
    if brain.sessions.merges:
        break
    table = brain.recognition.sightings
    sightings = list(zip(table["partial"].tolist(), table["loaded"].tolist(), strict=True))
report = MergeReport(**brain.sessions.merges[-1])
met = frame.index
print(f"frame {met}")
print("\n".join(report.lines()))

# %% [markdown]
# One look-alike is not enough: corridors repeat. `sessions.confirm` places (4) must agree on how one map
# lies in the other: the way between them must be the same on both.
#
# **What to see:** the frame at which the maps were joined, and Monday's template of the same place.

# %%
loaded_view = report.match["loaded_view"]
plot_frame_and_template(
    frames[met].image,
    stored.view.template_image(loaded_view),
    report.match["error"],
    loaded_view,
)

# %% [markdown]
# **What to see:** Tuesday's last four places, then Monday's first four: the same pictures in the same
# order.

# %%
agreed = [*sightings, (report.match["partial_experience"], report.match["loaded_experience"])]
first_frames = [one.experiences["first_frame"].tolist() for one in (own, stored.map)]
rows = [[first_frames[k][pair[k]] for pair in agreed[-4:]] for k in (0, 1)]
contact_sheet(
    [frames[i].image for row in rows for i in row],
    [f"Tuesday, place {z}" for z, _ in agreed[-4:]]
    + [f"Monday, place {u}" for _, u in agreed[-4:]],
)

# %% [markdown]
# ## The merge
# The matched place takes Monday's pose, and all of Tuesday turns and moves with it. The four equal places
# become one each; all links follow.
#
# **What to see:** two maps, each in its own coordinates; then one.

# %%
sessions = [stored.sessions.now.id, brain.sessions.now.id]
u, z = report.match["loaded_experience"], report.match["partial_experience"]
before, partial, after = (Picture.of(one) for one in (stored.map, own, brain.map))
plot_stages(
    [
        stage("at the match", before, sessions, before.poses[[u], :2],
              (stage("Tuesday", partial, sessions, partial.poses[[z], :2]),)),
        stage("after the merge", after, sessions, after.poses[[u], :2]),
    ],
    "Monday and Tuesday become one map",
)  # fmt: skip

# %% [markdown]
# The pose cells must follow, or views would pull the robot to where they were learnt on Tuesday's torus.
# Each session begins in the middle of the torus, heading along -x; so Tuesday's places lie elsewhere, and
# the ways between them run in other directions. Bindings are shifted by the difference of the two packets,
# **and turned** by the difference of the headings.
#
# **What to see:** in the merged panel the places of Tuesday continue those of Monday, as in the map of a
# single session over the same frames.

# %%
single = live(frames, config, name="single")
tuesday = live(frames[320:], config, stored, name="tuesday")
cells = config.pose_cells
torus = (cells.n_xy, cells.n_xy, cells.n_theta)
plot_bindings(bindings(single, [monday, tuesday]), torus, "Where places are bound")

# %% [markdown]
# What if the cells are only shifted, as in the paper, or not moved at all? Then known views find the
# activity elsewhere, and known places are made anew.
#
# **What to see:** the robot drives three laps. With shift and turn the map is complete after one, and has
# as many places as that of a single session; else it grows when the known part is driven again.

# %%
lives = {"turn": tuesday}
for how in ("shift", "none"):
    other = BrainConfig(sessions={"cells": how})
    lives[how] = live(frames[320:], other, stored, name="tuesday")
names = {"turn": "shifted and turned", "shift": "only shifted", "none": "not moved"}
figure, axes = plt.subplots(figsize=(7.5, 4.2))
for (how, life), colour in zip(lives.items(), SESSIONS, strict=False):
    session = life.brain.map.experiences["session"].numpy() == life.brain.sessions.now.id
    new = np.sort(life.brain.map.experiences["first_frame"].numpy()[session])
    count = stored.map.n + np.searchsorted(new, np.arange(met, len(frames)), side="right")
    axes.plot(np.arange(met, len(frames)), count, color=colour, lw=3.5 if how == "turn" else 1.5,
              label=f"{names[how]}: {life.brain.map.n} places")  # fmt: skip
axes.axhline(single.brain.map.n, color="0.3", ls="--", lw=1,
             label=f"single session: {single.brain.map.n}")  # fmt: skip
axes.set(xlabel="frame", ylabel="places of the joined map", yticks=range(120, 145, 5))
write_title(axes, "Known places made anew, if the pose cells do not follow")
legend_below(axes, 2)
plt.show()

# %% [markdown]
# ## As good as one session?
# **What to see:** the joined map on that of a single session over the same frames, after iterative closest
# points: the RMSE of their nodes is a fraction of a percent of the map's diagonal.

# %%
joined_xy, single_xy = tuesday.brain.map.poses[:, :2], single.brain.map.poses[:, :2]
found = map_rmse(joined_xy, single_xy)
plot_overlay(
    single_xy,
    found.alignment.apply(joined_xy),
    found.rmse,
    fraction_of_diagonal(found.rmse, single_xy),
    "Joined map on the single session's",
    np.column_stack(single.brain.map.links[:2]),
    np.column_stack(tuesday.brain.map.links[:2]),
)

# %% [markdown]
# ## Afterwards, and in vain
# Two finished sessions are merged the same way: every view of each is looked for in the other. And if
# there is nothing to find, the reason is given.

# %%
wednesday = live(frames[200:420], config, name="wednesday").brain
merged, (told,) = join_brains(monday.brain, wednesday)
print("\n".join(told.lines()[:2]))
elsewhere = live(open_source("world:corridor").frames(0, 200), config, name="corridor").brain
print(find_match(monday.brain, elsewhere).reason)

# %% [markdown]
# **What to see:** Monday's map and Wednesday's, which overlap in a third of a lap, as one. Shared places
# are Monday's.

# %%
days = [monday.brain.sessions.now.id, wednesday.sessions.now.id]
plot_stages(
    [
        stage("Monday", Picture.of(monday.brain.map), days),
        stage("Wednesday", Picture.of(wednesday.map), days),
        stage("merged", Picture.of(merged.map), days),
    ],
    "Two finished sessions",
)

# %% [markdown]
# ## Carried away
# At frame 250 of a drive around a corridor somebody lifts the robot and puts it back a third of a lap
# behind. The view changes at once by far more than in driving; so the map is stored, a new one begins, and
# a few places later the old one is recognised.
#
# **What to see:** in truth the robot jumps; on the map nothing is torn, and the frames after the jump lie
# where the robot was put.

# %%
corridor = list(open_source("world:corridor?laps=1").frames())
order = [*range(250), *range(120, 250)]
drive = [corridor[i]._replace(index=k, time_s=0.1 * k) for k, i in enumerate(order)]
carried = live(drive, config, name="carried")
xy, truth = track(carried.brain, [carried])
xy = align(xy, truth).apply(xy)
for session in carried.brain.sessions.sessions:
    print(
        f"{session.name}: frame {session.first_frame} on, {session.frames} frames, {session.began}"
    )
figure, panels = plt.subplots(1, 2, figsize=(10, 4.2), sharex=True, sharey=True)
for panel, points, title in zip(
    panels, (truth, xy), ("Truth", "On the joined map, laid on the truth"), strict=True
):
    for part, colour, name in (
        (slice(250), SESSIONS[0], "before"),
        (slice(250, None), SESSIONS[1], "after"),
    ):
        panel.plot(
            *points[part].T,
            color=colour,
            lw=4 if name == "before" else 1.6,
            label=f"{name} it was carried",
        )
    panel.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    write_title(panel, title)
legend_below(panels[0], 2)
plt.show()

# %% [markdown]
# ## From the command line
# ```
# neuroslam run monday.mp4 -o monday
# neuroslam run tuesday.mp4 -o tuesday --map monday
# neuroslam merge monday wednesday -o both
# neuroslam inspect both
# neuroslam verify both
# neuroslam export both map.g2o
# ```
# How maps are recognised, joined and refused: [docs/sessions.md](../docs/sessions.md).
