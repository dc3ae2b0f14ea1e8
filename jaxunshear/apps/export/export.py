"""Exports a trained model as one file for a computer without JAX: ONNX, or StableHLO.

The file is compared with JAX before it is put in its place.

>>> export_model(Path("standard"), Path("standard.onnx"))
"""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import numpy as np

from jaxunshear import __version__
from jaxunshear.apps.export.camera_pins import (
    describe_camera_images,
    describe_camera_pins,
    get_module_path,
    write_pin_module,
)
from jaxunshear.apps.export.parts import (
    MAX_DIFFERENCE,
    ExportedModel,
    load_exported_model,
    make_check_inputs,
    make_exported_function,
    measure_difference,
)
from jaxunshear.config.targets import get_unit, list_target_names
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_bytes
from jaxunshear.inference.trained_model import TrainedModel, load_model
from jaxunshear.models import layer_choice
from jaxunshear.output_checks import check_new_folder, check_outside
from jaxunshear.perception.preprocess import View
from jaxunshear.perception.sensor_check import FOREIGN_REASON

if TYPE_CHECKING:
    from jaxunshear.apps.export.onnx_graph import ExportCamera

ONNX, STABLEHLO = ".onnx", ".stablehlo"
EXTRA = "pip install -c constraints.txt '.[onnx]'"
PLATFORMS = ("cpu", "cuda")  # that a file of StableHLO runs on
INPUTS = {
    "image": "uint8 of 0 and 255, (batch, {px}, {px}): a frame as jaxunshear prepares it",
    "pins": "float32 px, (batch, {count}, 2): column and row of every pin in a prepared image of "
    "{px} px, in the order of rest_px, where they stand untouched; NaN for one that is not seen",
    "frame": "uint8, (batch, height, width) of greys or (batch, height, width, channels) in the "
    "order red, green, blue: as the camera gives it",
}


def export_model(
    name: Path,
    out: Path,
    batch: int | None = None,
    preprocess: Path | None = None,
    like: Path | None = None,
) -> None:
    """Write a model to `out`, and print its largest difference to JAX, over an output's range.

    Beside the file stands the module that finds pins in frames and says whether they show a
    contact; for networks over pins only if the model knows a camera. Raises UserError, and then
    leaves nothing behind.

    Args:
        batch: how many images the file takes at once, None for any.
        preprocess: frames of a camera; the file then takes such frames as they come.
        like: contacts of a camera, for networks over pins that learnt from simulation alone.
    """
    _check_arguments(out, batch, preprocess)
    module = get_module_path(out)
    model = load_model(name, like)
    if preprocess is not None and model.reads_pins:
        raise UserError(
            f"--preprocess: {name} reads pins, which are found outside of the file; "
            "name contacts of the camera by --like"
        )
    _check_extra(out.suffix)
    parts, camera = load_exported_model(model), None
    if preprocess is not None:
        from jaxunshear.apps.export.onnx_graph import read_camera

        camera = read_camera(preprocess, model.preprocess, model.view)
    if out.suffix == ONNX:
        data, difference = _export_onnx(parts, model, batch, camera)
    else:
        data, difference = _export_stablehlo(parts, batch)
    if not difference <= MAX_DIFFERENCE:
        raise UserError(
            f"{out} would differ from JAX by {difference:.1e} of an output's range, "
            f"more than {MAX_DIFFERENCE:g}: not written"
        )
    write_bytes(out, data)
    size = f"{len(data) / 1e6:.1f} MB"
    print(f"{out}: {size}, differs from JAX by at most {difference:.1e} of an output's range")
    module.unlink(missing_ok=True)  # of an earlier file, perhaps of another camera
    _write_module(model, parts, camera, out)


def _write_module(
    model: TrainedModel, parts: ExportedModel, camera: "ExportCamera | None", out: Path
) -> None:
    if parts.rest is None:
        view = model.view if camera is None else View(camera.box, dark=camera.dark)
        inputs = "image" if camera is None else "frame"
        path = write_pin_module(describe_camera_images(model, view), inputs, out)
    elif model.frame is None:
        print("no module that finds pins: name contacts of a camera by --like")
        return
    else:
        path = write_pin_module(describe_camera_pins(model, parts.rest), "pins", out)
    print(f"{path}: finds pins in frames of the camera, and says if they show no contact")


