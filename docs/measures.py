"""Draw the figures of ``docs/measures.md``: ``python docs/measures.py``."""

import warnings
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import torch

from neuroslam.cells import HeadDirectionCells, NavigationCells, OscillatoryInterference
from neuroslam.config import build_config, read_preset
from neuroslam.evaluation.decoding import decode_position, posterior
from neuroslam.evaluation.directions import head_direction_tuning, mean_direction
from neuroslam.evaluation.gridness import autocorrelogram, grid_stats, gridness
from neuroslam.evaluation.ratemap import Bins, RateMaps, fields, rate_map, spatial_information
from neuroslam.evaluation.selectivity import border_score, coherence, sparsity
from neuroslam.threads import limit_threads
from neuroslam.types import Motion
from neuroslam.worlds.arena import Arena
from neuroslam.worlds.rodent import roam
from neuroslam.worlds.senses import sense

IMAGES = Path(__file__).with_name("img")
PEAK_HZ, RATE_HZ, MINUTES = 20.0, 20.0, 20.0
BOX = Arena([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], name="box")
N_BOUNDARY = 168


def record():
    """Positions, headings and rates in Hz of a rat in a box of 1 m without noise."""
    walk = roam(BOX, MINUTES, np.random.default_rng(1), RATE_HZ)
    felt = sense(walk)
    cells = NavigationCells(build_config(read_preset("slrb"), "slrb"))
    heads, rates, places, facing = HeadDirectionCells(), [], [], []
    cells.oscillators.place_at(torch.from_numpy(walk.positions[0]))
    before = walk.headings_rad[0]
    heads.set_heading(before)
    for k, dt in enumerate(felt.dt_s):
        heading = walk.headings_rad[k]
        walls = np.column_stack([felt.wall_m[0, k], felt.wall_bearing_rad[0, k]])
        motion = Motion(felt.speed_m_s[0, k], 0.0, dt)
        here = cells.advance(motion, heading, walls[np.isfinite(walls[:, 0])])
        turn = (heading - before + np.pi) % (2 * np.pi) - np.pi
        heads.advance(Motion(0.0, turn / dt, dt))
        before = heading
        rates.append(cells.rates.copy())
        places.append(int(here.place))
        facing.append(heads.activity.numpy().copy())
    rates, facing = np.array(rates), np.array(facing)
    peak = rates.max(axis=0)
    return (
        walk,
        PEAK_HZ * rates / np.where(peak > 0, peak, 1.0),
        np.eye(max(places) + 1)[places] * PEAK_HZ,
        PEAK_HZ * facing / facing.max(),
    )


def show(ax, one, bins, title):
    ax.imshow(one, origin="lower", extent=bins.extent_m, cmap="inferno")
    ax.set(title=title, xlabel="x (m)", ylabel="y (m)")


