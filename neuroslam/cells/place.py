"""Place cells: a competitive Hebbian network on grid cells that recruits cells as it explores."""

import math
from typing import Any, NamedTuple, Self, cast

import numpy as np
import torch
from torch import Tensor

from neuroslam.compiled import compiled, runs_compiled
from neuroslam.config import PlaceCellConfig
from neuroslam.state.mergeable import Arrays, BufferModule, without_gradients
from neuroslam.state.pickling import Calls
from neuroslam.state.tables import Scalars

NEIGHBOURS = 12
"""Largest number of links of a place cell to those that won before or after it."""

_WINDOW = 32  # nearest cells, which compete
_SLACK_M = 0.06  # displacement after which the window is looked up again
_STILL = 1 / 4  # share of threshold_m below which a displacement keeps the winner
_ROOM = 64  # initial capacity of a table
_SILENT = -18.0  # logarithm of a response below which it counts as 0: 2e-8
_NO_CELL = -1
FAR_M = 1e6
"""Coordinate of the centres of unused rows."""

EMPTY = {"weights": 0.0, "centres_m": FAR_M, "visits": 0, "time_s": 0.0, "neighbours": _NO_CELL}
"""Columns of the table of cells, and the values of unused rows."""


class PlaceResponse(NamedTuple):
    """Result of the competition of place cells.

    Attributes:
        winner: Number of the winning cell, ``([batch])``; -1 while there is none.
        recruited: Whether it was recruited in this step.
        changed: Whether another cell won before.
    """

    winner: Tensor
    recruited: Tensor
    changed: Tensor


def place_response(
    weights: Tensor, away_m2: Tensor, grid: Tensor, power: float, continuity_m: float
) -> Tensor:
    r"""Return the responses of place cells before they compete.

    .. math:: p_j = [\mathbf w_j \cdot \hat{\mathbf g}]_+^a
              \exp\!\Big(-\frac{|X_j - x|^2}{2\sigma^2}\Big)

    The second factor excludes far cells with a similar grid pattern (SLRB, Algorithm 1, has none).

    Args:
        weights: :math:`\mathbf w_j`, unit vectors, ``(..., n, n_grid)``.
        away_m2: :math:`|X_j - x|^2`, ``(..., n)``.
        grid: :math:`\hat{\mathbf g}`, the grid cells' rates as a unit vector, ``(..., n_grid)``.
        power: :math:`a`.
        continuity_m: :math:`\sigma`.

    Returns:
        ``(..., n)``, from 0 to 1.
    """
    similarity = (weights @ grid.unsqueeze(-1)).squeeze(-1).clamp_min(0.0)
    return similarity.pow(power) * (away_m2 * (-0.5 / continuity_m**2)).exp()


def excited(response: Tensor, centres_m: Tensor, gain: float, width_m: float) -> Tensor:
    r"""Let place cells excite each other by a kernel over the distance of their centres.

    .. math:: e_j = p_j + g \sum_k e^{-|X_j - X_k|^2 / 2 s^2} \, p_k

    Cells lie anywhere, so that the convolution is a product with the kernel of their distances.

    Args:
        response: :math:`p`, ``(..., n)``.
        centres_m: :math:`X`, ``(..., n, 2)``.
        gain: :math:`g`.
        width_m: :math:`s`.

    Returns:
        ``(..., n)``; for a narrow kernel :math:`(1 + g)\,p`.

    Example:
        >>> line = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.2, 0.0]])
        >>> excited(torch.tensor([0.0, 1.0, 0.0]), line, 0.5, 0.1).tolist()[1]
        1.5
    """
    squares = (centres_m.unsqueeze(-2) - centres_m.unsqueeze(-3)).square().sum(-1)
    kernel = (squares * (-0.5 / width_m**2)).exp().to(response)
    return response + gain * (kernel @ response.unsqueeze(-1)).squeeze(-1)


