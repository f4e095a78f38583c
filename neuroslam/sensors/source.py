"""What every source of frames offers: a name, a length where it is known, and the frames."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from neuroslam.errors import BadFrame
from neuroslam.types import Frame

OnBadFrame = Callable[[BadFrame], object] | None


class Source(ABC):
    """A stream of frames.

    Opening one is cheap and finds the user's mistakes; frames are made only when asked for.

    Attributes:
        name: How the source is called in reports.
        n_frames: How many frames it has, or ``None`` if only reading it to the end would tell.
        frame_rate_hz: Frames per second, or ``None`` if unknown.
        live: Whether it shows what is there now, so that its frames cannot be read a second time.
        unused: What of it is in no frame, and why, a line each; known as far as it was read last.
    """

    name: str
    n_frames: int | None
    frame_rate_hz: float | None
    live: bool = False
    unused: tuple[str, ...] = ()

    @abstractmethod
    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``; the same ones whatever ``start`` is.

        Args:
            start: Number, in the source, of the first frame delivered.
            stop: Number at which to stop, or ``None`` for all.
            on_bad_frame: Called with the fault of each frame that cannot be used, which is then
                left out (a list's ``append`` collects them); ``None``: the fault is raised.

        Raises:
            BadFrame: If a frame cannot be used and ``on_bad_frame`` is ``None``.
            SourceError: If the source cannot be read on.
        """

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()


class IndexedSource(Source):
    """A source that can make any of its frames at once, knowing its number."""

    n_frames: int

    @abstractmethod
    def frame(self, index: int) -> Frame:
        """Make the frame of that number.

        Raises:
            BadFrame: If it cannot be used.
        """

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        end = self.n_frames if stop is None else min(stop, self.n_frames)
        for index in range(max(start, 0), end):
            try:
                frame = self.frame(index)
            except BadFrame as fault:
                if on_bad_frame is None:
                    raise
                on_bad_frame(fault)
                continue
            yield frame