def _check_arguments(out: Path, batch: int | None, preprocess: Path | None) -> None:
    if out.suffix not in (ONNX, STABLEHLO):
        raise UserError(f"--out {out}: name a file that ends in {ONNX} or {STABLEHLO}")
    if out.is_dir():
        raise UserError(f"--out {out} is a folder: name a file")
    check_new_folder(out.parent)
    check_outside(out, "--out")
    if batch is not None and not 1 <= batch <= 4096:
        raise UserError(f"--batch {batch}: use 1 to 4096, or any")
    if preprocess is not None and out.suffix != ONNX:
        raise UserError(
            f"--preprocess: frames are prepared in files that end in {ONNX} alone; leave it out"
        )


def _check_extra(suffix: str) -> None:
    try:
        import flatbuffers  # noqa: F401 - of JAX' own files

        if suffix == ONNX:
            import onnx  # noqa: F401
            import onnxruntime  # noqa: F401
    except ImportError as error:
        raise UserError(f"a file that ends in {suffix} needs {error.name}: {EXTRA}") from None


def _export_onnx(
    parts: ExportedModel, model: TrainedModel, batch: int | None, camera: "ExportCamera | None"
) -> tuple[bytes, float]:
    from jaxunshear.apps.export.onnx_file import build_onnx, make_onnx_runner
    from jaxunshear.apps.export.onnx_graph import preprocess_frames

    data = build_onnx(parts, batch, camera, _make_metadata(parts, model, camera))
    run = make_onnx_runner(data, parts)
    if camera is None:
        return data, measure_difference(parts, run, make_check_inputs(parts), batch)
    prepare = partial(preprocess_frames, camera)
    return data, measure_difference(parts, run, camera.frames, batch, prepare)


def build_stablehlo(parts: ExportedModel, batch: int | None) -> bytes:
    """Serialise `parts.make_exported_function` for `jax.export.deserialize`.

    `batch` is None for any.
    """
    from jax import export

    count = export.symbolic_shape("batch")[0] if batch is None else batch
    inputs = jax.ShapeDtypeStruct((count, *parts.shape), parts.dtype)
    function = jax.jit(make_exported_function(parts))
    # layers that are compiled for this processor stay here; a GPU must not round
    with layer_choice.use_layers(layer_choice.PLAIN), jax.default_matmul_precision("highest"):
        return bytes(export.export(function, platforms=PLATFORMS)(inputs).serialize())


def _export_stablehlo(parts: ExportedModel, batch: int | None) -> tuple[bytes, float]:
    from jax import export

    data = build_stablehlo(parts, batch)
    call = jax.jit(export.deserialize(bytearray(data)).call)

    def run(inputs: np.ndarray) -> Json:
        return jax.device_get(call(inputs))

    return data, measure_difference(parts, run, make_check_inputs(parts), batch)


def _make_metadata(
    parts: ExportedModel, model: TrainedModel, camera: "ExportCamera | None"
) -> dict[str, str]:
    names = list_target_names(parts.targets)
    metadata = {
        "jaxunshear": __version__,
        "size_px": str(parts.size),
        "names": ",".join(names),
        "units": ",".join(get_unit(name) for name in names),
        "pose_of": parts.method,
        "not_sure": FOREIGN_REASON,
        "frame_of_poses": model.source.pose_frame,
        "learnt": model.source.describe(),
        "preprocess": json.dumps(asdict(model.experiment.paired.preprocess)),
    }
    if parts.rest is not None:
        rest = json.dumps(np.round(parts.rest.astype(float), 3).tolist())
        return metadata | {
            "input": INPUTS["pins"].format(count=len(parts.rest), px=parts.size),
            "rest_px": rest,
        }
    if camera is None:
        return metadata | {"input": INPUTS["image"].format(px=parts.size)}
    return metadata | {"input": INPUTS["frame"], "crop_px": ",".join(map(str, camera.box))}