def bump_of(excitation: Tensor, inhibition: float) -> Tensor:
    r"""Return the bump of place cells that global inhibition leaves, sum 1.

    .. math:: b_j = \frac{[e_j - \varphi \max_k e_k]_+}{\sum_k [e_k - \varphi \max_l e_l]_+}

    The winner is the limit of :math:`\varphi \to 1`.

    Args:
        excitation: :math:`e`, of :func:`excited`, ``(..., n)``.
        inhibition: :math:`\varphi`, in [0, 1).

    Returns:
        ``(..., n)``; zeros where no cell is active.

    Example:
        >>> bump_of(torch.tensor([0.25, 1.0, 0.75]), 0.5).mul(3).tolist()
        [0.0, 2.0, 1.0]
    """
    left = (excitation - inhibition * excitation.amax(-1, keepdim=True)).clamp_min(0.0)
    return left / left.sum(-1, keepdim=True).clamp_min(torch.finfo(left.dtype).tiny)


def hebbian_step(weights: Tensor, grid: Tensor, rate: float) -> Tensor:
    r"""Move the winner's weights towards the grid pattern.

    .. math:: \mathbf w \leftarrow \frac{\mathbf w + \eta(\hat{\mathbf g} - \mathbf w)}{|\cdot|}

    Example:
        >>> moved = hebbian_step(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 1.0]), 0.5)
        >>> [round(w, 3) for w in moved.tolist()]
        [0.707, 0.707]
    """
    return torch.nn.functional.normalize(torch.lerp(weights, grid, rate), dim=-1)


@compiled
def _look_up(x_m: float, y_m: float, n: int, centres_m: np.ndarray, window: np.ndarray) -> None:
    """Put the cells nearest to a position into the window, in no order."""
    size = window.shape[1]
    away = np.empty(size)
    worst = 0
    for k in range(max(n, size)):
        dx, dy = centres_m[0, k, 0] - x_m, centres_m[0, k, 1] - y_m
        square = dx * dx + dy * dy
        if k < size:
            at = k
        elif square < away[worst]:
            at = worst
        else:
            continue
        away[at], window[0, at] = square, k
        if k >= size - 1:
            worst = 0
            for j in range(size):
                if away[j] > away[worst]:
                    worst = j


@compiled
def _link(start: int, end: int, neighbours: np.ndarray) -> None:
    """Link a cell to another in a free column, unless they are linked."""
    for column in range(neighbours.shape[2]):
        if neighbours[0, start, column] == end:
            return
    for column in range(neighbours.shape[2]):
        if neighbours[0, start, column] == _NO_CELL:
            neighbours[0, start, column] = end
            return


@compiled
def _excited(
    responses: np.ndarray, window: np.ndarray, centres_m: np.ndarray, gain: float, width_m: float
) -> np.ndarray:
    """Do as :func:`excited` for the cells of the window."""
    out = np.empty_like(responses)
    for j in range(responses.size):
        total = np.float32(0.0)
        for k in range(responses.size):
            if responses[k] > 0.0:
                dx = centres_m[0, window[0, j], 0] - centres_m[0, window[0, k], 0]
                dy = centres_m[0, window[0, j], 1] - centres_m[0, window[0, k], 1]
                kernel = np.float32(math.exp((dx * dx + dy * dy) * (-0.5 / width_m**2)))
                total += kernel * responses[k]
        out[j] = responses[j] + np.float32(gain) * total
    return out


