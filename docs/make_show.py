"""Draws the figure of `show`: two slides of the simulated recording, by the weights `skin`.

python -m docs.make_show          # writes docs/figures/show.png, in two minutes
"""

import tempfile
from pathlib import Path

from jaxunshear.demo_data import write_demo_data
from jaxunshear.report.show import load_model_for, plot_frames, predict_frames

FILE = Path(__file__).parent / "figures" / "show.png"
DRAWN = slice(0, None, 2)  # of the frames that `show` draws


def main() -> None:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "demo"
        write_demo_data(folder)
        slides = folder / "331_pins" / "edge" / "shear"
        model = load_model_for(slides, Path("skin"))
        FILE.write_bytes(plot_frames(predict_frames(slides, model)[DRAWN], model))


if __name__ == "__main__":
    main()
