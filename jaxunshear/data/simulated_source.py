"""The simulated sets as a data source."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from jaxunshear.config.data import DataSettings, PairedData, PoseData
from jaxunshear.config.experiment import list_further_tests
from jaxunshear.config.network_config import NetworkConfig, takes_taps
from jaxunshear.config.targets import make_range_targets, make_slide_targets
from jaxunshear.data.sources import DataSource, Examples, Helpers, PinLayout

if TYPE_CHECKING:
    from jaxunshear.data.stored_sets import SetReader


class SimulatedSource(DataSource):
    """Simulated pairs and taps: `PairedData` and `PoseData`."""

    evaluator = "jaxunshear.evaluation.simulated_evaluation:evaluate_simulation"
    pose_frame = (
        "x_mm and yaw_deg are relative to the simulated stimulus' target point, "
        "edge_mm (negative inside) and edge_deg give the nearest edge in the sensor frame; "
        "recorded_* are the labels that came with the images, in their own work frame."
    )
    predicts_directly = False

    @property
    def suits_recordings(self) -> bool:
        """Whether the networks learnt from pins as other sensors and cameras would show them."""
        experiment = self.experiment
        return experiment.unshear.input == "pins" and experiment.pins.turned > 0

    def describe(self) -> str:
        sensor, names = self.experiment.sensor.name, ", ".join(self.settings.names)
        simulated = f"These networks have seen simulated touches only (sensor {sensor}, {names})"
        if self.suits_recordings:
            return (
                f"{simulated}, drawn as other sensors and cameras would show them. "
                "What they read has a zero and a sense of its own, which a few labelled taps show "
                "(`jaxunshear evaluate MODEL --recordings DIR`); "
                "more exact are networks that learn from your own (`jaxunshear fit`)."
            )
        return (
            f"{simulated}: for recordings take the weights `skin`, "
            "or learn from your own with `jaxunshear fit`."
        )

    def list_sets(self) -> dict[str, DataSettings]:
        sets: dict[str, DataSettings] = {self.settings.set_name: self.settings}
        if takes_taps(self.experiment):
            sets[PoseData.set_name] = cast(PoseData, self.experiment.pose)
        return sets | list_further_tests(self.experiment)

    def list_test_digests(self) -> set[str]:
        tests = list_further_tests(self.experiment).values()
        return {digest for test in tests for digest in self.list_digests(test)}

    def open_examples(self, config: NetworkConfig, data_dir: Path, helpers: Helpers) -> Examples:
        settings = cast(PairedData | PoseData, config.source)
        reader = self.open_set(settings, data_dir)
        size, is_paired = settings.preprocess.size, config.spec.learns_from != "taps"
        rest = np.zeros((0, 2), np.float32)
        if config.modality == "pins":
            # the rest positions of recordings are means over taps, for want of untouched pins
            pins = reader.rows("train")["canonical_pins" if is_paired else "pins"]
            rest = pins.mean(axis=0, dtype=np.float64)
        radius_px = config.sensor.pin_radius_mm * size / settings.camera.mm_across
        return Examples(
            reader,
            make_range_targets(config.targets, settings.ranges),
            PinLayout(rest, radius_px, size),
            reader.length("train"),
            slide_targets=make_slide_targets(settings.ranges) if is_paired else (),
        )

    def open_set(self, settings: DataSettings, data_dir: Path) -> "SetReader":
        """Open a set. Raises UserError if it is missing or was made with other settings."""
        from jaxunshear.data.stored_sets import FactorialReader, SetReader, open_set

        is_factorial = self.shares_slides and settings == self.settings
        kind = FactorialReader if is_factorial else SetReader
        return open_set(settings, data_dir, self.experiment.sensor, kind)