@compiled
def compete_step(
    resumes: bool, rates: np.ndarray, position_m: np.ndarray, dt_s: float, stay_s: float,
    learns: int, power: float, continuity_m: float, threshold_m: float, rate: float,
    excitation: float, excitation_m: float,
    n_cells: np.ndarray, weights: np.ndarray, centres_m: np.ndarray, visits: np.ndarray,
    time_s: np.ndarray, neighbours: np.ndarray, winner: np.ndarray, window: np.ndarray,
    landmarks_m: np.ndarray, leash_m2: np.ndarray,
) -> int:  # fmt: skip
    """Do as :meth:`CompetitiveHebbianPlaceCells.forward` for one animal, in place.

    ``resumes`` tells that the table has grown, as the step asked for; ``stay_s`` is the time for
    which the winner has not changed, and was not credited; ``learns`` is 1 or 0, or -1 if all
    animals learn; then come numbers of the config, and the state.

    Returns:
        A sum of: 1 a cell was recruited; 2 the winner changed; 4 the table must grow first.
    """
    x, y = position_m[0], position_m[1]
    if not resumes:
        if learns >= 0 and winner[0] >= 0:
            time_s[0, winner[0]] += stay_s
            time_s[0, winner[0]] += learns * dt_s
        dx, dy = x - landmarks_m[0, 0, 0], y - landmarks_m[0, 0, 1]
        if not dx * dx + dy * dy > leash_m2[0, 0]:
            return 0
        dx, dy = x - landmarks_m[1, 0, 0], y - landmarks_m[1, 0, 1]
        if dx * dx + dy * dy > leash_m2[1, 0]:
            _look_up(x, y, n_cells[0], centres_m, window)
            landmarks_m[1, 0, 0], landmarks_m[1, 0, 1] = x, y
        landmarks_m[0, 0, 0], landmarks_m[0, 0, 1] = x, y
    n_grid, zero = weights.shape[2], np.float32(0.0)
    grid = np.empty(n_grid, np.float32)
    squares, k = zero, 0
    for m in range(rates.shape[0]):
        for i in range(rates.shape[1]):
            grid[k] = rates[m, i]
            squares += grid[k] * grid[k]
            k += 1
    norm = max(np.float32(math.sqrt(squares)), np.float32(1e-12))
    for k in range(n_grid):
        grid[k] /= norm
    nearest, far, farthest = np.inf, 0, -1.0
    responses = np.empty(window.shape[1], np.float32)
    for k in range(window.shape[1]):
        cell = window[0, k]
        dx, dy = centres_m[0, cell, 0] - x, centres_m[0, cell, 1] - y
        away = dx * dx + dy * dy
        nearest = min(nearest, away)
        if away > farthest:
            far, farthest = k, away
        a = b = c = d = zero
        for i in range(0, n_grid - 3, 4):
            a += weights[0, cell, i] * grid[i]
            b += weights[0, cell, i + 1] * grid[i + 1]
            c += weights[0, cell, i + 2] * grid[i + 2]
            d += weights[0, cell, i + 3] * grid[i + 3]
        for i in range(n_grid - n_grid % 4, n_grid):
            a += weights[0, cell, i] * grid[i]
        similarity = max((a + b) + (c + d), zero)
        near = math.exp(np.float32(away) * np.float32(-0.5 / continuity_m**2))
        responses[k] = np.float32(similarity ** np.float32(power)) * near
    if excitation > 0.0:
        responses = _excited(responses, window, centres_m, excitation, excitation_m)
    slot = np.argmax(responses)
    recruits = nearest >= threshold_m**2 and learns != 0
    if recruits:
        new = n_cells[0]
        if new >= weights.shape[1]:
            return 4
        for i in range(n_grid):
            weights[0, new, i] = grid[i]
        centres_m[0, new, 0], centres_m[0, new, 1] = x, y
        n_cells[0] = new + 1
        # The new cell replaces the farthest in the window, unless it is there already.
        slot = far
        for k in range(window.shape[1] - 1, -1, -1):
            if window[0, k] == new:
                slot = k
        window[0, slot] = new
    cell = window[0, slot]
    if rate > 0.0 and learns != 0:
        squares = zero
        for i in range(n_grid):
            moved = weights[0, cell, i] + np.float32(rate) * (grid[i] - weights[0, cell, i])
            weights[0, cell, i] = moved
            squares += moved * moved
        norm = max(np.float32(math.sqrt(squares)), np.float32(1e-12))
        for i in range(n_grid):
            weights[0, cell, i] /= norm
    if learns >= 0 and n_cells[0] == 0:  # an animal lost from the start has no cell
        cell = _NO_CELL
    before = winner[0]
    if cell == before:
        return int(recruits)
    if learns < 0 and before >= 0:
        time_s[0, before] += stay_s
    if learns != 0:
        visits[0, cell] += 1
        if before >= 0:
            _link(before, cell, neighbours)
            _link(cell, before, neighbours)
    winner[0] = cell
    return int(recruits) + 2


