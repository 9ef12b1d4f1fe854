"""Commands from ROS 2: a text on TOPIC/zero or TOPIC/reset, as any node or `ros2 topic pub` writes it."""

from typing import Any, Final

from cyclonedds.core import DDSException
from cyclonedds.domain import DomainParticipant
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from edge.errors import SinkError
from edge.pipeline.commands import Command, Commands, runtime_command
from edge.sinks.ros2.dds_types import TYPE_HASHES, dds_type
from edge.sinks.ros2.ros_types import STRING
from firmware_bridge.errors import CdrError

_KEPT: Final = 16
"""Commands of a topic that wait for the loop."""


class CommandTopics:
    """Subscriber without a thread of its own: the loop asks it before each scan.

    Topics serve nodes of every middleware; a service's calls are understood by those of one vendor alone.
    """

    def __init__(self, participant: DomainParticipant, base: str, commands: Commands) -> None:
        """Subscribe.

        Args:
            participant: of the domain.
            base: first part of the topics.
            commands: takes what is asked for.

        Raises:
            SinkError: a topic cannot be subscribed to.
        """
        qos = Qos(
            Policy.Reliability.Reliable(0),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(_KEPT),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[STRING.name]};".encode()),
        )
        self._commands = commands
        self._readers: dict[str, DataReader[Any]] = {}
        for name in ("zero", "reset"):
            try:
                topic = Topic(participant, f"rt/{base}/{name}", dds_type(STRING))
                self._readers[name] = DataReader(participant, topic, qos)
            except DDSException as error:
                raise SinkError(f"cannot subscribe to /{base}/{name}: {error}") from error
        commands.ask(self._read)

    def close(self) -> None:
        """Leave the topics."""
        self._readers.clear()

    def _read(self) -> None:
        for name, reader in self._readers.items():
            for sample in reader.take(N=_KEPT):
                if isinstance(sample, InvalidSample):  # its writer has gone
                    continue
                command = _command(name, sample.encoded)
                if command is None or self._commands.full:
                    self._commands.refuse(
                        f"a message on the topic {name} is refused: expected a sensor's name, or none"
                    )
                else:
                    self._commands.put(command)


def _command(name: str, data: bytes) -> Command | None:
    """Return the command in a message: an empty text is for all sensors, else it names the sensor to zero."""
    try:
        sensor = STRING.decode(data)["data"]
    except CdrError:
        return None
    return runtime_command({"cmd": name} | ({"sensor": sensor} if sensor else {}))
