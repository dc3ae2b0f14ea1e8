"""What each code holds that it should not: pose in the shear code, slide in the pose code, by probes on held-out poses.

    results = leakage(experiment, Path("runs/demo"), Path("datasets"), command)

Each quantity is probed by itself, by every family of `probes`; reported is the largest R2 over the
families, which errs towards a leak. Its ceiling is the largest R2 that the same families reach from the
pins of the network's input, or from either code. Quantities that the input does not show have no ceiling; they
are named, and left out of means. A slide is given as the sensor feels it, in its own frame.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxunshear.dataset.reading import Batch, Reader
from jaxunshear.errors import UserError
from jaxunshear.evaluation.codes import Encode, encoder_of, untrained
from jaxunshear.evaluation.exchange import errors_of
from jaxunshear.evaluation.probes import FAMILIES, fit_whitening
from jaxunshear.evaluation.readers import places
from jaxunshear.evaluation.slide import slides_read, slipping
from jaxunshear.evaluation.spread import OVER, interval, numbered_poses, redrawn_means
from jaxunshear.evenly import evenly
from jaxunshear.metrics.disentanglement import Blocks, score_dci, score_mig, score_sap
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
LEAST_CEILING = 0.1  # R2 from the input: below it a quantity cannot be seen, and has no ceiling
PLANTED = 0.01  # deviation of a planted leak, in shares of the code's widest direction
SEED = 0
CODES = ("z_s", "z_p")
LEAKS = (("pose", "z_s"), ("slide", "z_p"))  # what should not be there; the rest should
UNITS = {"rms_grey": "of 1 in grey", "rms_px": "px"}  # of what DS draws, over images and over pins
DRAWN = (*UNITS, "missed_per_image")
SLIDE = ("mae", "rmse", "coverage")
LABELS = ("pose", "move", "stimulus", "pose_id")
PINS = "sheared_pins"

Known = dict[str, np.ndarray]  # (N, 1), or (N, 2) of an angle over the full circle, by name


class Split(NamedTuple):
    """Slides that probes learn from, or are tested on."""

    seen: np.ndarray  # what the network is given
    pins: np.ndarray  # (N, 2 P) px, finite
    wanted: dict[str, Known]  # "pose" and "slide"
    poses: np.ndarray  # (N,) which pose a slide belongs to
    batch: Batch


class Estimate(NamedTuple):
    """Errors of the family that estimates a quantity best."""

    family: str
    squares: np.ndarray  # (M,) squared error
    scatter: np.ndarray  # (M,) squared distance from the mean
    families: dict[str, float]  # R2 of every family

    @property
    def r2(self) -> float:
        return self.families[self.family]


def leakage(
    experiment: Experiment, run_dir: Path, data_dir: Path, command: str, controls: bool = True
) -> Json:
    """Probe the disentangled network in `run_dir`, over images or pins; write leakage.json there.

    `controls` adds an untrained network and shuffled labels.

    Raises `UserError` if the network or the data set is missing or damaged, there is no shear code, or
    the network learnt from other data or is not trained to the end.
    """
    folder = Path(run_dir) / DISENTANGLED
    check_finished(folder)
    net, variables = read_net(folder), load_best(folder)
    check_origin(experiment, DISENTANGLED, run_dir)
    encode = encoder_of(net, variables)
    if encode is None:
        raise UserError(
            f"{folder} holds no network with a shear code: there is nothing to leak from"
        )
    examples = open_examples(experiment, DISENTANGLED, data_dir, run_dir)
    train, test = _splits(experiment, examples, data_dir)
    codes = [encode(split.seen) for split in (train, test)]
    fresh = []
    if controls:
        untrained_encode = encoder_of(net, untrained(net, variables, SEED))
        assert untrained_encode is not None
        fresh = [untrained_encode(split.seen) for split in (train, test)]
    rows = _probe_all(codes, fresh, train, test, controls)
    results = {
        "experiment": experiment.name,
        "simulated": recorded_of(experiment) is None,
        "metric": "R2 on test poses of the family of probes that finds most; share: R2 over its ceiling, the most "
        f"that the input's pins or a code give; brackets: 95 % over {OVER}",
        "rows": rows,
        "summary": [
            _summarise(rows, pair, test.poses) for pair in product(("pose", "slide"), CODES)
        ],
        "independence": _independence(codes[1], test, rows),
        "scores": _standard_scores(codes, train, test, rows),
        "exchanged": errors_of(net, variables, examples.reader),
        "slide": _slide(experiment, examples, encode, (train, test)),
        "slides": {"learnt": len(train.poses), "tested": len(test.poses)},
        "sizes": {code: int(codes[1][code].shape[1]) for code in CODES},
        **read_trained(run_dir, experiment.networks),
        **provenance(command),
    }
    for row in rows:
        del row["estimate"]
    write_json(Path(run_dir) / "leakage.json", results)
    return results


def _splits(experiment: Experiment, examples: Examples, data_dir: Path) -> tuple[Split, Split]:
    pose = _pose(experiment, data_dir)
    train = _read_split(experiment, examples, pose, "train", MOST_LEARNT)
    test = _read_split(experiment, examples, pose, "test", MOST_TESTED)
    mean = np.nanmean(train.pins, axis=0)  # a pin that is not seen counts as it is on average
    train, test = (
        s._replace(pins=np.where(np.isfinite(s.pins), s.pins, mean)) for s in (train, test)
    )
    return train, test


def _read_split(
    experiment: Experiment, examples: Examples, pose: list[Target], split: str, most: int
) -> Split:
    batch = _take(experiment, examples.reader, split, most)
    wanted = {"pose": _values(pose, batch), "slide": _slides(examples.slides, batch)}
    seen = batch[PINS if over_pins(experiment) else "sheared"]
    poses = numbered_poses(batch["stimulus"], batch["pose_id"])
    return Split(seen, places(batch[PINS]), wanted, poses, batch)


def probe_quantity(
    codes: Sequence[np.ndarray], known: np.ndarray, true: np.ndarray, groups: np.ndarray
) -> Estimate:
    """Estimate one quantity from a code by every family; return the errors of the best.

    `codes`: of training slides (N, F) and test slides (M, F); `known` (N, K) and `true` (M, K) are the
    quantity, with two columns for an angle over the full circle; `groups` (N,) are training poses.
    """
    scatter = np.sum(np.square(true - true.mean(axis=0)), axis=1)
    squares = {
        name: np.sum(np.square(probe(codes[0], known, codes[1], groups) - true), axis=1)
        for name, probe in FAMILIES.items()
    }
    families = {name: r2(errors, scatter) for name, errors in squares.items()}
    best = max(families, key=families.__getitem__)
    return Estimate(best, squares[best], scatter, families)


def _probe_all(
    codes: Sequence[Mapping[str, np.ndarray]],
    fresh: Sequence[Mapping[str, np.ndarray]],
    train: Split,
    test: Split,
    controls: bool,
) -> list[Json]:
    """Return a row for each quantity and code."""
    shuffled = np.random.default_rng(SEED).permutation(len(train.poses))
    rows = []
    for what in ("pose", "slide"):
        for quantity, known in train.wanted[what].items():
            true = test.wanted[what][quantity]
            inputs = {"pins": (train.pins, test.pins)}
            inputs |= {code: (codes[0][code], codes[1][code]) for code in CODES}
            found = {
                name: probe_quantity(pair, known, true, train.poses)
                for name, pair in inputs.items()
            }
            # a code is a function of the input, so what a code shows the input shows, too
            ceiling = max(estimate.r2 for estimate in found.values())
            for code in CODES:
                pair, estimate = inputs[code], found[code]
                row = {
                    "name": f"{quantity} from {code}",
                    "what": what,
                    "code": code,
                    "quantity": quantity,
                    "leak": (what, code) in LEAKS,
                    "r2": estimate.r2,
                    "r2 interval": _bootstrap_r2([estimate], test.poses),
                    "family": estimate.family,
                    "families": estimate.families,
                    "ceiling": ceiling if ceiling >= LEAST_CEILING else None,
                    "estimate": estimate,
                }
                if controls:
                    other = (fresh[0][code], fresh[1][code])
                    row["untrained"] = probe_quantity(other, known, true, train.poses).r2
                    row["shuffled"] = probe_quantity(pair, known[shuffled], true, train.poses).r2
                rows.append(row)
    return rows


def _summarise(rows: Sequence[Json], pair: tuple[str, str], poses: np.ndarray) -> Json:
    """Return the means over the quantities that have a ceiling, of what is in which code."""
    what, code = pair
    asked = [row for row in rows if (row["what"], row["code"]) == pair]
    seen = [row for row in asked if row["ceiling"] is not None]
    summary = {
        "name": f"{what} from {code}",
        "leak": pair in LEAKS,
        "quantities": [row["quantity"] for row in seen],
        "without a ceiling": [row["quantity"] for row in asked if row["ceiling"] is None],
    }
    for name in ("r2", "ceiling", "untrained", "shuffled"):
        if seen and name in seen[0]:
            summary[name] = float(np.mean([row[name] for row in seen]))
    if seen:
        summary["r2 interval"] = _bootstrap_r2([row["estimate"] for row in seen], poses)
        summary["share"] = float(np.mean([max(row["r2"], 0) / row["ceiling"] for row in seen]))
        summary["largest share"] = max(max(row["r2"], 0) / row["ceiling"] for row in seen)
    return summary


def _slide(
    experiment: Experiment, examples: Examples, encode: Encode, splits: Sequence[Split]
) -> list[Json]:
    """What both codes together say of the slide, in mm and deg, and how surely."""
    train, test = splits
    batch = _take(experiment, examples.reader, "validation", MOST_TESTED)
    seen = (train.seen, batch[PINS if over_pins(experiment) else "sheared"], test.seen)
    codes = [np.concatenate(list(encode(each).values()), axis=1) for each in seen]
    wanted = [train.wanted["slide"], _slides(examples.slides, batch), test.wanted["slide"]]
    slipped = (
        slipping(test.batch["stuck"], test.batch["slipping"]) if "stuck" in test.batch else None
    )
    return slides_read(codes, wanted, train.poses, test.poses, slipped)


def for_sweep(results: Json) -> list[Json]:
    """Rows of a sweep's ablation."""
    rows = []
    for part, errors in _exchanged(results):
        for name, row in errors["drawn"].items():
            rows.append(
                {"name": f"DS, codes {name}{part}"} | {n: row[n] for n in DRAWN if n in row}
            )
    for row in results["summary"]:
        if row["quantities"]:
            rows.append({n: row[n] for n in ("name", "r2", "ceiling", "share", "largest share")})
    rows += [{"name": row["name"], "r2": row["r2"]} for row in results["rows"]]
    rows.append({"name": "standard scores", **results["scores"]})
    rows += [
        {"name": f"{row['name']}, {row['part']}"} | {n: row[n] for n in SLIDE}
        for row in results["slide"]
    ]
    return rows


