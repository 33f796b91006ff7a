"""Labels of depth images and point clouds from a segmentation network that sees the colour images of a log."""
