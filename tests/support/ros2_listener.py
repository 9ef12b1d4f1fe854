"""A subscriber in a process of its own, as a ROS node would be one: prints a line of JSON for each message.

python ros2_listener.py DOMAIN {"topic": "sensor_msgs/msg/Image", ...} [best-effort] [signed-bytes]

With signed-bytes it describes bytes in another way than ROS's definitions, as Fast DDS does.
"""

import dataclasses
import json
import sys
import time

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import int8
from cyclonedds.internal import InvalidSample
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from ros2_messages import IDL, dds_type


def plain(value):
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, list) and value and isinstance(value[0], int):
        return bytes(one & 0xFF for one in value).hex()
    return [plain(one) for one in value] if isinstance(value, list) else value


def main(domain, topics, best_effort):
    participant = DomainParticipant(domain)
    reliability = Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(0)

    def qos(topic):
        """As rclpy and rmw_cyclonedds ask for: volatile but for static frames, keep last, and plain CDR alone."""
        return Qos(
            reliability,
            Policy.Durability.TransientLocal if topic == "tf_static" else Policy.Durability.Volatile,
            Policy.History.KeepLast(5 if best_effort else 10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )

    readers = {
        topic: DataReader(participant, Topic(participant, f"rt/{topic}", dds_type(name)), qos(topic))
        for topic, name in topics.items()
    }
    print(json.dumps({"topic": "listening"}), flush=True)
    while True:
        for topic, reader in readers.items():
            for message in reader.take(N=100):
                if isinstance(message, InvalidSample):  # its writer has gone
                    continue
                print(json.dumps({"topic": topic, "message": plain(message)}), flush=True)
        time.sleep(0.002)


if __name__ == "__main__":
    if "signed-bytes" in sys.argv:
        IDL["uint8"] = int8
    main(int(sys.argv[1]), json.loads(sys.argv[2]), "best-effort" in sys.argv)
