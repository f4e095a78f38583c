"""Loading of the library, for which a command that runs shortly spends most of its time."""

import gc
import sys
from importlib import import_module


def load(module: str = "neuroslam.runs.run") -> None:
    """Import a module and what it needs, without Python's search for reference cycles.

    Imports make a million objects, none of them garbage; the search for cycles takes a quarter of
    the time of an import, and would look at all of them again later.

    Example:
        >>> load("neuroslam.types")
    """
    if "torch" in sys.modules or not gc.isenabled():
        import_module(module)
        return
    gc.disable()
    try:
        import_module(module)
    finally:
        gc.freeze()
        gc.enable()
