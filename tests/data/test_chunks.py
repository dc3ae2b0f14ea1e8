import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from jaxunshear.config.configs import PAIRED
from jaxunshear.config.data import PoseData
from jaxunshear.config.sensor import TACTIP_331, Nuisance
from jaxunshear.config.splits import SPLITS
from jaxunshear.data import simulation
from jaxunshear.data.chunks import (
    iterate_paired_examples,
    iterate_pose_examples,
    load_chunk,
    pack_bits,
    summarise_set,
    unpack_bits,
)
from jaxunshear.data.sampling import sample_contacts
from jaxunshear.data.simulation import simulate_chunks
from jaxunshear.data.stored_sets import make_set, open_set
from jaxunshear.errors import UserError


def make(settings, sensor, folder, engine):
    shots = sample_contacts(settings)
    return shots, simulate_chunks(settings, sensor, shots, folder, engine)


def breaking(engine, helped: bool):
    """Return an engine whose first try fails at the x in the list.

    The second try fails, too, unless it `helped`.
    """

    def simulate(sensor, names, scenes):
        contacts = engine.simulate(sensor, names, scenes)
        bad = np.isin(scenes.pose[:, 0], marked)
        contacts.retried[bad] = True
        if not helped:
            contacts.pins[bad] = np.nan
            contacts.converged[bad & (scenes.pose[:, 1] > 0)] = False
        return contacts

    marked: list[float] = []
    return engine._replace(simulate=simulate), marked


def test_images_survive_packing():
    images = np.random.default_rng(0).integers(0, 2, (3, 13, 13), np.uint8) * np.uint8(255)
    np.testing.assert_array_equal(unpack_bits(pack_bits(images), 13), images)


def test_chunks_do_not_change_an_example(paired, sensor, engine, tmp_path):
    def all_of(name, batches):
        shots, paths = make(paired, sensor, tmp_path / name, engine._replace(plan=batches))
        return dict(sorted(iterate_paired_examples(paired, shots, paths, "train")))

    large = all_of("large", engine.plan)
    small = all_of("small", lambda _, __, s: np.array_split(np.arange(len(s))[::-1], 9))
    assert large.keys() == small.keys()
    for key, example in large.items():
        for field in ("canonical", "sheared", "canonical_pins", "sheared_pins", "pose"):
            np.testing.assert_array_equal(example[field], small[key][field])


def test_only_missing_chunks_are_made_again(paired, sensor, engine, tmp_path):
    calls = []

    def counted(sensor, names, scenes):
        calls.append(len(scenes))
        return engine.simulate(sensor, names, scenes)

    _, paths = make(paired, sensor, tmp_path, engine)
    before = {path: path.read_bytes() for path in paths}
    paths[2].unlink()
    make(paired, sensor, tmp_path, engine._replace(simulate=counted))
    assert len(calls) == 1
    assert {path: path.read_bytes() for path in paths} == before


def test_chunks_of_another_plan_are_made_again(paired, sensor, engine, tmp_path):
    make(paired, sensor, tmp_path, engine)
    halves = engine._replace(plan=lambda *_: [np.arange(50), np.arange(50, 100)])
    shots, paths = make(paired, sensor, tmp_path, halves)
    numbers = np.concatenate([load_chunk(path)["number"] for path in paths])
    assert sorted(numbers) == list(range(len(shots.scenes)))


def test_a_damaged_chunk_is_named(paired, sensor, engine, tmp_path):
    _, paths = make(paired, sensor, tmp_path, engine)
    paths[1].write_bytes(paths[1].read_bytes()[:500])
    with pytest.raises(UserError, match=r"00001\.npz.*delete it"):
        make(paired, sensor, tmp_path, engine)


def test_contacts_that_were_tried_again_are_reported_and_used(paired, sensor, engine, tmp_path):
    engine, marked = breaking(engine, helped=True)
    scenes = sample_contacts(paired).scenes
    marked += scenes.pose[[0, 60], 0].tolist()  # two complete poses
    shots, paths = make(paired, sensor, tmp_path, engine)
    counts = summarise_set(paired, shots, paths)
    assert (counts["retried"], counts["dropped"]) == (10, 0)
    spent = np.concatenate([load_chunk(path)["iterations"] for path in paths])
    slowest = np.concatenate([load_chunk(path)["number"] for path in paths])[spent == spent.max()]
    assert counts["iterations"]["most"] == spent.max()
    assert counts["iterations"]["median"] == np.median(spent)
    assert counts["iterations"]["slowest_number"] in slowest
    assert sum(counts["written"].values()) == shots.is_slide.sum()


