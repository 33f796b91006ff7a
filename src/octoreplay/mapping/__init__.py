"""Arrays only, no files and no clock: sensor model, octree, packet codec, consensus rules and map metrics."""
