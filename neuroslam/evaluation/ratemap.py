"""Rate maps of cells: occupancy, firing rate, firing fields and spatial information."""

from typing import NamedTuple, Self

import numpy as np

from neuroslam.errors import MapError

_LEAST_FIELD_M2 = 0.002  # about three bins of 2.5 cm
_ROUNDING_BINS = 1e-6  # a box that is a whole number of bins but for rounding gets no extra bin


class Bins(NamedTuple):
    """Square bins over the plane; a map over them is ``(n_y, n_x)``, row 0 at the smallest y.

    Attributes:
        x_min_m: Left edge of the first column.
        y_min_m: Lower edge of the first row.
        n_x: Columns.
        n_y: Rows.
        bin_m: Side of a bin.
    """

    x_min_m: float
    y_min_m: float
    n_x: int
    n_y: int
    bin_m: float

    @classmethod
    def around(cls, points_m: np.ndarray, bin_m: float = 0.025) -> Self:
        """Cover the box around some points: two opposite corners, vertices, or a whole track.

        The edges are multiples of ``bin_m``, so maps of several recordings share their bins.

        Args:
            points_m: ``(n, 2)``, metres.
            bin_m: Side of a bin.

        Raises:
            MapError: If the points are not finite ``(n, 2)``, or ``bin_m`` is not positive.

        Example:
            >>> Bins.around([[-0.5, -0.25], [0.5, 0.25]], bin_m=0.025).shape
            (20, 40)
        """
        if not (np.isfinite(bin_m) and bin_m > 0.0):
            raise MapError(f"Bins: bin_m is {bin_m:g}, expected a positive length in metres")
        points = _as_points("Bins", points_m)
        if not (len(points) and np.isfinite(points).all()):
            bad = int((~np.isfinite(points)).any(axis=1).sum())
            raise MapError(
                f"Bins: {len(points)} point(s), {bad} not finite; expected at least one, all finite"
            )
        low = np.floor(points.min(axis=0) / bin_m + _ROUNDING_BINS)
        high = np.ceil(points.max(axis=0) / bin_m - _ROUNDING_BINS)
        n_x, n_y = np.maximum(high - low, 1).astype(int).tolist()
        x_min, y_min = (low * bin_m).tolist()
        return cls(x_min, y_min, n_x, n_y, float(bin_m))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape ``(n_y, n_x)`` of a map."""
        return self.n_y, self.n_x

    @property
    def extent_m(self) -> tuple[float, float, float, float]:
        """Left, right, lower, upper edge: what ``imshow(..., origin="lower")`` takes."""
        x_max = self.x_min_m + self.n_x * self.bin_m
        return self.x_min_m, x_max, self.y_min_m, self.y_min_m + self.n_y * self.bin_m

    def flat_index(self, positions: np.ndarray) -> np.ndarray:
        """Return the flat index of the bin of every position, -1 outside (NaN is outside).

        The upper edges belong to the last bins.

        Example:
            >>> bins = Bins(0.0, 0.0, 2, 2, 0.5)
            >>> bins.flat_index([[0.1, 0.1], [1.0, 0.7], [1.1, 0.0]]).tolist()
            [0, 3, -1]
        """
        at = (_as_points("Bins", positions) - (self.x_min_m, self.y_min_m)) / self.bin_m
        size = np.array([self.n_x, self.n_y])
        inside = np.all((at >= -_ROUNDING_BINS) & (at <= size + _ROUNDING_BINS), axis=1)
        column, row = np.clip(np.where(inside[:, None], at, 0.0).astype(np.int64), 0, size - 1).T
        return np.where(inside, row * self.n_x + column, -1)


class RateMaps:
    """Accumulator of rate maps: sums of activity and counts of samples in every bin.

    Sums and counts are kept, not their quotient, so two recordings add up (``first + second``) to
    the maps of one long recording. All parts should have the same sampling rate.

    Attributes:
        bins: The bins.
        sums: Activity summed, ``(N, n_y, n_x)``.
        counts: Samples, ``(n_y, n_x)``.
        n_outside: Samples that were in no bin and were left out.

    Example:
        >>> maps = RateMaps(Bins(0.0, 0.0, 2, 1, 0.5), n_cells=1)
        >>> maps.add([[0.1, 0.2], [0.2, 0.2]], [[1.0], [3.0]])
        >>> maps.maps(sigma_bins=0.0).tolist()
        [[[2.0, nan]]]
    """

    def __init__(self, bins: Bins, n_cells: int) -> None:
        self.bins = bins
        self.sums = np.zeros((n_cells, *bins.shape))
        self.counts = np.zeros(bins.shape)
        self.n_outside = 0

    def add(self, positions: np.ndarray, activity: np.ndarray) -> None:
        """Add some samples.

        Args:
            positions: ``(T, 2)``, metres; those outside the bins or NaN are counted and left out.
            activity: ``(T, N)``, or ``(T,)`` for one cell.

        Raises:
            MapError: If the shapes do not fit, or an activity is not finite.
        """
        positions = _as_points("RateMaps", positions)
        activity = np.asarray(activity, dtype=np.float64)
        activity = activity[:, None] if activity.ndim == 1 else activity
        expected = (len(positions), len(self.sums))
        if activity.shape != expected:
            raise MapError(
                f"RateMaps: activity has shape {activity.shape}, expected (T, N) = {expected}; "
                "give a row for each position and a column for each cell"
            )
        if not np.isfinite(activity).all():
            cell = int(np.flatnonzero(~np.isfinite(activity).all(axis=0))[0])
            raise MapError(f"RateMaps: activity of cell {cell} is not finite; leave such cells out")
        from scipy.sparse import csr_array  # slow to import, not always needed

        index = self.bins.flat_index(positions)
        inside = np.flatnonzero(index >= 0)
        n_bins = self.counts.size
        membership = csr_array(
            (np.ones(len(inside)), (index[inside], inside)), shape=(n_bins, len(index))
        )
        self.sums = self.sums + (membership @ activity).T.reshape(self.sums.shape)
        self.counts = self.counts + np.bincount(index[inside], minlength=n_bins).reshape(
            self.counts.shape
        )
        self.n_outside += len(index) - len(inside)

    def __add__(self, other: Self) -> Self:
        """Return the sum of two recordings of the same cells over the same bins."""
        if self.bins != other.bins or len(self.sums) != len(other.sums):
            raise MapError(
                f"RateMaps: cannot add {len(other.sums)} cell(s) over {other.bins} to "
                f"{len(self.sums)} over {self.bins}; both need the same bins and cells"
            )
        both = type(self)(self.bins, len(self.sums))
        both.sums, both.counts = self.sums + other.sums, self.counts + other.counts
        both.n_outside = self.n_outside + other.n_outside
        return both

    def maps(
        self,
        sigma_bins: float = 1.5,
        min_occupancy_samples: float = 1.0,
        closing_bins: int = 0,
    ) -> np.ndarray:
        r"""Return mean activity per bin, smoothed, ``(N, n_y, n_x)``; NaN where unvisited.

        .. math:: \lambda(x) = \frac{\sum_{x'} G(x - x') \, S(x')}{\sum_{x'} G(x - x') \, T(x')}

        Sums :math:`S` and counts :math:`T` are smoothed by the same kernel, so an unvisited bin has
        no weight and a constant activity gives a constant map up to the edge.

        Args:
            sigma_bins: Standard deviation of the Gaussian :math:`G`; 0 does not smooth.
            min_occupancy_samples: A bin with fewer samples is unvisited.
            closing_bins: Fill gaps between visited bins, up to twice so many bins wide, with what
                the smoothing gives there; the outline of the visited bins stays.
        """
        visited = self.counts >= max(min_occupancy_samples, 1e-12)
        if closing_bins and sigma_bins > 0.0:
            from scipy import ndimage

            wide = np.pad(visited, closing_bins)  # else the edge of the map would be a gap
            square = np.ones((3, 3), bool)
            closed = ndimage.binary_closing(wide, square, iterations=closing_bins)
            inner = slice(closing_bins, -closing_bins)
            visited = visited | np.asarray(closed, dtype=bool)[inner, inner]
        sums, counts = self.sums, self.counts
        if sigma_bins > 0.0:
            from scipy import ndimage

            sums = ndimage.gaussian_filter(sums, (0.0, sigma_bins, sigma_bins), mode="constant")
            counts = ndimage.gaussian_filter(counts, sigma_bins, mode="constant")
        maps = np.full(sums.shape, np.nan)
        np.divide(sums, counts, out=maps, where=np.broadcast_to(visited, maps.shape))
        return maps


def rate_map(
    positions: np.ndarray,
    activity: np.ndarray,
    bins: Bins | None = None,
    sigma_bins: float = 1.5,
    min_occupancy_samples: float = 1.0,
) -> np.ndarray:
    """Return the smoothed rate maps ``(N, n_y, n_x)`` of one recording; see :class:`RateMaps`.

    Args:
        positions: ``(T, 2)``, metres.
        activity: ``(T, N)``, or ``(T,)`` for one cell.
        bins: ``None`` covers the positions with bins of 2.5 cm.
        sigma_bins: As in :meth:`RateMaps.maps`.
        min_occupancy_samples: As in :meth:`RateMaps.maps`.

    Raises:
        MapError: As :meth:`RateMaps.add`.

    Example:
        >>> rate_map([[0.01, 0.01], [0.04, 0.01]], [0.0, 4.0], sigma_bins=0.0).tolist()
        [[[0.0, 4.0]]]
    """
    activity = np.asarray(activity, dtype=np.float64)
    n_cells = activity.shape[1] if activity.ndim == 2 else 1
    gathered = RateMaps(Bins.around(positions) if bins is None else bins, n_cells)
    gathered.add(positions, activity)
    return gathered.maps(sigma_bins, min_occupancy_samples)


def spike_map(
    positions: np.ndarray,
    times: np.ndarray,
    spikes_s: np.ndarray,
    bins: Bins | None = None,
    sigma_bins: float = 1.5,
    min_occupancy_samples: float = 1.0,
) -> np.ndarray:
    """Return the rate map of a recorded cell in Hz, ``(n_y, n_x)``; see :class:`RateMaps`.

    A spike gets the position of the sample nearest in time; spikes before the first or after the
    last sample are left out. Every sample lasts the median interval.

    Args:
        positions: ``(T, 2)``, metres.
        times: ``(T,)``, seconds, rising.
        spikes_s: Times of the spikes, any number of them.
        bins: ``None`` covers the positions with bins of 2.5 cm.
        sigma_bins: As in :meth:`RateMaps.maps`.
        min_occupancy_samples: As in :meth:`RateMaps.maps`.

    Raises:
        MapError: As :meth:`RateMaps.add`, or if there are not as many rising times as positions.

    Example:
        >>> here, there = [0.01, 0.01], [0.04, 0.01]
        >>> spike_map([here, here, there], [0.0, 0.1, 0.2], [0.11, 0.12], sigma_bins=0.0).round(6)
        array([[10.,  0.]])
    """
    positions = _as_points("spike_map", positions)
    times, spikes = (np.asarray(values, dtype=np.float64).ravel() for values in (times, spikes_s))
    if len(times) != len(positions) or len(times) < 2 or not (np.diff(times) > 0.0).all():
        raise MapError(
            f"spike_map: {len(times)} times for {len(positions)} positions; expected as many, at "
            "least two, and rising"
        )
    interval = float(np.median(np.diff(times)))
    spikes = spikes[(spikes >= times[0] - interval / 2) & (spikes <= times[-1] + interval / 2)]
    nearest = np.searchsorted((times[:-1] + times[1:]) / 2, spikes)
    per_sample = np.bincount(nearest, minlength=len(times)) / interval
    (of_cell,) = rate_map(positions, per_sample, bins, sigma_bins, min_occupancy_samples)
    return of_cell


class Fields(NamedTuple):
    """The firing fields of every cell.

    Attributes:
        n_fields: Number of fields, ``(N,)``.
        area_m2: Area of the largest field, ``(N,)``; NaN without a field.
        diameter_m: Diameter of the disc of that area, ``(N,)``.
    """

    n_fields: np.ndarray
    area_m2: np.ndarray
    diameter_m: np.ndarray


def fields(
    maps: np.ndarray, bin_m: float, threshold: float = 0.5, min_area_m2: float = _LEAST_FIELD_M2
) -> Fields:
    """Find the firing fields: connected regions above a share of the map's own peak.

    Bins that touch by a side are connected. A cell that never fires has no field.

    Args:
        maps: ``(N, n_y, n_x)``, or one ``(n_y, n_x)``; NaN where unvisited.
        bin_m: Side of a bin.
        threshold: Share of the peak.
        min_area_m2: Smallest field; the default is about three bins of 2.5 cm.

    Raises:
        MapError: If the maps have another number of dimensions.

    Example:
        >>> two = np.array([[9.0, 9.0, 0.0, 5.0], [9.0, 9.0, 0.0, np.nan]])
        >>> found = fields(two, bin_m=0.1)
        >>> found.n_fields.tolist(), found.area_m2.round(3).tolist()
        ([2], [0.04])
    """
    from scipy import ndimage

    maps = _as_maps("fields", maps)
    filled = np.where(np.isfinite(maps), maps, -np.inf)
    peak = np.maximum(filled.max(axis=(1, 2), keepdims=True), 0.0)
    above = (filled > threshold * peak) & (peak > 0.0)
    labels, n = label_regions(above)
    area = np.bincount(labels.ravel(), minlength=n + 1)[1:] * bin_m**2
    cell = ndimage.maximum(np.arange(len(maps))[:, None, None], labels, np.arange(1, n + 1))
    cell = np.asarray(cell, dtype=np.int64)  # a region lies within one map
    large = area >= min_area_m2
    largest = np.zeros(len(maps))
    np.maximum.at(largest, cell[large], area[large])
    count = np.bincount(cell[large], minlength=len(maps))
    largest = np.where(count > 0, largest, np.nan)
    return Fields(count, largest, 2.0 * np.sqrt(largest / np.pi))


def field_activity(
    maps: np.ndarray, sums: np.ndarray, bin_m: float, threshold: float = 0.5
) -> tuple[np.ndarray, np.ndarray]:
    """Return the cell of each firing field, and the activity summed over it.

    Args:
        maps: As for :func:`fields`.
        sums: Activity summed in every bin, ``(N, n_y, n_x)``, as in :class:`RateMaps`.
        bin_m: Side of a bin.
        threshold: Share of the peak.

    Example:
        >>> two = np.array([[[9.0, 9.0, 0.0, 5.0], [9.0, 9.0, 0.0, 5.0]]])
        >>> cell, total = field_activity(two, 2.0 * two, bin_m=0.1)
        >>> cell.tolist(), total.tolist()
        ([0, 0], [72.0, 20.0])
    """
    from scipy import ndimage

    maps = _as_maps("field_activity", maps)
    filled = np.where(np.isfinite(maps), maps, -np.inf)
    peak = np.maximum(filled.max(axis=(1, 2), keepdims=True), 0.0)
    labels, n = label_regions((filled > threshold * peak) & (peak > 0.0))
    each = np.arange(1, n + 1)
    cell = np.asarray(ndimage.maximum(np.arange(len(maps))[:, None, None], labels, each), np.int64)
    total = np.asarray(ndimage.sum(sums, labels, each))
    large = np.bincount(labels.ravel(), minlength=n + 1)[1:] * bin_m**2 >= _LEAST_FIELD_M2
    return cell[large], total[large]


def label_regions(above: np.ndarray) -> tuple[np.ndarray, int]:
    """Number the connected regions of each map of a stack; bins that touch by a side connect.

    Args:
        above: Bins of the regions, ``(N, n_y, n_x)``.

    Returns:
        Number of each bin's region, 0 outside; and how many regions all maps have.

    Example:
        >>> label_regions(np.array([[[True, False, True]], [[True, True, False]]]))
        (array([[[1, 0, 2]], [[3, 3, 0]]], dtype=int32), 3)
    """
    from scipy import ndimage

    within_a_map = np.zeros((3, 3, 3), dtype=bool)
    within_a_map[1] = ndimage.generate_binary_structure(2, 1)
    labels = np.zeros(above.shape, np.int32)
    ndimage.label(above, within_a_map, output=labels)
    return labels, int(labels.max(initial=0))


def responding(activity: np.ndarray, threshold: float = 0.5) -> np.ndarray:
    """Count the cells that fire above a share of the strongest at that instant, ``(T,)``.

    The count is 0 while no cell is active.

    Args:
        activity: ``(T, N)``.
        threshold: Share of the maximum.

    Raises:
        MapError: If the activity is not ``(T, N)`` with at least one cell.

    Example:
        >>> responding([[1.0, 0.6, 0.5], [0.0, 0.0, 0.0]]).tolist()
        [2, 0]
    """
    activity = np.asarray(activity)
    if activity.ndim != 2 or activity.shape[1] == 0:
        raise MapError(f"responding: activity has shape {activity.shape}, expected (T, N)")
    strongest = activity.max(axis=1, keepdims=True)
    return np.sum((activity > threshold * strongest) & (strongest > 0.0), axis=1)


def coverage(maps: np.ndarray, inside: np.ndarray | None = None) -> np.ndarray:
    """Return the visited share of the bins, for every map.

    Args:
        maps: ``(..., n_y, n_x)``; NaN where unvisited.
        inside: Which bins can be visited at all, ``(n_y, n_x)``; ``None`` is every bin.

    Raises:
        MapError: If no bin can be visited, or the shapes differ.

    Example:
        >>> float(coverage(np.array([[1.0, 0.0], [np.nan, 2.0]])))
        0.75
    """
    visited = np.isfinite(np.asarray(maps))
    inside = np.ones(visited.shape[-2:], bool) if inside is None else np.asarray(inside, bool)
    if inside.shape != visited.shape[-2:] or not inside.any():
        raise MapError(
            f"coverage: inside has shape {inside.shape} and {int(inside.sum())} bin(s), expected "
            f"{visited.shape[-2:]} and at least one"
        )
    return np.asarray(np.sum(visited & inside, axis=(-2, -1)) / inside.sum())


def spatial_information(maps: np.ndarray, occupancy: np.ndarray) -> np.ndarray:
    r"""Return the spatial information of each cell in bits per spike, ``(N,)``.

    .. math:: I = \sum_x p(x) \frac{\lambda(x)}{\bar\lambda} \log_2 \frac{\lambda(x)}{\bar\lambda},
              \qquad \bar\lambda = \sum_x p(x) \lambda(x)

    By W. E. Skaggs, B. L. McNaughton, K. M. Gothard and E. J. Markus, "An information-theoretic
    approach to deciphering the hippocampal code", NIPS 5, 1993. Times :math:`\bar\lambda` it is
    bits per second. A short recording biases it upwards, smoothing downwards.

    Args:
        maps: Rates, ``(N, n_y, n_x)`` or one ``(n_y, n_x)``, not negative; NaN where unvisited.
        occupancy: Time or samples per bin, ``(n_y, n_x)``, of any scale.

    Returns:
        Bits per spike, at least 0; NaN for a cell that never fires.

    Raises:
        MapError: If a rate is negative, the shapes differ, or no visited bin has an occupancy.

    Example:
        >>> quarter = np.array([[8.0, 0.0], [0.0, 0.0]])  # fires in one of four equal bins
        >>> spatial_information(quarter, np.ones((2, 2))).tolist()
        [2.0]
    """
    maps = _as_maps("spatial_information", maps)
    occupancy = np.asarray(occupancy, dtype=np.float64)
    if occupancy.shape != maps.shape[1:]:
        raise MapError(
            f"spatial_information: occupancy has shape {occupancy.shape}, expected that of a map, "
            f"{maps.shape[1:]}"
        )
    if (maps < 0.0).any():
        raise MapError("spatial_information: a rate is negative; expected rates, not potentials")
    visited = np.isfinite(maps)
    weight = np.where(visited, occupancy, 0.0)
    total = weight.sum(axis=(1, 2), keepdims=True)
    if not (total > 0.0).all():
        raise MapError("spatial_information: a map has no visited bin; record for longer")
    rate = np.where(visited, maps, 0.0)
    mean = (weight * rate).sum(axis=(1, 2), keepdims=True) / total
    ratio = np.divide(rate, mean, out=np.zeros_like(rate), where=mean > 0.0)
    log = np.log2(ratio, out=np.zeros_like(ratio), where=ratio > 0.0)
    bits = np.maximum((weight / total * ratio * log).sum(axis=(1, 2)), 0.0)  # -1e-17 is rounding
    return np.where(mean[:, 0, 0] > 0.0, bits, np.nan)


def _as_points(who: str, points_m: np.ndarray) -> np.ndarray:
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise MapError(f"{who}: points have shape {points.shape}, expected (n, 2) in metres")
    return points


def _as_maps(who: str, maps: np.ndarray) -> np.ndarray:
    maps = np.asarray(maps, dtype=np.float64)
    if maps.ndim not in (2, 3) or maps.size == 0:
        raise MapError(f"{who}: maps have shape {maps.shape}, expected (N, n_y, n_x), not empty")
    return maps.reshape(-1, *maps.shape[-2:])
