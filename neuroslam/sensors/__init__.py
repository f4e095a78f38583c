"""Sources of frames: recordings, cameras and rendered worlds."""

from neuroslam.sensors.open import open_source
from neuroslam.sensors.source import Source

__all__ = ["Source", "open_source"]