def table(results: Json) -> str:
    """For people."""
    lines = [f"{'R2 of':24}  code [95 %]              strongest      ceiling  untrained  shuffled"]
    for row in results["rows"]:
        low, high = row["r2 interval"]
        values = [row.get(name) for name in ("ceiling", "untrained", "shuffled")]
        more = "  ".join("    none" if value is None else f"{value:8.3f}" for value in values)
        mark = "  a leak" if row["leak"] else ""
        lines.append(
            f"{row['name']:24}  {row['r2']:6.3f} [{low:.3f}, {high:.3f}]   {row['family']:12}  {more}{mark}"
        )
    for row in results["summary"]:
        if row["quantities"]:
            share, largest = row["share"], row["largest share"]
            lines.append(
                f"{row['name']}: {share:.0%} of the ceiling on average, {largest:.0%} at most"
            )
        if row["without a ceiling"]:
            lines.append(
                f"{row['name']}: the input does not show {', '.join(row['without a ceiling'])}: left out"
            )
    for row in results["independence"]:
        lines.append(
            f"{row['name']}: HSIC {row['hsic']:.4f} of 1, p = {row['p']:.3f} of independence, "
            f"{row['planted p']:.3f} of a planted leak; {row['poses']} poses"
        )
    for name, value in results["scores"].items():
        lines.append(f"{name} by block: {value:.3f}")
    for part, errors in _exchanged(results):
        for name, row in errors["drawn"].items():
            low, high = row["interval"]
            value, unit = next((row[name], unit) for name, unit in UNITS.items() if name in row)
            text = f"{value:.3f} [{low:.3f}, {high:.3f}] {unit} from the contact of that pose and that slide"
            lines.append(f"DS, codes {name}{part}: {text}")
    for row in results["slide"]:
        mae, coverage = (
            "{:.3g} [{:.3g}, {:.3g}]".format(row[name], *row[f"{name} interval"])
            for name in ("mae", "coverage")
        )
        lines.append(
            f"{row['name']} from both codes, {row['part']} ({row['slides']}): error {mae}; 95 % intervals hold {coverage}"
        )
    return "\n".join([*lines, results["metric"]])


