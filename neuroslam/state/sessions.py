"""Where a brain's memories come from: its sessions, and the merges that joined them."""

import hashlib
import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuroslam.state.join import Join
from neuroslam.state.mergeable import Mergeable, State
from neuroslam.state.pickling import Calls
from neuroslam.state.renumbering import Renumbering

ID_BITS = 40


@dataclass
class Session:
    """One uninterrupted drive.

    Attributes:
        id: Tells it from all others; follows from its source, its config and its first frame.
        source: What was driven through, as the user named it.
        preset: Name of the preset it was run with, if any.
        recorded: Date of the recording, where its file has one.
        first_frame: Number of its first frame in the source.
        first_time_s: Time of that frame.
        frames: Frames seen.
        began: Why it is a session of its own: ``start``, ``kidnapped`` or ``gap``.
        continues: Session that it goes on from, where it was kidnapped or after a gap; else 0.
    """

    id: int
    source: str = ""
    preset: str = ""
    recorded: str = ""
    first_frame: int = 0
    first_time_s: float = 0.0
    frames: int = 0
    began: str = "start"
    continues: int = 0

    @property
    def name(self) -> str:
        """Its id as it is printed: ten hexadecimal digits."""
        return session_name(self.id)


def session_name(session: int) -> str:
    """Write a session's id as it is printed.

    Example:
        >>> session_name(255)
        '00000000ff'
    """
    return f"{session:010x}"


def session_id(*parts: object) -> int:
    """Make an id of whatever tells a session from others: texts, numbers, arrays, ``None``.

    Example:
        >>> session_id("a", 1) == session_id("a", 1), session_id("a", 1) == session_id("b", 1)
        (True, False)
    """
    digest = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(f"{part.dtype}{part.shape}".encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(repr(part).encode())
        digest.update(b";")
    return int.from_bytes(digest.digest()[:8], "big") >> (64 - ID_BITS)


class SessionLog(Mergeable):
    """The sessions of a brain, the last being the one that goes on, and its merges.

    State is text, JSON in bytes: names and reports are no numbers.
    """

    text: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.sessions: list[Session] = []
        self.merges: list[dict[str, Any]] = []
        self.refusals: list[dict[str, Any]] = []
        self.register_buffer("text", torch.zeros(0, dtype=torch.uint8))
        self.register_state_dict_pre_hook(Calls("_write"))
        self.register_load_state_dict_pre_hook(_take_length)
        self.register_load_state_dict_post_hook(Calls("_read"))

    @property
    def now(self) -> Session:
        """The session that goes on."""
        return self.sessions[-1]

    def this_drive(self) -> set[str]:
        """Return the names of the session that goes on and of those that it continues."""
        before = {session.id: session.continues for session in self.sessions}
        drive, session = set(), self.now.id
        while session:
            drive.add(session_name(session))
            session = before.get(session, 0)
        return drive

    def renumber(self, change: Renumbering) -> None:
        """Do nothing: the log has no ids of the map."""

    def merged(self, loaded: State, partial: State, join: Join) -> State:
        """Keep the loaded sessions, then the partial ones that it does not have; so the merges."""
        one, other = _parse(loaded["text"]), _parse(partial["text"])
        last = other["sessions"][-1]["id"] if other["sessions"] else None
        known = {session["id"]: session for session in one["sessions"]}
        for session in other["sessions"]:
            before = known.pop(session["id"], session)  # the one with more frames knows more
            known[session["id"]] = max(before, session, key=lambda s: s["frames"])
        if last is not None:
            known[last] = known.pop(last)
        both = {
            name: one[name] + [item for item in other[name] if item not in one[name]]
            for name in ("merges", "refusals")
        }
        return {"text": _as_bytes({"sessions": list(known.values()), **both})}

    def _write(self) -> None:
        self.text = _as_bytes(
            {
                "sessions": [asdict(session) for session in self.sessions],
                "merges": self.merges,
                "refusals": self.refusals,
            }
        )

    def _read(self) -> None:
        about = _parse(self.text)
        self.sessions = [Session(**session) for session in about["sessions"]]
        self.merges, self.refusals = about["merges"], about["refusals"]


def _as_bytes(about: dict[str, Any]) -> Tensor:
    text = json.dumps(about).encode()
    return torch.frombuffer(bytearray(text), dtype=torch.uint8)


def _parse(text: Tensor) -> dict[str, Any]:
    if not len(text):
        return {"sessions": [], "merges": [], "refusals": []}
    about: dict[str, Any] = json.loads(bytes(text.tolist()))
    return about


def _take_length(
    module: SessionLog, state: dict[str, Tensor], prefix: str, *_unused: object
) -> None:
    saved = state.get(prefix + "text")
    if saved is not None:
        module.text = module.text.new_empty(saved.shape)