def test_contacts_that_fail_twice_are_dropped_and_reported(paired, sensor, engine, tmp_path):
    engine, marked = breaking(engine, helped=False)
    marked += sample_contacts(paired).scenes.pose[[0], 0].tolist()
    shots, paths = make(paired, sensor, tmp_path, engine)
    counts = summarise_set(paired, shots, paths)
    assert (counts["retried"], counts["dropped"], counts["slides_without_tap"]) == (5, 5, 0)
    assert [scene["number"] for scene in counts["dropped_scenes"]] == [0, 1, 2, 3, 4]
    assert counts["dropped_scenes"][2]["move"] == shots.scenes.move[2].tolist()
    for index, split in enumerate(SPLITS):
        written = [key for key, _ in iterate_paired_examples(paired, shots, paths, split)]
        assert len(written) == counts["written"][split]
        assert not any(key.startswith("disk_0_") for key in written)
        assert index in shots.split


def test_slides_whose_taps_are_lost(paired, sensor, engine, tmp_path):
    shots = sample_contacts(paired)

    def blind(settings, sensor, tips, number, age):
        images, pins = engine.render(settings, sensor, tips, number, age)
        images[np.isin(number, [0, 5, 6])] = 0  # a tap of pose 0, both taps of pose 1
        return images, pins

    paths = simulate_chunks(paired, sensor, shots, tmp_path, engine._replace(render=blind))
    counts = summarise_set(paired, shots, paths)
    assert (counts["dropped"], counts["slides_without_tap"]) == (3, 3)
    examples = dict(
        pair for split in SPLITS for pair in iterate_paired_examples(paired, shots, paths, split)
    )
    assert len(examples) == sum(counts["written"].values()) == shots.is_slide.sum() - 3
    assert {examples[f"disk_0_{slide}"]["tap_id"] for slide in range(3)} == {1}
    assert "disk_1_0" not in examples


def test_pose_examples_cover_all_taps_once(pose, sensor, engine, tmp_path):
    shots, paths = make(pose, sensor, tmp_path, engine)
    keys = [key for split in SPLITS for key, _ in iterate_pose_examples(pose, shots, paths, split)]
    assert len(set(keys)) == len(keys) == len(shots.scenes)


def test_rendered_images_depend_on_the_number_alone_and_show_their_pins():
    nuisance = Nuisance(drift_px=4.0, specks=0, housing_ring=False)
    settings = PoseData(config="tiny", nuisance=nuisance)
    from jaxunshear.simulator.pin_layout import compute_pin_tips

    tips = np.repeat(compute_pin_tips(TACTIP_331)[None], 18, axis=0).astype(np.float32)
    number, age = np.arange(18), np.linspace(0, 1, 18)
    images, pins = simulation.render_images(settings, TACTIP_331, tips, number, age)
    again, _ = simulation.render_images(settings, TACTIP_331, tips[17:], number[17:], age[17:])
    np.testing.assert_array_equal(again[0], images[17])
    other, _ = simulation.render_images(settings, TACTIP_331, tips[:1], number[:1] + 1, age[:1])
    assert np.any(other[0] != images[0])
    for row in (0, 17):  # drift is in the pins too
        col, line = np.rint(pins[row]).astype(int).T
        assert (images[row][line, col] > 0).mean() > 0.98
    # 4 frame px at half size
    assert np.linalg.norm(pins[17] - pins[0], axis=-1).min() == pytest.approx(2.0, abs=0.1)


def test_the_real_simulator_makes_a_few_pairs(tmp_path):
    settings = dataclasses.replace(PAIRED["tiny"], stimuli=("disk",), poses=5, slides=1)
    shots, paths = make(settings, TACTIP_331, tmp_path, simulation.make_engine())
    counts = summarise_set(settings, shots, paths)
    assert counts["dropped"] == 0
    (_, example), *_ = iterate_paired_examples(settings, shots, paths, "train")
    canonical, sheared = (
        np.asarray(Image.open(io.BytesIO(example[name]))) for name in ("canonical", "sheared")
    )
    assert canonical.shape == sheared.shape == (128, 128)
    assert 0.1 < (canonical > 0).mean() < 0.4
    assert (canonical != sheared).mean() > 0.01
    shear = np.linalg.norm(example["sheared_pins"] - example["canonical_pins"], axis=-1)
    assert 1 < shear.max() < 20


def test_a_stored_set_gives_twist_and_tilt_where_they_vary(paired, sensor, engine, tmp_path):
    ranges = dataclasses.replace(paired.ranges, twist_deg=5.0, tilt_deg=9.0)
    for settings, widths in (
        (paired, (4, 2)),
        (dataclasses.replace(paired, taps=1, ranges=ranges), (6, 3)),
    ):
        make_set(settings, sensor, tmp_path, engine)
        rows = open_set(settings, tmp_path, sensor).rows("test")
        assert (rows["pose"].shape[1], rows["move"].shape[1]) == widths
    shots = sample_contacts(settings)
    tested = shots.is_slide & (shots.split == SPLITS.index("test"))
    slides = shots.scenes.take(np.flatnonzero(tested))
    for name, drawn in (("pose", slides.pose), ("move", slides.move)):
        np.testing.assert_allclose(np.sort(rows[name][:, -1]), np.sort(drawn[:, -1]), rtol=1e-6)