def maps(walk, rates, places, facing):
    bins = Bins.around(BOX.boundary, 0.04)
    gathered = RateMaps(bins, rates.shape[1])
    gathered.add(walk.positions, rates)
    smooth, raw = gathered.maps(1.0), gathered.maps(0.0)
    place = rate_map(walk.positions, places, bins, 1.0)
    figure, axes = plt.subplots(2, 3, figsize=(12, 8), layout="constrained")
    one = place[np.argmin([np.hypot(*(walk.positions[c > 0].mean(0) - 0.5)) for c in places.T])]
    found = fields(one, bins.bin_m)
    show(axes[0, 0], one, bins,
         f"Place cell: {found.n_fields[0]} field of {1e4 * found.area_m2[0]:.0f} cm²,\n"
         f"{spatial_information(one, gathered.counts)[0]:.1f} bits/spike, "
         f"sparsity {sparsity(one, gathered.counts)[0]:.3f}")  # fmt: skip
    axes[0, 0].contour(one, [0.5 * np.nanmax(one)], colors="w", extent=bins.extent_m)
    grid = N_BOUNDARY + 24 + 5
    show(axes[0, 1], smooth[grid], bins,
         f"Grid cell: coherence {coherence(raw[grid])[0]:.2f},\n"
         f"{fields(smooth[grid], bins.bin_m).n_fields[0]} fields")  # fmt: skip
    stats = grid_stats(smooth[grid], bins.bin_m)
    reach = 1.0
    axes[0, 2].imshow(
        autocorrelogram(smooth[grid]), origin="lower", cmap="RdBu_r", vmin=-1, vmax=1,
        extent=(-reach, reach, -reach, reach),
    )  # fmt: skip
    axes[0, 2].plot(*stats.peaks_m.T, "k+", markersize=10)
    axes[0, 2].set(
        title=f"Its autocorrelogram: grid score {gridness(smooth[grid]):.2f},\n"
        f"spacing {stats.spacing_m:.2f} m",
        xlabel="shift in x (m)",
        ylabel="shift in y (m)",
    )
    scores = border_score(smooth[:N_BOUNDARY], bins.bin_m)
    best = int(np.nanargmax(scores.score))
    show(axes[1, 0], smooth[best], bins,
         f"Boundary cell: border score {scores.score[best]:.2f},\n"
         f"coverage {scores.coverage[best]:.2f}, distance {scores.distance[best]:.2f}")  # fmt: skip
    tuned = head_direction_tuning(walk.headings_rad, facing)
    spikes = np.random.default_rng(2).poisson(facing[:, 20] / RATE_HZ)
    test = mean_direction(walk.headings_rad, spikes)
    axes[1, 1].remove()
    polar = figure.add_subplot(2, 3, 5, projection="polar")
    polar.plot(np.append(tuned.bins_rad, tuned.bins_rad[0]),
               np.append(tuned.curves[20], tuned.curves[20, 0]), color="tab:blue")  # fmt: skip
    polar.annotate("", (tuned.preferred_rad[20], tuned.length[20] * tuned.peak[20]), (0, 0),
                   arrowprops={"color": "tab:red", "width": 2, "headwidth": 8})  # fmt: skip
    polar.set_rlabel_position(250)
    polar.set_rticks((10, 20))
    polar.set_title(
        f"Head-direction cell (Hz): mean vector {tuned.length[20]:.2f}\n"
        f"at {np.degrees(tuned.preferred_rad[20]):.0f}°; Rayleigh z {test.z:.0f} of {spikes.sum()} "
        "spikes"
    )
    coarse = Bins.around(BOX.boundary, 0.05)
    counts = np.random.default_rng(3).poisson(rates[:, N_BOUNDARY:] / RATE_HZ)
    window = 5  # samples, 250 ms
    half = len(counts) // 2 // window * window
    learnt = rate_map(walk.positions[:half], counts[:half] * RATE_HZ, coarse, 0.5)
    held = counts[half : half + 1200 * window // 5 * 5].reshape(-1, window, counts.shape[1]).sum(1)
    at = walk.positions[half + window // 2 :: window][: len(held)]
    decoded = decode_position(held, learnt, coarse, window / RATE_HZ)
    p = posterior(held[60:61], learnt, window / RATE_HZ)[0]
    axes[1, 2].imshow(p, origin="lower", extent=coarse.extent_m, cmap="Greys", vmin=0)
    part = slice(30, 91)
    axes[1, 2].plot(*at[part].T, color="tab:green", label="true, 15 s")
    axes[1, 2].plot(*decoded.mean_m[part].T, ".", color="tab:red", label="decoded, each 250 ms")
    axes[1, 2].plot(*at[60], "*", color="tab:green", markersize=14, markeredgecolor="k")
    error = np.median(np.linalg.norm(decoded.mean_m - at, axis=1))
    axes[1, 2].set(
        title="Decoded from grid cells, held out:\n"
        f"median error {100 * error:.0f} cm (grey: posterior)",
        xlabel="x (m)",
        ylabel="y (m)",
    )
    axes[1, 2].legend(loc="upper right", fontsize=8)
    figure.savefig(IMAGES / "measures_maps.png", dpi=80)


def spikes_of_theta():
    """Spikes of two grid cells of oscillatory interference on a straight run of 4 m, 40 times."""
    cells = OscillatoryInterference([0.6], n_cells=36, theta_hz=8.0).double()
    dt, rng = 0.002, np.random.default_rng(0)
    fired = [], []
    times, phases, x = [], [], []
    n = round(4.0 / 0.25 / dt)
    velocity = torch.tensor([0.25, 0.0], dtype=torch.float64)
    which = None
    start = 0.0
    for _ in range(12):
        cells.reset()
        rates = np.array([cells(velocity, dt).numpy().ravel().copy() for _ in range(n)])
        which = np.argsort(rates.sum(axis=0))[-2:] if which is None else which
        at = start + dt * np.arange(n)
        times.append(at)
        phases.append(2 * np.pi * 8.0 * dt * np.arange(1, n + 1))
        x.append(0.25 * dt * np.arange(n))
        for cell, into in zip(which, fired, strict=True):
            spikes = rng.random(n) < 120.0 * rates[:, cell] * dt
            into.append(np.stack([at[spikes], phases[-1][spikes] % (2 * np.pi), x[-1][spikes]]))
        start += n * dt
    wave = np.cos(np.concatenate(phases)) + rng.normal(0.0, 0.4, n * 12)
    return [np.concatenate(one, axis=1) for one in fired], np.concatenate(times), wave


def spike_trains():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import pynapple as nap
    (first, second), times, wave = spikes_of_theta()
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        group = nap.TsGroup({0: nap.Ts(np.sort(first[0])), 1: nap.Ts(np.sort(second[0]))})
        cross = nap.compute_crosscorrelogram(group, binsize=0.01, windowsize=0.5)
        lfp = nap.Tsd(times, wave)
        phase = nap.compute_hilbert_phase(nap.apply_bandpass_filter(lfp, (6.0, 10.0), fs=500.0))
        at = group[0].value_from(phase).values % (2 * np.pi)
    axes[0].bar(cross.index, cross.iloc[:, 0], width=0.01, color="tab:blue")
    axes[0].set(title="Cross-correlogram of two grid cells", xlabel="lag (s)",
                ylabel="rate by chance = 1")  # fmt: skip
    locked = mean_direction(at)
    chance = f"p {locked.p:.1g}" if locked.p > 1e-300 else "p below 1e-300"
    axes[1].hist(np.degrees(np.concatenate([at, at + 2 * np.pi])), 36, color="tab:blue")
    axes[1].set(
        title=f"Theta phase of {at.size} spikes: mean {np.degrees(locked.mean_rad):.0f}°,\n"
        f"length {locked.length:.2f}, {chance}",
        xlabel="phase of theta, two cycles (°)",
        ylabel="spikes",
    )
    axes[2].plot(
        first[2],
        np.degrees((first[1] + np.pi) % (2 * np.pi) - np.pi),
        ".",
        color="tab:blue",
        markersize=3,
    )
    axes[2].set(title="The same cell on the track", xlabel="position (m)",
                ylabel="phase of theta (°)", yticks=(-180, -90, 0, 90, 180))  # fmt: skip
    figure.savefig(IMAGES / "measures_spikes.png", dpi=80)


if __name__ == "__main__":
    with limit_threads(1):
        maps(*record())
        spike_trains()
