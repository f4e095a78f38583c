"""Values that the shell completes: presets, keys of the config, experiments.

A completion runs at every press of the tab key, so it loads no more than it needs.
"""


def complete_preset(incomplete: str) -> list[str]:
    """Return the names of presets that begin so.

    Example:
        >>> complete_preset("ope")
        ['openratslam']
    """
    from neuroslam.config.files import preset_names

    return [name for name in preset_names() if name.startswith(incomplete)]


def complete_experiment(incomplete: str) -> list[str]:
    """Return the names of experiments that begin so.

    Example:
        >>> complete_experiment("grid-com")
        ['grid-comparison']
    """
    from neuroslam.experiments import EXPERIMENTS

    return [name for name in ("all", *EXPERIMENTS) if name.startswith(incomplete)]


def complete_assignment(incomplete: str) -> list[str]:
    """Return the keys of the config that begin so, each with its ``=``.

    Example:
        >>> complete_assignment("view.thr")
        ['view.threshold=']
    """
    from pydantic import BaseModel

    from neuroslam.config import BrainConfig

    def keys(of: BaseModel, path: str) -> list[str]:
        found = []
        for name in type(of).model_fields:
            value = getattr(of, name)
            inner = isinstance(value, BaseModel)
            found += keys(value, f"{path}{name}.") if inner else [f"{path}{name}="]
        return found

    return [key for key in keys(BrainConfig(), "") if key.startswith(incomplete)]
