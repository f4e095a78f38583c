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
# # Pose cells: a belief that moves
# RatSLAM keeps its estimate of *where am I, and which way do I face* as a packet of activity in a
# three-dimensional sheet of cells: x, y and heading. Every axis goes round, so the sheet is a torus
# and a small one serves a large world. This notebook looks at the cells alone: how a packet forms,
# how it follows odometry, and how a familiar view moves it.
#
# Equations are those of Menezes et al., *A Multisession SLAM Approach for RatSLAM* (2023).

# %%
# %matplotlib inline
import math

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam.cells import PoseCellNetwork
from neuroslam.cells.attractor import inject
from neuroslam.config import PoseCellConfig
from neuroslam.errors import MapError
from neuroslam.plotting import plot_pose_cells
from neuroslam.types import Motion, PoseEstimate, ViewMatch

torch.set_num_threads(1)
torch.set_grad_enabled(False)
STILL = Motion(v_m_s=0.0, w_rad_s=0.0, dt_s=1.0)
UNSEEN = ViewMatch(template=-1, error=-1.0, relative_heading_rad=0.0, is_new=False)


def network(**config):
    """One cell is a metre, so speeds in m/s are cells a second."""
    return PoseCellNetwork(PoseCellConfig(cell_size_m=1.0, **config))


def place(cells, x, y, theta):
    """Put all activity around one point, and let it settle."""
    cells.reset()
    empty = cells.packet._replace(values=0 * cells.packet.values)
    cells.packet = inject(empty, PoseEstimate(x, y, theta), 1.0)
    for _ in range(10):
        cells.integrate(STILL)


# %% [markdown]
# ## Neighbours excite, the surround inhibits
# Each step spreads activity with a narrow Gaussian $W_e$, takes away what a wide one $W_i$ collects,
# removes a constant $\varphi$ from every cell, and normalises (Eqs. 1 and 3):
#
# $$P \leftarrow W_e * P, \qquad P \leftarrow P - W_i * P, \qquad
# P \leftarrow [P - \varphi]_+ / \textstyle\sum [P - \varphi]_+$$
#
# **What to see:** together they are a Mexican hat: neighbours of a cell gain, the ring around them
# loses.

# %%
excite, inhibit = (kernels[2].numpy() for kernels in network().kernels)
hat = np.pad(excite, 2) - np.convolve(excite, inhibit)
offsets = np.arange(-5, 6)
figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].plot(np.arange(-3, 4), excite, "o-", color="#0072B2", label="excitation, σ = 1")
axes[0].plot(np.arange(-2, 3), inhibit, "s-", color="#D55E00", label="inhibition, σ = 2")
axes[0].set(xlabel="distance (cells)", ylabel="weight", title="The two kernels along an axis")
axes[0].legend(frameon=False)
axes[1].axhline(0, color="grey", lw=0.8)
axes[1].plot(offsets, hat, "o-", color="#009E73")
axes[1].set(xlabel="distance (cells)", ylabel="weight", title="Excite, then inhibit")
plt.show()

# %% [markdown]
# ## A packet forms
# **What to see:** all activity begins in one cell; within a few steps it is a compact packet that
# keeps its size. That is the attractor.

# %%
cells = network()
figure, axes = plt.subplots(1, 5, figsize=(12, 2.8), layout="constrained")
for step, panel in enumerate(axes):
    above = cells.activity.sum(0).numpy()
    panel.imshow(above, origin="lower", cmap="viridis")
    active = int((cells.activity > 0).sum())
    panel.set(title=f"step {step}: {active} active", xlabel="x (cells)")
    cells.integrate(STILL)
axes[0].set_ylabel("y (cells)")
plt.show()

# %% [markdown]
# ## It follows odometry
# Layer $k$ holds the belief of heading $\theta_k$, so it moves by $v\,dt$ along $\theta_k$; then all
# layers turn by $\omega\,dt$. Here the robot drives three circles.
#
# **What to see:** the estimate (dots) lies on the circle that odometry says (line), lap after lap,
# and where the circle leaves the sheet it comes in again on the other side.

# %%
cells = network()
place(cells, 17.0, 10.0, 0.0)
v, w, steps = 0.5, 2 * math.pi / 80, 240
track = np.array([[*cells.integrate(Motion(v, w, 1.0))] for _ in range(steps)])
heading = w * np.arange(steps)  # a layer moves along its heading, then turns
wanted = np.array([17.0, 10.0]) + v * np.cumsum([np.cos(heading), np.sin(heading)], axis=1).T
error = (track[:, :2] - wanted + 10.5) % 21 - 10.5
figure, axes = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
points = wanted % 21
points[1:][np.abs(np.diff(points, axis=0)).max(1) > 10] = np.nan
axes[0].plot(*points.T, color="black", lw=1, label="odometry")
axes[0].plot(*track[:, :2].T, ".", color="#0072B2", ms=5, label="estimate")
axes[0].set(
    xlim=(0, 21), ylim=(0, 21), aspect="equal", xlabel="x (cells)", ylabel="y (cells)",
    title="Three circles on the torus",
)  # fmt: skip
axes[0].legend(frameon=False, loc="center left")
axes[1].plot(np.hypot(*error.T), color="#0072B2")
axes[1].set(xlabel="step", ylabel="distance (cells)", title="Estimate from odometry", ylim=(0, 0.5))
plt.show()
print(f"after three laps the estimate is {np.hypot(*error[-1]):.2f} cells from odometry")

