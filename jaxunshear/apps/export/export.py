"""A trained model as one file for a computer without JAX: ONNX, or StableHLO. It is compared with JAX before it is put in its place.

>>> export_model(Path("standard"), Path("standard.onnx"))
"""

import json
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxunshear import __version__
from jaxunshear.config.data import Recorded
from jaxunshear.config.experiment import Experiment, uses_pins
from jaxunshear.errors import UserError
from jaxunshear.files import write_bytes
from jaxunshear.inference.infer import FRAMES, OWN_FRAME
from jaxunshear.inference.suitability import describe_training
from jaxunshear.model_folders import find_model_folder, load_settings
from jaxunshear.output_checks import check_new_folder
from jaxunshear.protected_folders import check_outside

if TYPE_CHECKING:
    from jaxunshear.apps.export.frames import ExportCamera
    from jaxunshear.apps.export.parts import ExportedModel

ONNX, STABLEHLO = ".onnx", ".stablehlo"
EXTRA = "pip install -c constraints.txt '.[onnx]'"
PLATFORMS = ("cpu", "cuda")  # that a file of StableHLO runs on
INPUTS = {
    "image": "uint8 of 0 and 255, (batch, {px}, {px}): a frame as jaxunshear prepares it",
    "pins": "float32 px, (batch, {count}, 2): column and row of every pin in a prepared image of {px} px, in the order of rest_px, where "
    "they stand untouched; NaN for one that is not seen",
    "frame": "uint8, (batch, height, width) of greys or (batch, height, width, channels) in the order red, green, blue: as the camera "
    "gives it",
}


def export_model(
    model: Path, out: Path, batch: int | None = None, preprocess: Path | None = None
) -> float:
    """Writes `out`; `batch`: how many images it takes at once, None for any; `preprocess`: frames of a camera, which the file then takes
    as they come. Returns the largest difference to JAX, of an output's range. Raises UserError, and then leaves nothing behind."""
    _check(out, batch, preprocess)
    folder = find_model_folder(model)
    experiment = load_settings(folder)
    if preprocess is not None and uses_pins(experiment):
        raise UserError(
            f"--preprocess: {model} reads pins, which are found outside of the file; leave it out"
        )
    _check_extra(out.suffix)
    from jaxunshear.apps.export.parts import MAX_DIFFERENCE, load_exported_model

    parts = load_exported_model(folder, experiment)
    if out.suffix == ONNX:
        data, off = _onnx(parts, folder, experiment, batch, preprocess)
    else:
        data, off = _stablehlo(parts, batch)
    if not off <= MAX_DIFFERENCE:
        raise UserError(
            f"{out} would differ from JAX by {off:.1e} of an output's range, more than {MAX_DIFFERENCE:g}: not written"
        )
    write_bytes(out, data)
    print(
        f"{out}: {len(data) / 1e6:.1f} MB, differs from JAX by at most {off:.1e} of an output's range"
    )
    return off


def _check(out: Path, batch: int | None, preprocess: Path | None) -> None:
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


def _onnx(
    parts: "ExportedModel",
    folder: Path,
    experiment: Experiment,
    batch: int | None,
    preprocess: Path | None,
) -> tuple[bytes, float]:
    from jaxunshear.apps.export.frames import preprocess_frames, read_camera
    from jaxunshear.apps.export.onnx_file import build_onnx, make_onnx_runner
    from jaxunshear.apps.export.parts import make_check_inputs, measure_difference
    from jaxunshear.inference.perceiver import load_training_frame

    camera = None
    if preprocess is not None:
        learnt = load_training_frame(folder, experiment)
        camera = read_camera(
            preprocess, experiment.paired.preprocess, learnt.view if learnt else None
        )
    data = build_onnx(parts, batch, camera, _metadata(parts, experiment, camera))
    run = make_onnx_runner(data, parts)
    if camera is None:
        return data, measure_difference(parts, run, make_check_inputs(parts), batch)
    return data, measure_difference(
        parts, run, camera.frames, batch, partial(preprocess_frames, camera)
    )


def build_stablehlo(parts: "ExportedModel", batch: int | None) -> bytes:
    """`parts.make_exported_function` as `jax.export.deserialize` reads it. `batch`: None for any."""
    import jax
    from jax import export

    from jaxunshear.apps.export.parts import make_exported_function
    from jaxunshear.models import layer_choice

    many = export.symbolic_shape("batch")[0] if batch is None else batch
    given = jax.ShapeDtypeStruct((many, *parts.shape), parts.dtype)
    # layers that are compiled for this processor stay here; a GPU is not to round
    with layer_choice.use_layers(layer_choice.PLAIN), jax.default_matmul_precision("highest"):
        return bytes(
            export.export(jax.jit(make_exported_function(parts)), platforms=PLATFORMS)(
                given
            ).serialize()
        )


def _stablehlo(parts: "ExportedModel", batch: int | None) -> tuple[bytes, float]:
    import jax
    from jax import export

    from jaxunshear.apps.export.parts import make_check_inputs, measure_difference

    data = build_stablehlo(parts, batch)
    run = jax.jit(export.deserialize(bytearray(data)).call)
    return data, measure_difference(
        parts, lambda each: jax.device_get(run(each)), make_check_inputs(parts), batch
    )


def _metadata(
    parts: "ExportedModel", experiment: Experiment, camera: "ExportCamera | None"
) -> dict[str, str]:
    """What a program needs to know of a file of ONNX, and its reader of the networks."""
    from jaxunshear.config.targets import list_target_names

    names = list_target_names(parts.targets)
    known = {
        "jaxunshear": __version__,
        "size_px": str(parts.size),
        "names": ",".join(names),
        "units": ",".join(name.rpartition("_")[2] for name in names),
        "pose_of": parts.method,
        "frame_of_poses": OWN_FRAME if isinstance(experiment.paired, Recorded) else FRAMES,
        "learnt": describe_training(experiment),
        "preprocess": json.dumps(asdict(experiment.paired.preprocess)),
    }
    if parts.rest is not None:
        rest = json.dumps(np.round(parts.rest.astype(float), 3).tolist())
        return known | {
            "input": INPUTS["pins"].format(count=len(parts.rest), px=parts.size),
            "rest_px": rest,
        }
    if camera is None:
        return known | {"input": INPUTS["image"].format(px=parts.size)}
    return known | {"input": INPUTS["frame"], "crop_px": ",".join(map(str, camera.box))}
