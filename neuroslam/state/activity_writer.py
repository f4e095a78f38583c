"""Recording of the activity of all cells: to disk while a brain runs, or into memory."""

import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from neuroslam.errors import ConfigError
from neuroslam.state.activity import DEFAULT_RATE_HZ, FORMAT, PATH, TIMES, ActivityLog
from neuroslam.state.arrays import (
    ROWS,
    ArrayFolder,
    array_names,
    attributes_of,
    read_array,
    rows_of,
)
from neuroslam.state.population import Population
from neuroslam.types import Frame, StepResult

_BUFFER = 4 * ROWS  # samples that are written at once: each writing opens every array
_FLUSH_S = 2.0  # wall-clock time after which rows are written, though their block is not full
_ROUNDING = 1e-6  # share of a sample
_UNKNOWN = (np.nan, np.nan, np.nan)


class ActivityWriter:
    """Records the activity of a brain's cells: to disk while it runs, or into memory.

    A sample is taken at most ``rate_hz`` times a second of the source's time. On disk rows are
    written every 2048 samples, or two seconds of wall-clock time: what a killed run can lose.

    Args:
        path: Folder to write; ``None``: keep the samples in memory.
        rate_hz: Samples a second.
        only: Populations to record; ``None``: all.
        about: What is known of the record; JSON.

    Raises:
        ConfigError: If the rate is not above 0.
    """

    def __init__(
        self,
        path: Path | None,
        rate_hz: float = DEFAULT_RATE_HZ,
        only: Iterable[str] | None = None,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        if not 0.0 < rate_hz < np.inf:
            raise ConfigError(f"rate of the record is {rate_hz} Hz; expected a number above 0")
        self.rate_hz = rate_hz
        self.only = None if only is None else tuple(only)
        self._about = {
            "format": FORMAT, "rate_hz": rate_hz, "only": self.only, "populations": [],
        } | dict(about or {})  # fmt: skip
        self._names: list[str] = []
        self._units: dict[str, str] = {}
        self._cells: dict[str, dict[str, np.ndarray]] = {}
        self._start_s: float | None = None
        self._last = -1  # number of the last sample, at the rate
        self._rows = 0  # written
        self._n = 0  # in the buffers
        self._flushed = time.monotonic()
        self._path_rows: list[tuple[float, ...]] = []
        self._buffers: dict[str, np.ndarray] = {}
        self._widths: dict[str, int] = {}
        self._kept: list[dict[str, np.ndarray]] = []
        self.path = path
        self._folder = None if path is None else ArrayFolder(path, self._about)

    @classmethod
    def reopen(cls, path: Path, last_frame: int) -> "ActivityWriter":
        """Write on after a frame; the samples after it are forgotten.

        Raises:
            CheckpointError: If the folder holds no log.
        """
        about = attributes_of(path)
        writer = cls(None, float(about["rate_hz"]), about["only"])
        writer._about, writer.path = about, path
        writer._names = list(about["populations"])
        for name in writer._names:
            writer._units[name] = str(attributes_of(path, name).get("units", "1"))
        rows = min((rows_of(path, name) for name in array_names(path)), default=0)
        if rows:
            frames, times = (read_array(path, name, rows) for name in ("frame", "time_s"))
            rows = int(np.searchsorted(frames, last_frame, side="right"))
            if rows:
                writer._start_s = float(times[0])
                writer._last = writer._number(float(times[rows - 1]))
        writer._rows = rows
        writer._folder = ArrayFolder.reopen(path, rows)
        return writer

    def _number(self, time_s: float) -> int:
        return int((time_s - cast(float, self._start_s)) * self.rate_hz + _ROUNDING)

    def note(self, result: StepResult, frame: Frame, populations: Mapping[str, Population]) -> None:
        """Take a sample, if one is due.

        Args:
            result: Of the brain's step.
            frame: That it was given.
            populations: Of the brain.

        Raises:
            ConfigError: If a population to record is none of those of the brain.
        """
        time_s = result.time_s
        if self._start_s is None:
            self._start_s = time_s
        number = int((time_s - self._start_s) * self.rate_hz + _ROUNDING)
        if number <= self._last:
            return
        self._last = number
        i, truth = self._n, frame.truth or _UNKNOWN
        self._path_rows.append((time_s, result.frame, *truth, *result.pose, result.motion.v_m_s))
        for population in populations.values():
            if not population.record_into(self._buffers, self._widths, i):
                self._copy(population, i)
        self._n = i + 1
        if i == 0 and self.only is not None and not self._rows:
            self._refuse_unknown(populations)
        if self._n == _BUFFER or time.monotonic() - self._flushed > _FLUSH_S:
            self.flush()

    def _copy(self, population: Population, i: int) -> None:
        """Write what a population records into row ``i`` of the buffers."""
        for name, rates in population.recorded().items():
            if self.only is not None and name not in self.only:
                continue
            n = len(rates)
            buffer = self._buffers.get(name)
            if buffer is None or buffer.shape[1] < n:
                buffer = self._widened(name, n, population)
            buffer[i, :n] = rates
            if n > self._widths[name]:
                self._widths[name] = n

    def _widened(self, name: str, n: int, population: Population) -> np.ndarray:
        """Return a buffer for as many cells, which holds what the one before held."""
        before = self._buffers.get(name)
        if name not in self._names:
            if name in (*TIMES, *PATH) or not name.replace("_", "").isalnum():
                raise TypeError(
                    f"{type(population).__name__}.recorded(): {name!r} is no name for a record; "
                    "expected letters, digits and _, and none of the columns of the path"
                )
            self._names.append(name)
            self._units[name] = population.rate_units.get(name, "1")
        if before is None:
            buffer = np.zeros((_BUFFER, n), np.float32)
        else:
            buffer = np.zeros((_BUFFER, max(n, 2 * before.shape[1])), np.float32)
            buffer[: self._n, : before.shape[1]] = before[: self._n]
        self._buffers[name] = buffer
        self._widths.setdefault(name, n)
        return buffer

    def _refuse_unknown(self, populations: Mapping[str, Population]) -> None:
        missing = sorted({*(self.only or ())} - {*self._names})
        if missing:
            there = [name for each in populations.values() for name in each.recorded()]
            raise ConfigError(
                f"--record: no population {missing[0]!r} in this brain; it has: "
                f"{', '.join(there) or 'none with activity'}"
            )

    def describe(self, populations: Mapping[str, Population]) -> None:
        """Store what the cells are tuned to, as far as they are recruited now."""
        for population in populations.values():
            for name, columns in population.cell_properties().items():
                self._cells[name] = {key: np.asarray(value) for key, value in columns.items()}
        if self._folder is not None:
            self._write_attributes()

    def _write_attributes(self) -> None:
        folder = cast(ArrayFolder, self._folder)
        self._about["populations"] = self._names
        folder.describe(self._about)
        for name in self._names:
            cells = {key: value.tolist() for key, value in self._cells.get(name, {}).items()}
            labels = {"units": self._units[name], "cells": cells}
            folder.describe({"_ARRAY_DIMENSIONS": ["time", f"{name}_cell"]} | labels, name)

    def flush(self) -> None:
        """Write the samples in the buffers.

        Raises:
            OSError: If the folder cannot be written.
        """
        self._flushed = time.monotonic()
        if not self._n:
            return
        table = np.array(self._path_rows)
        columns = [*TIMES, "truth_m", "truth_heading_rad"]
        columns += ["estimate_m", "estimate_heading_rad", "speed_m_s"]
        blocks, at = {}, 0
        for name in columns:
            width, dtype = PATH.get(name) or (1, TIMES[name])
            part = table[:, at] if width == 1 else table[:, at : at + width]
            blocks[name], at = part.astype(dtype), at + width
        for name, buffer in self._buffers.items():
            blocks[name] = buffer[: self._n, : self._widths[name]]
        if self._folder is None:
            self._kept.append({name: block.copy() for name, block in blocks.items()})
        else:
            before = len(array_names(self._folder.path)) if not self._rows else -1
            self._folder.append(self._rows, blocks)
            if before >= 0 or self._about["populations"] != self._names:
                for name in blocks.keys() - self._buffers.keys():
                    dimensions = ["time", "axis"][: blocks[name].ndim]
                    self._folder.describe({"_ARRAY_DIMENSIONS": dimensions}, name)
                self._write_attributes()
        for name, buffer in self._buffers.items():
            buffer[: self._n, : self._widths[name]] = 0.0
        self._path_rows.clear()
        self._rows, self._n = self._rows + self._n, 0

    def moved(self, path: Path) -> None:
        """Write on in a folder to which the files were moved."""
        self.path = path
        if self._folder is not None:
            self._folder.path = path

    def log(self) -> ActivityLog:
        """Return what was recorded so far."""
        self.flush()
        if self.path is not None:
            return ActivityLog.open(self.path)
        sizes = {name: 0 for name in self._names}
        for block in self._kept:
            for name in self._names:
                sizes[name] = max(sizes[name], block[name].shape[1] if name in block else 0)
        rates = {name: np.zeros((self._rows, n), np.float32) for name, n in sizes.items()}
        at = 0
        for block in self._kept:
            rows = len(block["time_s"])
            for name in self._names:
                if name in block:
                    rates[name][at : at + rows, : block[name].shape[1]] = block[name]
            at += rows
        columns = {}
        widths = {name: (1, dtype) for name, dtype in TIMES.items()} | PATH
        for name, (width, dtype) in widths.items():
            parts = [block[name] for block in self._kept]
            shape = (0,) if width == 1 else (0, width)
            columns[name] = np.concatenate(parts) if parts else np.zeros(shape, dtype)
        return ActivityLog(columns, rates, self._units, self._cells, self._about)
