"""Learns what `jaxunshear/perception/touch.py` needs from simulated contacts, and scores it.

Slides, the taps at their poses, and the dome untouched: with noise, wear, and a view that has
shifted. Slip is learnt from more slides, which are shorter: long ones slide everywhere. What the
simulator knows is the truth: the share of the contact's nodes that slip, and by how much a slide
has dragged the skin of the contact on from where its tap has it.
"""

from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from sklearn.metrics import roc_auc_score

from benchmarks.touch_fitting import Touches, compare_shear, format_weights, learn_weights
from jaxunshear.config.configs import PAIRED, get_config_sensor
from jaxunshear.config.sensor import Nuisance, Sensor
from jaxunshear.data.recordings import read_recordings
from jaxunshear.data.simulation import render_images
from jaxunshear.errors import UserError
from jaxunshear.files import Json, write_text
from jaxunshear.inference.trained_model import load_model
from jaxunshear.perception import touch as touches
from jaxunshear.perception.lattice_fitting import compute_rest_lattice
from jaxunshear.perception.pin_tracking import track_images
from jaxunshear.progress import Progress
from jaxunshear.selection import select_evenly
from jaxunshear.simulator import simulate
from jaxunshear.simulator.contacts import Skins
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.paths import make_paths
from jaxunshear.simulator.pin_layout import compute_pin_tips
from jaxunshear.simulator.scene import Scenes, compute_edge_labels, sample_poses
from jaxunshear.text_table import format_text_table

STIMULI = ("edge", "disk", "clover", "surface")
# px, by the configuration that has sensor and camera
SIZES = {"skin": (128, 256), "tiny": (128,), "demo": (128,)}
POSES, TEST_POSES = 150, 80  # of each of these, to learn from and to score
DEPTH_MM = (0.02, 4.2)
MIN_DEPTH_MM = 0.5  # contacts from here on must not be refused
MOST_MOVE_MM, MOST_TWIST_DEG = 5.0, 20.0
FRICTION = (0.2, 0.7)
NUISANCE = Nuisance(drift_px=2.0, drift_brightness=0.15)
TEST_SEED = 1_000_000  # added to that of contacts that weights are learnt from
SHORT_SEED = 2_000_000  # added for shorter slides, from which only slip is learnt
SHORT_SLIDES = {"skin": 300, "tiny": 600, "demo": 300}  # most of the sensor that is the default
RECORDED_IMAGES, RECORDED_LENGTHS_MM = 500, (0, 1, 2, 3, 4, 8)
COLUMNS = (
    *("name", "images", "followed", "auc", "refused", "refused_untouched", "slip_rms", "slip_sd"),
    *("shear_rms_mm", "shear_sd_mm", "shear_rms_deg", "shear_sd_deg", "inside_mm", "inside_deg"),
)
format_table = partial(format_text_table, columns=COLUMNS)


def bench_touch(
    seed: int = 0, weights: Path | None = None, recordings: Path | None = None
) -> list[Json]:
    """Return rows of simulated contacts, and of a folder of recordings if it is named.

    With `weights`, learn on other contacts first, and write that file.
    """
    names, rows = list(SIZES), []
    with Progress("bench touch", len(names) * (2 if weights else 1), unit="sensors") as progress:
        learnt, short = [], []
        for number, name in enumerate(names if weights else ()):
            learnt += simulate_touches(name, POSES, seed)
            short += simulate_short_slides(name, SHORT_SLIDES[name], SHORT_SEED + seed + number)
            progress.advance()
        if weights:
            write_text(weights, format_weights(learn_weights(learnt, short)))
        model = touches.load_weights(weights or touches.WEIGHTS)
        for name in names:
            tested = simulate_touches(name, TEST_POSES, TEST_SEED + seed)
            for size, contacts in zip(SIZES[name], tested, strict=True):
                label = f"{get_config_sensor(name).name}, {size} px"
                rows.append({"name": label} | score_touches(contacts, model))
            progress.advance()
    return rows + (score_recordings(recordings) if recordings else [])


