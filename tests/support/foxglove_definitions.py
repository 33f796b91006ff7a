"""Definitions of the foxglove_msgs for ROS 2 that the tests use."""

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_FOXGLOVE_MSGS = {
    "CompressedImage": "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
    "RawImage": "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\nstring encoding\n"
    "uint32 step\nuint8[] data\n",
    "CameraCalibration": "builtin_interfaces/Time timestamp\nstring frame_id\nuint32 width\nuint32 height\n"
    "string distortion_model\nfloat64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\n",
    "PackedElementField": "string name\nuint32 offset\nuint8 type\n",
    "PointCloud": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\nuint32 point_stride\n"
    "foxglove_msgs/PackedElementField[] fields\nuint8[] data\n",
    "LaserScan": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\nfloat64 start_angle\n"
    "float64 end_angle\nfloat64[] ranges\nfloat64[] intensities\n",
    "LocationFix": "builtin_interfaces/Time timestamp\nstring frame_id\nfloat64 latitude\nfloat64 longitude\n"
    "float64 altitude\nfloat64[9] position_covariance\nuint8 position_covariance_type\n",
    "PoseInFrame": "builtin_interfaces/Time timestamp\nstring frame_id\ngeometry_msgs/Pose pose\n",
    "FrameTransform": "builtin_interfaces/Time timestamp\nstring parent_frame_id\nstring child_frame_id\n"
    "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n",
    "FrameTransforms": "foxglove_msgs/FrameTransform[] transforms\n",
}
FOXGLOVE_ROS2 = get_typestore(Stores.ROS2_HUMBLE)
for _name, _definition in _FOXGLOVE_MSGS.items():
    FOXGLOVE_ROS2.register(get_types_from_msg(_definition, f"foxglove_msgs/msg/{_name}"))
