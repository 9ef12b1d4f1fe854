"""DDS domain in which the ROS 2 nodes of this machine and its network meet, and their topics in it."""

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any, Final
from weakref import WeakValueDictionary
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.idl.annotations import final
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from edge.errors import SinkError, UsageError
from firmware_bridge.recording.cdr import Field, MessageType

_LOOPBACK: Final = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
TYPE_HASHES: Final[dict[str, str]] = {
    "geometry_msgs/msg/PointStamped": "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    "sensor_msgs/msg/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "std_msgs/msg/Float64": "705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    "std_msgs/msg/Int8": "26525065a403d972cb672f0777e333f0c799ad444ae5fcd79e43d1e73bd0f440",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "sensor_msgs/msg/Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    "geometry_msgs/msg/WrenchStamped": "8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "diagnostic_msgs/msg/DiagnosticArray": "5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
}
"""SHA-256 of each type's description, as ROS makes it (RIHS01); from Iron on ROS warns of publishers without one."""
_OPEN: WeakValueDictionary[int, Domain] = WeakValueDictionary()


def domain_id(environment: Mapping[str, str]) -> int:
    """Return ROS_DOMAIN_ID, 0 by default."""
    text = environment.get("ROS_DOMAIN_ID") or "0"
    if not (text.isascii() and text.isdigit() and int(text) <= 232):  # the largest that still has ports
        raise UsageError(f"ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to 232")
    return int(text)


def configuration(environment: Mapping[str, str]) -> str:
    """Return the configuration of Cyclone DDS by the variables that ROS reads; CYCLONEDDS_URI comes last, and wins."""
    reach = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper()
    peers = [peer for peer in environment.get("ROS_STATIC_PEERS", "").split(";") if peer]
    if reach == "OFF":
        raise UsageError(
            "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF, which hides edge-sr from other nodes: set it to LOCALHOST or SUBNET"
        )
    general = ""
    if reach == "LOCALHOST":
        general, peers = f"{_LOOPBACK}<AllowMulticast>false</AllowMulticast>", ["localhost", *peers]
    elif environment.get("ROS_LOCALHOST_ONLY") == "1":
        general, peers = _LOOPBACK, []
    discovery = "".join(f"<Peer Address={quoteattr(peer)}/>" for peer in peers)
    if peers:  # peers are tried on the ports of so many participants of a machine, the number that ROS takes
        auto = "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        discovery = f"{auto}<Peers>{discovery}</Peers>"
    # The default lets each writer wait a second at its end for a reader that has stopped.
    quick_end = "<Internal><WriterLingerDuration>100ms</WriterLingerDuration></Internal>"
    # Fast DDS 3, under ROS's default middleware, describes a sequence of bytes in a way that Cyclone DDS takes for no
    # type, and images reached no such node. Names of types, and ROS's hashes of them, are compared as before. The
    # number is its vendor's id.
    fast_dds = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    parts = f"<General>{general}</General><Discovery>{discovery}</Discovery>{fast_dds}{quick_end}"
    wanted = f"<CycloneDDS><Domain>{parts}</Domain></CycloneDDS>"
    return ",".join(filter(None, (wanted, environment.get("CYCLONEDDS_URI", ""))))


def join(environment: Mapping[str, str]) -> tuple[Domain | None, DomainParticipant]:
    """Take part in the domain (None where this process had opened it otherwise), until nothing holds the two objects.

    Raises a UsageError where a variable of the environment cannot be used, a SinkError where the domain is not joined.
    """
    number, wanted = domain_id(environment), configuration(environment)
    domain = _OPEN.get(number)
    try:
        if domain is None:
            try:
                domain = _OPEN[number] = Domain(number, wanted)
            except DDSException as error:
                if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:  # which is: it is open
                    raise
        return domain, DomainParticipant(number)
    except (DDSException, UnicodeEncodeError) as error:
        raise SinkError(
            f"cannot join DDS domain {number} ({error}): check the network, ROS_DOMAIN_ID and CYCLONEDDS_URI"
        ) from error


def writer(
    participant: DomainParticipant, topic: str, kind: MessageType, depth: int = 1, *, latched: bool = False
) -> DataWriter[Any]:
    """Return a writer that never waits, and keeps `depth` messages for a slow reader; if latched, for later ones too.

    It is reliable, because the subscriptions that ROS makes by default accept nothing less.
    """
    durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
    qos = _qos(kind, depth, Policy.Reliability.Reliable(max_blocking_time=0), durability)
    try:
        return DataWriter(participant, Topic(participant, f"rt/{topic}", dds_type(kind)), qos)
    except DDSException as error:
        raise SinkError(f"cannot publish on /{topic}: {error}") from error


def reader(
    participant: DomainParticipant, topic: str, kind: MessageType, depth: int, *, reliable: bool
) -> DataReader[Any]:
    """Return a reader that keeps `depth` messages; one that is not reliable takes those of every writer."""
    reliability = Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort
    try:
        topics = Topic(participant, f"rt/{topic}", dds_type(kind))
        return DataReader(participant, topics, _qos(kind, depth, reliability, Policy.Durability.Volatile))
    except DDSException as error:
        raise SinkError(f"cannot subscribe to /{topic}: {error}") from error


def taken(reader: DataReader[Any], most: int) -> Iterator[bytes]:
    """Yield the messages that wait at a reader, as bytes."""
    for sample in reader.take(N=most):
        if not isinstance(sample, InvalidSample):  # else its writer has gone
            yield sample.encoded


def _qos(kind: MessageType, depth: int, *policies: Any) -> Qos:
    encoding = Policy.DataRepresentation(use_cdrv0_representation=True)
    of_type = TYPE_HASHES.get(kind.name)
    hashes = () if of_type is None else (Policy.Userdata(f"typehash=RIHS01_{of_type};".encode()),)
    return Qos(*policies, Policy.History.KeepLast(depth), encoding, *hashes)


@cache
def dds_type(kind: MessageType) -> type[IdlStruct]:
    """Return the DDS type of a message, named as ROS names it; final, so plain CDR. An instance holds the message."""
    package, _, name = kind.name.split("/")
    members = {field.name: _member(field) for field in kind.fields}
    made: Any = make_idl_struct(name, f"{package}.msg.dds_.{name}_", members, dataclassify=False)
    made.__init__ = lambda self, encoded: setattr(self, "encoded", encoded)
    made.serialize = lambda self, **_: self.encoded  # called by a writer in place of its own encoder
    made.deserialize = made.deserialize_key = classmethod(_received)  # and by a reader
    return final(made)


def _received(cls: Any, data: bytes, **_: object) -> Any:
    return cls(data)


def _member(field: Field) -> Any:
    if field.message is not None:
        single = dds_type(field.message)
    else:
        single = {"string": str, "bool": bool}.get(field.kind) or getattr(types, field.kind)
    if field.length:
        return types.array[single, field.length]
    return single if field.length is None else types.sequence[single]
