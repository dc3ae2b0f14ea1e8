"""Adapts a model to the dome in front of the camera: its lost pins, and how it stands untouched."""

from collections.abc import Sequence
from pathlib import Path

from jaxunshear.data.sensor_frame import read_frames
from jaxunshear.errors import UserError
from jaxunshear.inference.trained_model import TrainedModel
from jaxunshear.perception.lattice import check_pin_numbers


def adapt_to_dome(
    model: TrainedModel, untouched: Path | None = None, without: Sequence[int] = ()
) -> None:
    """Leave lost pins out of a model's frames, and learn where pins stand untouched.

    Raises UserError.
    """
    if without:
        if model.frame is None:
            raise UserError(
                f"--without: {model.folder} does not know the pins of these frames: leave it out, "
                "or name a --model over pins, such as skin"
            )
        check_pin_numbers(without, len(model.frame.rest))
        model.frame = model.frame._replace(lost=tuple(sorted(set(without))))
    if untouched is not None:
        model.learn_rest_positions(read_frames(untouched, model.preprocess, model.view))
