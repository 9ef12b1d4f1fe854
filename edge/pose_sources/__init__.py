"""Sources of poses beside stdin: they steer nothing else, and put what they receive into the queue of poses."""
