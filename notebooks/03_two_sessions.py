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
# # Two sessions, one map
# On Monday a robot maps three quarters of a gallery and is switched off. On Tuesday it starts somewhere
# else, with an unknown pose. It begins a new map, until it recognises experiences of Monday's map; then
# the two maps are merged. This is the multisession RatSLAM of Menezes et al. (2023), step by step.

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam import BrainConfig, NavigationBrain, load_brain, open_source, save_brain
from neuroslam.evaluation.icp import fraction_of_diagonal, map_rmse
from neuroslam.evaluation.trajectory import align
from neuroslam.experiments.session_runs import (
    MapSnapshot,
    bindings,
    measure,
    run_session,
    stage,
    track,
)
from neuroslam.figures.maps import contact_sheet, plot_frame_and_template, plot_map
from neuroslam.figures.sessions import plot_bindings, plot_overlay, plot_stages
from neuroslam.figures.style import SESSIONS, STYLE, legend_below, write_title
from neuroslam.merging.match import find_match
from neuroslam.merging.report import MergeReport
from neuroslam.runs.merge import join_brains

torch.set_num_threads(1)
plt.rcParams.update(STYLE | {"figure.constrained_layout.use": True, "figure.dpi": 100})
config = BrainConfig()
source = open_source("world:ellipse?laps=3.8&width=256&height=64")
frames = list(source.frames())
lap = source.frames_per_lap
same = sum(np.array_equal(frames[i].image, frames[i + lap].image) for i in range(lap))
print(f"{len(frames)} frames, {frames[-1].time_s:.0f} s, {lap} frames a lap")
print(f"{same} of the {lap} images of the second lap are equal to those of the first")

# %% [markdown]
# The gallery is rendered, so the truth is known. Every lap shows the same images, pixel by pixel,
# and the odometry is exact: this notebook shows how a merge works, not how hard view matching can be.
# Changing light follows below.
#
# ## Monday
# Frames 0 to 299: three quarters of a lap. The whole brain is saved in one file.
#
# **What to see:** the path is open; the robot never returned to its start.

# %%
monday = run_session(frames[:300], config, name="monday")
with tempfile.TemporaryDirectory() as folder:
    file = Path(folder) / "monday.safetensors"
    save_brain(monday.brain, file)
    print(f"{file.stat().st_size / 1024:.0f} kB")
    stored = load_brain(file)
plot_map(stored.map.poses, np.column_stack(stored.map.links[:2]), title="Monday's map")

# %% [markdown]
# ## Tuesday: where am I?
# The new session begins at frame 320, a little beyond where Monday ended. `store` gives the new brain
# Monday's map, with an unknown alignment. Until it is recognised, every experience is new. The table
# `recognition.sightings` holds the recent matches; the loop copies it, because the merge empties it.

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
    columns = (table[name].tolist() for name in ("partial", "loaded", "error"))
    sightings = list(zip(*columns, strict=True))
report = MergeReport(**brain.sessions.merges[-1])
met, u, z = frame.index, report.match["loaded_experience"], report.match["partial_experience"]
agreed = [*sightings, (z, u, report.match["error"])]
print(f"joined at frame {met}, {met - 320} frames after the start")
for tuesdays, mondays, error in agreed:
    print(f"experience {tuesdays} of Tuesday matches {mondays} of Monday: match error {error:.4f}")

# %% [markdown]
# **What to see:** two maps without a common frame. Both begin at (0, 0) with the same heading, so
# Tuesday's is drawn below. The rings are the same position in truth.

# %%
sessions = [stored.sessions.now.id, brain.sessions.now.id]
before, partial, after = (MapSnapshot.of(one) for one in (stored.map, own, brain.map))
little = stage("Tuesday", partial, sessions, partial.poses[[z], :2])
plot_stages(
    [stage(f"Frame {met}: two maps", before, sessions, before.poses[[u], :2], (little,))],
    "Before the merge",
)

# %% [markdown]
# **What to see:** the frame at which the maps were joined, and the matching template of Monday.

# %%
view = report.match["loaded_view"]
plot_frame_and_template(
    frames[met].image, stored.view.template_image(view), report.match["error"], view
)

# %% [markdown]
# ## One match is not enough
# Rooms have similar walls and doors, so a single view match proves nothing: `sessions.confirm`
# experiences (4) must agree on the alignment of the maps. The displacement from one to the next must be
# equal on both.
#
# **What to see:** left, the last four experiences of Tuesday; right, the matching ones of Monday: the same
# order, the same displacements.