def simulate_touches(name: str, count: int, seed: int) -> list[Touches]:
    """Simulate a slide, its tap and an untouched dome for `count` poses, at each size of image."""
    sensor, rng = get_config_sensor(name), np.random.default_rng(seed)
    scenes = _sample_scenes(rng, count)
    contacts, skins = simulate.follow(sensor, STIMULI, make_paths(scenes))
    tips = np.concatenate([contacts.pins, np.repeat(compute_pin_tips(sensor)[None], count, 0)])
    age = rng.random(3 * count)
    nodes = contacts.stuck_nodes + contacts.slipping_nodes
    is_over = compute_edge_labels(STIMULI, scenes)[:, 0] <= 0
    nothing = np.zeros(count)
    truth = {
        "pose": np.arange(3 * count) % count,
        "depth_mm": np.concatenate([np.where(is_over, scenes.pose[:, 3], 0), nothing]),
        "nodes": np.concatenate([nodes, nothing]),
        "slip": np.concatenate([contacts.slipping_nodes / np.maximum(nodes, 1), nothing]),
        "drag": np.pad(_measure_drags(sensor, skins), ((0, 2 * count), (0, 0))),
    }
    solved = np.concatenate([contacts.converged, nothing == 0])
    return _render_touches(name, tips, age, seed, truth, solved)


def simulate_short_slides(name: str, count: int, seed: int) -> list[Touches]:
    """Simulate `count` slides, most of them short, at each size of image.

    What they drag is not known: there are no taps at their poses.
    """
    sensor, rng = get_config_sensor(name), np.random.default_rng(seed)
    scenes = _sample_scenes(rng, count).take(np.arange(count))
    scenes = replace(scenes, move=scenes.move * rng.random(count)[:, None])
    contacts = simulate.simulate(sensor, STIMULI, scenes)
    nodes = contacts.stuck_nodes + contacts.slipping_nodes
    is_over = compute_edge_labels(STIMULI, scenes)[:, 0] <= 0
    truth = {
        "pose": np.arange(count),
        "depth_mm": np.where(is_over, scenes.pose[:, 3], 0),
        "nodes": nodes,
        "slip": contacts.slipping_nodes / np.maximum(nodes, 1),
        "drag": np.full((count, 3), np.nan),
    }
    return _render_touches(name, contacts.pins, rng.random(count), seed, truth, contacts.converged)


def _render_touches(
    name: str,
    tips: np.ndarray,
    age: np.ndarray,
    seed: int,
    truth: dict[str, np.ndarray],
    solved: np.ndarray,
) -> list[Touches]:
    """Render pins, track them, and describe their motion, at each size of image."""
    sensor, paired, count = get_config_sensor(name), PAIRED[name], len(tips)
    made = []
    for size in SIZES[name]:
        preprocess = replace(paired.preprocess, size=size)
        settings = replace(paired, preprocess=preprocess, nuisance=NUISANCE, seed=seed)
        number = np.arange(count)
        images, _ = render_images(settings, sensor, tips.astype(np.float32), number, age)
        lattice = compute_rest_lattice(sensor, settings.camera, preprocess)
        motion, followed = track_images(lattice, images, independent=True)
        gauge, used = touches.make_touch_gauge(lattice, sensor), followed & solved
        field = touches.measure_field(gauge, lattice.rest + motion[used])
        features = touches.describe_field(gauge, field)
        truth["followed"] = np.full(count, followed[solved].mean())
        made.append(Touches(features, **{name: each[used] for name, each in truth.items()}))
    return made


def _sample_scenes(rng: np.random.Generator, count: int) -> Scenes:
    """Sample `count` slides, then the tap at each one's pose."""
    pose = sample_poses(rng, count, 5.0, 180.0, DEPTH_MM)
    length, angle = MOST_MOVE_MM * rng.random(count), rng.uniform(0, 2 * np.pi, count)
    twist = rng.uniform(-MOST_TWIST_DEG, MOST_TWIST_DEG, count) * (rng.random(count) < 0.5)
    move = np.stack([length * np.cos(angle), length * np.sin(angle), twist], axis=-1)
    friction = np.exp(rng.uniform(np.log(FRICTION[0]), np.log(FRICTION[1]), count))
    slides = Scenes(rng.integers(len(STIMULI), size=count), pose, move, friction)
    both = slides.take(np.tile(np.arange(count), 2))
    return replace(both, move=np.concatenate([move, 0 * move]))