@compiled
def respond_into(
    grid: np.ndarray, position_m: np.ndarray, power: float, continuity_m: float,
    n_cells: np.ndarray, weights: np.ndarray, centres_m: np.ndarray, out: np.ndarray,
) -> None:  # fmt: skip
    """Write what :func:`place_response` gives for all cells of one animal into ``out``.

    Responses below 2e-8 are 0 if another is above. A product in single precision, which is fast,
    finds the cells that may respond more; only of these the response is computed, in double
    precision.
    """
    square, last = 0.0, grid.size - grid.size % 4
    for k in range(grid.size):
        square += np.float64(grid[k]) * grid[k]
    scale, n = 1.0 / max(math.sqrt(square), 1e-12), n_cells[0]
    near, silent, any_responds = np.empty(_ROOM), _SILENT, False
    blocks = (n + _ROOM - 1) // _ROOM
    for block in range(2 * blocks):  # of cells that were recruited one after the other
        if block == blocks:
            if any_responds:
                break
            silent = -np.inf  # all are weak: again, with those that are hardly alike
        first = block % blocks * _ROOM
        size, closest = min(_ROOM, n - first), -np.inf
        for i in range(size):
            dx = centres_m[0, first + i, 0] - position_m[0]
            dy = centres_m[0, first + i, 1] - position_m[1]
            near[i] = (dx * dx + dy * dy) * (-0.5 / continuity_m**2)
            closest = max(closest, near[i])
            out[first + i] = 0.0
        if closest < _SILENT:
            continue
        alike = np.dot(weights[0, first : first + size], grid)
        for i in range(size):
            # ln s <= s - 1; the margin is above the rounding of single precision
            if near[i] < _SILENT or (
                power * (min(alike[i] * scale, 1.0) - 1.0 + 1e-5) + near[i] < silent
            ):
                continue
            a = b = c = d = 0.0
            w = weights[0, first + i]
            for k in range(0, last, 4):
                a += w[k] * np.float64(grid[k])
                b += w[k + 1] * np.float64(grid[k + 1])
                c += w[k + 2] * np.float64(grid[k + 2])
                d += w[k + 3] * np.float64(grid[k + 3])
            for k in range(last, grid.size):
                a += w[k] * np.float64(grid[k])
            similarity = ((a + b) + (c + d)) * scale
            if similarity > 0.0 and power * (min(similarity, 1.0) - 1.0) + near[i] >= silent:
                out[first + i] = similarity**power * math.exp(near[i])
                any_responds = True


