"""From logs to robots: which topics are whose, where the sensor is, and frames in the order of their stamps."""
