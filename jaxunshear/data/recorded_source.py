"""Recordings of a real sensor as a data source."""

from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from jaxunshear.config.data import RENDERED_PAIRINGS, DataSettings, Recorded
from jaxunshear.config.network_config import NetworkConfig
from jaxunshear.config.networks import POSENETS
from jaxunshear.config.targets import Targets
from jaxunshear.data.recorded_contacts import parse_folder_digests
from jaxunshear.data.sources import DataSource, Examples, Helpers, PinLayout
from jaxunshear.files import Json

if TYPE_CHECKING:
    from jaxunshear.data.reader import Reader
    from jaxunshear.data.recorded_set import RecordedSet


class RecordedSource(DataSource):
    """Recordings of a real sensor: `Recorded`, and `RecordedTaps` for `pose`."""

    evaluator = "jaxunshear.evaluation.recorded_evaluation:evaluate_recordings"
    pair_fields = ("weight",)
    pin_fields = ("sure",)
    has_frame = True

    def describe(self) -> str:
        labelled, pins = self.settings.labelled, self.experiment.sensor.pins
        share = f", with {labelled:.0%} of the slides' labels" if labelled < 1 else ""
        return (
            f"These networks learnt from recordings of one sensor of {pins} pins{share}: "
            "errors are larger on another sensor, object or camera; "
            "score them with `jaxunshear evaluate MODEL --recordings RECORDINGS`."
        )

    def list_sets(self) -> dict[str, DataSettings]:
        return {self.settings.set_name: self.settings}

    def list_digests(self, settings: DataSettings) -> set[str]:
        return parse_folder_digests(cast(Recorded, settings).digest)

    def list_test_digests(self) -> set[str]:
        return self.list_digests(self.settings)

    def describe_origin(self, config: NetworkConfig) -> Json:
        origin, used = super().describe_origin(config), cast(Recorded, config.source)
        if config.spec.learns_from == "taps":
            return origin
        origin["labelled"] = used.labelled
        reads_poses = config.name in POSENETS
        if not reads_poses or used.pairing == "simulated":
            origin["pairing"] = used.pairing
        if used.unlabelled != "left_out":
            origin["unlabelled"] = used.unlabelled
        if used.direct_taps != "none":
            origin["direct_taps"] = used.direct_taps
        if used.others:
            origin["others"] = list(used.others)
        return origin

    def open_stored(self, data_dir: Path, settings: DataSettings | None = None) -> "RecordedSet":
        from jaxunshear.data.recorded_set import RecordedSet
        from jaxunshear.data.stored_sets import open_set

        used, experiment = cast(Recorded, settings or self.settings), self.experiment
        stored = open_set(used, data_dir, experiment.sensor)
        return RecordedSet(used, stored, experiment.seed, experiment.targets)

    def open_examples(self, config: NetworkConfig, data_dir: Path, helpers: Helpers) -> Examples:
        stored = self.open_stored(data_dir, config.source)
        targets = stored.make_targets(config.targets)
        epoch = stored.count_contacts("slides", "train")
        taps = stored.count_contacts("taps", "train")
        images = config.modality == "images"
        if config.spec.learns_from == "taps":
            reader, epoch = stored.read_taps(), taps
        elif config.spec.role == "unshears":
            reader = self.open_pairs(stored, targets, helpers, images)
        else:
            is_simulated = stored.settings.pairing == "simulated"
            simulate = helpers.load_simulator(stored) if is_simulated else None
            reader = stored.read_slides(simulate, images)
            epoch += taps if stored.settings.direct_taps == "recorded" else 0
        return Examples(
            reader,
            targets,
            read_pin_layout(stored.frame),
            taps if stored.settings.pairing == "simulated" else epoch,
            stored.read_taps() if taps else None,
            stored.make_slide_targets(),
        )

    def open_pairs(
        self, stored: "RecordedSet", targets: Targets, helpers: Helpers, images: bool
    ) -> "Reader":
        pairing, unlabelled = stored.settings.pairing, stored.settings.unlabelled
        render = helpers.load_renderer() if pairing in RENDERED_PAIRINGS else None
        simulate = helpers.load_simulator(stored) if pairing == "simulated" else None
        estimate = helpers.load_estimator() if unlabelled == "pseudo_label" else None
        poses = tuple(target for target in targets if target.field == "pose")
        return stored.read_pairs(poses, render, images, estimate, simulate)

    def make_pose_targets(self, data_dir: Path) -> Targets:
        return self.open_stored(data_dir).make_targets(())

    def read_frame(self, data_dir: Path) -> Json | None:
        return self.open_stored(data_dir).frame


def read_pin_layout(frame: Json) -> PinLayout:
    """Read the layout of the pins from what the frames of a sensor have in common."""
    return PinLayout(
        np.array(frame["place_px"], np.float32), float(frame["radius_px"]), int(frame["size"])
    )
