"""Topics of a result (docs/result-format.md)."""

METRICS_TOPIC = "/metrics"
CONTRADICTION_TOPIC = "/contradiction"
FRAMES_TOPIC = "/frames"
GRAPH_TOPIC = "/graph"
TF_TOPIC = "/tf"
STATIC_TF_TOPIC = "/tf_static"


def map_state_topic(robot_id: str) -> str:
    """Return the topic of a robot's stored map states."""
    return f"/{robot_id}/map_state"


def evidence_topic(robot_id: str) -> str:
    """Return the topic of a robot's stored evidence."""
    return f"/{robot_id}/evidence"


def map_view_topic(robot_id: str) -> str:
    """Return the topic of a robot's map for viewers."""
    return f"/{robot_id}/map"


def markers_topic(robot_id: str) -> str:
    """Return the topic of a robot's map as cubes."""
    return f"/{robot_id}/markers"


def grid_topic(robot_id: str) -> str:
    """Return the topic of a robot's occupancy grid."""
    return f"/{robot_id}/grid"


def octomap_topic(robot_id: str) -> str:
    """Return the topic of a robot's map as an OctoMap tree."""
    return f"/{robot_id}/octomap"


def pose_topic(robot_id: str) -> str:
    """Return the topic of a robot's sensor pose."""
    return f"/{robot_id}/pose"


def packet_topic(robot_id: str) -> str:
    """Return the topic of the packets that a robot sent."""
    return f"/{robot_id}/packet"
