"""The stored configurations of both data sets, and how a set made with other settings is distinguished."""

import dataclasses
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxunshear.config.data import PairedData, PoseData, Ranges, Recorded
from jaxunshear.config.image import FITTED_CAMERA, FLUSH_CAMERA, Preprocess
from jaxunshear.config.sensor import (
    FITTED_FRICTION,
    TACTIP_331,
    TACTIP_331_FITTED,
    TACTIP_331_FLUSH,
    Sensor,
)
from jaxunshear.errors import UserError
from jaxunshear.files import Json

VERSION = "3.0.0"  # of the stored sets; raise it whenever the same settings give other bits
RECORDED_VERSION = "1.0.0"
METADATA = "metadata.json"  # of a stored set: its settings, counts, frames and versions
MANIFEST = (
    "shards.json"  # of a stored set: the SHA-256 of each shard, and the checksum of its metadata
)
PAIRED_SET, POSE_SET, RECORDED_SET = "tactip_paired", "tactip_pose", "tactip_recorded"
# of `Recorded`: where it lies, and what is made of it
NOT_STORED_CONFIGS = (
    *("tap_folder", "slide_folder", "pairs", "pairing"),
    *("labelled", "unlabelled", "direct_taps"),
)
DataSettings = PairedData | PoseData | Recorded

FITTED: Json = {
    "camera": FITTED_CAMERA,
    "friction": FITTED_FRICTION,
}  # what sets of the fitted sensor share
FITTED_256: Json = FITTED | {
    "camera": replace(FITTED_CAMERA, frame_px=256),
    "preprocess": Preprocess(size=256),
}
SKIN_RANGES: Json = FITTED | {  # touches as recordings of an edge have them
    "stimuli": ("edge", "disk", "clover", "teardrop"),
    "ranges": Ranges(
        lateral_mm=6.0, yaw_deg=180.0, depth_min_mm=0.7, depth_max_mm=4.2, move_mm=5.0
    ),
}
# as deep as a dome that leans so far can touch without contact beyond its rings
TILTED_RANGES = Ranges(depth_max_mm=5.0, tilt_deg=25.0)

PAIRED = {
    each.config: each
    for each in (
        PairedData(config="tiny", poses=10),
        PairedData(config="demo", camera=FLUSH_CAMERA),
        PairedData(config="calibrated", **FITTED),
        PairedData(config="standard", poses=1200, **FITTED),
        PairedData(config="skin", poses=750, **SKIN_RANGES),
        PairedData(config="parted", poses=800, slides=4, poses_a_slide=4, **FITTED),
        PairedData(config="end_to_end", poses=3200, slides=4, poses_a_slide=4, **FITTED_256),
        PairedData(
            config="twisted",
            poses=200,
            slides=4,
            poses_a_slide=4,
            ranges=Ranges(twist_deg=5.0),
            **FITTED,
        ),
        PairedData(
            config="tilted", poses=200, slides=4, poses_a_slide=4, ranges=TILTED_RANGES, **FITTED
        ),
        PairedData(config="paper_short", poses=1200, **FITTED_256),
        PairedData(
            config="paper", poses=200, taps=50, slides=150, tap_depth_jitter_mm=1.0, **FITTED_256
        ),
        PairedData(
            config="paper_tenth",
            poses=200,
            taps=5,
            slides=15,
            tap_depth_jitter_mm=1.0,
            **FITTED_256,
        ),
    )
}
POSE = {
    each.config: each
    for each in (
        PoseData(config="tiny", poses=10),
        PoseData(config="demo", camera=FLUSH_CAMERA),
        PoseData(config="calibrated", **FITTED),
        PoseData(config="standard", poses=3000, **FITTED),
        PoseData(config="skin", poses=1000, **SKIN_RANGES),
        PoseData(config="parted", poses=1600, **FITTED),
        PoseData(config="end_to_end", poses=6400, **FITTED_256),
        PoseData(config="tilted", poses=1200, ranges=TILTED_RANGES, **FITTED),
        PoseData(config="paper_short", poses=3000, **FITTED_256),
        PoseData(config="paper", poses=10_000, **FITTED_256),
        PoseData(config="paper_tenth", poses=1000, **FITTED_256),
    )
}
CONFIGS: dict[str, dict[str, PairedData] | dict[str, PoseData]] = {
    PAIRED_SET: PAIRED,
    POSE_SET: POSE,
}


