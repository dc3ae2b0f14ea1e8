"""Make stored data sets, or find them."""

import contextlib
import io
import shutil
from pathlib import Path

from jaxunshear.config import configs
from jaxunshear.config.data import DataSettings, PairedData, PoseData, Recorded
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.data.chunks import SimulationEngine
from jaxunshear.data.sampling import check_settings
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import compute_checksum, explain_os_error, raise_machine_error, read_object

MAX_CHANGES_NAMED = 3


def format_remedy(folder: Path) -> str:
    """Format what a user does about a damaged set."""
    return f"delete {folder} and run `jaxunshear data` again"


def make_damage_error(folder: Path, what: str) -> UserError:
    """Make the error that names what is damaged in a set, and the remedy."""
    return UserError(f"the data set in {folder} is damaged ({what}): {format_remedy(folder)}")


def read_metadata(settings: DataSettings, sensor: Sensor, data_dir: Path) -> dict:
    """Read `metadata.json` of a set: settings, sensor, counts, versions.

    Raises `UserError` if it is missing or damaged, or was made with other settings.
    """
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        raise UserError(f"there is no data set in {folder}: make it with `jaxunshear data`")
    try:
        metadata = read_object(folder / configs.METADATA)
        checksums = read_object(folder / configs.MANIFEST)
    except UserError as error:
        raise_machine_error(folder, error)
        raise make_damage_error(folder, get_first_line(error)) from error
    is_intact = checksums.get(configs.METADATA) in (None, compute_checksum(metadata))
    if not is_intact or not isinstance(metadata.get("counts"), dict):
        raise make_damage_error(folder, configs.METADATA)
    expected = configs.describe_set(settings, sensor)
    stored = {key: metadata.get(key) for key in expected}
    changes = configs.list_differences(stored, expected)
    if changes:
        further = len(changes) - MAX_CHANGES_NAMED
        more = f" and {further} more" if further > 0 else ""
        raise UserError(
            f"the data set in {folder} was made with another "
            f"{', '.join(changes[:MAX_CHANGES_NAMED])}{more}: "
            "delete that folder, or use another data folder"
        )
    return metadata


def make_set(
    settings: DataSettings,
    sensor: Sensor = TACTIP_331,
    data_dir: Path = Path("datasets"),
    engine: SimulationEngine | None = None,
) -> dict:
    """Make the set that `settings` describe under `data_dir` unless it is there.

    A killed run is continued. Returns the set's metadata. Raises `UserError` for settings out of
    range, a set made with other settings, or a full disk.
    """
    check_settings(settings, sensor)
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        try:
            _build(settings, sensor, folder.parents[2], engine)
        except OSError as error:
            raise explain_os_error(folder, error) from error
    metadata = read_metadata(settings, sensor, data_dir)
    unfinished = configs.get_unfinished_folder(settings, sensor, data_dir)
    shutil.rmtree(unfinished, ignore_errors=True)
    return metadata


def _build(
    settings: DataSettings, sensor: Sensor, data_dir: Path, engine: SimulationEngine | None
) -> None:
    import absl.logging
    import tensorflow_datasets as tfds

    from jaxunshear.data import builders

    kinds = {
        PairedData.set_name: builders.TactipPaired,
        PoseData.set_name: builders.TactipPose,
        Recorded.set_name: builders.TactipRecorded,
    }
    set_name, name = settings.set_name, configs.compute_config_name(settings, sensor)
    is_standard = name in configs.CONFIGS.get(set_name, {})
    config = name if is_standard else builders.SetConfig(name=name, settings=settings, sensor=sensor)
    # TFDS warns of each configuration that it does not know
    absl.logging.set_verbosity(absl.logging.ERROR)
    tfds.disable_progress_bar()
    builder = kinds[set_name](config=config, data_dir=data_dir)
    if engine is not None:
        builder.engine = engine
    with contextlib.redirect_stdout(io.StringIO()):  # TFDS announces a download
        builder.download_and_prepare()
