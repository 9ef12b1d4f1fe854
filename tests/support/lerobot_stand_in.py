"""Interface of LeRobot that a camera plugin needs, written from its documentation, where LeRobot is not installed.

It is no kinder than the real one: abstract methods must be there, and a camera is found and made by names alone. The
same tests run with the real package where that is installed.
"""

import abc
import importlib
import importlib.metadata
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar


@dataclass(kw_only=True)
class CameraConfig:
    fps: int | None = None
    width: int | None = None
    height: int | None = None

    words: ClassVar[dict[type, str]] = {}  # by which classes were registered

    @classmethod
    def register_subclass(cls, word: str):
        def register(kind: type) -> type:
            cls.words[kind] = word
            return kind

        return register

    @property
    def type(self) -> str:
        return self.words[self.__class__]


class Camera(abc.ABC):
    def __init__(self, config: CameraConfig) -> None:
        self.fps, self.width, self.height = config.fps, config.width, config.height

    @property
    @abc.abstractmethod
    def is_connected(self) -> bool: ...

    @staticmethod
    @abc.abstractmethod
    def find_cameras() -> list[dict[str, Any]]: ...

    @abc.abstractmethod
    def connect(self, warmup: bool = True) -> None: ...

    @abc.abstractmethod
    def read(self) -> Any: ...

    @abc.abstractmethod
    def async_read(self, timeout_ms: float = 200.0) -> Any: ...

    @abc.abstractmethod
    def disconnect(self) -> None: ...


def make_cameras_from_configs(configs: dict[str, CameraConfig]) -> dict[str, Camera]:
    """Make each camera: its class is called as its settings' without Config, in the package that holds them."""
    made = {}
    for key, config in configs.items():
        package = importlib.import_module(config.__class__.__module__.rpartition(".")[0])
        made[key] = getattr(package, config.__class__.__name__.removesuffix("Config"))(config)
    return made


def register_third_party_plugins() -> None:
    """Import every installed package whose name begins as a plugin's does."""
    for one in importlib.metadata.distributions():
        if (one.metadata["Name"] or "").startswith("lerobot_camera_"):
            importlib.import_module(one.metadata["Name"])


def install(monkeypatch) -> None:
    """Put the stand-in where `import lerobot` finds it, until the test ends."""
    parts = {
        "lerobot": {},
        "lerobot.cameras": {"Camera": Camera, "CameraConfig": CameraConfig},
        "lerobot.cameras.camera": {"Camera": Camera},
        "lerobot.cameras.configs": {"CameraConfig": CameraConfig},
        "lerobot.cameras.utils": {"make_cameras_from_configs": make_cameras_from_configs},
        "lerobot.utils": {},
        "lerobot.utils.errors": dict.fromkeys(
            ("DeviceNotConnectedError", "DeviceAlreadyConnectedError"), ConnectionError
        ),
        "lerobot.utils.import_utils": {"register_third_party_plugins": register_third_party_plugins},
    }
    for name, content in parts.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
