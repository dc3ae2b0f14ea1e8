"""Draws the figure of `show`: two slides of the simulated recording, by the weights `skin`.

python -m docs.make_show          # writes docs/figures/show.png, in two minutes
"""

import io
import tempfile
from pathlib import Path

from PIL import Image

from jaxunshear.demo_data import write_demo_data
from jaxunshear.report.show import load_model_for, plot_frames, predict_frames

FILE = Path(__file__).parent / "figures" / "show.png"
DRAWN = slice(0, None, 2)  # of the frames that `show` draws
PALETTE = 64  # colours of the file, which keep it small


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "demo"
        write_demo_data(folder)
        slides = folder / "331_pins" / "edge" / "shear"
        model = load_model_for(slides, Path("skin"))
        picture = plot_frames(predict_frames(slides, model)[DRAWN], model)
    colours = Image.open(io.BytesIO(picture)).convert("RGB")
    colours.quantize(PALETTE, dither=Image.Dither.NONE).save(FILE, optimize=True)


if __name__ == "__main__":
    main()
