"""A node of ROS 2: images in, poses out, by a model exported with `jaxunshear export --preprocess FRAMES`.

Needs rclpy, numpy and onnxruntime, and robot.py and ros_messages.py beside it.

python examples/ros2_node.py --ros-args -p model:=touch.onnx -r image:=/camera/image_raw
It publishes `pose`, a sensor_msgs/JointState: names, and positions in m and rad, with the image's own time. Of an
image that gets no pose it publishes nothing, and logs why.
"""

import math

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from robot import Touch
from ros_messages import to_pixels
from sensor_msgs.msg import Image, JointState

SI = {"mm": 1e-3, "deg": math.pi / 180}


class TouchNode(Node):
    """Answers the newest image; those that come meanwhile are dropped."""

    def __init__(self) -> None:
        super().__init__("touch")
        self._touch = Touch(self.declare_parameter("model", "touch.onnx").value)
        self._publisher = self.create_publisher(JointState, "pose", 1)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self.create_subscription(Image, "image", self.answer, newest)

    def answer(self, image: Image) -> None:
        shape = image.height, image.width
        line = self._touch.answer(to_pixels(image.encoding, shape, image.step, bytes(image.data)))
        if "error" in line:
            self.get_logger().warning(line["error"], throttle_duration_sec=1.0)
            return
        message = JointState(header=image.header)
        for name, value in line["pose"].items():  # such as edge_mm
            quantity, _, unit = name.rpartition("_")
            message.name.append(quantity)
            message.position.append(value * SI[unit])
        self._publisher.publish(message)


def main() -> None:
    rclpy.init()
    node = TouchNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
