"""Interface of all sources of frames."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator

from neuroslam.errors import BadFrame
from neuroslam.sensors.landmarks import LandmarkWords
from neuroslam.types import Frame

OnBadFrame = Callable[[BadFrame], object] | None


class Source(ABC):
    """A stream of frames.

    Opening a source is cheap and finds the user's mistakes; frames are made only on demand.

    Attributes:
        name: Name of the source in reports.
        n_frames: Number of frames; ``None`` if unknown before the source is read to its end.
        frame_rate_hz: Frames per second; ``None`` if unknown.
        live: Whether the source is live: its frames cannot be read a second time.
        unused: Data that is in no frame, and why, one line each; complete once the source was
            read to its end.
        notes: How the data is read, where that was a choice, one line each: topics of a bag, units,
            bits of a pixel; complete once the source was read to its end.
        landmark_words: Names and attributes of its landmarks, empty if it knows none.
    """

    name: str
    n_frames: int | None
    frame_rate_hz: float | None
    live: bool = False
    unused: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    landmark_words: tuple[LandmarkWords, ...] = ()

    @abstractmethod
    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``; a frame does not depend on ``start``.

        Args:
            start: Index of the first frame.
            stop: Index after the last frame; ``None`` for all.
            on_bad_frame: Called with the error of each unusable frame, which is then skipped (a
                list's ``append`` collects them); ``None``: the error is raised.

        Raises:
            BadFrame: If a frame is unusable and ``on_bad_frame`` is ``None``.
            SourceError: If the source cannot be read any further.
        """

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()


class IndexedSource(Source):
    """A source with random access to its frames."""

    n_frames: int  # pyright: ignore[reportIncompatibleVariableOverride] - known beforehand

    @abstractmethod
    def frame(self, index: int) -> Frame:
        """Return the frame of that index.

        Raises:
            BadFrame: If the frame is unusable.
        """

    def frames(
        self, start: int = 0, stop: int | None = None, on_bad_frame: OnBadFrame = None
    ) -> Iterator[Frame]:
        """Yield the frames ``start <= index < stop``, see :meth:`Source.frames`."""
        end = self.n_frames if stop is None else min(stop, self.n_frames)
        for index in range(max(start, 0), end):
            try:
                frame = self.frame(index)
            except BadFrame as error:
                if on_bad_frame is None:
                    raise
                on_bad_frame(error)
                continue
            yield frame
