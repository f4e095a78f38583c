r"""Attractors of a batch of brains: packets in windows of one size.

A :class:`~neuroslam.cells.convolve.Packet` of a batch has values ``(brains, a, b, c)`` and an
origin for each brain, ``(brains, 3)``. The window is as large as the widest packet needs, so a
step of 64 tracking brains costs a few large products instead of 64 times as many small ones.
On an accelerator, where shapes should not depend on values, the window is the whole torus.
"""

from functools import lru_cache
from typing import cast

import torch
from torch import Tensor

from neuroslam.cells.attractor import shift_matrix
from neuroslam.cells.convolve import Packet
from neuroslam.errors import MapError
from neuroslam.geometry import TWO_PI

_NEVER = 1 << 20  # cells ago: more than any ring has


def to_packets(activity: Tensor) -> Packet:
    """Take the windows that hold all activity of each brain.

    Args:
        activity: Shape ``(brains, n_theta, n_y, n_x)``.

    Raises:
        MapError: If no cell of a brain is active.
    """
    if not bool(activity.flatten(1).any(1).all()):
        raise MapError("pose cells: no activity in a brain of the batch; expected some in each")
    origin = torch.zeros(len(activity), 3, dtype=torch.int64, device=activity.device)
    n_theta, n_y, n_x = activity.shape[-3:]
    return trim_all(Packet(activity, origin, (n_theta, n_y, n_x)))


def to_tori(packets: Packet) -> Tensor:
    """Put the windows back onto their tori; shape ``(brains, n_theta, n_y, n_x)``.

    Example:
        >>> tori = torch.rand(2, 7, 8, 9)
        >>> torch.equal(to_tori(to_packets(tori)), tori)
        True
    """
    return _cut(packets, -_origins(packets), packets.shape)


def trim_all(packets: Packet) -> Packet:
    """Cut each window at the longest gap of silence, all to the size of the largest.

    Some cell of each brain is active.
    """
    values = packets.values.detach()
    if values.device.type != "cpu":
        return packets
    layers = values.flatten(2)
    plane = layers.amax(1).unflatten(1, values.shape[2:])
    peaks = (layers.amax(2), plane.amax(2), plane.amax(1))
    peaks = torch.nn.utils.rnn.pad_sequence([peak.T for peak in peaks]).permute(1, 2, 0)
    n = _numbers(packets.shape, values.device)
    starts, reached = _longest_gaps(peaks != 0.0, n)
    kept = _cut(packets, starts, tuple(reached.amax(1).tolist()))
    return Packet(kept, (_origins(packets) + starts) % n, packets.shape)


def _origins(packets: Packet) -> Tensor:
    return cast(Tensor, packets.origin)


def _longest_gaps(active: Tensor, n: Tensor) -> tuple[Tensor, Tensor]:
    """Find the start of activity after the longest silence of each ring, and its extent.

    Args:
        active: Which cells of the windows are active, ``(3, brains, size)``.
        n: Cells in each ring, ``(3,)``.

    Returns:
        First cells of the windows that are kept, ``(brains, 3)``, and how many, ``(3, brains)``.
    """
    places = _places(active.shape[2], active.device)
    seen = torch.where(active, places, -_NEVER).cummax(2).values
    turn_before = seen[..., -1:] - n[:, None, None]
    before = torch.cat([turn_before, torch.maximum(seen[..., :-1], turn_before)], dim=2)
    widest, start = torch.where(active, places - before, 0).max(2)
    return start.T, n[:, None] - widest + 1


@lru_cache(maxsize=64)
@torch.inference_mode(mode=False)
def _places(size: int, device: torch.device) -> Tensor:
    return torch.arange(size, device=device)


@lru_cache(maxsize=64)
@torch.inference_mode(mode=False)
def _numbers(values: tuple[int, ...], device: torch.device) -> Tensor:
    return torch.tensor(values, device=device)