# %%
created = [one.experiences["first_frame"].tolist() for one in (own, stored.map)]
seen = [
    (f"{day}, place {place}, frame {created[k][place]}", frames[created[k][place]].image)
    for pair in agreed
    for k, (day, place) in enumerate(zip(("Tuesday", "Monday"), pair[:2], strict=True))
]
contact_sheet([image for _, image in seen], [name for name, _ in seen])

# %% [markdown]
# What happens without? A robot with Monday's map starts in another building, an office corridor, and
# drives 60 frames. Its `view.threshold` is 0.09 instead of 0.05 on purpose, so that some views match
# templates of the gallery.
#
# **What to see:** if the first match decides (left), the corridor is attached to the gallery, wrongly. If
# four must agree (right), the maps stay apart.

# %%
corridor = list(open_source("world:corridor?laps=1").frames())
panels = []
for confirm in (1, 4):
    poor = BrainConfig(view={"threshold": 0.09}, sessions={"confirm": confirm})
    gallery = run_session(frames[:300], poor, name="gallery")
    lost = run_session(corridor[:60], poor, gallery.brain, name="corridor")
    ids = [life.brain.sessions.now.id for life in (gallery, lost)]
    here, known = MapSnapshot.of(lost.brain.map), MapSnapshot.of(gallery.brain.map)
    if lost.merge_snapshots:
        match = lost.merge_snapshots[0].report["match"]
        print(f"confirm = {confirm}: joined at frame {lost.merge_snapshots[0].frame}, wrongly")
        ring = here.poses[[match["loaded_experience"]], :2]
        panels.append(stage(f"confirm = {confirm}: joined", here, ids, ring))
    else:
        print(f"confirm = {confirm}: {lost.brain.not_joined()[0]['reason']}")
        apart = stage("corridor", here, ids)
        panels.append(stage(f"confirm = {confirm}: two maps", known, ids, others=(apart,)))
plot_stages(panels, "Gallery and corridor do not belong together")

# %% [markdown]
# ## The merge
# The matched experience takes Monday's pose, and the whole map of Tuesday turns and moves with it. Four
# experiences of each map are matched and merged in pairs, with their links.

# %%
print("\n".join(report.lines()))

# %% [markdown]
# **What to see:** Tuesday's map before the merge; aligned with Monday's; and at the end of Tuesday, when
# the robot has driven through the part unknown to both, and the loop is closed.

# %%
# The same frames again, with the trajectory recorded.
tuesday = run_session(frames[320:], config, stored, name="tuesday")
final = MapSnapshot.of(tuesday.brain.map)
ends = [stored.sessions.now.id, tuesday.brain.sessions.now.id]
turned = f"Right after: turned by {np.degrees(report.rotation_rad):.0f}°"
plot_stages(
    [
        stage("Tuesday's own map", partial, sessions, partial.poses[[z], :2]),
        stage(turned, after, sessions, after.poses[[u], :2]),
        stage(f"Frame {frames[-1].index}: the loop is closed", final, ends),
    ],
    "Tuesday's map turns and becomes part of Monday's",
)

# %% [markdown]
# ## The pose cells follow
# Each template is bound to the position of the activity packet at which it was learnt: x, y and heading
# on a torus. Every session begins at the centre with the same heading. So Tuesday's bindings are shifted,
# **and** the displacements between them have other directions. The merge shifts them by the difference of
# the two packets, and turns them by the difference of the headings. The activity moves with them.
#
# **What to see:** the ring is the matched experience. In the merged panel Tuesday's bindings are those of a
# single session over all frames. The torus is periodic: a path that leaves on one side enters on the
# other.

# %%
single = run_session(frames, config, name="single")
cells = config.pose_cells
torus = (cells.n_xy, cells.n_xy, cells.n_theta)
plot_bindings(bindings(single, [monday, tuesday]), torus, "Bindings of experiences to pose cells")

# %% [markdown]
# The paper only shifts. Then the state is right at the matched experience and wrong everywhere else: a
# known view injects one packet, odometry moves another, and known experiences are created again. `shift`
# reproduces that; `none` leaves the bindings as they were.
#
# **What to see:** at frame 700 all maps grow by the part that neither session had seen (frames 300 to 319
# of the lap). With the turn that is all. Only shifted, Tuesday's own part (frames 320 to 399 of the lap)
# is created again on the next lap. Without any move, each session's bindings are consistent among
# themselves, and experiences are created again only where the sessions meet.

