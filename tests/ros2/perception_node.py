"""A perception node as a user writes it: image in, detection out, and the work of the callback offloaded."""

import sys

import rclpy
from geometry_msgs.msg import PointStamped
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image

from offboard import Offloader
from offboard.ros2 import image_array
from offboard.ros2.node import until_shutdown
from tests.ros2.spots import brightest_spot

# rclpy wakes the node on SIGTERM before it ends its context. A node without a timer may then wait for ever.
AWAKE_S = 1.0


class Detector(Node):
    """Says where the brightest spot of each image is."""

    def __init__(self, endpoint: str) -> None:
        super().__init__("detector")
        self.offload = Offloader.connect(endpoint, trace=sys.argv[2])
        self.offload.wait_for_sites(brightest_spot, 10.0)
        self.found = self.create_publisher(PointStamped, "spot", 10)
        self.create_subscription(Image, "image", self.see, qos_profile_sensor_data)

    def see(self, message: Image) -> None:
        row, col = self.offload(brightest_spot, image_array(message))
        spot = PointStamped(header=message.header)
        spot.point.x, spot.point.y = float(col), float(row)
        self.found.publish(spot)


rclpy.init()
with until_shutdown():
    detector = Detector(sys.argv[1])
    while rclpy.ok():
        rclpy.spin_once(detector, timeout_sec=AWAKE_S)
