"""Decoding of sensor messages into arrays: images, point clouds, cameras and labels."""