# %%
lives = {"turn": tuesday}
for how in ("shift", "none"):
    other = BrainConfig(sessions={"cells": how})
    lives[how] = run_session(frames[320:], other, stored, name="tuesday")
names = {"turn": "shifted and turned", "shift": "only shifted", "none": "not moved"}
figure, axes = plt.subplots(figsize=(7.5, 4.2))
for (how, life), colour in zip(lives.items(), SESSIONS, strict=False):
    made = life.brain.map.experiences
    mine = made["session"].numpy() == life.brain.sessions.now.id
    new = np.sort(made["first_frame"].numpy()[mine])
    count = stored.map.n + np.searchsorted(new, np.arange(met, len(frames)), side="right")
    axes.plot(np.arange(met, len(frames)), count, color=colour, lw=4 if how == "turn" else 1.6,
              label=f"{names[how]}: {life.brain.map.n}")  # fmt: skip
    print(
        f"{names[how]}: {life.brain.map.n} experiences, {life.created_at_known_views} of them created again"
    )
axes.axhline(single.brain.map.n, color="0.2", ls="--", lw=1,
             label=f"single session: {single.brain.map.n}")  # fmt: skip
axes.set(xlabel="frame", ylabel="experiences of the merged map", yticks=range(120, 145, 5))
write_title(axes, "Known experiences are created again if the pose cells do not turn")
legend_below(axes, 2)
plt.show()

# %% [markdown]
# ## As good as one session?
# Tuesday continues for almost three laps. On known ground no experience is created, and the loop is
# closed. A single session, which saw frames 300 to 319 too, has as many templates, experiences and links.
# The two sessions count one loop closure more: the junction of Tuesday and Monday.

# %%
lived = np.array([*range(300), *range(320, len(frames))])
alone = measure("single session", [single], None, lived)
joined = measure("two sessions", [monday, tuesday], single, lived)
for what in ("frames", "templates", "experiences", "links", "loop_closures"):
    print(f"{what:14} single {alone[what]:5}   two sessions {joined[what]:5}")
print("created again at known views:", joined["places_created_at_known_views_after_merge"])

# %% [markdown]
# **What to see:** the merged map aligned with that of the single session by iterative closest points (ICP).
# The RMSE between their experiences is a fraction of a percent of the diagonal of the map.

# %%
joined_xy, single_xy = tuesday.brain.map.poses[:, :2], single.brain.map.poses[:, :2]
found = map_rmse(joined_xy, single_xy)
plot_overlay(
    single_xy,
    found.alignment.apply(joined_xy),
    found.rmse,
    fraction_of_diagonal(found.rmse, single_xy),
    "Merged map and map of the single session, aligned by ICP",
    np.column_stack(single.brain.map.links[:2]),
    np.column_stack(tuesday.brain.map.links[:2]),
)

# %% [markdown]
# A view often matches some frames before the robot reaches the position where it was learnt (0.08 m per
# frame), and the map moves the robot ahead. Odometry is exact here, so it alone would be nearer to the
# truth; view matches pay where odometry drifts ([the notebook before](02_map_a_video.ipynb)).
#
# **What to see:** the distance of each frame's position from the truth, after rigid alignment of the whole
# trajectory. Two sessions are about as good as one. Tuesday's frames before the merge (320 to 410) are
# included, as their experiences moved with the map. The peaks are early view matches, the same in each
# lap.

# %%
figure, axes = plt.subplots(figsize=(7.5, 3.6))
for name, part, numbers, colour in (
    ("single session", [single], np.arange(len(frames)), "0.3"),
    ("two sessions", [monday, tuesday], lived, SESSIONS[1]),
):
    xy, truth = track(part[-1].brain, part)
    off = np.linalg.norm(align(xy, truth).apply(xy) - truth, axis=1)
    drawn = np.full(len(frames), np.nan)
    drawn[numbers] = off
    label = f"{name}: {np.sqrt(np.mean(off**2)):.3f} m RMS"
    axes.plot(drawn, color=colour, lw=1.4, label=label)
axes.axvline(met, color="#DD1122", lw=1)
axes.annotate("merge", (met, 0.97), (4, 0), xycoords=("data", "axes fraction"),
              textcoords="offset points", va="top", color="#DD1122")  # fmt: skip
