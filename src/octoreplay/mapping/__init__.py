"""Sensor model, octree, packet codec, consensus rules and map metrics: arrays only, no files and no clock."""
