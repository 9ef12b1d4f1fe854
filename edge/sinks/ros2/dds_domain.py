"""DDS domain in which the ROS 2 nodes of this machine and its network meet."""

from collections.abc import Mapping
from typing import Final
from weakref import WeakValueDictionary
from xml.sax.saxutils import quoteattr

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant

from edge.errors import SinkError, UsageError

LARGEST_DOMAIN: Final = 232
"""Largest domain number that still has ports."""
_LOOPBACK: Final = '<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>'
# The default lets each writer wait a second at its end for a reader that has stopped.
_QUICK_END: Final = "<Internal><WriterLingerDuration>100ms</WriterLingerDuration></Internal>"
# Fast DDS 3, under ROS's default middleware, describes a sequence of bytes in a way that Cyclone DDS takes for no type,
# and images reached no such node. Names of types, and ROS's hashes of them, are compared as before.
_FAST_DDS: Final = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"  # its vendor id
_OPEN: WeakValueDictionary[int, Domain] = WeakValueDictionary()


def domain_id(environment: Mapping[str, str]) -> int:
    """Return ROS_DOMAIN_ID, 0 by default.

    Raises:
        UsageError: it is not a valid domain number.
    """
    text = environment.get("ROS_DOMAIN_ID") or "0"
    if not (text.isascii() and text.isdigit() and int(text) <= LARGEST_DOMAIN):
        raise UsageError(f"ROS_DOMAIN_ID is {text!r}, expected a whole number from 0 to {LARGEST_DOMAIN}")
    return int(text)


def configuration(environment: Mapping[str, str]) -> str:
    """Return the configuration of Cyclone DDS, from the variables that ROS reads; CYCLONEDDS_URI comes last, and wins.

    Raises:
        UsageError: discovery is switched off, so that no node could receive a message.
    """
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
    parts = f"<General>{general}</General><Discovery>{discovery}</Discovery>{_FAST_DDS}{_QUICK_END}"
    wanted = f"<CycloneDDS><Domain>{parts}</Domain></CycloneDDS>"
    return ",".join(filter(None, (wanted, environment.get("CYCLONEDDS_URI", ""))))


def join(environment: Mapping[str, str]) -> tuple[Domain | None, DomainParticipant]:
    """Take part in the domain; it is left as soon as nothing holds the returned objects.

    Returns:
        The domain, None where this process had opened it by other means, and a participant.

    Raises:
        UsageError: a variable of the environment has a value that cannot be used.
        SinkError: the domain cannot be joined.
    """
    number, wanted = domain_id(environment), configuration(environment)
    domain = _OPEN.get(number)
    try:
        if domain is None:
            domain = _open(number, wanted)
        return domain, DomainParticipant(number)
    except (DDSException, UnicodeEncodeError) as error:
        raise SinkError(
            f"cannot join DDS domain {number} ({error}): check the network, ROS_DOMAIN_ID and CYCLONEDDS_URI"
        ) from error


def _open(number: int, wanted: str) -> Domain | None:
    try:
        domain = Domain(number, wanted)
    except DDSException as error:
        if error.code == DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            return None
        raise
    _OPEN[number] = domain
    return domain