def _exchanged(results: Json) -> list[tuple[str, Json]]:
    """What DS draws of exchanged codes, all of it and its parts, each with what its name ends in."""
    errors = results["exchanged"]
    return (
        [("", errors), *((f", {part['part']}", part) for part in errors["by slip"])]
        if errors
        else []
    )


def _take(experiment: Experiment, reader: Reader, split: str, most: int) -> Batch:
    """Evenly chosen slides with labels, those whose pins are sure."""
    sure = ("sure",) if recorded_of(experiment) else ()
    batch = reader.take(split, np.arange(reader.length(split)), (*LABELS, *sure))
    kept = np.isfinite(batch["pose"]).all(axis=1) & np.isfinite(batch["move"]).all(axis=1)
    rows = np.flatnonzero(kept & (batch["sure"] == 1) if sure else kept)
    if not len(rows):
        raise UserError(
            f"no {split} slide has labels of its pose and its slide: there is nothing to probe for"
        )
    rows = rows[evenly(len(rows), most)]
    more = () if recorded_of(experiment) else ("felt", "edge", "stuck", "slipping")
    images = () if over_pins(experiment) else ("sheared",)
    return reader.take(split, rows, (PINS, *images, *LABELS, *more))


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
        scaled = (
            [np.cos(angle), np.sin(angle)]
            if target.circle
            else [(value - target.middle) / target.reach]
        )
        values[target.name] = np.stack(scaled, axis=-1)
    return values


