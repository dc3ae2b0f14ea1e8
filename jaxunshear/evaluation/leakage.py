"""What each code holds that it should not: pose in the shear code, slide in the pose code, asked by probes on held-out poses.

    results = leakage(experiment, Path("runs/demo"), Path("datasets"), command)

A probe learns from codes of training slides and answers for those of test slides; R2 is 1 where it recovers all, 0 where nothing. Beside it
stand a ceiling (the same probe on the network's own input), a floor (labels shuffled among training slides) and the codes of an
untrained network. A slide is given as the sensor feels it, in its own frame.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from jaxunshear.dataset.reading import Batch, Reader
from jaxunshear.errors import UserError
from jaxunshear.evaluation.codes import Encode, encoder_of, untrained
from jaxunshear.evaluation.exchange import errors_of
from jaxunshear.evaluation.probes import LEAST, PROBES
from jaxunshear.evaluation.readers import pixels, places
from jaxunshear.evaluation.slide import slides_read, slipping
from jaxunshear.evaluation.spread import OVER, interval, numbered_poses, redrawn_means
from jaxunshear.evenly import evenly
from jaxunshear.metrics.independence import hsic, r2
from jaxunshear.metrics.machine import provenance
from jaxunshear.results.trained import read_trained
from jaxunshear.settings.data import PairedData, Ranges
from jaxunshear.settings.experiment import Experiment, over_pins, recorded_of
from jaxunshear.settings.registry import DISENTANGLED
from jaxunshear.settings.targets import SIMULATED, Target, Targets, of_ranges, true_values
from jaxunshear.storage import Json, write_json
from jaxunshear.training.checkpoint import check_finished, load_best, read_net
from jaxunshear.training.examples import Examples, open_examples, stored_of
from jaxunshear.training.origin import check_origin

MOST_LEARNT, MOST_TESTED = 4000, 2000  # slides, evenly chosen
MOST_COMPARED = 500  # poses, in the criterion of independence
SEED = 0
CODES = ("z_s", "z_p")
LEAKS = (("pose", "z_s"), ("slide", "z_p"))  # what should not be there; the rest should
UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of what DS draws, over images and over pins
DRAWN = (*UNITS, "missed_per_image")
SLIDE = ("mae", "rmse", "coverage")
LABELS = ("pose", "move", "stimulus", "pose_id")

Known = dict[str, np.ndarray]  # (N, 1), or (N, 2) of an angle over the full circle, by name


def leakage(experiment: Experiment, run_dir: Path, data_dir: Path, command: str, leaks_alone: bool = False) -> Json:
    """Probes the disentangled network in `run_dir`, over images or pins; writes leakage.json there. `leaks_alone`: not what should be in
    each code, and neither ceiling, floor nor an untrained network beside it.

    Raises `UserError` where the network or the data set is missing or damaged, there is no shear code, or the network learnt from other
    data or is not trained to the end.
    """
    folder = Path(run_dir) / DISENTANGLED
    check_finished(folder)
    net, variables = read_net(folder), load_best(folder)
    check_origin(experiment, DISENTANGLED, run_dir)
    encode = encoder_of(net, variables)
    if encode is None:
        raise UserError(f"{folder} holds no network with a shear code: there is nothing to leak from")
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    reader = examples.reader
    seen = "sheared_pins" if over_pins(experiment) else "sheared"
    learnt, tested = (
        _taken(experiment, reader, split, seen, most) for split, most in (("train", MOST_LEARNT), ("test", MOST_TESTED))
    )
    pose = _pose(experiment, data_dir)
    wanted = [{"pose": _values(pose, b), "slide": _slides(examples.slides, b)} for b in (learnt, tested)]
    groups, poses = (numbered_poses(batch["stimulus"], batch["pose_id"]) for batch in (learnt, tested))
    codes = [encode(batch[seen]) for batch in (learnt, tested)]
    others: dict[str, list[Mapping[str, np.ndarray]]] = {}
    if not leaks_alone:
        fresh = encoder_of(net, untrained(net, variables, SEED))
        assert fresh is not None
        features = places if over_pins(experiment) else pixels
        inputs = [features(batch[seen]) for batch in (learnt, tested)]
        mean = np.nanmean(inputs[0], axis=0)  # a pin that is not seen counts as it is on average
        others = {
            "untrained": [fresh(batch[seen]) for batch in (learnt, tested)],
            "input": [dict.fromkeys(CODES, np.where(np.isfinite(values), values, mean)) for values in inputs],
        }
    results = {
        "experiment": experiment.name,
        "simulated": recorded_of(experiment) is None,
        "metric": f"R2 on test poses, mean over the quantities named in 'each'; brackets: 95 % over {OVER}",
        "rows": _probed(codes, others, wanted, groups, poses, leaks_alone),
        "independence": [_independence(what, code, codes[1][code], wanted[1][what], poses) for what, code in LEAKS],
        "exchanged": errors_of(net, variables, reader),
        "slide": [] if leaks_alone else _slide(experiment, examples, seen, encode, (learnt, tested)),
        "slides": {"learnt": len(groups), "tested": len(poses)},
        "sizes": {code: int(codes[1][code].shape[1]) for code in CODES},
        **read_trained(run_dir, experiment.networks),
        **provenance(command),
    }
    write_json(Path(run_dir) / "leakage.json", results)
    return results


def _probed(
    codes: Sequence[Mapping[str, np.ndarray]],
    others: Mapping[str, Sequence[Mapping[str, np.ndarray]]],
    wanted: Sequence[Mapping[str, Known]],
    groups: np.ndarray,
    poses: np.ndarray,
    leaks_alone: bool,
) -> list[Json]:
    """A row for each quantity, code and probe. Of codes, of what stands beside them and of what is wanted, learnt slides
    come first, in `groups` of one pose, then tested ones, of `poses`."""
    shuffled = np.random.default_rng(SEED).permutation(len(groups))
    rows = []
    for what, code, probe in product(("pose", "slide"), CODES, PROBES):
        if leaks_alone and (what, code) not in LEAKS:
            continue
        known, true = (each[what] for each in wanted)
        asked = partial(_scores, probe, true=true, groups=groups)
        own = (codes[0][code], codes[1][code])
        each, band = _with_interval(asked(known, *own), poses)
        row = {"name": f"{what} from {code}", "probe": probe, "leak": (what, code) in LEAKS}
        row |= {"r2": float(np.mean(list(each.values()))), "r2 interval": band, "each": each}
        row |= {name: _mean_r2(asked(known, pair[0][code], pair[1][code])) for name, pair in others.items()}
        if not leaks_alone:
            row["shuffled"] = _mean_r2(asked({name: value[shuffled] for name, value in known.items()}, *own))
        rows.append(row)
    return rows


def _slide(
    experiment: Experiment, examples: Examples, seen: str, encode: Encode, batches: Sequence[Batch]
) -> list[Json]:
    """What both codes together say of the slide, in mm and deg, and how surely."""
    learnt, tested = batches
    between = _taken(experiment, examples.reader, "validation", seen, MOST_TESTED)
    codes = [np.concatenate(list(encode(batch[seen]).values()), axis=1) for batch in (learnt, between, tested)]
    wanted = [_slides(examples.slides, batch) for batch in (learnt, between, tested)]
    groups, poses = (numbered_poses(batch["stimulus"], batch["pose_id"]) for batch in (learnt, tested))
    slipped = slipping(tested["stuck"], tested["slipping"]) if "stuck" in tested else None
    return slides_read(codes, wanted, groups, poses, slipped)


def for_sweep(results: Json) -> list[Json]:
    """Rows of a sweep's ablation."""
    rows = []
    for part, errors in _exchanged(results):
        for name, row in errors["drawn"].items():
            rows.append({"name": f"DS, codes {name}{part}"} | {n: row[n] for n in DRAWN if n in row})
    rows += [{"name": f"{row['name']} ({row['probe']})", "r2": row["r2"]} for row in results["rows"]]
    read = ({"name": f"{row['name']}, {row['part']}"} | {n: row[n] for n in SLIDE} for row in results["slide"])
    return [*rows, *read]


