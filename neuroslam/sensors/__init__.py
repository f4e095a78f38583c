"""Where frames come from: files, and worlds rendered on the fly."""

from neuroslam.sensors.open import open_source
from neuroslam.sensors.source import Source

__all__ = ["Source", "open_source"]