axes.set(xlabel="frame", ylabel="distance from the truth (m)", ylim=(0, None))
write_title(
    axes, "Position error (rigid alignment) of one and of two sessions", "an ellipse of 12 by 8 m"
)
legend_below(axes, 2)
plt.show()

# %% [markdown]
# ## Two finished sessions
# Two finished sessions can be merged as well: `find_match` compares every template of each with the other,
# and `join_brains` matches and merges. Wednesday is a drive over frames 600 to 819, a lap and a half later,
# with changing light.

# %%
changing = open_source("world:ellipse?laps=3.8&width=256&height=64&light=0.2")
wednesday = run_session(changing.frames(600, 820), config, name="wednesday").brain
print(find_match(monday.brain, wednesday).reason)
merged, (report,) = join_brains(monday.brain, wednesday)
print("\n".join(report.lines()))

# %% [markdown]
# **What to see:** Wednesday began on the far side, but its own map begins at (0, 0) as well. The merge turns
# it by half a turn, and closes the loop. Shared experiences remain those of Monday (first session).

# %%
days = [monday.brain.sessions.now.id, wednesday.sessions.now.id]
plot_stages(
    [
        stage("Monday", MapSnapshot.of(monday.brain.map), days),
        stage("Wednesday", MapSnapshot.of(wednesday.map), days),
        stage("Merged", MapSnapshot.of(merged.map), days),
    ],
    "Two finished sessions become one map",
)

# %% [markdown]
# If two maps do not match, the merge is refused and the report states the reason. Here the gallery and the
# corridor, with the default threshold:

# %%
elsewhere = run_session(corridor[:200], config, name="corridor").brain
nothing, (report,) = join_brains(monday.brain, elsewhere)
print("\n".join(report.lines()))

# %% [markdown]
# ## A kidnapped robot
# After 250 frames in the corridor the robot is moved to its position of 130 frames earlier. The view
# changes at once by far more than while driving. So the map is stored, a new one begins, and some
# experiences later the old one is recognised.
#
# **What to see:** left, the jump (arrow); right, the trajectory on the joined map: the part after the jump
# begins at the new position.

# %%
order = [*range(250), *range(120, 250)]
drive = [corridor[i]._replace(index=k, time_s=0.1 * k) for k, i in enumerate(order)]
kidnapped = run_session(drive, config, name="kidnapped")
for session in kidnapped.brain.sessions.sessions:
    print(
        f"{session.name}: {session.began}, from frame {session.first_frame}, {session.frames} frames"
    )
(joint,) = kidnapped.merge_snapshots
print(f"joined at frame {joint.frame}: {MergeReport(**joint.report).lines()[0]}")
xy, truth = track(kidnapped.brain, [kidnapped])
xy = align(xy, truth).apply(xy)
figure, panels = plt.subplots(1, 2, figsize=(10, 4.2), sharex=True, sharey=True)
titles = ("Truth", "On the joined map, aligned with the truth")
for panel, points, title in zip(panels, (truth, xy), titles, strict=True):
    panel.plot(*points[:250].T, color=SESSIONS[0], lw=4.5, label="before the jump")
    panel.plot(*points[250:].T, color=SESSIONS[1], lw=1.6, label="after it")
    panel.set(xlabel="x (m)", aspect="equal")
    write_title(panel, title)
panels[0].annotate("", truth[250], truth[249], arrowprops={"arrowstyle": "->", "lw": 1.5})
panels[0].annotate("kidnapped", (truth[249] + truth[250]) / 2, (0, -8), va="top",
                   textcoords="offset points")  # fmt: skip
apart = np.linalg.norm(xy - truth, axis=1)
write_title(panels[1], titles[1], f"RMSE {np.sqrt(np.mean(apart**2)):.2f} m, rigid alignment")
panels[0].set_ylabel("y (m)")
figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
plt.show()

# %% [markdown]
# ## From the command line
# ```
# neuroslam run monday.mp4 -o monday
# neuroslam run tuesday.mp4 --map monday -o tuesday    # joins Monday's map once recognised
# neuroslam merge monday wednesday -o both             # two finished sessions; exit 3: refused
# neuroslam inspect both                               # content of the map
# neuroslam verify both                                # faults of the map
# neuroslam export both map.g2o                        # or .graphml, or TUM
# ```
# How maps are recognised, joined and refused: [docs/sessions.md](../docs/sessions.md).