@compiled
def responses_step(
    grid: np.ndarray, position_m: np.ndarray, power: float, continuity_m: float,
    n_cells: np.ndarray, weights: np.ndarray, centres_m: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Do as :func:`place_response` for all cells of one animal; those below 2e-8 are 0."""
    out = np.empty(n_cells[0], np.float32)
    respond_into(grid, position_m, power, continuity_m, n_cells, weights, centres_m, out)
    return out


@compiled
def record_step(
    row: int, felt: np.ndarray, grid: np.ndarray, position_m: np.ndarray, power: float,
    continuity_m: float, n_cells: np.ndarray, weights: np.ndarray, centres_m: np.ndarray,
    felt_rows: np.ndarray, grid_rows: np.ndarray, place_rows: np.ndarray,
) -> int:  # fmt: skip
    """Write boundary, grid and place cells of one animal into a row of three tables.

    Returns:
        Number of place cells; -1 if the table is too narrow for them, and nothing was written.
    """
    n = n_cells[0]
    if n > place_rows.shape[1]:
        return -1
    rates = grid.reshape(-1)
    felt_rows[row, : felt.size] = felt.reshape(-1)
    grid_rows[row, : rates.size] = rates
    respond_into(
        rates, position_m, power, continuity_m, n_cells, weights, centres_m, place_rows[row]
    )
    return int(n)


class Stay(Scalars):
    """Time for which the present winners have not changed."""

    stay_s: float

    def __init__(self) -> None:
        super().__init__(stay_s=0.0)


class CompetitiveHebbianPlaceCells(BufferModule):
    """Place cells that compete for patterns of grid cells; a new one is recruited far from others.

    :func:`place_response`, :func:`excited`, :func:`bump_of` and :func:`hebbian_step` have the
    mathematics. The winner is found among
    the nearest cells: beyond them the response is bounded by the distance alone. State: for every
    cell its ``weights``, ``centres_m``, ``visits``, ``time_s`` and ``neighbours`` (the graph:
    cells that won one after the other), and the window of nearest cells.

    Args:
        config: Distance between cells, power, learning.
        n_grid: Number of grid cells.
        batch: Number of animals side by side, or ``None`` for one.

    Example:
        >>> cells = CompetitiveHebbianPlaceCells(PlaceCellConfig(), n_grid=2)
        >>> cells(torch.tensor([1.0, 0.0]), torch.tensor([0.0, 0.0]), dt_s=0.1).recruited.item()
        True
        >>> cells(torch.tensor([0.9, 0.1]), torch.tensor([0.01, 0.0]), dt_s=0.1).winner.item()
        0
    """

    n_cells: Tensor
    weights: Tensor
    centres_m: Tensor
    visits: Tensor
    time_s: Tensor
    neighbours: Tensor
    winner: Tensor
    window: Tensor
    landmarks_m: Tensor
    leash_m2: Tensor
    threshold_m: Tensor

    def __init__(self, config: PlaceCellConfig, n_grid: int, batch: int | None = None) -> None:
        super().__init__()
        self.config = config
        self.batch = batch
        b = batch or 1
        self.register_buffer("n_cells", torch.zeros(b, dtype=torch.int64))
        self.register_buffer("weights", torch.zeros(b, _ROOM, n_grid))
        self.register_buffer("centres_m", torch.full((b, _ROOM, 2), FAR_M, dtype=torch.float64))
        self.register_buffer("visits", torch.zeros(b, _ROOM, dtype=torch.int64))
        self.register_buffer("time_s", torch.zeros(b, _ROOM, dtype=torch.float64))
        none = torch.full((b, _ROOM, NEIGHBOURS), _NO_CELL, dtype=torch.int64)
        self.register_buffer("neighbours", none)
        self.register_buffer("winner", torch.full((b,), _NO_CELL, dtype=torch.int64))
        self.register_buffer("window", torch.arange(_WINDOW).repeat(b, 1))
        # Positions of the last competition, and of the last look-up of the window.
        self.register_buffer("landmarks_m", torch.full((2, b, 2), FAR_M, dtype=torch.float64))
        leash = torch.tensor([[_STILL * config.threshold_m], [_SLACK_M]], dtype=torch.float64)
        self.register_buffer("leash_m2", leash.square(), persistent=False)
        self.register_buffer("threshold_m", torch.tensor(config.threshold_m, dtype=torch.float64))
        self.now = Stay()
        self._near: tuple[Tensor, Tensor] | None = None  # weights and centres of the window
        self.register_state_dict_pre_hook(Calls("_write_back"))
        self.register_load_state_dict_pre_hook(_take_capacity)
        self.register_load_state_dict_post_hook(Calls("_forget_window"))

    @property
    def capacity(self) -> int:
        """Number of cells that the tables can hold before they grow."""
        return self.weights.shape[1]

    def _forget_window(self) -> None:
        self._near = None

    @without_gradients
    def forward(
        self, grid: Tensor, position_m: Tensor, dt_s: float, *, learns: Tensor | None = None
    ) -> PlaceResponse:
        """Let the cells compete; recruit one where none is near, and let the winner learn.

        Nothing is done while all animals are within a quarter of ``threshold_m`` of the last
        competition: the winner stays, and does not learn the same pattern again.

        Args:
            grid: Rates of the grid cells, ``([batch,] n_grid)``.
            position_m: Position decoded from the phases of the oscillators, ``([batch,] 2)``.
            dt_s: Time since the last step.
            learns: Which animals recruit and learn, ``(batch or 1,)``; the others only respond.
                ``None``: all.
        """
        one = self.batch is None
        position = (position_m[None] if one else position_m).detach().to(self.centres_m)
        moved = (position - self.landmarks_m).square().sum(-1) > self.leash_m2
        competes, leaves_window = moved.any(1).tolist()
        if learns is not None:
            self._flush_time()
            self._credit(self.winner, learns.to(self.time_s) * dt_s)
        if not competes:
            self.now.stay_s += dt_s if learns is None else 0.0
            none = torch.zeros_like(self.winner, dtype=torch.bool)
            return self._response(none, none)
        grid = (grid[None] if one else grid).detach().to(self.weights)
        grid = torch.nn.functional.normalize(grid, dim=-1)
        weights, centres = self._nearest(position, moved[1] if leaves_window else None)
        c = self.config
        away = (centres - position.unsqueeze(1)).square().sum(-1)
        response = place_response(weights, away.to(grid), grid, c.power, c.continuity_m)
        if c.excitation:
            response = excited(response, centres, c.excitation, c.excitation_m)
        slot = response.argmax(-1)
        recruited = away.amin(-1) >= c.threshold_m**2
        if learns is not None:
            recruited = recruited & learns
        if bool(recruited.any()):
            slot = self._recruit(recruited, grid, position, slot, away)
        winner = self.window.gather(1, slot[:, None])[:, 0]
        if learns is not None:  # an animal lost from the start has no cell
            winner = winner.where(self.n_cells > 0, _NO_CELL)
        if c.hebbian_rate:
            self._learn(grid, slot, learns)
        changed = winner != self.winner
        if bool(changed.any()):
            self._flush_time()
            self._enter(changed if learns is None else changed & learns, winner)
            self.winner = winner
        self.now.stay_s += dt_s if learns is None else 0.0
        return self._response(recruited, changed)

    def compete_compiled(
        self, rates: np.ndarray, position_m: np.ndarray, dt_s: float, learns: bool | None
    ) -> tuple[int, bool]:
        """Do as :meth:`forward` for one animal, in place.

        Args:
            rates: Rates of the grid cells, ``(n_modules, n_cells)``.
            position_m: Position of the animal, ``(2,)``.
            dt_s: Time since the last step.
            learns: Whether the animal recruits and learns; ``None``: it does.

        Returns:
            Number of the winner, -1 while there is none; whether it was recruited in this step.
        """
        if self._near is not None:
            self._write_back()
            self._near = None
        c, now, grows, learning = (
            self.config,
            self.now,
            False,
            -1 if learns is None else int(learns),
        )
        while True:
            *arrays, _ = cast(Arrays, self.arrays())
            done = compete_step(
                grows, rates, position_m, dt_s, now.stay_s, learning, c.power, c.continuity_m,
                c.threshold_m, c.hebbian_rate, c.excitation, c.excitation_m, *arrays,
            )  # fmt: skip
            grows = done >= 4
            if not grows:
                break
            self._grow()
        stay_s = 0.0 if done >= 2 or learning >= 0 else now.stay_s
        now.stay_s = stay_s + dt_s if learning < 0 else stay_s
        return int(arrays[6][0]), done % 2 == 1

    def _response(self, recruited: Tensor, changed: Tensor) -> PlaceResponse:
        if self.batch is not None:
            return PlaceResponse(self.winner, recruited, changed)
        return PlaceResponse(self.winner[0], recruited[0], changed[0])

    @without_gradients
    def responses(self, grid: Tensor, position_m: Tensor | None = None) -> Tensor:
        """Return the responses of all cells, ``([batch,] n)``, zero where there is none.

        Args:
            grid: Rates of the grid cells, ``([batch,] n_grid)``.
            position_m: Where the animal is; ``None``: the response to the grid alone.
        """
        self._write_back()
        one = self.batch is None
        if one and position_m is not None and runs_compiled(grid, position_m, self.weights):
            return torch.from_numpy(self.responses_compiled(grid.numpy(), position_m.numpy()))
        grid = (grid[None] if one else grid).to(self.weights)
        grid = torch.nn.functional.normalize(grid, dim=-1)
        c, n = self.config, int(self.n_cells.max())
        weights = self.weights[:, :n]
        away = torch.zeros_like(weights[..., 0])
        if position_m is not None:
            position = (position_m[None] if one else position_m).to(self.centres_m)
            away = (self.centres_m[:, :n] - position.unsqueeze(1)).square().sum(-1).to(away)
        response = place_response(weights, away, grid, c.power, c.continuity_m)
        return response[0] if one else response

    @without_gradients
    def responses_at(self, grid: Tensor, position_m: Tensor) -> Tensor:
        """Return the responses of all cells of one animal at many positions, ``(t, n)``.

        Args:
            grid: Rates of the grid cells at each, ``(t, n_grid)``.
            position_m: The positions, ``(t, 2)``.
        """
        self._write_back()
        c, n = self.config, int(self.n_cells[0])
        grid = torch.nn.functional.normalize(grid.to(self.weights), dim=-1)
        away = torch.cdist(position_m.to(self.centres_m), self.centres_m[0, :n]).square()
        similarity = (grid @ self.weights[0, :n].mT).clamp_min(0.0)
        near = (away * (-0.5 / c.continuity_m**2)).exp().to(similarity)
        return similarity.pow(c.power) * near

    def responses_compiled(self, grid: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Do as :meth:`responses` for one animal; what the cells have learnt is in the tables."""
        c, (n_cells, weights, centres, *_) = self.config, cast(Arrays, self.arrays())
        grid = np.ascontiguousarray(grid, weights.dtype)
        return responses_step(grid, position_m, c.power, c.continuity_m, n_cells, weights, centres)

    def record_compiled(
        self, row: int, felt: np.ndarray, grid: np.ndarray, position_m: np.ndarray,
        felt_rows: np.ndarray, grid_rows: np.ndarray, place_rows: np.ndarray,
    ) -> int:  # fmt: skip
        """Do as :func:`record_step` with the tables of these cells."""
        c, (n_cells, weights, centres, *_) = self.config, cast(Arrays, self.arrays())
        return record_step(
            row, felt, grid, position_m, c.power, c.continuity_m, n_cells, weights, centres,
            felt_rows, grid_rows, place_rows,
        )  # fmt: skip

    @without_gradients
    def bump(self, grid: Tensor, position_m: Tensor) -> tuple[Tensor, Tensor]:
        """Return the bump of all cells ``([batch,] n)``, and the position that it encodes.

        Args:
            grid: Rates of the grid cells, ``([batch,] n_grid)``.
            position_m: Where the animal believes to be, ``([batch,] 2)``.

        Returns:
            The bump, of :func:`bump_of`, and its centre of mass, ``([batch,] 2)``, metres.
        """
        c, response = self.config, self.responses(grid, position_m)
        centres = self.centres_m[:, : response.shape[-1]]
        centres = centres[0] if self.batch is None else centres
        bump = bump_of(excited(response, centres, c.excitation, c.excitation_m), c.inhibition)
        return bump, (bump.to(centres).unsqueeze(-1) * centres).sum(-2)

    def centre_of(self, cells: Tensor) -> Tensor:
        """Return the centre of one cell of each animal, ``([batch,] 2)``."""
        at = cells.reshape(-1, 1, 1).expand(-1, 1, 2)
        centres = self.centres_m.gather(1, at)[:, 0]
        return centres[0] if self.batch is None else centres

    def graph(self, animal: int = 0) -> tuple[Tensor, Tensor]:
        """Return the graph of place cells: centres ``(n, 2)`` and links ``(m, 2)``, each once."""
        n = int(self.n_cells[animal])
        neighbours = self.neighbours[animal, :n]
        start, slot = (neighbours >= 0).nonzero(as_tuple=True)
        links = torch.stack([start, neighbours[start, slot]], dim=1)
        links = torch.unique(links.sort(dim=1).values, dim=0)
        return self.centres_m[animal, :n].clone(), links

    def _nearest(self, position: Tensor, moved: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return weights and centres of the nearest cells of each animal."""
        looked_up_at = self.landmarks_m[1]
        if moved is not None:
            rows = moved.nonzero()[:, 0]
            self._write_back(rows)
            n = max(_WINDOW, int(self.n_cells.max()))
            away = (self.centres_m[rows, :n] - position[rows].unsqueeze(1)).square().sum(-1)
            self.window = self.window.index_put(
                (rows,), away.topk(_WINDOW, dim=1, largest=False, sorted=False).indices
            )
            looked_up_at = position.where(moved.unsqueeze(1), looked_up_at)
            if self._near is not None:
                for near, table in zip(self._near, (self.weights, self.centres_m), strict=True):
                    near[rows] = table[rows.unsqueeze(1), self.window[rows]]
        self.landmarks_m = torch.stack([position, looked_up_at])
        if self._near is None:
            rows = torch.arange(len(position), device=position.device).unsqueeze(1)
            self._near = self.weights[rows, self.window], self.centres_m[rows, self.window]
        return self._near

    def _recruit(
        self, recruited: Tensor, grid: Tensor, position: Tensor, slot: Tensor, away: Tensor
    ) -> Tensor:
        """Add a cell for each animal that needs one; return the slots of the winners."""
        rows = recruited.nonzero()[:, 0]
        new = self.n_cells[rows]
        if int(new.max()) >= self.capacity:
            self._grow()
        self.weights[rows, new] = grid[rows]
        self.centres_m[rows, new] = position[rows]
        self.n_cells = self.n_cells + recruited.long()
        # The new cell replaces the farthest in the window, unless it is there already.
        is_in = self.window[rows] == new.unsqueeze(1)
        at = torch.where(is_in.any(1), is_in.long().argmax(1), away[rows].argmax(1))
        self._write_back(rows)  # before another cell takes the slot
        self.window = self.window.index_put((rows, at), new)
        weights, centres = cast(tuple[Tensor, Tensor], self._near)
        weights[rows, at] = grid[rows]
        centres[rows, at] = position[rows]
        return slot.index_put((rows,), at)

    def _learn(self, grid: Tensor, slot: Tensor, learns: Tensor | None) -> None:
        """Let the winners learn in the window; :meth:`_write_back` copies it to the table."""
        near = cast(tuple[Tensor, Tensor], self._near)[0]
        at = slot[:, None, None].expand(-1, 1, near.shape[-1])
        before = near.gather(1, at)
        after = hebbian_step(before, grid.unsqueeze(1), self.config.hebbian_rate)
        if learns is not None:
            after = after.where(learns[:, None, None], before)
        near.scatter_(1, at, after)

    @without_gradients
    def _write_back(self, rows: Tensor | None = None) -> None:
        """Copy the weights of the windows, of some animals or all, to the table."""
        if self._near is None:
            return
        if rows is None:
            rows = torch.arange(len(self.window), device=self.window.device)
        self.weights[rows.unsqueeze(1), self.window[rows]] = self._near[0][rows]

    def _apply(self, fn: Any, recurse: bool = True) -> Self:  # noqa: ANN401 - as nn.Module has it
        self._write_back()
        self._near = None
        return super()._apply(fn, recurse)

    def forget_winner(self) -> None:
        """Forget the winner, as after relocalisation: the next one is not linked to it."""
        self._flush_time()
        self.winner = torch.full_like(self.winner, _NO_CELL)
        self.landmarks_m = torch.full_like(self.landmarks_m, FAR_M)

    def _flush_time(self) -> None:
        """Add the time since the last change of winners to their times."""
        if self.now.stay_s:
            self._credit(
                self.winner, torch.full_like(self.winner, self.now.stay_s, dtype=torch.float64)
            )
            self.now.stay_s = 0.0

    def _credit(self, winner: Tensor, time_s: Tensor) -> None:
        had = time_s.to(self.time_s).where(winner >= 0, 0.0)
        self.time_s.scatter_add_(1, winner.clamp_min(0)[:, None], had[:, None])

    def _enter(self, changed: Tensor, winner: Tensor) -> None:
        rows = changed.nonzero()[:, 0]
        new, old = winner[rows], self.winner[rows]
        self.visits[rows, new] += 1
        linked = old >= 0
        rows, new, old = rows[linked], new[linked], old[linked]
        for start, end in ((old, new), (new, old)):
            links = self.neighbours[rows, start]
            known = (links == end.unsqueeze(1)).any(1)
            free = links == _NO_CELL
            add = ~known & free.any(1)
            slot = free.long().argmax(1)
            self.neighbours[rows[add], start[add], slot[add]] = end[add]

    def _grow(self) -> None:
        for name, empty in EMPTY.items():
            old = getattr(self, name)
            setattr(self, name, torch.cat([old, torch.full_like(old, empty)], dim=1))


def _take_capacity(
    module: torch.nn.Module, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    for name in EMPTY:
        saved = state.get(prefix + name)
        if saved is not None and len(saved) == len(getattr(module, name)):
            setattr(module, name, getattr(module, name).new_empty(saved.shape))
