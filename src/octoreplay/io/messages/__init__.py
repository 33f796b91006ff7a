"""From bytes to message objects: ROS, protobuf and JSON, and what sensors and poses look like in all of them."""
