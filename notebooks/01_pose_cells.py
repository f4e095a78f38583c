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
# RatSLAM represents its pose estimate as a packet of activity in a three-dimensional sheet of cells:
# x, y and heading. Every axis is periodic, so the sheet is a torus and a small one serves a large
# world. This notebook shows the cells alone: how a packet forms, how it follows odometry, and how a
# known view moves it.
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
from neuroslam.figures.maps import plot_pose_cells
from neuroslam.figures.style import ACTIVITY, INK, LOOP, MAP, STYLE, legend_below, write_title
from neuroslam.types import Motion, PoseEstimate, ViewMatch

torch.set_num_threads(1)
torch.set_grad_enabled(False)
plt.rcParams.update(STYLE | {"figure.constrained_layout.use": True, "figure.dpi": 100})
COLOURS = (MAP, LOOP, INK)
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


def new(template):
    return ViewMatch(template, -1.0, 0.0, is_new=True)


def known(template):
    return ViewMatch(template, 0.01, 0.0, is_new=False)


# %% [markdown]
# ## Neighbours excite, the surround inhibits
# Each step spreads activity with a narrow Gaussian $W_e$, subtracts the result of a wide one $W_i$,
# removes a constant $\varphi$ from every cell, and normalises (Eqs. 1 and 3):
#
# $$P \leftarrow W_e * P, \qquad P \leftarrow P - W_i * P, \qquad
# P \leftarrow [P - \varphi]_+ / \textstyle\sum [P - \varphi]_+$$
#
# **What to see:** together they are a Mexican hat: a cell and its neighbours gain (red), the ring
# around them loses (blue). The images are sums over heading; the last one has its own colour scale.

# %%
excite, inhibit = (kernels[2].numpy() for kernels in network().kernels)
both = np.convolve(excite, inhibit)
kernels = {
    "Excitation $W_e$, σ = 1": np.pad(np.outer(excite, excite), 2),
    "Inhibition $W_i$, σ = 2": np.pad(np.outer(inhibit, inhibit), 3),
    "Excite, then inhibit": np.pad(np.outer(excite, excite), 2) - np.outer(both, both),
}
figure, axes = plt.subplots(1, 4, figsize=(12.5, 3.1))
for panel, title, top in zip(axes, kernels, (0.16, 0.16, 0.02), strict=False):
    reach = (-5.5, 5.5, -5.5, 5.5)
    drawn = panel.imshow(kernels[title], "RdBu_r", vmin=-top, vmax=top, extent=reach)
    panel.grid(visible=False)
    panel.set(title=title, xlabel="Δx (cells)", xticks=range(-4, 5, 2), yticks=range(-4, 5, 2))
    figure.colorbar(drawn, ax=panel, shrink=0.75, extend="max" if top < 0.1 else "neither")
axes[0].set_ylabel("Δy (cells)")
for name, kernel, colour in zip(("$W_e$", "$W_i$", "both"), kernels.values(), COLOURS, strict=True):
    axes[3].plot(range(-5, 6), kernel[5], "o-", ms=4, color=colour, label=name)
axes[3].axhline(0, color="#777777", lw=0.8)
axes[3].set(title="The middle row", xlabel="Δx (cells)", ylabel="weight", box_aspect=0.95)
axes[3].set_xticks(range(-4, 5, 2))
axes[3].legend()
plt.show()

# %% [markdown]
# ## A packet forms
# **What to see:** all activity begins in one cell; three steps later it is a compact packet of a
# hundred cells that keeps its size. A packet that is too wide shrinks to the same packet
# (right). That is the attractor.

# %%
cells, wide = network(), network()
place_x, heading = np.arange(21) - 10, np.arange(36) - 18
bell_x, bell_theta = np.exp(-((place_x / 3) ** 2) / 2), np.exp(-((heading / 3) ** 2) / 2)
blob = bell_theta[:, None, None] * bell_x[:, None] * bell_x
wide.activity = torch.from_numpy(blob / blob.sum())
peaks = []
figure, axes = plt.subplots(1, 5, figsize=(12.5, 2.9))
for step in range(21):
    if step < 4:
        active = int((cells.activity > 0).sum())
        axes[step].imshow(cells.activity.sum(0).numpy(), ACTIVITY, origin="lower")
        axes[step].grid(visible=False)
        axes[step].set(xlabel="x (cells)")
        write_title(axes[step], f"Step {step}", f"{active} active")
    peaks.append((cells.peak, wide.peak))
    cells.integrate(STILL)
    wide.integrate(STILL)
axes[0].set_ylabel("y (cells)")
for peak, colour, name in zip(
    zip(*peaks, strict=True), COLOURS, ("one cell", "σ = 3"), strict=False
):
    axes[4].plot(peak, "o-", ms=3, color=colour, label=f"from {name}")
axes[4].set(yscale="log", ylim=(1e-3, 2), xlabel="step", ylabel="activity", box_aspect=1)
axes[4].set_title("The most active cell")
axes[4].legend()
plt.show()

