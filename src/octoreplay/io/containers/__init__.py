"""Readers of MCAP files, ROS 1 bags and rosbag2 recordings, also damaged ones, and a writer of MCAP files."""
