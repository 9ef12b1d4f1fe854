"""A publisher of poses in a process of its own, as a ROS node would be one, with types made of ROS's definitions.

python ros2_pose_writer.py DOMAIN '[[TOPIC, TYPE], ...]'; then a line of JSON for each message on stdin:
[TOPIC, TYPE, MESSAGE]
"""

import json
import sys

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.topic import Topic
from ros2_messages import built, dds_type

# As rclpy's default publisher.
QOS = Qos(
    Policy.Reliability.Reliable(max_blocking_time=10**8),
    Policy.Durability.Volatile,
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)


def main(domain, topics):
    participant = DomainParticipant(domain)
    writers = {
        (topic, name): DataWriter(participant, Topic(participant, f"rt/{topic}", dds_type(name)), QOS)
        for topic, name in topics
    }
    print("ready", flush=True)
    for line in sys.stdin:
        topic, name, message = json.loads(line)
        writers[topic, name].write(built(name, message))


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(sys.argv[2]))
