"""Makes the data sets of an experiment, or finds them made."""

import contextlib
import io
import shutil
from pathlib import Path

from jaxunshear.config import configs
from jaxunshear.config.data import PoseData, Recorded
from jaxunshear.config.experiment import Experiment, list_further_tests, takes_taps
from jaxunshear.config.sensor import TACTIP_331, Sensor
from jaxunshear.data.chunks import SimulationEngine
from jaxunshear.data.sampling import check_settings
from jaxunshear.errors import UserError, get_first_line
from jaxunshear.files import compute_checksum, explain_os_error, raise_machine_error, read_object


def format_remedy(folder: Path) -> str:
    return f"delete {folder} and run `jaxunshear data` again"


def make_damage_error(folder: Path, what: str) -> UserError:
    return UserError(f"the data set in {folder} is damaged ({what}): {format_remedy(folder)}")


def read_metadata(settings: configs.DataSettings, sensor: Sensor, data_dir: Path) -> dict:
    """`metadata.json` of a set: settings, sensor, counts, versions. Raises `UserError` if it is missing, or was made with
    other settings."""
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        raise UserError(f"there is no data set in {folder}: make it with `jaxunshear data`")
    try:
        metadata, sums = (
            read_object(folder / configs.METADATA),
            read_object(folder / configs.MANIFEST),
        )
    except UserError as error:
        raise_machine_error(folder, error)
        raise make_damage_error(folder, get_first_line(error)) from error
    intact = sums.get(configs.METADATA) in (None, compute_checksum(metadata)) and isinstance(
        metadata.get("counts"), dict
    )
    if not intact:
        raise make_damage_error(folder, configs.METADATA)
    wanted = configs.describe_set(settings, sensor)
    changed = configs.list_differences({key: metadata.get(key) for key in wanted}, wanted)
    if changed:
        more = f" and {len(changed) - 3} more" if len(changed) > 3 else ""
        raise UserError(
            f"the data set in {folder} was made with another {', '.join(changed[:3])}{more}: "
            "delete that folder, or use another data folder"
        )
    return metadata


def make_set(
    settings: configs.DataSettings,
    sensor: Sensor = TACTIP_331,
    data_dir: Path = Path("datasets"),
    engine: SimulationEngine | None = None,
) -> dict:
    """Makes the set that `settings` describe under `data_dir`, going on where a killed run stopped; returns its metadata.

    At once if the set is there. Raises `UserError`: settings out of range, a set made with other settings, a full disk.
    """
    if not isinstance(settings, Recorded):
        check_settings(settings)
    folder = configs.get_set_folder(settings, sensor, data_dir)
    if not folder.exists():
        try:
            _make(settings, sensor, folder.parents[2], engine)
        except OSError as error:
            raise explain_os_error(folder, error) from error
    metadata = read_metadata(settings, sensor, data_dir)
    shutil.rmtree(
        configs.get_unfinished_folder(settings, sensor, data_dir), ignore_errors=True
    )  # no longer needed
    return metadata


def _make(
    settings: configs.DataSettings, sensor: Sensor, data_dir: Path, engine: SimulationEngine | None
) -> None:
    import absl.logging
    import tensorflow_datasets as tfds

    from jaxunshear.data.builders import paired, pose, recorded, stored

    name = configs.compute_config_name(settings, sensor)
    builders = {
        configs.PAIRED_SET: paired.TactipPaired,
        configs.POSE_SET: pose.TactipPose,
        configs.RECORDED_SET: recorded.TactipRecorded,
    }
    standard = name in configs.CONFIGS.get(configs.get_set_name(settings), {})
    config = name if standard else stored.SetConfig(name=name, settings=settings, sensor=sensor)
    absl.logging.set_verbosity(
        absl.logging.ERROR
    )  # TFDS warns of each configuration that it does not know
    tfds.disable_progress_bar()
    builder = builders[configs.get_set_name(settings)](config=config, data_dir=data_dir)
    if engine is not None:
        builder.engine = engine
    with contextlib.redirect_stdout(io.StringIO()):  # TFDS announces a download
        builder.download_and_prepare()


def list_sets(experiment: Experiment) -> dict[str, configs.DataSettings]:
    """The settings of all sets that an experiment needs, by the sets' names; those of further tests by the tests'."""
    sets: dict[str, configs.DataSettings] = {
        configs.get_set_name(experiment.paired): experiment.paired
    }
    if takes_taps(experiment) and isinstance(experiment.pose, PoseData):
        sets[configs.POSE_SET] = experiment.pose
    return sets | list_further_tests(experiment)


def make_sets(
    experiment: Experiment, data_dir: Path, engine: SimulationEngine | None = None
) -> dict[str, dict]:
    """Makes those sets; their metadata by the same names."""
    return {
        name: make_set(settings, experiment.sensor, data_dir, engine)
        for name, settings in list_sets(experiment).items()
    }
