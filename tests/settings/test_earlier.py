"""What earlier versions stored is read, compared and named as if the settings that came later stood in it."""

import dataclasses
from pathlib import Path

import pytest

from jaxunshear.errors import UserError
from jaxunshear.run import run_stages
from jaxunshear.settings.configs import describe
from jaxunshear.settings.data import Recorded, RecordedTaps
from jaxunshear.settings.earlier import GONE, LATER, is_later, without_later
from jaxunshear.settings.experiment import Experiment
from jaxunshear.settings.fields import replaced
from jaxunshear.settings.networks import PinUnshear
from jaxunshear.settings.stored import from_json, to_json
from jaxunshear.storage import read_json, write_json
from jaxunshear.training.checkpoint import read_net, write_settings

ROOT = Path(__file__).resolve().parents[2]
NOW = Experiment(name="now", claim="none")
NO_FOLDERS = "paired.slide_folder is missing, paired.tap_folder is missing"
REFUSED = {  # results of earlier versions
    "demo": "train.kernels is missing",
    "few_pairs": "pins.shear_noise = 0.1 is no setting",
    "recorded_edge_joint": NO_FOLDERS,
    "recorded_images": f"{NO_FOLDERS}, paired.unlabelled is missing",
    "recorded_joint": NO_FOLDERS,
}
RECORDED = dataclasses.replace(NOW, paired=Recorded(), pose=RecordedTaps())


def groups(kind):
    """The dataclasses that an experiment is made of."""
    found = [dataclasses.fields(kind)]
    for value in vars(kind).values():
        found += groups(value) if dataclasses.is_dataclass(value) else []
    return found


def test_what_came_later_does_nothing_at_its_default():
    fields = [field for now in (NOW, RECORDED) for group in groups(now) for field in group if field.name in LATER]
    assert {field.name for field in fields} == set(LATER)
    assert all(field.default == LATER[field.name] for field in fields)


def test_an_earlier_file_is_todays_experiment():
    earlier = without_later(to_json(NOW))
    assert not {"other_tilts_deg"} & earlier.keys() and not set(LATER) & earlier["pins"].keys()
    assert from_json(earlier) == NOW
    changed = replaced(NOW, "train_pins.paired_share", 0.1)
    assert without_later(to_json(changed))["train_pins"]["paired_share"] == 0.1
    assert "twist_deg" not in describe(NOW.paired, NOW.sensor)["settings"]["ranges"]


@pytest.mark.parametrize(("group", "name"), [("pins", "shear_noise"), ("train", "label_weight")])
def test_a_setting_that_went_may_stand_in_a_file_where_it_does_nothing(tmp_path, group, name):
    assert not GONE.keys() & {field.name for group in groups(NOW) for field in group}
    earlier = to_json(NOW)
    earlier[group][name] = 0.0
    assert from_json(earlier) == NOW and without_later(earlier) == without_later(to_json(NOW))
    write_json(tmp_path / "model.json", {group: earlier[group]})
    write_settings(tmp_path, {group: to_json(NOW)[group]})
    earlier[group][name] = 0.1
    with pytest.raises(UserError, match=rf"{group}\.{name} = 0\.1 is no setting; run"):
        from_json(earlier)
    write_json(tmp_path / "model.json", {group: earlier[group]})
    with pytest.raises(UserError, match=rf"{group}\.{name} = 0\.1, now None"):
        write_settings(tmp_path, {group: to_json(NOW)[group]})


@pytest.mark.parametrize("name", ["epochs", "claim"])
def test_what_was_always_there_may_not_lack(name):
    earlier = without_later(to_json(NOW))
    (earlier if name in earlier else earlier["train"]).pop(name)
    with pytest.raises(UserError, match=rf"does not fit this version: (train\.)?{name} is missing; run"):
        from_json(earlier)


def test_settings_of_another_kind_are_compared_with_the_nearest_one():
    recorded = to_json(dataclasses.replace(NOW, paired=Recorded(), pose=RecordedTaps()))
    del recorded["paired"]["tap_folder"]
    with pytest.raises(UserError, match=r"version: paired\.tap_folder is missing; run"):
        from_json(recorded)
    with pytest.raises(UserError, match=r"version: paired is no group; run"):
        from_json(to_json(NOW) | {"paired": 3})


@pytest.mark.parametrize("path", sorted((ROOT / "docs" / "results").glob("*.json")), ids=lambda path: path.stem)
def test_published_settings_are_read_or_refused_for_what_differs(path):
    held = read_json(path)
    settings = held.get("base") or held.get("settings")
    if not settings:
        return
    if path.stem in REFUSED:
        with pytest.raises(UserError) as refusal:
            from_json(settings, path.name)
        assert str(refusal.value) == f"{path.name} does not fit this version: {REFUSED[path.stem]}; run it again"
    else:
        assert from_json(settings, path.name).claim


def test_an_earlier_run_goes_on(tmp_path):
    folder = tmp_path / NOW.name
    write_json(folder / "experiment.json", without_later(to_json(NOW)))
    (folder / "disentangled").mkdir()
    run_stages(NOW, (), tmp_path, tmp_path, "none")
    assert from_json(read_json(folder / "experiment.json")) == NOW
    with pytest.raises(UserError, match=r"another train_pins\.tap_weight"):
        run_stages(replaced(NOW, "train_pins.tap_weight", 0.5), (), tmp_path, tmp_path, "none")


def test_an_earlier_training_is_the_same_training(tmp_path):
    net = PinUnshear()
    settings = {"kind": "pin_unshear", "net": vars(net), "training": dataclasses.asdict(NOW.train_pins)}
    write_json(tmp_path / "model.json", without_later(settings))
    write_settings(tmp_path, settings)
    assert read_net(tmp_path) == net
    other = {**settings, "net": {**settings["net"], "apart": True}}
    with pytest.raises(UserError, match=r"net\.apart = None, now True"):
        write_settings(tmp_path, other)


def test_lists_of_json_are_tuples():
    assert is_later("other_tilts_deg", []) and not is_later("other_tilts_deg", [5.0])


def test_a_group_without_settings_is_itself():
    assert from_json(to_json(RECORDED)) == RECORDED


def test_an_earlier_recorded_run_was_split_at_random():
    earlier = without_later(to_json(RECORDED))
    assert "split" not in earlier["paired"] and from_json(earlier).paired.split == "random"
    block = to_json(replaced(RECORDED, "paired.split", "block"))
    assert without_later(block)["paired"]["split"] == "block"
