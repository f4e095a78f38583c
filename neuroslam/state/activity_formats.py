"""Recorded activity in the formats of xarray, pynapple and Neurodata Without Borders."""

import warnings
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from neuroslam.errors import ConfigError
from neuroslam.geometry import TWO_PI

if TYPE_CHECKING:
    import pynapple
    import xarray

_RESOLUTION_S = 1e-6  # of the times of spikes
_SAME_STEP = 1e-6  # s: times that differ less from a constant rate are stored as that rate


class SpikeTrains(Protocol):
    """Spikes of a population; see :class:`~neuroslam.state.activity.Spikes`."""

    @property
    def times_s(self) -> np.ndarray:
        """Of all spikes, rising."""
        ...

    @property
    def cells(self) -> np.ndarray:
        """Number of the cell of each."""
        ...

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        ...


class Recorded(Protocol):
    """What is used of an :class:`~neuroslam.state.activity.ActivityLog`."""

    time_s: np.ndarray
    speed_m_s: np.ndarray
    estimate_m: np.ndarray
    estimate_heading_rad: np.ndarray
    rates: dict[str, np.ndarray]
    units: dict[str, str]
    cells: dict[str, dict[str, np.ndarray]]
    about: dict[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the populations."""
        ...

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        ...

    @property
    def has_truth(self) -> bool:
        """Whether the position is the true one."""
        ...

    @property
    def position_m(self) -> np.ndarray:
        """Position of the animal."""
        ...

    @property
    def heading_rad(self) -> np.ndarray:
        """Heading of the animal."""
        ...

    def spikes(self, name: str, seed: int = 0, peak_hz: float = 20.0) -> SpikeTrains:
        """Draw spikes."""
        ...


def to_xarray(log: "Recorded") -> "xarray.Dataset":
    """Return the log as a dataset: one variable a population, over ``time`` and its cells."""
    try:
        import xarray
    except ImportError as error:
        raise _missing("xarray", error) from None
    time = ("time", log.time_s, {"units": "s"})
    data: dict[str, Any] = {
        "position": (("time", "axis"), log.position_m, {"units": "m"}),
        "heading": ("time", log.heading_rad, {"units": "rad"}),
        "speed": ("time", log.speed_m_s, {"units": "m/s"}),
        "estimate": (("time", "axis"), log.estimate_m, {"units": "m"}),
        "estimate_heading": ("time", log.estimate_heading_rad, {"units": "rad"}),
    }
    coordinates: dict[str, Any] = {"time": time, "axis": ["x", "y"]}
    for name, rates in log.rates.items():
        cell = f"{name}_cell"
        data[name] = (("time", cell), rates, {"units": log.units[name]})
        coordinates[cell] = np.arange(rates.shape[1])
        for column, values in _whole(log, name):
            coordinates[f"{name}_{column}"] = (cell, values)
    plain = {k: v for k, v in log.about.items() if isinstance(v, str | int | float)}
    return xarray.Dataset(data, coordinates, plain)


def to_pynapple(log: "Recorded") -> dict[str, "pynapple.TsdFrame | pynapple.Tsd"]:
    """Return the log as pynapple's time series by name."""
    try:
        import pynapple
    except ImportError as error:
        raise _missing("pynapple", error) from None
    made: dict[str, Any] = {
        "position": pynapple.TsdFrame(log.time_s, log.position_m, columns=["x", "y"]),
        "head_direction": pynapple.Tsd(log.time_s, log.heading_rad % TWO_PI),
        "speed": pynapple.Tsd(log.time_s, log.speed_m_s),
    }
    for name, rates in log.rates.items():
        made[name] = pynapple.TsdFrame(log.time_s, rates, metadata=dict(_whole(log, name)))
    return made


def write_nwb(
    log: "Recorded", path: Path, spikes: tuple[str, ...], seed: int, about: Mapping[str, Any]
) -> Path:
    """Write the log as a file of Neurodata Without Borders."""
    try:
        pynwb: Any = import_module("pynwb")  # its types are made at run time
    except ImportError as error:
        raise _missing("pynwb", error) from None
    behavior = pynwb.behavior
    about = dict(about)
    subject = about.pop("subject", None) or pynwb.file.Subject(
        subject_id="simulation",
        species="Rattus norvegicus",
        sex="U",
        age="P90D",
        description="A simulated animal; species and age are those that the model is of.",
    )
    source = str(log.about.get("source", "a trajectory"))
    fields: dict[str, Any] = {
        "session_description": f"Cells of neuroslam driven by {source}.",
        "identifier": str(log.about.get("identifier", f"neuroslam {source}")),
        "session_start_time": datetime(2000, 1, 1, tzinfo=UTC),
        "experiment_description": "Simulated activity; the date of the session has no meaning.",
        "experimenter": ["Simulation, Neuroslam"],
        "institution": "none",
        "keywords": ["simulation", "neuroslam", *log.names],
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pynwb's and hdmf's own
        file = pynwb.NWBFile(subject=subject, **(fields | about))
        behaviour = file.create_processing_module("behavior", "Path of the animal.")
        truth = "true" if log.has_truth else "estimated by the brain"
        behaviour.add(
            behavior.Position(
                spatial_series=_spatial(log, "position", log.position_m, "meters", truth)
            )
        )
        behaviour.add(
            behavior.CompassDirection(
                spatial_series=_spatial(log, "heading", log.heading_rad, "radians", truth)
            )
        )
        behaviour.add(_series(log, "speed", log.speed_m_s, "m/s", "Measured running speed."))
        cells = file.create_processing_module("ecephys", "Activity of the model's cells.")
        for name, rates in log.rates.items():
            unit = log.units[name]
            what = f"Activity of the {name.replace('_', ' ')} cells, a column for each cell."
            tuned = "; ".join(f"{k}: {v.tolist()}" for k, v in _whole(log, name))
            series = _series(log, name, rates, "Hz" if unit == "Hz" else "a.u.", what)
            series.fields["comments"] = f"Tuning: {tuned}" if tuned else "no comments"
            cells.add(series)
        for name in spikes:
            _add_units(file, log, name, seed)
        with pynwb.NWBHDF5IO(str(path), "w") as io:
            io.write(file)
    return path


def _add_units(file: Any, log: "Recorded", name: str, seed: int) -> None:  # noqa: ANN401
    if file.units is None:
        what = "Poisson spikes drawn from the activity of cells."
        file.units = import_module("pynwb.misc").Units(
            name="units", description=what, resolution=_RESOLUTION_S
        )
        file.add_unit_column("population", "Population of the cell.")
        file.add_unit_column("cell", "Number of the cell in its population.")
    drawn = log.spikes(name, seed)
    order = np.argsort(drawn.cells, kind="stable")  # keeps the times of a cell rising
    edges = np.searchsorted(drawn.cells[order], np.arange(drawn.n_cells + 1))
    for cell in range(drawn.n_cells):
        times = drawn.times_s[order[edges[cell] : edges[cell + 1]]]
        if len(times):  # a unit is a cell that fired
            file.add_unit(spike_times=times, population=name, cell=cell)


def _timing(log: "Recorded") -> dict[str, Any]:
    """Return a constant rate where the samples have one, else the time of each."""
    steps = np.diff(log.time_s)
    if len(steps):
        step = float((log.time_s[-1] - log.time_s[0]) / len(steps))
        ideal = log.time_s[0] + step * np.arange(log.n_samples)
        if np.abs(ideal - log.time_s).max() < _SAME_STEP:
            return {"rate": float(np.round(1.0 / step, 9)), "starting_time": float(log.time_s[0])}
    return {"timestamps": log.time_s}


def _series(log: "Recorded", name: str, data: np.ndarray, unit: str, what: str) -> Any:  # noqa: ANN401
    return import_module("pynwb").TimeSeries(
        name=name, data=_packed(data), unit=unit, description=what, **_timing(log)
    )


def _spatial(log: "Recorded", name: str, data: np.ndarray, unit: str, truth: str) -> Any:  # noqa: ANN401
    frame = "(0, 0) is the origin of the arena" if log.has_truth else "(0, 0) is the start"
    if name == "heading":
        frame = "0 is along the x axis, counter-clockwise positive"
    return import_module("pynwb.behavior").SpatialSeries(
        name=name,
        description=f"{name.capitalize()} of the animal, {truth}.",
        data=_packed(data),
        unit=unit,
        reference_frame=frame,
        **_timing(log),
    )


def _packed(data: np.ndarray) -> Any:  # noqa: ANN401 - hdmf's wrapper of an array
    packed = import_module("hdmf.backends.hdf5.h5_utils").H5DataIO
    return packed(data, compression="gzip", compression_opts=4, chunks=True, shuffle=True)


def _whole(log: "Recorded", name: str) -> Iterator[tuple[str, np.ndarray]]:
    """Yield the columns that say something of every cell of a population."""
    n = log.rates[name].shape[1]
    for column, values in log.cells.get(name, {}).items():
        if len(values) == n:
            yield column, values


def _missing(package: str, error: ImportError) -> ConfigError:
    return ConfigError(f"{package} cannot be imported ({error}); pip install neuroslam[neuro]")
