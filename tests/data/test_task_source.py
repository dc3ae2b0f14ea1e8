"""Test how recordings of several tasks become examples of one network."""

import jax
import numpy as np
import pytest

from jaxunshear.config.data import PairedData, Recorded, RecordedTasks
from jaxunshear.config.experiment import Experiment
from jaxunshear.config.networks import PinUnshear
from jaxunshear.config.rules import find_experiment_problems
from jaxunshear.config.targets import make_label_targets
from jaxunshear.data.reader import Reader
from jaxunshear.data.sources import open_source
from jaxunshear.data.task_source import align_frames, join_readers, join_targets
from jaxunshear.models import pin_networks
from jaxunshear.training.tasks import join_teachers

REST = np.random.default_rng(0).uniform(10, 90, (20, 2))
RING = np.repeat([0, 1, 2, 3], 5)


def make_frame(shift=(0.0, 0.0), spread=0.0):
    """A frame that has moved, and whose contacts press the pins outwards."""
    angle = 2 * np.pi * np.arange(20) / 5
    outwards = spread * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return {"place_px": (REST + shift + outwards).tolist(), "shell": RING.tolist()}


def make_pairs(count, pose, seed):
    pins = np.random.default_rng(seed).normal(size=(count, 20, 2)).astype(np.float32)
    rows = {
        "canonical_pins": pins,
        "sheared_pins": pins + 1,
        "pose": np.full((count, 6), pose, np.float32),
        "stimulus": np.zeros(count, np.int32),
        "others": np.zeros((count, seed)),
    }
    return Reader(lambda split: rows, 96)


def test_frames_differ_by_the_shift_of_their_rims():
    shift = align_frames(make_frame(), make_frame((0.7, -0.2), spread=0.4))
    np.testing.assert_allclose(shift.shift, [0.7, -0.2], atol=1e-12)
    assert shift.left_px == pytest.approx(0.4)


def test_joined_pins_are_in_the_frame_of_the_first_task():
    frames = make_frame(), make_frame((0.7, -0.2))
    readers = [make_pairs(3, 1.0, 1), make_pairs(2, 2.0, 2)]
    shifts = [align_frames(frame, frames[0]) for frame in frames]
    rows = join_readers(readers, shifts, 96, {}).rows("train")
    assert rows["stimulus"].tolist() == [0, 0, 0, 1, 1]
    own = readers[1].rows("train")["sheared_pins"]
    np.testing.assert_allclose(rows["sheared_pins"][3:], own - [0.7, -0.2], atol=1e-6)
    assert np.isnan(rows["pose_0"][3:]).all() and np.isnan(rows["pose_1"][:3]).all()
    assert (rows["pose_0"][:3] == 1).all() and (rows["pose_1"][3:] == 2).all()
    assert "others" not in rows  # columns of a table are of one task


def test_targets_of_each_task_weigh_as_if_it_were_alone():
    poses = np.random.default_rng(0).uniform(0, 9, (30, 6))
    names = (("y_mm",), ("z_mm", "Rx_deg", "Ry_deg"))
    joined = join_targets([make_label_targets(each, poses) for each in names])
    assert [target.field for target in joined] == ["pose_0", "pose_1", "pose_1", "pose_1"]
    assert [target.weight for target in joined] == pytest.approx([4, 4 / 3, 4 / 3, 4 / 3])


def test_teachers_give_the_outputs_of_each():
    teachers = [lambda pins: pins[:, 0], lambda pins: 2 * pins[:, 1]]
    pins = jax.numpy.asarray(REST[None, :2], jax.numpy.float32)
    np.testing.assert_allclose(
        join_teachers(teachers)(pins)[0], [*REST[0], *2 * REST[1]], rtol=1e-6
    )
    assert join_teachers(teachers[:1]) is teachers[0]


def test_a_network_that_is_moved_gives_pins_of_the_other_frame():
    net = PinUnshear(hidden=8, layers=1, pose_code=3, shear_code=0)
    variables = pin_networks.init(net, REST, 1.0, jax.random.key(0))
    pins = jax.numpy.asarray(REST[None] + 1.5, jax.numpy.float32)
    shift = np.array([0.7, -0.2], np.float32)
    moved = pin_networks.move_frame(variables, shift)
    np.testing.assert_allclose(
        pin_networks.unshear(net, moved, pins - shift),
        pin_networks.unshear(net, variables, pins) - shift,
        atol=1e-4,
    )


def test_tasks_are_named_by_their_folders():
    folders = "a/edge", "b/edge", "c/surface", "d/joint"
    tasks = RecordedTasks(tuple(Recorded(folder, digest=folder) for folder in folders))
    assert tasks.names == ("edge_1", "edge_2", "surface", "joint_4")
    experiment = Experiment("lab", "", networks=("disentangled",), paired=tasks)
    parts = open_source(experiment).list_parts()
    assert [part.name for part in parts] == list(tasks.names)
    assert all(part.networks == ("posenet",) for part in parts)  # none has slides
    others = RecordedTasks(tasks.tasks[1:], tasks.names[1:])
    assert others.names == ("edge_2", "surface", "joint_4")


@pytest.mark.parametrize(
    ("digests", "remedy"),
    [(("a",), "two folders of recordings or more"), (("a", "a"), "name each recording once")],
)
def test_problems_of_tasks_are_named(digests, remedy):
    tasks = tuple(Recorded("tap", "slide", digest=digest) for digest in digests)
    experiment = Experiment("lab", "", paired=RecordedTasks(tasks))
    problems = dict(find_experiment_problems(experiment))
    assert remedy in problems["paired.tasks"]


@pytest.mark.parametrize("names", [("one",), ("one", "one"), ("one", "joint"), ("others", "one")])
def test_tasks_need_names_of_their_own(names):
    tasks = RecordedTasks((Recorded("a", "a", digest="a"), Recorded("b", "b", digest="b")), names)
    problems = dict(find_experiment_problems(Experiment("lab", "", paired=tasks)))
    assert "a name of its own" in problems["paired.names"]


def test_odd_names_and_slides_without_taps_are_refused():
    parts = Recorded("a", "a", digest="a"), Recorded("", "b", digest="b")
    tasks = RecordedTasks(parts, ("../a", "b"))
    problems = dict(find_experiment_problems(Experiment("lab", "", paired=tasks)))
    assert "names a folder" in problems["paired.names"]
    assert "record taps of each task" in problems["paired.tasks"]
    assert RecordedTasks((Recorded("x/my edge"), Recorded("x/others"))).names == (
        "my_edge",
        "others_2",
    )


def test_simulated_contacts_have_no_parts():
    assert not PairedData.has_parts and RecordedTasks.has_parts
