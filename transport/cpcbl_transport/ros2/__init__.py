"""ROS 2 on Zenoh without ROS: the wire of rmw_zenoh and of zenoh-bridge-ros2dds.

`qos`, `names`, `tokens` and `attachment` are the layouts of keys and headers as pure functions,
`messages` is the CDR payload, `graph` decides what is heard and why something is not, `session` is
Zenoh, and `node` is what a bridge uses:

    with open_node(NodeSettings(connect=("tcp/127.0.0.1:7447",))) as node:
        publisher = node.publisher("r1/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped")
        node.subscribe("r1/odom", "nav_msgs/msg/Odometry", on_message=print)

The whole package needs the extra `ros2` (`pip install 'cpcbl-team[ros2]'`), and nothing else of
the project imports it but the bridge.
"""