def get_config_sensor(config: str) -> Sensor:
    """The sensor of a stored configuration."""
    return {"tiny": TACTIP_331, "demo": TACTIP_331_FLUSH}.get(config, TACTIP_331_FITTED)


def get_set_name(settings: DataSettings) -> str:
    """The data set that these settings describe."""
    if isinstance(settings, Recorded):
        return RECORDED_SET
    return PAIRED_SET if isinstance(settings, PairedData) else POSE_SET


def get_version(settings: DataSettings) -> str:
    return RECORDED_VERSION if isinstance(settings, Recorded) else VERSION


def describe_set(settings: DataSettings, sensor: Sensor) -> dict:
    """Everything that decides a set's bits, as plain JSON types."""
    fields = dataclasses.asdict(settings)
    for name in (
        NOT_STORED_CONFIGS if isinstance(settings, Recorded) else ("config",)
    ):  # a name only
        del fields[name]
    full = {
        "set": get_set_name(settings),
        "version": get_version(settings),
        "sensor": dataclasses.asdict(sensor),
        "settings": fields,
    }
    return json.loads(json.dumps(full))


def convert_to_floats(thing: Any) -> Any:
    """Numbers as floats: 1 and 1.0 are the same setting."""
    if isinstance(thing, dict):
        return {name: convert_to_floats(value) for name, value in thing.items()}
    if isinstance(thing, list | tuple):
        return [convert_to_floats(value) for value in thing]
    return float(thing) if isinstance(thing, int) and not isinstance(thing, bool) else thing


def compute_fingerprint(settings: DataSettings, sensor: Sensor) -> str:
    """Eight hexadecimal digits of `describe_set`."""
    text = json.dumps(convert_to_floats(describe_set(settings, sensor)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def compute_config_name(settings: DataSettings, sensor: Sensor = TACTIP_331) -> str:
    """Name of the stored configuration: `settings.config` if nothing in it was changed, else `custom-<8 hex digits>`; of recordings
    `recorded-<8 hex digits>`."""
    if isinstance(settings, Recorded):
        return f"recorded-{compute_fingerprint(settings, sensor)}"
    known = CONFIGS[get_set_name(settings)]
    if settings.config not in known:
        raise UserError(
            f"config '{settings.config}' of {get_set_name(settings)} is unknown: use one of {', '.join(known)}"
        )
    if settings == known[settings.config] and sensor == get_config_sensor(settings.config):
        return settings.config
    return f"custom-{compute_fingerprint(settings, sensor)}"


def get_set_folder(settings: DataSettings, sensor: Sensor, data_dir: Path) -> Path:
    """Where a finished set lies, as TFDS names it: <data_dir>/<set>/<config>/<version>."""
    return (
        Path(data_dir).absolute()
        / get_set_name(settings)
        / compute_config_name(settings, sensor)
        / get_version(settings)
    )


def get_unfinished_folder(settings: DataSettings, sensor: Sensor, data_dir: Path) -> Path:
    """Where the chunks of a set lie until it is finished."""
    name = f"{get_set_name(settings)}-{compute_config_name(settings, sensor)}-{compute_fingerprint(settings, sensor)}"
    return Path(data_dir).absolute() / ".partial" / name


def list_differences(stored: dict, wanted: dict, path: str = "") -> list[str]:
    """Names of the fields in which two `describe_set` dictionaries differ, dotted."""
    names = []
    for key in sorted(stored.keys() | wanted.keys()):
        here, there = stored.get(key), wanted.get(key)
        if isinstance(here, dict) and isinstance(there, dict):
            names += list_differences(here, there, f"{path}{key}.")
        elif here != there:
            names.append(f"{path}{key}")
    return names
