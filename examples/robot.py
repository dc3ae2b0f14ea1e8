"""A robot's program: frames in, poses out, by a model exported with `jaxunshear export`. Needs numpy and onnxruntime alone.

python examples/robot.py touch.onnx frames.npy      # (N, ...) of what the model takes: frames, prepared images, or pins

With touch_pins.py beside it, which `export` writes, it takes frames, and a frame without contact has no pose. That module needs scipy, scikit-image and threadpoolctl.
"""

import importlib
import json
import sys
import time
from pathlib import Path

import numpy as np
import onnxruntime

SCHEMA = 1  # of the lines, as `jaxunshear stream` has them


class Touch:
    """A model in memory."""

    def __init__(self, file: str) -> None:
        self._session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
        known = self._session.get_modelmeta().custom_metadata_map
        self.names = known["names"].split(",")  # of what it reads, such as edge_mm, edge_deg
        self._reason = known["not_sure"]  # of every frame that is not
        self._given = self._session.get_inputs()[0]
        self._dtype = np.uint8 if self._given.type == "tensor(uint8)" else np.float32
        self._run(np.zeros(self._given.shape[1:], self._dtype))  # the first call is slow
        self._camera = None
        module = Path(file).with_name(f"{Path(file).stem}_pins.py")
        if module.exists():
            sys.path.append(str(module.parent))
            self._camera = importlib.import_module(module.stem).CAMERA

    def answer(self, frame: np.ndarray) -> dict[str, float | str | dict[str, float]]:
        """Of one frame, as in a line of `jaxunshear stream`: confidence, and the pose, mm and deg by name, or why there is none.

        With the module beside the file: "touch", too.
        """
        name = self._given.name
        if self._camera is None:
            return self._run(frame)
        is_prepared = name == "image" and frame.shape == tuple(self._given.shape[1:])
        reading = self._camera.read_image(frame) if is_prepared else self._camera.read(frame)
        line = self._run(frame if name == "frame" else reading.inputs[0])
        touch = {name: round(value, 4) for name, value in reading.touch.items()}
        if reading.reason:
            line = {"confidence": 0.0, "error": reading.reason}
        elif "pose" in line:
            line["confidence"] = round(line["confidence"] * reading.familiarity, 4)
            pose = self._camera.turn_pose(line["pose"])
            line["pose"] = {name: round(value, 4) for name, value in pose.items()}
        return line | ({"touch": touch} if touch else {})

    def _run(self, frame: np.ndarray) -> dict[str, float | str | dict[str, float]]:
        """Run the model on what it takes; "unsheared" is asked for likewise."""
        if frame.shape != tuple(self._given.shape[1:]) or frame.dtype != self._dtype:
            raise SystemExit(
                f"{frame.dtype} {frame.shape}: the model takes {self._given.type} {self._given.shape[1:]}"
            )
        outputs = self._session.run(["pose", "confidence", "sure"], {self._given.name: frame[None]})
        pose, confidence, sure = (output[0] for output in outputs)
        if not sure:
            return {"confidence": 0.0, "error": self._reason}
        by_name = {
            name: round(float(number), 4) for name, number in zip(self.names, pose, strict=True)
        }
        return {"confidence": round(float(confidence), 4), "pose": by_name}


def main(model: str, source: str) -> None:
    touch = Touch(model)
    for number, frame in enumerate(np.load(source)):  # a camera's, on a robot
        came = time.perf_counter()
        line = {"schema": SCHEMA, "frame": number, "name": f"{source} {number}", "time_s": None}
        line |= touch.answer(frame)
        spent = 1e3 * (time.perf_counter() - came)
        print(json.dumps(line | {"ms": round(spent, 3)}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