def _bootstrap_r2(estimates: Sequence[Estimate], poses: np.ndarray) -> list[float]:
    """Return the 95 % interval of the mean R2 over redrawn poses."""
    redrawn = []
    for estimate in estimates:
        values = {"squares": estimate.squares, "scatter": estimate.scatter}
        means = redrawn_means(values, poses, SEED)
        redrawn.append(1 - means["squares"] / means["scatter"])
    return interval(np.mean(redrawn, axis=0))


def _independence(codes: Mapping[str, np.ndarray], test: Split, rows: Sequence[Json]) -> list[Json]:
    """Test each leak for independence, one slide at each pose: rows are independent draws.

    The planted leak shows the test's power: codes of other contacts, which know nothing, with the
    quantity hidden in a direction of PLANTED of the code's spread. A test that does not find it says
    nothing by a large p.
    """
    first = np.unique(test.poses, return_index=True)[1]
    chosen = first[evenly(len(first), MOST_COMPARED)]
    shuffled = np.random.default_rng(SEED).permutation(chosen)
    found = []
    for row in rows:
        if not row["leak"] or row["ceiling"] is None:
            continue
        code, quantity = codes[row["code"]], test.wanted[row["what"]][row["quantity"]][chosen]
        statistic, p = hsic(fit_whitening(code).apply(code[chosen]), quantity, SEED)
        hidden = PLANTED * code.std(axis=0).max() * quantity / max(quantity.std(), 1e-12)
        planted = np.concatenate([code[shuffled], hidden], axis=1)
        _, power = hsic(fit_whitening(planted).apply(planted), quantity, SEED)
        name = f"{row['quantity']} and {row['code']}"
        found.append(
            {"name": name, "hsic": statistic, "p": p, "planted p": power, "poses": len(chosen)}
        )
    return found


def _standard_scores(
    codes: Sequence[Mapping[str, np.ndarray]], train: Split, test: Split, rows: Sequence[Json]
) -> dict[str, float]:
    """Return MIG, SAP and DCI by block over the quantities with a ceiling, on whitened codes."""
    asked = {(row["what"], row["quantity"]) for row in rows if row["ceiling"] is not None}
    if {what for what, _ in asked} != {"pose", "slide"}:
        return {}
    whitenings = {name: fit_whitening(codes[0][name]) for name in ("z_p", "z_s")}
    sizes = [whitening.directions.shape[1] for whitening in whitenings.values()]
    blocks = []
    for split, encoded in zip((train, test), codes, strict=True):
        factors = [(int(w == "slide"), split.wanted[w][q]) for w, q in sorted(asked)]
        blocks.append(
            Blocks(
                np.concatenate(
                    [whitenings[name].apply(encoded[name]) for name in whitenings], axis=1
                ),
                np.repeat([0, 1], sizes),
                np.concatenate([values for _, values in factors], axis=1),
                np.concatenate([np.full(values.shape[1], owner) for owner, values in factors]),
            )
        )
    dci = {f"DCI {name}": value for name, value in score_dci(*blocks).items()}
    return {"MIG": score_mig(blocks[0]), "SAP": score_sap(*blocks), **dci}
