"""The journal of a shared map on a Ray cluster: an actor that has the file, for many machines.

The actor holds an ordinary :class:`~neuroslam.shared_map.journal.Journal` on the disk of its
machine; an offer is acknowledged when it is on that disk. Messages are bytes on the way too.
"""

from pathlib import Path
from typing import Any

from neuroslam.config import BrainConfig
from neuroslam.errors import SharedMapError
from neuroslam.shared_map.journal import Entry, Journal, Layout, Receipt, shared_config

PREFIX = "ray:"
"""Begin of the address of a shared map on Ray: ``ray:NAME``."""

SPACE = "neuroslam"
"""Ray's namespace of the actors."""

ANSWER_S = 30.0
"""Longest wait for an answer."""

START_S = 300.0
"""Longest wait for the first: the actor loads torch, on a busy machine for minutes."""


class _Keeper:
    """What runs in the actor: a journal, made with the config of the first robot."""

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self.journal: Journal | None = None

    def open(self, config: BrainConfig | None) -> BrainConfig:
        """Open the journal, or check a robot's config against it; return the shared config."""
        with Journal(self.folder, config) as checked:  # the first robot's makes the file
            agreed = checked.config
        if self.journal is None:
            self.journal = Journal(self.folder)
        return agreed

    def ask(self, name: str, *values: Any) -> Any:  # noqa: ANN401 - what the method returns
        """Call a method of the journal."""
        if self.journal is None:  # Ray has started the actor again, on its disk
            self.journal = Journal(self.folder)
        return getattr(self.journal, name)(*values)


def keep_on_ray(name: str, folder: str | Path) -> Any:  # noqa: ANN401 - Ray's handle
    """Start the actor of a shared map; Ray must have been initialised.

    Args:
        name: Its name; robots open ``ray:NAME``.
        folder: Folder on the machine of the actor.

    Returns:
        The handle; the actor ends with it, or with the cluster.
    """
    import ray

    actor: Any = ray.remote(num_cpus=0, max_restarts=-1, max_task_retries=-1)(_Keeper)
    return actor.options(name=name, namespace=SPACE).remote(str(Path(folder).resolve()))


class RayJournal:
    """A journal on another machine, with the methods that robots use.

    Args:
        name: Name of the actor.
        config: Config of the robot.

    Raises:
        ConfigError: If the robots of the shared map have another config.
        SharedMapError: If there is no such actor, or it does not answer.
    """

    def __init__(self, name: str, config: BrainConfig | None = None) -> None:
        self.name = name
        wanted = None if config is None else shared_config(config)
        try:
            import ray

            self._actor: Any = ray.get_actor(name, namespace=SPACE)
        except (ImportError, ValueError, ConnectionError, RuntimeError) as error:
            raise SharedMapError(
                f"{PREFIX}{name}: there is no such shared map on Ray ({error})"
            ) from None
        self.config: BrainConfig = self._get(self._actor.open.remote(wanted), START_S)

    def offer(self, robot: str, message: bytes) -> Receipt:
        """Store an offer; see :meth:`~neuroslam.shared_map.journal.Journal.offer`."""
        found: Receipt = self._get(self._actor.ask.remote("offer", robot, message))
        return found

    def since(self, number: int, most: int = 1000) -> list[Entry]:
        """Return the offers after a number."""
        found: list[Entry] = self._get(self._actor.ask.remote("since", number, most))
        return found

    def published(self) -> Layout | None:
        """Return the newest fold that was published."""
        found: Layout | None = self._get(self._actor.ask.remote("published"))
        return found

    def _get(self, promise: Any, wait_s: float = ANSWER_S) -> Any:  # noqa: ANN401 - any answer
        import ray
        from ray.exceptions import RayError, RayTaskError

        try:
            return ray.get(promise, timeout=wait_s)
        except RayTaskError as error:
            cause = error.cause
            if isinstance(cause, SharedMapError | ValueError):  # ConfigError is a ValueError
                raise cause from None
            raise SharedMapError(f"{PREFIX}{self.name}: {cause}") from None
        except RayError as error:
            raise SharedMapError(
                f"{PREFIX}{self.name}: does not answer ({type(error).__name__}); the robot can go "
                "on, and offer again later"
            ) from None
