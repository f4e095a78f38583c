"""Parameters of the ROS node."""

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import Field, ValidationError

from neuroslam.config import BrainConfig
from neuroslam.config.section import Section
from neuroslam.errors import ConfigError
from neuroslam.runs.run import resolve_config


class RosSettings(Section):
    """Parameters of the node; all are numbers, flags or text, as parameters of ROS are.

    Example:
        >>> RosSettings(preset="ratslam", set="view.threshold=0.05").brain_config().view.threshold
        0.05
    """

    preset: str = Field(default="", description="preset of the brain, see `neuroslam presets`")
    config: str = Field(default="", description="TOML file with a config of the brain")
    set: str = Field(default="", description="assignments such as `view.threshold=0.05`, by spaces")
    map_file: str = Field(
        default="", description="file of the map: loaded if it is there, saved to"
    )
    save_on_exit: bool = Field(default=True, description="save the map when the node ends")
    image_topic: str = Field(default="image", description="topic of the camera; empty: none")
    image_transport: Literal["", "raw", "compressed"] = Field(
        default="", description="type of the images; empty: compressed if the topic ends so"
    )
    odometry_topic: str = Field(default="odom", description="topic of odometry; empty: none")
    scan_topic: str = Field(default="", description="topic of a laser scanner; empty: none")
    motion: Literal["twist", "poses"] = Field(
        default="twist", description="part of the odometry that is used"
    )
    map_frame: str = Field(default="map", description="frame of the map")
    odom_frame: str = Field(
        default="", description="frame of odometry; empty: that of its messages"
    )
    base_frame: str = Field(default="", description="frame of the robot; empty: as odometry says")
    publish_tf: bool = Field(default=True, description="publish the transform of the map")
    transform_tolerance_s: float = Field(
        default=0.1, ge=0, le=10, description="seconds by which the transform is dated forward"
    )
    lag_s: float = Field(
        default=0.5, gt=0, le=60, description="seconds by which one sensor may lag behind the other"
    )
    graph_every_s: float = Field(
        default=2.0, gt=0, description="seconds between two messages of graph and path"
    )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Self:
        """Return the settings of parameters by name.

        Raises:
            ConfigError: If a value is invalid; the message is one line.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(map(str, first["loc"]))
            raise ConfigError(f"parameter {name}: {first['msg']}, got {first['input']!r}") from None

    @property
    def is_compressed(self) -> bool:
        """Whether images come as ``sensor_msgs/CompressedImage``."""
        by_name = self.image_topic.rstrip("/").endswith("compressed")
        return self.image_transport == "compressed" or (not self.image_transport and by_name)

    def brain_config(self) -> BrainConfig | None:
        """Return the config of the brain; ``None`` if no parameter says anything of it.

        Raises:
            ConfigError: If a preset, file, key or value is invalid.
        """
        if not (self.preset or self.config or self.set):
            return None
        file = Path(self.config) if self.config else None
        return resolve_config(self.preset or None, file, tuple(shlex.split(self.set)), option="set")
