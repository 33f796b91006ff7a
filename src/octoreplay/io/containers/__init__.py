"""From files to raw messages: MCAP, ROS 1 bags and rosbag2, whole or damaged; and writing MCAP."""
