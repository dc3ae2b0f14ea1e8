"""Poses of a recorded bag of ROS 2, without ROS. Needs numpy and onnxruntime, and robot.py and ros_messages.py beside it.

python examples/read_bag.py touch.onnx bag /camera/image_raw      # a JSON line for each image: its time, and its pose or why there is none
python examples/read_bag.py --save frames.npy bag /camera/image_raw      # all images in one array
"""

import json
import sys
from pathlib import Path

import numpy as np
from ros_messages import read_bag


def print_poses(model: str, bag: str, topic: str) -> None:
    from robot import Touch

    touch = Touch(model)
    for number, frame in enumerate(read_bag(Path(bag), topic)):
        line = {"frame": number, "time_s": frame.time_s} | touch.answer(frame.pixels)
        print(json.dumps(line), flush=True)


def save(file: str, bag: str, topic: str) -> None:
    np.save(file, np.stack([frame.pixels for frame in read_bag(Path(bag), topic)]))


if __name__ == "__main__":
    save(*sys.argv[2:]) if sys.argv[1] == "--save" else print_poses(*sys.argv[1:])
