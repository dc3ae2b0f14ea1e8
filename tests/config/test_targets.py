"""Pose targets: how they are written, and scaled to outputs of a network and back."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxunshear.config.data import Ranges
from jaxunshear.config.targets import (
    CIRCLE,
    RANGE,
    RECORDED_FIELDS,
    SIMULATED_FIELDS,
    Target,
    count_outputs,
    from_json,
    get_unit,
    list_label_fields,
    list_target_names,
    make_label_targets,
    make_move_targets,
    make_range_targets,
    make_slide_targets,
    parse_target,
    read_true_values,
    to_json,
)
from jaxunshear.errors import UserError
from jaxunshear.metrics import compute_pose_errors
from jaxunshear.models import posenet
from jaxunshear.report.wording import name_quantity
from jaxunshear.training.tasks import compute_pose_error_terms

USUAL = make_range_targets((), Ranges())
SEVERAL = ("depth_mm", "y_mm", "yaw_deg:range:2", "edge_deg:circle:0.5", "edge_mm")


def recorded(count=60):
    """Make poses (N, 6) with constant z_mm and Ry_deg, and Rz_deg over the full circle."""
    poses = np.random.default_rng(0).uniform(-1, 1, (count, 6)) * [3, 4, 0, 10, 0, 180]
    poses += [10, 0, 2, 5, 1, 0]
    poses[:2, 5] = -179, 179
    return poses


def simulated(count=50):
    """Labels of a simulated set, all within the default ranges."""
    rng = np.random.default_rng(0)
    pose = rng.uniform(-1, 1, (count, 4)) * [5, 5, 45, 2.5] + [0, 0, 0, 3.5]
    edge = rng.uniform(-1, 1, (count, 2)) * [7, 179]
    return {"pose": jnp.asarray(pose, jnp.float32), "edge": jnp.asarray(edge, jnp.float32)}


def test_a_target_is_a_name_with_or_without_its_kind_and_weight():
    assert parse_target("x_mm", SIMULATED_FIELDS) == ("x_mm", None, 1.0)
    assert parse_target("edge_deg:circle", SIMULATED_FIELDS) == ("edge_deg", CIRCLE, 1.0)
    assert parse_target("edge_mm:range:4", SIMULATED_FIELDS) == ("edge_mm", RANGE, 4.0)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("z_mm", "target 'z_mm' is unknown: use x_mm, y_mm, yaw_deg, depth_mm, edge_mm, edge_deg"),
        ("", "target '' is unknown"),
        ("x_mm:circle", "'x_mm:circle': only an angle goes round a circle; write x_mm:range"),
        ("yaw_deg:round", "'yaw_deg:round' is not understood: write yaw_deg, yaw_deg:range"),
        ("yaw_deg:", "is not understood"),
        ("yaw_deg:4", "is not understood"),
        ("yaw_deg:range:4:4", "is not understood"),
        *(
            (f"x_mm:range:{weight}", "weight in the loss is a number above 0")
            for weight in ("0", "-1", "nan", "inf", "much", "")
        ),
    ],
)
def test_what_is_no_target_is_refused(text, line):
    with pytest.raises(UserError, match=line):
        parse_target(text, SIMULATED_FIELDS)
    with pytest.raises(UserError, match=line):
        make_range_targets((text,), Ranges())


def test_a_simulated_set_has_the_papers_two_and_the_edge():
    assert list_target_names(USUAL) == ("x_mm", "yaw_deg", "edge_mm", "edge_deg")
    assert [target.weight for target in USUAL] == [1, 1, 4, 1]
    assert [target.is_circular for target in USUAL] == [False, False, False, True]
    assert [target.half_range for target in USUAL[:3]] == [5, 45, pytest.approx(5 * 2**0.5)]
    assert count_outputs(USUAL) == 5
    assert posenet.list_output_weights(USUAL) == (1, 1, 4, 1, 1)
    assert list_label_fields(USUAL) == ("pose", "edge")
    assert list_label_fields(USUAL[:2]) == ("pose",)


@pytest.mark.parametrize(
    ("ranges", "names"),
    [
        (Ranges(lateral_mm=0), ("yaw_deg", "edge_deg")),
        (Ranges(yaw_deg=0), ("x_mm", "edge_mm", "edge_deg")),
        (Ranges(lateral_mm=0, yaw_deg=0), ()),
    ],
)
def test_what_does_not_vary_is_no_target(ranges, names):
    assert list_target_names(make_range_targets((), ranges)) == names


@pytest.mark.parametrize(
    ("text", "ranges"),
    [
        ("x_mm", Ranges(lateral_mm=0)),
        ("yaw_deg", Ranges(yaw_deg=0)),
        ("edge_deg:circle", Ranges(lateral_mm=0, yaw_deg=0)),
        ("depth_mm", Ranges(depth_min_mm=2, depth_max_mm=2)),
    ],
)
def test_naming_what_does_not_vary_is_refused(text, ranges):
    with pytest.raises(UserError, match=f"target '{text.split(':')[0]}' does not vary"):
        make_range_targets((text,), ranges)


def test_named_targets_come_in_their_order_and_take_middle_and_reach_of_their_range():
    depth, y, yaw, angle, _ = make_range_targets(
        SEVERAL, Ranges(lateral_mm=3, yaw_deg=90, depth_min_mm=1, depth_max_mm=5)
    )
    assert depth == Target("depth_mm", "pose", 3, 3.0, 2.0)
    assert y == Target("y_mm", "pose", 1, 0.0, 3.0)
    assert yaw == Target("yaw_deg", "pose", 2, 0.0, 90.0, weight=2.0)
    assert angle == Target("edge_deg", "edge", 1, is_circular=True, weight=0.5)


@pytest.mark.parametrize(
    ("half", "text", "circle"),
    [
        (150, "yaw_deg", False),
        (151, "yaw_deg", True),
        (151, "yaw_deg:range", False),
        (20, "yaw_deg:circle", True),
    ],
)
def test_an_angle_is_a_circle_where_it_is_asked_for_or_goes_round(half, text, circle):
    (target,) = make_range_targets((text,), Ranges(yaw_deg=half))
    assert target.is_circular == circle
    assert target.outputs == (2 if circle else 1)


def test_recorded_labels_that_vary_are_targets():
    targets = make_label_targets((), recorded())
    assert list_target_names(targets) == ("x_mm", "y_mm", "Rx_deg", "Rz_deg")
    assert [target.is_circular for target in targets] == [False, False, False, True]
    assert [target.column for target in targets] == [0, 1, 3, 5]
    assert list_label_fields(targets) == ("pose",)


def test_recorded_labels_fill_the_outputs_from_end_to_end():
    poses = recorded()
    targets = make_label_targets(("x_mm", "y_mm", "Rx_deg"), poses)
    wanted = np.asarray(posenet.scale_poses({"pose": poses}, targets))
    np.testing.assert_allclose(wanted.min(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(wanted.max(axis=0), 1, atol=1e-6)
    turned = make_label_targets(("Rz_deg:range",), poses)
    wanted = np.asarray(posenet.scale_poses({"pose": poses}, turned))[:2, 0]
    np.testing.assert_allclose(wanted, [0, 1], atol=1e-2)


def test_what_slides_vary_is_felt_by_the_sensor_or_labelled():
    assert list_target_names(make_slide_targets(Ranges())) == ("slide_x_mm", "slide_y_mm")
    x, _, twist = make_slide_targets(Ranges(move_mm=2, twist_deg=20))
    assert (x.field, x.column, x.centre, x.half_range, x.is_circular) == ("felt", 0, 0, 2, False)
    assert (twist.name, twist.column, twist.half_range) == ("slide_twist_deg", 2, 20)
    assert make_slide_targets(Ranges(move_mm=0)) == ()
    moves = np.zeros((4, 6))
    moves[:3, 0], moves[:3, 5], moves[3] = [-5, 0, 3], [0, 1, 2], np.nan
    along, turn = make_move_targets(moves)
    assert along == Target("slide_x_mm", "move", 0, -1, 4)
    assert turn == Target("slide_Rz_deg", "move", 5, 1, 1)
    assert make_move_targets(moves[3:]) == make_move_targets(moves[:0]) == ()


def test_rows_with_an_unknown_label_give_nothing_of_ranges():
    poses = recorded()
    unknown = poses.copy()
    unknown[:, 0] = 1e3
    unknown[:, 4] = np.nan
    assert make_label_targets((), np.concatenate([poses, unknown])) == make_label_targets((), poses)
    assert make_label_targets((), unknown) == make_label_targets((), poses[:0]) == ()


@pytest.mark.parametrize("text", ["z_mm", "Ry_deg:circle"])
def test_naming_a_label_that_stays_where_it_is_is_refused(text):
    with pytest.raises(UserError, match="does not vary in this data set: leave it out"):
        make_label_targets((text,), recorded())


def test_the_slide_of_a_recording_is_a_target_where_it_is_named():
    poses, moves = recorded(), np.zeros((len(recorded()), 6))
    moves[:, 0], moves[0, 5] = np.linspace(-3, 5, len(moves)), 4
    targets = make_label_targets(("y_mm", "slide_x_mm", "slide_Rz_deg:range:2"), poses, moves)
    assert targets[1:] == (
        Target("slide_x_mm", "move", 0, 1.0, 4.0),
        Target("slide_Rz_deg", "move", 5, 2.0, 2.0, weight=2.0),
    )
    assert list_label_fields(targets) == ("pose", "move")
    wanted = np.asarray(posenet.scale_poses({"pose": poses, "move": moves}, targets))
    np.testing.assert_allclose(wanted[:, 1], np.linspace(0, 1, len(moves)), atol=1e-6)
    assert make_label_targets((), poses, moves) == make_label_targets((), poses)
    with pytest.raises(UserError, match="slide_y_mm' does not vary"):
        make_label_targets(("slide_y_mm",), poses, moves)


def test_recorded_and_simulated_sets_have_names_of_their_own():
    with pytest.raises(UserError, match="'edge_mm' is unknown: use x_mm, y_mm, z_mm, Rx_deg"):
        make_label_targets(("edge_mm",), recorded())
    assert set(RECORDED_FIELDS) & set(SIMULATED_FIELDS) == {"x_mm", "y_mm"}


@pytest.mark.parametrize("jit", [True, False])
@pytest.mark.parametrize("count", [1, 3, 5])
def test_labels_come_back_from_their_outputs(count, jit):
    targets, batch = make_range_targets(SEVERAL[:count], Ranges()), simulated()

    def there_and_back(batch):
        outputs = posenet.scale_poses(batch, targets)
        return outputs, posenet.unscale_outputs(outputs, targets)

    outputs, back = (jax.jit(there_and_back) if jit else there_and_back)(batch)
    assert outputs.shape == (50, count_outputs(targets))
    assert len(posenet.list_output_weights(targets)) == count_outputs(targets)
    assert 0 <= float(outputs.min()) < float(outputs.max()) <= 1
    true = read_true_values(targets, batch)
    assert tuple(true) == list_target_names(targets) and set(back) == set(true)
    for name, values in true.items():
        np.testing.assert_allclose(back[name], values, atol=1e-3 if name.endswith("_deg") else 1e-5)


def test_simulated_outputs_are_the_very_numbers_they_were():
    """Compare with labels over their limit, or cosine and sine, moved from [-1, 1] to [0, 1]."""
    batch, ranges = simulated(), Ranges()
    pose, edge, angle = batch["pose"], batch["edge"], jnp.deg2rad(batch["edge"][:, 1])
    lateral, yaw, distance = ranges.lateral_mm, ranges.yaw_deg, 2**0.5 * ranges.lateral_mm
    lengths = (pose[:, 0] / lateral, pose[:, 2] / yaw, edge[:, 0] / distance)
    former = (jnp.stack((*lengths, jnp.cos(angle), jnp.sin(angle)), -1) + 1) / 2
    np.testing.assert_array_equal(posenet.scale_poses(batch, USUAL), former)
    back, signed = posenet.unscale_outputs(former, USUAL), 2 * former - 1
    scales = {"x_mm": lateral, "yaw_deg": yaw, "edge_mm": distance}
    for i, (name, scale) in enumerate(scales.items()):
        np.testing.assert_array_equal(back[name], scale * signed[:, i])
    turned = jnp.rad2deg(jnp.arctan2(signed[:, 4], signed[:, 3]))
    np.testing.assert_array_equal(back["edge_deg"], turned)


@pytest.mark.parametrize("kind", [CIRCLE, RANGE])
@pytest.mark.parametrize(
    ("label", "answer", "error"), [(179, -179, 2), (-180, 180, 0), (-10, 10, 20), (90, -90, 180)]
)
def test_errors_of_angles_go_the_short_way_round(kind, label, answer, error):
    """In training and in evaluation, and whether the angle is one output or two."""
    labels, answers = np.zeros((2, 6), np.float32), np.zeros((2, 6), np.float32)
    labels[:, 5], answers[:, 5] = (label, 10), (answer, 10)
    targets = make_label_targets((f"Rz_deg:{kind}",), np.outer([-180.0, 180.0], np.eye(6)[5]))
    outputs, batch = posenet.scale_poses({"pose": answers}, targets), {"pose": labels}
    terms = compute_pose_error_terms(outputs, batch, targets)
    np.testing.assert_allclose(terms["Rz_deg"], [error, 0], atol=1e-3)
    read = jax.tree.map(np.asarray, posenet.unscale_outputs(outputs, targets))
    errors = compute_pose_errors(read, read_true_values(targets, batch))
    np.testing.assert_allclose(errors["Rz_deg"], [error, 0], atol=1e-3)


def test_only_mm_and_deg_are_units_in_names():
    names = ("edge_mm", "tilt_x_deg", "force_x", "Fx")
    assert [get_unit(name) for name in names] == ["mm", "deg", "1", "1"]
    assert [name_quantity(name) for name in names[2:]] == ["force x", "Fx"]


def test_errors_of_lengths_do_not_wrap():
    (target,) = targets = make_label_targets(("x_mm",), np.outer([-200.0, 200.0], np.eye(6)[0]))
    assert (target.centre, target.half_range) == (0, 200)
    outputs = posenet.scale_poses({"pose": np.full((1, 6), -190, np.float32)}, targets)
    batch = {"pose": np.full((1, 6), 190, np.float32)}
    assert float(compute_pose_error_terms(outputs, batch, targets)["x_mm"][0]) == 380


@pytest.mark.parametrize(
    "targets",
    [USUAL, make_range_targets(SEVERAL, Ranges()), make_label_targets((), recorded()), ()],
)
def test_targets_come_back_from_json(targets):
    assert from_json(json.loads(json.dumps(to_json(targets))), "model.json") == targets


@pytest.mark.parametrize("stored", [[{"name": "x_mm"}], [{"title": "x_mm"}], ["x_mm"], 5, None])
def test_json_of_another_form_is_refused(stored):
    with pytest.raises(UserError, match=r"posenet/model\.json states no pose targets"):
        from_json(stored, "posenet/model.json")


def test_classes_have_an_output_each_and_errors_of_0_or_1():
    poses, others = np.zeros((6, 6)), {"object_class": np.array([0, 1, 2, 2, np.nan, 1])}
    (target,) = targets = make_label_targets(("object_class",), poses, others=others)
    assert (target.classes, count_outputs(targets)) == (3, 3)
    labels = {"others": np.array([[0], [2], [np.nan]], np.float32)}
    outputs = posenet.scale_poses(labels, targets)
    np.testing.assert_array_equal(outputs[:2], [[1, 0, 0], [0, 0, 1]])
    assert np.isnan(outputs[2]).all()
    likely = jnp.array([[0.5, 0.4, 0.1], [0.4, 0.5, 0.1], [0.1, 0.2, 0.3]])
    read = jax.tree.map(np.asarray, posenet.unscale_outputs(likely, targets))
    np.testing.assert_array_equal(read["object_class"], [0, 1, 2])
    expected = [0, 1, np.nan]
    errors = compute_pose_errors(read, read_true_values(targets, labels))
    np.testing.assert_array_equal(errors["object_class"], expected)
    terms = compute_pose_error_terms(likely, labels, targets)
    np.testing.assert_array_equal(terms["object_class"], expected)
    drawn = posenet.sample_outputs(targets, 300, jax.random.key(0))
    np.testing.assert_array_equal(np.unique(drawn, axis=0), np.eye(3)[::-1])


@pytest.mark.parametrize("value", [0.5, -1.0, 100.0])
def test_classes_that_are_no_integers_are_refused(value):
    others = {"object_class": np.array([0.0, value])}
    with pytest.raises(UserError, match="'object_class': a class is an integer from 0 to 99"):
        make_label_targets(("object_class",), np.zeros((2, 6)), others=others)