def _cut(packets: Packet, starts: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Take windows of other sizes that start elsewhere; cells outside of the old ones are silent.

    Args:
        packets: What is cut.
        starts: First cells, relative to the windows' own, ``(brains, 3)``.
        sizes: Cells along each axis.

    Returns:
        Values ``(brains, *sizes)``.
    """
    values = packets.values
    a, b, c = (
        (starts[:, axis, None] + _places(size, values.device)) % n
        for axis, (size, n) in enumerate(zip(sizes, packets.shape, strict=True))
    )
    _, had_a, had_b, had_c = values.shape
    held = (
        (a < had_a)[:, :, None, None] & (b < had_b)[:, None, :, None] & (c < had_c)[:, None, None]
    )
    index = (a * (had_b * had_c))[:, :, None, None] + (b * had_c)[:, None, :, None]
    index = (index + c[:, None, None]).where(held, 0)
    return values.flatten(1).gather(1, index.flatten(1)).view(held.shape) * held


def move_all(
    packets: Packet,
    distance_cells: float | Tensor,
    turn_cells: float | Tensor,
    aside_cells: Tensor,
) -> Packet:
    """Move and turn the activity of each brain by its own odometry.

    :func:`~neuroslam.cells.attractor.path_integrate` has the equations.

    Args:
        packets: Windows of the brains.
        distance_cells: Shape ``(brains,)``, or a number.
        turn_cells: Likewise.
        aside_cells: x and y by which all layers move besides, ``(brains, 2)``.
    """
    values, sizes, shape = packets.values, packets.values.shape[1:], packets.shape
    layers = _origins(packets)[:, :1] + torch.arange(sizes[0], device=values.device)
    heading = layers.to(values.dtype) * (TWO_PI / shape[0])
    directions = torch.stack([heading.cos(), heading.sin()], dim=1)  # (brains, 2, a)
    distance = torch.as_tensor(distance_cells, dtype=values.dtype, device=values.device)
    turn = torch.as_tensor(turn_cells, dtype=values.dtype, device=values.device).expand(len(values))
    shifts = distance.expand(len(values))[:, None, None] * directions
    shifts = shifts + torch.as_tensor(aside_cells).to(values)[..., None]
    firsts, needed = _reaches((turn[:, None], shifts[:, 1], shifts[:, 0]), sizes, shape)
    first_theta, first_y, first_x = firsts.unbind(1)
    n_out_theta, n_out_y, n_out_x = needed
    along_x = shift_matrix(shifts[:, 0] - first_x[:, None], 0, n_out_x, sizes[2], shape[2])
    along_y = shift_matrix(shifts[:, 1] - first_y[:, None], 0, n_out_y, sizes[1], shape[1])
    moved = along_y @ values @ along_x.transpose(-1, -2)
    along_theta = shift_matrix(turn - first_theta, 0, n_out_theta, sizes[0], shape[0])
    turned = (along_theta @ moved.flatten(-2, -1)).unflatten(-1, (n_out_y, n_out_x))
    by = firsts.to(torch.int64)
    return Packet(turned, (_origins(packets) + by) % _numbers(shape, values.device), shape)


def _reaches(
    shifts: tuple[Tensor, ...], sizes: tuple[int, ...], shape: tuple[int, int, int]
) -> tuple[Tensor, list[int]]:
    """Return the origins of windows after shifts, ``(brains, 3)``, and the cells they need."""
    ends = [shift.detach().aminmax(dim=1) for shift in shifts]
    firsts = torch.stack([low for low, _ in ends], dim=1).floor()
    if tuple(sizes) == shape:  # whole rings: no need to wait for values of an accelerator
        return firsts, list(shape)
    lasts = torch.stack([high for _, high in ends], dim=1).ceil()
    more = (lasts - firsts).amax(0).tolist()
    return firsts, [min(size + int(m), n) for size, m, n in zip(sizes, more, shape, strict=True)]


def decode_all(packets: Packet, radius: int) -> Tensor:
    """Find the dominant packet of every brain; :func:`~.attractor.decode` has the equation.

    Args:
        packets: Windows of the brains.
        radius: Cells to each side of the peak.

    Returns:
        x, y, theta in cells, shape ``(brains, 3)``.
    """
    values = packets.values
    peak = values.flatten(1).argmax(1)
    _, b, c = values.shape[1:]
    peaks = torch.stack([peak // (b * c), peak // c % b, peak % c], dim=1)
    near = _cut(packets, peaks - radius, (2 * radius + 1,) * 3)
    over_x = near.sum(3)
    marginals = torch.stack([over_x.sum(2), over_x.sum(1), near.sum((1, 2))], dim=1)
    n = _numbers(packets.shape, values.device)
    unit = TWO_PI / n.to(values.dtype)
    angles = (_places(2 * radius + 1, values.device) - radius) * unit[:, None]
    turn = torch.atan2((marginals * angles.sin()).sum(-1), (marginals * angles.cos()).sum(-1))
    return ((peaks + _origins(packets) + turn / unit) % n).flip(-1)
