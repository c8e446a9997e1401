"""A ROS 2 node that publishes what `trifix live --publish udp://:5005` sends, as PoseWithCovarianceStamped and tf.

Each body has a topic of its own, trifix/BODY/pose. ROS takes metres, and a covariance of small shifts and turns in the
coordinates of the map: ours are in the sensor's, so both halves are turned. Refused frames are not published.

Run, where ROS 2 is set up: python3 examples/ros2_node.py --ros-args -p port:=5005
"""

import json
import socket

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.node import Node
from rclpy.time import Time
from tf2_ros import TransformBroadcaster

MAP, SENSOR = "trifix_map", "trifix_sensor"
IN_METRES = np.diag([1e-3, 1e-3, 1e-3, 1.0, 1.0, 1.0])


class PoseNode(Node):
    def __init__(self) -> None:
        super().__init__("trifix")
        self._topics = {}
        self._tf = TransformBroadcaster(self)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", self.declare_parameter("port", 5005).value))
        self._socket.setblocking(False)
        self.create_timer(0.002, self._receive)

    def _receive(self) -> None:
        while True:
            try:
                pose = json.loads(self._socket.recv(65536))
            except BlockingIOError:
                return
            if pose["status"] == "positioned":
                self._publish(pose)

    def _publish(self, pose: dict) -> None:
        body = pose["body"]
        topic = f"trifix/{body}/pose" if body else "trifix/pose"
        if topic not in self._topics:
            self._topics[topic] = self.create_publisher(PoseWithCovarianceStamped, topic, 10)
        x, y, z = (1e-3 * each for each in pose["position_mm"])
        qx, qy, qz, qw = pose["quaternion_xyzw"]
        stamp = Time(nanoseconds=pose["timestamp_ns"]).to_msg()

        told = PoseWithCovarianceStamped()
        told.header.stamp, told.header.frame_id = stamp, f"{MAP}_{body}" if body else MAP
        position, turn = told.pose.pose.position, told.pose.pose.orientation
        position.x, position.y, position.z = x, y, z
        turn.x, turn.y, turn.z, turn.w = qx, qy, qz, qw
        A = np.kron(np.eye(2), rotation(qx, qy, qz, qw)) @ IN_METRES
        told.pose.covariance = (A @ np.array(pose["covariance"]) @ A.T).ravel().tolist()
        self._topics[topic].publish(told)

        moved = TransformStamped()
        moved.header = told.header
        moved.child_frame_id = f"{SENSOR}_{body}" if body else SENSOR
        shift, turn = moved.transform.translation, moved.transform.rotation
        shift.x, shift.y, shift.z = x, y, z
        turn.x, turn.y, turn.z, turn.w = qx, qy, qz, qw
        self._tf.sendTransform(moved)


def rotation(x: float, y: float, z: float, w: float) -> np.ndarray:
    """The rotation matrix of a unit quaternion."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def main() -> None:
    rclpy.init()
    node = PoseNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
