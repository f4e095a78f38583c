"""Merge of two semantic maps: decoded, aligned by shared landmarks, written to one memory."""

from typing import NamedTuple

import torch
from torch import Tensor

from neuroslam.errors import SpaceError
from neuroslam.spiking.decoding import PositionDecoder
from neuroslam.spiking.slam import SSPSLAM

_KNOWN = 0.5  # strength of recall above which a landmark is known


class SemanticMergeReport(NamedTuple):
    """Report of the merge of two semantic maps.

    Attributes:
        joined: Whether they were.
        reason: In one line.
        offset_m: What the partial map was moved by.
        agree: Landmarks by which the maps were aligned.
        moved: Known to both, but elsewhere; the partial map, which is younger, is believed.
        added: Known to the partial map alone.
        kept: Known to the loaded map alone.
        residual_m: How far apart those that agree are, at most.
    """

    joined: bool
    reason: str
    offset_m: tuple[float, ...] = ()
    agree: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()
    added: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()
    residual_m: float = 0.0


def merge_semantic_maps(
    loaded: SSPSLAM, partial: SSPSLAM, confirm: int = 2, tolerance_m: float = 0.1
) -> tuple[SSPSLAM | None, SemanticMergeReport]:
    r"""Merge the map of a session into a loaded one; neither is altered.

    The vectors of a landmark in both maps, unbound, give the offset of the maps:
    :math:`\hat\phi_l(x_i) \circledast \hat\phi_p(x_i)^{-1} \approx \phi(\Delta)`, points and
    regions alike. Most landmarks must agree on :math:`\Delta`. All of the partial map is moved by
    it, and both are written into one memory. The session that goes on is the partial one.

    Args:
        loaded: The map that is merged into.
        partial: The other; of the same config, but with landmarks of its own.
        confirm: So many landmarks must agree, at least.
        tolerance_m: Within how far.

    Returns:
        The merged map, or ``None`` if it was refused; and the report.

    Raises:
        SpaceError: If the maps are not of the same kind.
    """
    _same_kind(loaded, partial)
    theirs, ours = _known(loaded), _known(partial)
    both = [name for name in theirs if name in ours]
    if len(both) < confirm:
        known = f"{len(both)} landmarks are known to both maps, {confirm} must be"
        return None, SemanticMergeReport(False, known)
    space = loaded.space
    turns = torch.stack([theirs[n] * ours[n].conj() for n in both])
    offsets = PositionDecoder(space)(turns).position_m
    apart = torch.cdist(offsets, offsets)
    votes = (apart <= tolerance_m).sum(-1)
    chosen = apart[int(votes.argmax())] <= tolerance_m
    if int(chosen.sum()) < max(confirm, len(both) // 2 + 1):
        said = (
            f"{int(chosen.sum())} of {len(both)} shared landmarks agree on the offset of the maps, "
            f"{max(confirm, len(both) // 2 + 1)} must; the others are elsewhere"
        )
        return None, SemanticMergeReport(False, said)
    offset = offsets[chosen].mean(0)
    move = space.encode_fourier(offset).detach()
    agree = [name for name, yes in zip(both, chosen.tolist(), strict=True) if yes]
    joined: dict[str, Tensor] = dict(theirs)
    for name, z in ours.items():
        there = z * move
        joined[name] = (theirs[name] + there) / 2 if name in agree else there
    low, high = space.bounds_m.T.to(offset)
    at = PositionDecoder(space)(torch.stack(list(ours.values()))).position_m + offset
    at = torch.cat([at, partial.integrator.position_m + offset])
    outside = ((at < low) | (at > high)).any(-1)
    if bool(outside.any()):
        name = [*ours, "the animal"][int(outside.to(torch.uint8).argmax())]
        said = f"{name} would lie outside the bounds of the space; give it a larger reach_m"
        return None, SemanticMergeReport(False, said)
    merged = _written(loaded, partial, joined, offset)
    report = SemanticMergeReport(
        True,
        f"{len(agree)} of {len(both)} shared landmarks agree",
        tuple(offset.tolist()),
        tuple(agree),
        tuple(name for name in both if name not in agree),
        tuple(name for name in ours if name not in theirs),
        tuple(name for name in theirs if name not in ours),
        float((offsets[chosen] - offset).norm(dim=-1).max()),
    )
    return merged, report


def _same_kind(loaded: SSPSLAM, partial: SSPSLAM) -> None:
    mine, other = loaded.config.model_dump(), partial.config.model_dump()
    differ = [key for key in mine if mine[key] != other[key]]
    if differ:
        raise SpaceError(
            f"merge: the maps differ in {', '.join(differ)}; maps of one config can be merged"
        )
    if loaded.batch != 1 or partial.batch != 1:
        raise SpaceError(
            f"merge: batches of {loaded.batch} and {partial.batch}; merge one animal at a time"
        )
    for name in set(loaded.names) & set(partial.names):
        a, b = (m.pointers[m.names.index(name)] for m in (loaded, partial))
        if not torch.allclose(a, b, atol=1e-6):
            raise SpaceError(
                f"merge: the pointers of {name!r} differ; use one vocabulary in both sessions"
            )


def _known(slam: SSPSLAM) -> dict[str, Tensor]:
    """Return the recall of each known landmark, by name, as Fourier coefficients."""
    z = slam.space.to_fourier(slam.map.read(slam.pointers)[0])
    found = slam.uncertainty(z)
    strength = z.abs().square().mean(-1).sqrt() if found is None else found.strength
    return {name: z[k] / strength[k] for k, name in enumerate(slam.names) if strength[k] > _KNOWN}


def _written(
    loaded: SSPSLAM, partial: SSPSLAM, known: dict[str, Tensor], offset_m: Tensor
) -> SSPSLAM:
    """Make the merged map, which continues the partial session in the loaded frame."""
    pointers = dict(zip(loaded.names, loaded.pointers, strict=True))
    for name, pointer in zip(partial.names, partial.pointers, strict=True):
        pointers.setdefault(name, pointer)
    merged = SSPSLAM(loaded.given, torch.stack(list(pointers.values())), list(pointers))
    state = partial.state_dict()
    for prefix in ("map.", "places."):
        state |= {k: v for k, v in loaded.state_dict().items() if k.startswith(prefix)}
    state["pointers"] = merged.pointers
    if merged.config.has_uncertain_sightings:
        state["evidence_s"] = sum(
            (_evidence(part, merged.names) for part in (loaded, partial)),
            torch.zeros_like(merged.evidence_s),
        )
    merged.load_state_dict(state)
    keys = torch.stack([pointers[name] for name in known])
    vectors = merged.space.from_fourier(torch.stack(list(known.values())))
    merged.map.write(keys, vectors)
    if merged.places is not None:
        merged.places.write(vectors, keys)
    merged.start(partial.integrator.position_m + offset_m)
    return merged


def _evidence(slam: SSPSLAM, names: tuple[str, ...]) -> Tensor:
    """Return the evidence of a map for landmarks by name, ``(1, landmarks)``; 0 for others."""
    known = dict(zip(slam.names, slam.evidence_s[0].tolist(), strict=True))
    return slam.evidence_s.new_tensor([[known.get(name, 0.0) for name in names]])
