"""A robot's program: frames in, poses out, by a model exported with `jaxunshear export`. Needs numpy and onnxruntime alone.

python examples/robot.py touch.onnx frames.npy      # (N, ...) of what the model takes: frames, prepared images, or pins
"""

import json
import sys
import time

import numpy as np
import onnxruntime


class Touch:
    """A model in memory."""

    def __init__(self, file: str) -> None:
        self._session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        known = self._session.get_modelmeta().custom_metadata_map
        self.names = known["names"].split(",")  # of what it reads, such as edge_mm, edge_deg
        self._given = self._session.get_inputs()[0]
        self._dtype = np.uint8 if self._given.type == "tensor(uint8)" else np.float32
        self.pose(np.zeros(self._given.shape[1:], self._dtype))  # the first call is slow

    def pose(self, frame: np.ndarray) -> dict[str, float]:
        """Of one frame, mm and deg by name. "unsheared" and, of images, "confidence" are asked for likewise."""
        if frame.shape != tuple(self._given.shape[1:]) or frame.dtype != self._dtype:
            raise SystemExit(
                f"{frame.dtype} {frame.shape}: the model takes {self._given.type} {self._given.shape[1:]}"
            )
        (poses,) = self._session.run(["pose"], {self._given.name: frame[None]})
        return dict(zip(self.names, map(float, poses[0]), strict=True))


def main(model: str, source: str) -> None:
    touch = Touch(model)
    for number, frame in enumerate(np.load(source)):  # a camera's, on a robot
        came = time.perf_counter()
        pose = touch.pose(frame)
        spent = 1e3 * (time.perf_counter() - came)
        print(json.dumps({"frame": number, "pose": pose, "ms": round(spent, 2)}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