def table(results: Json) -> str:
    """For people."""
    lines = [f"{'R2 of':16}  probe   code [95 %]              untrained  input   shuffled"]
    for row in results["rows"]:
        low, high = row["r2 interval"]
        more = "  ".join(f"{row[name]:8.3f}" for name in ("untrained", "input", "shuffled") if name in row)
        mark = "  a leak" if row["leak"] else ""
        lines.append(f"{row['name']:16}  {row['probe']:6}  {row['r2']:6.3f} [{low:.3f}, {high:.3f}]   {more}{mark}")
    for row in results["independence"]:
        lines.append(
            f"{row['name']}: HSIC {row['hsic']:.4f} of 1, p = {row['p']:.3f} of independence, {row['poses']} poses"
        )
    for part, errors in _exchanged(results):
        for name, row in errors["drawn"].items():
            low, high = row["interval"]
            value, unit = next((row[name], unit) for name, unit in UNITS.items() if name in row)
            text = f"{value:.3f} [{low:.3f}, {high:.3f}] {unit} from the contact of that pose and that slide"
            lines.append(f"DS, codes {name}{part}: {text}")
    for row in results["slide"]:
        mae, coverage = (
            "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"]) for name in ("mae", "coverage")
        )
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; 95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _exchanged(results: Json) -> list[tuple[str, Json]]:
    """What DS draws of exchanged codes, all of it and its parts, each with what its name ends in."""
    errors = results["exchanged"]
    return [("", errors), *((f", {part['part']}", part) for part in errors["by slip"])] if errors else []