def _measure_drags(sensor: Sensor, skins: Skins) -> np.ndarray:
    """Measure by how much each slide has dragged its contact on from its tap's place.

    Returns (B / 2, 3) mm, mm and deg in the sensor frame: mean and turn over the nodes that touch.
    """
    dome, force = load_shared_dome(sensor), skins.force_n
    moved = (force.reshape(len(force), -1) @ dome.w.T).reshape(force.shape)
    slides, taps = np.split(moved[..., :2], 2)
    drags = np.zeros((len(slides), 3))
    for row, way in enumerate(slides - taps):
        touching = np.any(force[row] != 0, axis=-1)
        if np.sum(touching) > 2:
            place = dome.nodes[touching, :2] - dome.nodes[touching, :2].mean(axis=0)
            mean = way[touching].mean(axis=0)
            x, y = (way[touching] - mean).T
            turn = np.sum(place[:, 0] * y - place[:, 1] * x) / np.square(place).sum()
            drags[row] = (*mean, np.degrees(turn))
    return drags


def score_touches(contacts: Touches, weights: touches.TouchWeights) -> Json:
    """Score contacts, and untouched domes, that the weights have not learnt from."""
    contact = touches.predict_touch(weights, contacts.features).contact
    untouched, touching = contacts.nodes == 0, contacts.nodes > 0
    deep = touching & (contacts.depth_mm >= MIN_DEPTH_MM)
    judged = untouched | deep
    found = touching & (contact >= touches.MIN_CONTACT)
    slides = contacts.take(found & deep & contacts.drag.any(axis=-1))
    slip = touches.predict_touch(weights, slides.features).slip
    every = contacts.take(found)
    (error, half_width), drag = compare_shear(every, weights), every.drag
    inside = np.abs(error) <= half_width
    return {
        "images": len(contact),
        "followed": float(contacts.followed[0]),
        "auc": float(roc_auc_score(deep[judged], contact[judged])),
        "refused": float(np.mean(contact[deep] < touches.MIN_CONTACT)),
        "refused_untouched": float(np.mean(contact[untouched] < touches.MIN_CONTACT)),
        "brier": float(np.mean((contact - touching) ** 2)),
        "slip_rms": _compute_rms(slip - slides.slip),
        "slip_sd": float(slides.slip.std()),
        "shear_rms_mm": _compute_rms(error[:, :2]),
        "shear_sd_mm": _compute_rms(drag[:, :2]),
        "shear_rms_deg": _compute_rms(error[:, 2]),
        "shear_sd_deg": _compute_rms(drag[:, 2]),
        "inside_mm": float(inside[:, :2].mean()),
        "inside_deg": float(inside[:, 2].mean()),
    }


def _compute_rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def score_recordings(folder: Path) -> list[Json]:
    """Score recorded contacts by the length of their slide, as its labels have it.

    The dome is touched in all of them: `refused` is the share of those that would have no pose.
    """
    model = load_model("skin", like=folder)
    recordings = read_recordings(folder, model.preprocess)
    if recordings.moves is None:
        raise UserError(f"--recordings {folder}: name contacts with labelled slides")
    rows = set(select_evenly(len(recordings), RECORDED_IMAGES).tolist())
    frames = [frame for frame in recordings.iterate_frames(model.view) if frame.row in rows]
    touch = model.touch(np.array([frame.image for frame in frames]))
    moves = recordings.moves[[frame.row for frame in frames]]
    length, scored = np.linalg.norm(moves[:, :2], axis=-1), []
    shear = np.hypot(touch.shear_x_mm, touch.shear_y_mm)
    followed = np.isfinite(touch.contact)
    for low, high in pairwise(RECORDED_LENGTHS_MM):
        here = followed & (length >= low) & (length < high)
        if not here.any():
            continue
        scored.append(
            {
                "name": f"{low} to {high} mm",
                "images": int(here.sum()),
                "refused": float(np.mean(touch.contact[here] < touches.MIN_CONTACT)),
                "least_contact": float(touch.contact[here].min()),
                "slip": float(np.nanmean(touch.slip[here])),
                "shear_mm": float(np.nanmean(shear[here])),
                "shear_deg": float(np.nanmean(np.abs(touch.shear_deg[here]))),
            }
        )
    return scored