# %% [markdown]
# ## It follows odometry
# Layer $k$ holds the activity of heading $\theta_k$, so it moves by $v\,dt$ along $\theta_k$; then all
# layers turn by $\omega\,dt$. Here the robot drives three circles.
#
# **What to see:** the estimate (dots) follows the circle of the odometry (line), lap after lap,
# and where the circle leaves the sheet it comes in again on the other side.

# %%
cells = network()
place(cells, 17.0, 10.0, 0.0)
v, w, steps = 0.5, 2 * math.pi / 80, 240
track = np.array([[*cells.integrate(Motion(v, w, 1.0))] for _ in range(steps)])
heading = w * np.arange(steps)  # a layer moves along its heading, then turns
wanted = np.array([17.0, 10.0]) + v * np.cumsum([np.cos(heading), np.sin(heading)], axis=1).T
error = (track[:, :2] - wanted + 10.5) % 21 - 10.5
figure, axes = plt.subplots(1, 2, figsize=(10, 4.4))
points = wanted % 21
points[1:][np.abs(np.diff(points, axis=0)).max(1) > 10] = np.nan
axes[0].plot(*points.T, color=INK, lw=1, label="odometry")
axes[0].plot(*track[:, :2].T, ".", color=MAP, ms=5, label="estimate")
axes[0].plot(17, 10, "o", ms=9, mfc="white", mec=INK, mew=1.4, label="start")
axes[0].set(xlim=(0, 21), ylim=(0, 21), aspect="equal", xlabel="x (cells)", ylabel="y (cells)")
axes[0].set(title="Three circles on the torus", xticks=range(0, 22, 3), yticks=range(0, 22, 3))
legend_below(axes[0], columns=3)
axes[1].plot(np.hypot(*error.T), color=MAP)
for lap in (80, 160):
    axes[1].axvline(lap, color="#777777", lw=0.8, ls=":")
axes[1].set(xlabel="step (80 a lap)", ylabel="distance (cells)", ylim=(0, 0.1))
axes[1].set_title("Distance of the estimate from odometry")
plt.show()
print(f"after three laps the estimate is {np.hypot(*error[-1]):.2f} cells from odometry")

# %% [markdown]
# **What to see:** the packet after three laps, from above and from the side: it is at the start
# again, and on the right it lies across the seam, since 360° is 0°.

# %%
plot_pose_cells(cells.activity.numpy(), cells.estimate)

# %% [markdown]
# ## It turns
# A turn on the spot changes only the heading, along an axis with a period of 36 cells.
#
# **What to see:** the packet (bright) follows the commanded heading (dashes) through two full turns.

# %%
cells = network()
place(cells, 10.0, 10.0, 0.0)
turn, strip = 2 * math.pi / 72, []
for _ in range(144):
    strip.append(cells.activity.sum((1, 2)).numpy())
    cells.integrate(Motion(0.0, turn, 1.0))
asked = np.degrees(turn) * np.arange(144) % 360
asked[1:][np.diff(asked) < 0] = np.nan
figure, axes = plt.subplots(figsize=(8, 3.2))
drawn = axes.imshow(
    np.array(strip).T, ACTIVITY, origin="lower", aspect="auto", extent=(-0.5, 143.5, -5, 355)
)
axes.plot(asked, "--", color="white", lw=1.2, label="commanded")
axes.grid(visible=False)
axes.set(xlabel="step", ylabel="heading θ (°)", yticks=range(0, 360, 90), ylim=(-5, 355))
axes.set_title("Two turns on the spot, 5° a step")
axes.legend(loc="lower right", labelcolor="white")
figure.colorbar(drawn, label="share of all activity")
plt.show()

# %% [markdown]
# ## Gain
# Clipping at zero pulls a moving packet back. The classic network therefore lags, most of all when
# it is slow; the lag depends on cell size and frame rate, and is why old parameter sets do not carry
# over. Here the slip is measured and fed back (`exact_gain`), so a metre is a metre at any speed.
#
# **What to see:** driven at 0.1 cells a step the classic network covers 88 % of the path, and loses about
# as much in a slow turn; with exact gain it covers all of it.

# %%
speeds = np.array([0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0])


def gain(motion, axis, speed, exact):
    """Cells made over cells asked, in 150 steps along x (axis 0) or heading (axis 2)."""
    cells = network(exact_gain=exact)
    place(cells, 5.0, 10.0, 0.0)
    n, before, made = cells.shape[2 - axis], cells.estimate[axis], 0.0
    for _ in range(150):
        now = cells.integrate(motion)[axis]
        made += (now - before + n / 2) % n - n / 2
        before = now
    return made / (150 * speed)


figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), sharey=True)
for exact, colour, name in ((False, LOOP, "classic"), (True, MAP, "exact gain")):
    driven = [gain(Motion(s, 0.0, 1.0), 0, s, exact) for s in speeds]
    turned = [gain(Motion(0.0, s * 2 * math.pi / 36, 1.0), 2, s, exact) for s in speeds]
    for panel, made in zip(axes, (driven, turned), strict=True):
        panel.plot(speeds, made, "o-", ms=5, color=colour, label=name)
    print(f"{name}: at 0.1 cells a step {driven[2]:.0%} of the way, {turned[2]:.0%} of the turn")
for panel, title, axis in zip(axes, ("Driving", "Turning"), ("speed", "turn rate"), strict=True):
    panel.axhline(1, color="#777777", lw=0.8)
    panel.set(xscale="log", title=title, xlabel=f"{axis} (cells a step)")
    panel.set_xticks(speeds, [f"{s:g}" for s in speeds])
    panel.minorticks_off()
axes[0].set_ylabel("gain: measured / commanded")
axes[0].legend(loc="lower right")
plt.show()

# %% [markdown]
# ## A familiar view moves it
# A view is bound to the estimate at which it was first seen. Seen again, it injects activity there
# (Eq. 5). A second packet grows beside the first; they inhibit each other, and one wins.
#
# **What to see:** the packet is at x = 4, and the views seen were learnt around x = 14. After
# one view (left) the second packet lives on for a hundred steps, and loses. After five views that
# belong together (right) the estimate has jumped to it (dashes), and the first packet loses.

# %%
figure, axes = plt.subplots(
    2, 2, figsize=(11, 5.2), sharex=True, sharey="row", height_ratios=[2, 1.2]
)
for column, glances, title in zip(axes.T, (1, 5), ("One view", "Five views"), strict=True):
    cells = network(inject_after=0)
    for template in range(5):  # learnt along a line from x = 13.4 to x = 14.6
        place(cells, 13.4 + 0.3 * template, 10.0, 0.0)
        cells.update_from_view(new(template))
    place(cells, 4.0, 10.0, 0.0)
    strip, found = [], []
    for step in range(160):
        seen = known(step - 10) if 10 <= step < 10 + glances else UNSEEN
        found.append(cells(STILL, seen).x)
        strip.append(cells.activity.sum((0, 1)).numpy())
    strip = np.array(strip)
    drawn = column[0].imshow(strip.T, ACTIVITY, origin="lower", aspect="auto", vmin=0, vmax=0.4)
    column[0].plot(found, "--", color=LOOP, lw=1.6, label="estimate")
    column[0].grid(visible=False)
    column[0].set(title=title, yticks=range(0, 21, 4))
    column[1].plot(strip[:, :9].sum(1), color=MAP, label="at x = 4")
    column[1].plot(strip[:, 9:].sum(1), color=LOOP, label="at x = 14")
    column[1].axvspan(9.5, 9.5 + glances, color="#dddddd", label="view seen")
    column[1].set(xlabel="step", ylim=(-0.03, 1.03), xlim=(-0.5, 159.5))
    print(f"{title}: x = {found[9]:.1f} before, {found[-1]:.1f} after")
axes[0, 0].set_ylabel("x (cells)")
axes[0, 0].legend(loc="upper right", labelcolor="white")
axes[1, 0].set_ylabel("share of activity")
axes[1, 0].legend(loc="center right")
figure.colorbar(drawn, ax=axes[0], label="share of all activity", pad=0.01)
plt.show()

# %% [markdown]
# ## Fatigue of a view
# A robot that stands still sees one view again and again. Without fatigue, a wrong match would displace the
# estimate. So a view that is seen repeatedly injects
# $\delta\,(30 - e^{1.2\,d})/30$, and its decay $d$ grows each time and recovers slowly. The activity
# of the network sums to 1 before the injection, so the excess is the injected activity.
#
# **What to see:** after two frames in a row the view is silent; seventy steps later it injects again.

# %%
cells = network(inject_after=0)
cells(STILL, new(0))
cells(STILL, UNSEEN)
added = []
for step in range(80):
    shown = step < 5 or step >= 75
    cells.update_from_view(known(0) if shown else UNSEEN)
    added.append(cells.packet.values.sum().item() - 1.0 if shown else np.nan)
    cells.integrate(STILL)
figure, axes = plt.subplots(figsize=(8, 2.8))
axes.plot(added, "o", color=MAP)
axes.axvspan(4.5, 74.5, color="#eeeeee")
axes.text(39.5, 0.09, "the view is not seen", ha="center", color="#666666")
axes.set(xlabel="step", ylabel="activity added", title="Fatigue of a view seen in a row")
axes.set_ylim(-0.01, 0.21)
plt.show()

# %% [markdown]
# ## Too much inhibition
# If global inhibition exceeds all activity, nothing is left to normalise. That is a named error, never a
# NaN.

# %%
try:
    network(global_inhibition=0.5).integrate(STILL)
except MapError as error:
    print(f"MapError: {error}")

# %% [markdown]
# Next: [a whole map from a video](02_map_a_video.ipynb).
