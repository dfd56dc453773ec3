"""A node whose context ends between two steps of `spin`: prints what `until_shutdown` lets through."""

import rclpy
from rclpy.executors import SingleThreadedExecutor

from offboard.ros2.node import until_shutdown

rclpy.init()
node = rclpy.create_node("ended")
executor = SingleThreadedExecutor()
executor.add_node(node)
try:
    with until_shutdown():
        raise RuntimeError("a defect")
except RuntimeError as error:
    print(error)
rclpy.shutdown()
with until_shutdown():
    executor.spin_once()
    raise AssertionError("a spin without a context is an error")
print("ended")
