"""Poses of a robot's sensor from its own measurements: LiDAR odometry, and odometry of depth images."""