def _taken(experiment: Experiment, reader: Reader, split: str, seen: str, most: int) -> Batch:
    """Evenly chosen slides with labels, those whose pins are sure."""
    sure = ("sure",) if recorded_of(experiment) else ()
    batch = reader.take(split, np.arange(reader.length(split)), (*LABELS, *sure))
    kept = np.isfinite(batch["pose"]).all(axis=1) & np.isfinite(batch["move"]).all(axis=1)
    rows = np.flatnonzero(kept & (batch["sure"] == 1) if sure else kept)
    if not len(rows):
        raise UserError(f"no {split} slide has labels of its pose and its slide: there is nothing to probe for")
    rows = rows[evenly(len(rows), most)]
    more = () if recorded_of(experiment) else ("felt", "edge", "stuck", "slipping")
    return reader.take(split, rows, (seen, *LABELS, *more))


def _pose(experiment: Experiment, data_dir: Path) -> list[Target]:
    """All of a pose that the data vary."""
    if isinstance(experiment.paired, PairedData):
        return [target for name in SIMULATED for target in _varied(name, experiment.paired.ranges)]
    return list(stored_of(experiment, data_dir).targets(()))


def _slides(slides: Targets, batch: Batch) -> Known:
    """The slide in mm and deg: as the sensor feels it; of recordings as it is labelled."""
    return {name: value[:, None] for name, value in true_values(slides, batch).items()}


def _varied(name: str, ranges: Ranges) -> tuple[Target, ...]:
    try:
        return of_ranges((name,), ranges)
    except UserError:  # it does not vary
        return ()


def _values(targets: list[Target], batch: Batch) -> Known:
    values = {}
    for target in targets:
        value = batch[target.field][:, target.column].astype(np.float64)
        angle = np.radians(value)
        scaled = [np.cos(angle), np.sin(angle)] if target.circle else [(value - target.middle) / target.reach]
        values[target.name] = np.stack(scaled, axis=-1)
    return values


def _scores(
    probe: str, known: Known, codes: np.ndarray, asked: np.ndarray, true: Known, groups: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """By quantity, of each test slide: its squared error, and its squared distance from the mean."""
    answers = PROBES[probe](codes, np.concatenate(list(known.values()), axis=1), asked, groups)
    found, column = {}, 0
    for name, value in true.items():
        answer = answers[:, column : column + value.shape[1]]
        column += value.shape[1]
        error, scatter = (np.sum(np.square(value - other), axis=1) for other in (answer, value.mean(axis=0)))
        found[name] = (error, scatter)
    return found


def _mean_r2(scores: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> float:
    return float(np.mean([r2(*pair) for pair in scores.values()]))


def _with_interval(
    scores: Mapping[str, tuple[np.ndarray, np.ndarray]], poses: np.ndarray
) -> tuple[dict[str, float], list[float]]:
    values = {f"{name}/{i}": part for name, pair in scores.items() for i, part in enumerate(pair)}
    means = redrawn_means(values, poses, SEED)
    redrawn = np.mean([1 - means[f"{name}/0"] / means[f"{name}/1"] for name in scores], axis=0)
    return {name: r2(*pair) for name, pair in scores.items()}, interval(redrawn)


def _independence(what: str, code: str, codes: np.ndarray, wanted: Known, poses: np.ndarray) -> Json:
    """Of one slide at each pose: rows are independent draws."""
    first = np.unique(poses, return_index=True)[1]
    rows = first[evenly(len(first), MOST_COMPARED)]
    known = np.concatenate(list(wanted.values()), axis=1)
    one, other = ((x - x.mean(axis=0)) / np.maximum(x.std(axis=0), LEAST) for x in (codes, known))
    statistic, p = hsic(one[rows], other[rows], SEED)
    return {"name": f"{what} and {code}", "hsic": statistic, "p": p, "poses": len(rows)}
