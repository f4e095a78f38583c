"""Activity of a run's cells for figures: as it was recorded, or computed along the path."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from neuroslam.brain import NavigationBrain
from neuroslam.errors import CheckpointError
from neuroslam.figures.recorded import plot_population, plot_raster
from neuroslam.runs.reading import trajectory
from neuroslam.state.activity import ACTIVITY, ActivityLog

_MOST = 4000  # poses at which activity is computed
RECORDED = "recorded during the run, along the {whose} path"
COMPUTED = (
    "computed from the cells at the end of the run, along the estimated path; "
    "run with --record cells to see what was active"
)


def activity_of(
    out: Path, brain: NavigationBrain, trace: dict[str, np.ndarray]
) -> tuple[ActivityLog | None, str]:
    """Return the activity of a run's cells, and a line that says where it is from.

    Recorded activity is read from ``activity.zarr``. Without it, the activity of an animal's cells
    (of a brain whose map shows its own cells) is computed at up to 4000 poses of its path.

    Args:
        out: Folder of the run.
        brain: Of the run.
        trace: Of the run.

    Returns:
        The activity, or ``None``: there is none, or the record is damaged.
    """
    if (out / ACTIVITY).is_dir():
        try:
            log = ActivityLog.open(out)
        except CheckpointError as error:
            return None, f"The recorded activity cannot be read: {error}"
        if log.n_samples and any(log[name].size for name in log.names):
            return log, RECORDED.format(whose="true" if log.has_truth else "estimated")
    if brain.leader.relaxes_map:  # the map's frame is not that of the cells
        return None, ""
    track = trajectory(brain, trace)
    rows = np.flatnonzero(np.isfinite(track).all(axis=1))
    if len(rows) > _MOST:
        rows = rows[np.linspace(0, len(rows) - 1, _MOST).round().astype(int)]
    if len(rows) < 2:
        return None, ""
    at, heading, speed = track[rows, :2], track[rows, 2], trace["v_m_s"][rows]
    rates: dict[str, np.ndarray] = {}
    units: dict[str, str] = {}
    cells: dict[str, dict[str, np.ndarray]] = {}
    for population in brain.populations.values():
        found = population.rates_at(at, heading, speed)
        rates |= found
        units |= {name: population.rate_units.get(name, "1") for name in found}
        for name, columns in population.cell_properties().items():
            cells[name] = {key: np.asarray(value) for key, value in columns.items()}
    if not any(table.size for table in rates.values()):
        return None, ""
    log = ActivityLog.from_arrays(trace["time_s"][rows], at, rates, heading, units)
    log.speed_m_s, log.cells = speed, cells
    return log, COMPUTED


def draw_cells(log: ActivityLog, note: str, most: int = 4) -> dict[str, Figure]:
    """Draw the figures of a run's activity: ``raster.png``, and ``cells_NAME.png`` of each kind.

    Args:
        log: Of :func:`activity_of`.
        note: Second line of the titles: what :func:`activity_of` says.
        most: Largest number of cells of a kind.
    """
    figures = {
        f"cells_{name}.png": plot_population(log, name, most, note)
        for name in log.names
        if (log[name] > 0.0).any()
    }
    if figures:
        figures["raster.png"] = plot_raster(log, note)
    return figures
