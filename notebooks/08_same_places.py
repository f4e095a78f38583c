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
# # Places that look the same
# A robot drives along a square corridor whose four sides and corners are identical, but for a mark at one
# corner. It is kidnapped to another side: no view shows it. Clone cells keep a belief over all experiences
# of the map (a hidden Markov model; George et al. 2021), which collapses where the mark is seen, or is
# missing. [The page](../docs/same_places.md) has the equations and what was measured.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

from neuroslam import NavigationBrain
from neuroslam.cells.clone_steps import advance_belief
from neuroslam.config import build_config, merge_values, read_preset
from neuroslam.experiments.same_places import plan_drive
from neuroslam.figures.style import INK, LOOP, MAP, STYLE

plt.rcParams.update(STYLE)
drive = plan_drive("corners", seed=0, legs=1)
kidnapped = drive.kidnapped[0]
print(drive.source.n_frames, "frames, kidnapped at frame", kidnapped)

# %% [markdown]
# **What to see:** three of the four views are the same; the mark is in the other.

# %%
n = drive.source.frames_per_lap
figure, axes = plt.subplots(1, 4, figsize=(10, 1.7), layout="constrained")
for ax, quarter in zip(axes, range(4), strict=True):
    ax.imshow(drive.source.frame(10 + quarter * n // 4).image, cmap="gray")
    ax.set(xticks=[], yticks=[], title=f"side {quarter + 1}")
plt.show()

# %% [markdown]
# **What to see:** the path from above, and the jump that neither the views nor odometry show.

# %%
truth = drive.source.truths()
figure, ax = plt.subplots(figsize=(4, 3.6), layout="constrained")
ax.plot(*truth[:kidnapped, :2].T, color=INK, lw=1)
ax.annotate("", truth[kidnapped, :2], truth[kidnapped - 1, :2], arrowprops={"arrowstyle": "->"})
ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="The drive, and the kidnapping")
plt.show()

# %% [markdown]
# ## One step
# The belief moves along the links as far as odometry says, and spreads a little with every link.
#
# **What to see:** the belief after 0, 2, 4 and 6 m on a chain of links of 0.4 m.

# %%
chain = np.arange(24), np.arange(1, 25), np.full(24, 0.4), np.zeros(24)
belief, since = np.eye(25)[1], np.zeros((25, 2))
figure, ax = plt.subplots(figsize=(6, 2.4), layout="constrained")
for step in range(61):
    if step % 20 == 0:
        ax.plot(0.4 * np.arange(25), belief, label=f"{0.1 * step:g} m")
    belief, since, _ = advance_belief(belief, since, *chain, (0.1, 0.0), 0.4)
ax.set(xlabel="place on the chain (m)", ylabel="belief", title="The belief follows odometry")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# ## The drive
# The preset `auto` with one population more. The belief is recorded in every fifth frame.

# %%
config = merge_values(read_preset("auto"), {"cells": "pose+clones"})
brain = NavigationBrain(build_config(config))
entropy, unknown, at, rows = [], [], [], []
for frame in drive.source:
    result = brain(frame._replace(truth=None))
    cells = brain.clones.scalars()
    entropy.append(cells["clones/entropy_bits"])
    unknown.append(cells["clones/unknown"])
    at.append(int(brain.map.experiences.array("first_frame")[result.experience]))
    if frame.index % 5 == 0:
        rows.append(brain.clones.rates)
print(brain.map.n, "experiences,", brain.map.n_links, "links")

# %% [markdown]
# **What to see:** in the first lap all ground is unknown, though three sides look like the first one.

# %%
path = np.arange(len(at)) * drive.step_m
figure, ax = plt.subplots(figsize=(8, 2.2), layout="constrained")
ax.plot(path, unknown, color=LOOP)
ax.axvline(path[kidnapped], color=INK, ls="--", lw=0.8)
ax.set(xlabel="path (m)", ylabel="belief", title="Belief in unknown ground")
plt.show()

# %% [markdown]
# **What to see:** after the kidnapping (dashed) the belief spreads out, and collapses again.

# %%
figure, ax = plt.subplots(figsize=(8, 2.2), layout="constrained")
ax.plot(path, entropy, color=MAP)
ax.axvline(path[kidnapped], color=INK, ls="--", lw=0.8)
ax.set(xlabel="path (m)", ylabel="bits", title="Entropy of the belief")
plt.show()

# %% [markdown]
# **What to see:** the belief in each experience, over the path: lines that run on are places passed in turn.

# %%
table = np.zeros((brain.map.n, len(rows)))
for column, row in enumerate(rows):
    table[: len(row), column] = row
figure, ax = plt.subplots(figsize=(8, 3.2), layout="constrained")
extent = (0.0, path[-1], 0.0, float(len(table)))
ax.imshow(np.sqrt(table), aspect="auto", origin="lower", cmap="magma", extent=extent)
ax.axvline(path[kidnapped], color="w", ls="--", lw=0.8)
ax.set(xlabel="path (m)", ylabel="experience", title="Belief in each experience")
plt.show()

# %% [markdown]
# **What to see:** the robot is believed on the wrong side until the views contradict.

# %%
off_m = np.hypot(*(truth[at] - truth)[:, :2].T)
figure, ax = plt.subplots(figsize=(8, 2.2), layout="constrained")
ax.plot(path, off_m, color=INK)
ax.axvline(path[kidnapped], color=INK, ls="--", lw=0.8)
ax.set(xlabel="path (m)", ylabel="error (m)", title="Distance of the believed place from the truth")
plt.show()

# %% [markdown]
# **What to see:** the belief over the map at the end: one place.

# %%
poses, belief = brain.map.poses, brain.clones.rates
figure, ax = plt.subplots(figsize=(4, 3.6), layout="constrained")
ax.scatter(*poses[:, :2].T, s=8, color="0.8")
ax.scatter(*poses[: len(belief), :2].T, s=400 * belief + 1e-3, color=MAP)
ax.set(aspect="equal", xlabel="x (m)", ylabel="y (m)", title="Belief over the experiences")
plt.show()
