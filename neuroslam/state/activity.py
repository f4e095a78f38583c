"""The activity of all cells over time, recorded while a brain runs, and the path of the animal."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from neuroslam.errors import CheckpointError, ConfigError
from neuroslam.state.arrays import array_names, attributes_of, read_array, rows_of

if TYPE_CHECKING:
    import pynapple
    import xarray

ACTIVITY = "activity.zarr"
"""Folder of the recorded activity in that of a run."""

DEFAULT_RATE_HZ = 20.0
"""Samples a second."""

FORMAT = 1
"""Version of what is in the folder."""

TIMES = {"time_s": "<f8", "frame": "<i4"}
"""Columns of when a sample was taken, and their types."""

PATH = {
    "truth_m": (2, "<f8"), "truth_heading_rad": (1, "<f4"), "estimate_m": (2, "<f8"),
    "estimate_heading_rad": (1, "<f4"), "speed_m_s": (1, "<f4"),
}  # fmt: skip
"""Columns of the path: numbers of a row, and their type."""


class Spikes(NamedTuple):
    """Spikes of a population.

    Attributes:
        times_s: Of all spikes, rising, ``(m,)``.
        cells: Number of the cell of each, ``(m,)``.
        n_cells: Number of cells.
    """

    times_s: np.ndarray
    cells: np.ndarray
    n_cells: int

    def of(self, cell: int) -> np.ndarray:
        """Return the times of the spikes of one cell."""
        times: np.ndarray = self.times_s[self.cells == cell]
        return times


def _properties(stored: Any, name: str) -> dict[str, np.ndarray]:  # noqa: ANN401 - of JSON
    """Return what cells are tuned to as columns of numbers, booleans or texts."""
    try:
        found = {str(key): np.array(values) for key, values in stored.items()}
        wrong = [key for key, column in found.items() if column.dtype.kind not in "fiubU"]
    except (AttributeError, TypeError, ValueError, OverflowError) as error:
        raise CheckpointError(f"{name}: damaged ({error}); record it again") from None
    if wrong:
        raise CheckpointError(f"{name}: column {wrong[0]!r} is no column of numbers or texts")
    return found


class ActivityLog:
    """Activity of every population over time, with where the animal was; read into memory.

    A population is a dense array of samples times cells, in an order that does not change; a cell
    that was recruited during the run is 0 in the samples before.
    :func:`~neuroslam.runs.activity.record` makes one in Python, and ``neuroslam run ... --record
    cells`` writes one, which :meth:`open` reads.

    Attributes:
        rates: Activity by population, ``(n_samples, n_cells)``, float32.
        units: Unit of each: "Hz", or "1" for activity without a scale.
        cells: What the cells are tuned to, by population: columns ``(n_cells,)``.
        time_s: Time of each sample, ``(n_samples,)``.
        frame: Number of the frame of each.
        truth_m: True position, ``(n_samples, 2)``, NaN where the source does not know it.
        truth_heading_rad: And true heading.
        estimate_m: Position that the brain estimates, ``(n_samples, 2)``, in its own frame.
        estimate_heading_rad: And heading.
        speed_m_s: Measured speed.
        about: Source, config and rate of the record.

    Example:
        >>> log = ActivityLog.from_arrays(
        ...     [0.0, 0.1], np.zeros((2, 2)), {"grid": np.array([[0.0, 0.5], [1.0, 0.5]])}
        ... )
        >>> log["grid"].shape, log.names, log.n_samples
        ((2, 2), ('grid',), 2)
    """

    def __init__(
        self,
        columns: Mapping[str, np.ndarray],
        rates: Mapping[str, np.ndarray],
        units: Mapping[str, str] | None = None,
        cells: Mapping[str, Mapping[str, np.ndarray]] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        self.time_s = columns["time_s"]
        self.frame = columns["frame"]
        self.truth_m = columns["truth_m"]
        self.truth_heading_rad = columns["truth_heading_rad"]
        self.estimate_m = columns["estimate_m"]
        self.estimate_heading_rad = columns["estimate_heading_rad"]
        self.speed_m_s = columns["speed_m_s"]
        self.rates = dict(rates)
        self.units = {name: (units or {}).get(name, "1") for name in rates}
        self.cells = {
            name: {column: np.asarray(values) for column, values in of_one.items()}
            for name, of_one in (cells or {}).items()
            if name in self.rates
        }
        self.about = dict(about or {})

    @classmethod
    def from_arrays(
        cls,
        time_s: Any,  # noqa: ANN401 - whatever numpy takes
        position_m: np.ndarray,
        rates: Mapping[str, np.ndarray],
        heading_rad: np.ndarray | None = None,
        units: Mapping[str, str] | None = None,
    ) -> "ActivityLog":
        """Make a log of arrays that were recorded elsewhere.

        Args:
            time_s: Time of each sample, ``(n,)``.
            position_m: Of the animal, ``(n, 2)``.
            rates: Activity by population, ``(n, n_cells)``.
            heading_rad: Of the animal, ``(n,)``; ``None``: unknown.
            units: Of the activity; "1" where none is given.

        Raises:
            ConfigError: If the numbers of samples differ.
        """
        time_s, position = np.asarray(time_s, np.float64), np.asarray(position_m, np.float64)
        n = len(time_s)
        tables = {name: np.asarray(table, np.float32) for name, table in rates.items()}
        if position.shape != (n, 2) or any(t.ndim != 2 or len(t) != n for t in tables.values()):
            shapes = {"position_m": position.shape} | {k: t.shape for k, t in tables.items()}
            raise ConfigError(f"ActivityLog: {n} times, but {shapes}; expected ({n}, ...) of each")
        heading = np.full(n, np.nan) if heading_rad is None else np.asarray(heading_rad, np.float64)
        speed = np.zeros(n)
        if n > 1:
            speed[1:] = np.hypot(*np.diff(position, axis=0).T) / np.diff(time_s)
        columns = {
            "time_s": time_s, "frame": np.arange(n), "truth_m": position,
            "truth_heading_rad": heading, "estimate_m": np.full((n, 2), np.nan),
            "estimate_heading_rad": np.full(n, np.nan), "speed_m_s": speed,
        }  # fmt: skip
        return cls(columns, tables, units)

    @classmethod
    def open(cls, path: str | Path) -> "ActivityLog":
        """Read a recorded log: the folder of a run, or the folder ``activity.zarr`` in it.

        A log of a run that still goes on, or was killed, is read as far as it was written.

        Raises:
            CheckpointError: If there is none, or it is damaged, or memory does not suffice.
        """
        path = Path(path)
        path = path / ACTIVITY if (path / ACTIVITY).is_dir() else path
        about, names = attributes_of(path), array_names(path)
        if about.get("format") != FORMAT or not {*TIMES, *PATH} <= {*names}:
            raise CheckpointError(
                f"{path}: no recorded activity of format {FORMAT}; expected a folder that "
                "`neuroslam run ... --record cells` has written"
            )
        rows = min(rows_of(path, name) for name in names)
        columns = {name: read_array(path, name, rows) for name in (*TIMES, *PATH)}
        widths = {name: (1, dtype) for name, dtype in TIMES.items()} | PATH
        for name, (width, dtype) in widths.items():
            shape = (rows,) if width == 1 else (rows, width)
            if columns[name].shape != shape or columns[name].dtype != np.dtype(dtype):
                raise CheckpointError(
                    f"{path}/{name}: {columns[name].dtype} {columns[name].shape}; expected "
                    f"{np.dtype(dtype)} {shape}"
                )
        listed = about.get("populations")
        if not isinstance(listed, list):
            raise CheckpointError(f"{path}: does not list its populations; record it again")
        populations = [name for name in listed if name in names]
        rates = {name: read_array(path, name, rows) for name in populations}
        units, properties = {}, {}
        for name, table in rates.items():
            of_one = attributes_of(path, name)
            if table.ndim != 2 or not np.isfinite(table).all():
                raise CheckpointError(
                    f"{path}/{name}: {table.shape}, or not finite; record it again"
                )
            units[name] = str(of_one.get("units", "1"))
            properties[name] = _properties(of_one.get("cells", {}), f"{path}/{name}")
        return cls(columns, rates, units, properties, about)

    def __getitem__(self, name: str) -> np.ndarray:
        try:
            return self.rates[name]
        except KeyError:
            known = ", ".join(self.rates) or "none"
            raise ConfigError(
                f"ActivityLog: no population {name!r}; recorded are: {known}"
            ) from None

    def __repr__(self) -> str:
        sizes = ", ".join(f"{name} {table.shape[1]}" for name, table in self.rates.items())
        return f"ActivityLog({self.n_samples} samples, cells: {sizes or 'none'})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the populations."""
        return tuple(self.rates)

    @property
    def n_samples(self) -> int:
        """Number of samples."""
        return len(self.time_s)

    @property
    def has_truth(self) -> bool:
        """Whether the source knew the true position in every sample."""
        return self.n_samples > 0 and bool(np.isfinite(self.truth_m).all())

    @property
    def position_m(self) -> np.ndarray:
        """Position of the animal: the true one, or, where it is not known, that of the brain."""
        return self.truth_m if self.has_truth else self.estimate_m

    @property
    def heading_rad(self) -> np.ndarray:
        """Heading of the animal, true or of the brain as :attr:`position_m`."""
        return self.truth_heading_rad if self.has_truth else self.estimate_heading_rad

    def spikes(self, name: str, seed: int = 0, peak_hz: float = 20.0) -> Spikes:
        r"""Draw a Poisson spike train of each cell of a population.

        .. math:: n \sim \mathrm{Poisson}(r\,\Delta t)

        spikes in each interval between two samples, at uniform times in it. Rates in Hz are taken
        as they are; activity without a scale is scaled so that the largest of the population is
        ``peak_hz``. The same seed gives the same spikes.

        Args:
            name: The population.
            seed: Of the draws.
            peak_hz: Rate of the most active cell, where the activity has no unit.

        Raises:
            ConfigError: If there is no such population.
        """
        rates = np.maximum(self[name].astype(np.float64), 0.0)
        if self.units[name] != "Hz" and rates.size:
            rates *= peak_hz / max(float(rates.max()), 1e-12)
        steps = np.diff(self.time_s)
        if len(steps):
            # A pause in the record is no time to fire in.
            steps = np.minimum(np.append(steps, steps[-1]), 2.0 * np.median(steps))
        else:
            steps = np.zeros(len(rates))
        draw = np.random.default_rng(seed)
        counts = draw.poisson(rates * steps[:, None])
        sample, cell = counts.nonzero()
        times = counts[sample, cell]
        sample, cell = sample.repeat(times), cell.repeat(times)
        at = self.time_s[sample] + draw.random(len(sample)) * steps[sample]
        order = np.argsort(at, kind="stable")
        return Spikes(at[order], cell[order], rates.shape[1])

    def to_xarray(self) -> "xarray.Dataset":
        """Return an ``xarray.Dataset``; needs the extra ``neuro``.

        Raises:
            ConfigError: If xarray is not installed.
        """
        from neuroslam.state.activity_formats import to_xarray

        return to_xarray(self)

    def to_pynapple(self) -> dict[str, "pynapple.TsdFrame | pynapple.Tsd"]:
        """Return pynapple's time series by name; needs the extra ``neuro``.

        ``position`` (columns x, y), ``head_direction`` in [0, 2 pi), ``speed``, and populations.

        Raises:
            ConfigError: If pynapple is not installed.
        """
        from neuroslam.state.activity_formats import to_pynapple

        return to_pynapple(self)

    def to_nwb(
        self,
        path: str | Path,
        spikes: Iterable[str] = (),
        seed: int = 0,
        about: Mapping[str, Any] | None = None,
    ) -> Path:
        """Write a file of Neurodata Without Borders; needs the extra ``neuro``.

        Args:
            path: The file, which is replaced.
            spikes: Populations whose Poisson spikes are written as units, see :meth:`spikes`.
            seed: Of these spikes.
            about: Fields of ``pynwb.NWBFile`` that replace the defaults, and ``subject``.

        Raises:
            ConfigError: If pynwb is not installed.
        """
        from neuroslam.state.activity_formats import write_nwb

        return write_nwb(self, Path(path), tuple(spikes), seed, about or {})