# %%
figure = plot_pose_cells(cells.activity.numpy(), cells.estimate)
figure

# %% [markdown]
# ## Gain
# Clipping at zero pulls a moving packet back. The classic network therefore lags, most of all when
# it is slow; the lag depends on cell size and frame rate, and is why old parameter sets do not carry
# over. Here the slip is measured and fed back (`exact_gain`), so a metre is a metre at any speed.
#
# **What to see:** the classic network makes 88 % of its way at 0.1 cells a step; ours all of it.

# %%
speeds = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0])


def gain(speed, exact):
    cells = network(exact_gain=exact)
    place(cells, 5.0, 10.0, 0.0)
    before, way = cells.estimate.x, 0.0
    for _ in range(150):
        now = cells.integrate(Motion(speed, 0.0, 1.0)).x
        way += (now - before + 10.5) % 21 - 10.5
        before = now
    return way / (150 * speed)


figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
for exact, colour, name in ((False, "#D55E00", "classic"), (True, "#0072B2", "exact gain")):
    axes.plot(speeds, [gain(s, exact) for s in speeds], "o-", color=colour, label=name)
axes.axhline(1, color="grey", lw=0.8)
axes.set(
    xscale="log", xlabel="speed (cells a step)", ylabel="way made / way asked",
    title="Gain of the pose cells",
)  # fmt: skip
axes.set_xticks(speeds, [f"{s:g}" for s in speeds])
axes.minorticks_off()
axes.legend(frameon=False)
plt.show()

# %% [markdown]
# ## A familiar view moves it
# A view is bound to the estimate at which it was first seen. Seen again, it injects activity there
# (Eq. 5). One glance is not enough; a sequence of views that belong together wins.
#
# **What to see:** the packet starts at x = 4. From step 3 on views are seen that were learnt around
# x = 14: a second packet grows beside the first, they compete, and the new one wins.

# %%
cells = network(inject_after=0)
for template in range(8):  # eight views, learnt along a line from x = 13 to x = 15
    place(cells, 13.0 + 0.3 * template, 10.0, 0.0)
    cells.see(ViewMatch(template, -1.0, 0.0, is_new=True))
place(cells, 4.0, 10.0, 0.0)
strip, peaks = [], []
for step in range(12):
    seen = ViewMatch((step - 3) % 8, 0.01, 0.0, is_new=False) if step >= 3 else UNSEEN
    peaks.append(cells(STILL, seen).x)
    strip.append(cells.activity.sum((0, 1)).numpy())
figure, axes = plt.subplots(figsize=(7, 3.4), layout="constrained")
drawn = axes.imshow(np.array(strip).T, origin="lower", aspect="auto", cmap="viridis")
axes.plot(peaks, "x", color="#D55E00", label="estimate")
axes.axvline(2.5, color="white", ls=":", label="views begin")
axes.set(xlabel="step", ylabel="x (cells)", title="Two packets compete")
axes.legend(loc="upper left", labelcolor="white", frameon=False)
figure.colorbar(drawn, label="share of all activity")
plt.show()
print(f"estimate before: x = {peaks[0]:.1f}, after: x = {peaks[-1]:.1f}")

# %% [markdown]
# ## A view tires
# A robot that stands still sees one view again and again. Were it to inject for ever, a wrong match
# would drag the belief away. So a view that is seen in a row tires: it injects
# $\delta\,(30 - e^{1.2\,d})/30$, and its decay $d$ grows each time and recovers slowly.
#
# **What to see:** after two frames in a row the view is silent; seventy steps later it is fresh again.

# %%
cells = network(inject_after=0)
cells(STILL, ViewMatch(0, -1.0, 0.0, is_new=True))
cells(STILL, UNSEEN)
energy = []
for step in range(80):
    shown = step < 5 or step >= 75
    decay = cells.bindings["decay"][0].item() + (cells.last.view == 0 and shown)
    energy.append(max(0.0, 0.2 / 30 * (30 - math.exp(min(1.2 * decay, 10.0)))) if shown else np.nan)
    cells(STILL, ViewMatch(0, 0.01, 0.0, is_new=False) if shown else UNSEEN)
figure, axes = plt.subplots(figsize=(7, 2.8), layout="constrained")
axes.plot(energy, "o", color="#0072B2")
axes.axvspan(4.5, 74.5, color="#eeeeee")
axes.text(39.5, 0.09, "another view is seen", ha="center", color="#666666")
axes.set(xlabel="step", ylabel="injected activity", title="Fatigue of a view seen in a row")
plt.show()

# %% [markdown]
# ## Too much inhibition
# Where global inhibition is above all activity nothing is left to normalise. That is an error with a
# name, never a NaN.

# %%
try:
    network(global_inhibition=0.5).integrate(STILL)
except MapError as error:
    print(error)

# %% [markdown]
# Next: [a whole map from a video](02_map_a_video.ipynb).
