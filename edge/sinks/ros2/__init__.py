"""ROS 2: its messages, names and types, and the sink."""
