"""Decoding of ROS, protobuf and JSON messages, and one form of sensor, pose and label messages for all of them."""
