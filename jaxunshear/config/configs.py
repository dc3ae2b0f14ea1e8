"""The stored configurations of data sets, and the names of sets with other settings."""

import hashlib
import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import cast

from jaxunshear.config.data import DataSettings, PairedData, PoseData, Ranges
from jaxunshear.config.sensor import (
    FITTED_CAMERA,
    FITTED_FRICTION,
    FLUSH_CAMERA,
    GEL_PAD,
    PAD_CAMERA,
    TACTIP_331,
    TACTIP_331_FITTED,
    TACTIP_331_FLUSH,
    Preprocess,
    Sensor,
    describe_sensor,
)
from jaxunshear.config.types import Value
from jaxunshear.errors import UserError
from jaxunshear.files import Json

METADATA = "metadata.json"  # of a stored set: its settings, counts, frames and versions
# of a stored set: the SHA-256 of each shard, and the checksum of its metadata
MANIFEST = "shards.json"

# what sets share: the fitted sensor, that sensor at 256 px, the paper's numbers of contacts
FITTED: Json = {"camera": FITTED_CAMERA, "friction": FITTED_FRICTION}
FITTED_256: Json = FITTED | {
    "camera": replace(FITTED_CAMERA, frame_px=256),
    "preprocess": Preprocess(size=256),
}
PAPER: Json = FITTED_256 | {"poses": 200, "tap_depth_jitter_mm": 1.0}
SHARED_SLIDES: Json = {"slides": 4, "poses_a_slide": 4}
SKIN_RANGES: Json = FITTED | {  # contacts such as recordings of an edge have
    "stimuli": ("edge", "disk", "clover", "teardrop"),
    "ranges": Ranges(
        lateral_mm=6.0, yaw_deg=180.0, depth_min_mm=0.7, depth_max_mm=4.2, move_mm=5.0
    ),
}
# the greatest depth at which a dome that leans so far touches within its contact rings
TILTED: Json = FITTED | {"ranges": Ranges(depth_max_mm=5.0, tilt_deg=25.0)}
TWISTED: Json = FITTED | {"ranges": Ranges(twist_deg=5.0)}
ON_PAD: Json = {
    "stimuli": ("edge", "disk", "clover", "teardrop"),
    "camera": PAD_CAMERA,
    "ranges": Ranges(yaw_deg=180.0, depth_min_mm=0.4, depth_max_mm=1.2, move_mm=1.5),
}

PAIRED = {
    each.config: each
    for each in (
        PairedData(config="tiny", poses=10),
        PairedData(config="demo", camera=FLUSH_CAMERA),
        PairedData(config="calibrated", **FITTED),
        PairedData(config="standard", poses=1200, **FITTED),
        PairedData(config="skin", poses=750, **SKIN_RANGES),
        PairedData(config="pad", poses=750, **ON_PAD),
        PairedData(config="parted", poses=800, **SHARED_SLIDES, **FITTED),
        PairedData(config="end_to_end", poses=3200, **SHARED_SLIDES, **FITTED_256),
        PairedData(config="twisted", poses=200, **SHARED_SLIDES, **TWISTED),
        PairedData(config="tilted", poses=200, **SHARED_SLIDES, **TILTED),
        PairedData(config="paper_short", poses=1200, **FITTED_256),
        PairedData(config="paper", taps=50, slides=150, **PAPER),
        PairedData(config="paper_tenth", taps=5, slides=15, **PAPER),
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
        PoseData(config="pad", poses=1000, **ON_PAD),
        PoseData(config="parted", poses=1600, **FITTED),
        PoseData(config="end_to_end", poses=6400, **FITTED_256),
        PoseData(config="tilted", poses=1200, **TILTED),
        PoseData(config="paper_short", poses=3000, **FITTED_256),
        PoseData(config="paper", poses=10_000, **FITTED_256),
        PoseData(config="paper_tenth", poses=1000, **FITTED_256),
    )
}
CONFIGS: dict[str, dict[str, PairedData] | dict[str, PoseData]] = {
    PairedData.set_name: PAIRED,
    PoseData.set_name: POSE,
}


def get_config_sensor(config: str) -> Sensor:
    others = {"tiny": TACTIP_331, "demo": TACTIP_331_FLUSH, "pad": GEL_PAD}
    return others.get(config, TACTIP_331_FITTED)


def describe_set(settings: DataSettings, sensor: Sensor) -> dict:
    """Describe in plain JSON types everything that decides a set's bits."""
    stored = asdict(cast(Value, settings))
    for name in settings.not_stored:
        del stored[name]
    head = {"set": settings.set_name, "version": settings.version}
    description = head | {"sensor": describe_sensor(sensor), "settings": stored}
    return json.loads(json.dumps(description))


def compute_digest(settings: object) -> str:
    """Compute eight hexadecimal digits of nested settings; 1 and 1.0 are the same setting."""
    floats = json.loads(json.dumps(settings), parse_int=float)
    return hashlib.sha256(json.dumps(floats, sort_keys=True).encode()).hexdigest()[:8]


def compute_fingerprint(settings: DataSettings, sensor: Sensor) -> str:
    return compute_digest(describe_set(settings, sensor))


def compute_config_name(settings: DataSettings, sensor: Sensor = TACTIP_331) -> str:
    """Return the name under which a set is stored, that of its unchanged configuration if it can.

    Else it is `custom-<fingerprint>`; for recordings `recorded-<fingerprint>`. Raises UserError for
    an unknown configuration.
    """
    configs = CONFIGS.get(settings.set_name)
    if configs is None:
        return f"recorded-{compute_fingerprint(settings, sensor)}"
    config = getattr(settings, "config", "")
    if config not in configs:
        raise UserError(
            f"config '{config}' of {settings.set_name} is unknown: use one of {', '.join(configs)}"
        )
    if settings == configs[config] and sensor == get_config_sensor(config):
        return config
    return f"custom-{compute_fingerprint(settings, sensor)}"


def get_set_folder(settings: DataSettings, sensor: Sensor, data_dir: Path) -> Path:
    """Return a finished set's folder as TFDS names it: <data_dir>/<set>/<config>/<version>."""
    name = compute_config_name(settings, sensor)
    return Path(data_dir).absolute() / settings.set_name / name / settings.version


def get_unfinished_folder(settings: DataSettings, sensor: Sensor, data_dir: Path) -> Path:
    """Return the folder of a set's chunks until it is finished."""
    config = compute_config_name(settings, sensor)
    name = f"{settings.set_name}-{config}-{compute_fingerprint(settings, sensor)}"
    return Path(data_dir).absolute() / ".partial" / name


def list_differences(one: dict, other: dict, path: str = "") -> list[str]:
    """List the dotted names of the fields in which two nested dictionaries differ."""
    names = []
    for key in sorted(one.keys() | other.keys()):
        here, there = one.get(key), other.get(key)
        if isinstance(here, dict) and isinstance(there, dict):
            names += list_differences(here, there, f"{path}{key}.")
        elif here != there:
            names.append(f"{path}{key}")
    return names
