"""Settings, tables, images and folders of every kind, drawn by hypothesis: exit code 2 and one line, or an answer."""

import contextlib
import io
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st
from PIL import Image

from jaxunshear.config.experiment import Experiment
from jaxunshear.config.fields import list_field_types, override_fields
from jaxunshear.config.image import Preprocess
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.types import check_types
from jaxunshear.data.labels import read_pair_table, read_table, read_targets
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.errors import UserError
from jaxunshear.files import read_json
from tests.faults.outcome import Row, Size
from tests.faults.places import Places, flipped

FORMATS = ("PNG", "TIFF", "BMP", "JPEG", "WEBP")
NAMES = (
    "sensor_image",
    "obj_id",
    "pose_id",
    *(f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)),
)
WORDS = st.sampled_from(
    (
        "",
        "0",
        "-1",
        "1e308",
        "nan",
        "inf",
        "1_0",
        "0x1",
        "None",
        "True",
        "()",
        "1,2",
        "٣",
        "a",
        "../x",
        "\x00",
    )
)
CELLS = st.one_of(WORDS, st.integers(-10, 10).map(str), st.floats().map(repr), st.text(max_size=8))
SHARES = {"settings": 0.45, "csv": 0.35, "images": 0.15, "layouts": 0.05}


def rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """A row for each kind of input."""
    kinds: dict[str, tuple[st.SearchStrategy[Any], Callable[[Any], object]]] = {
        "settings": (_settings(), _parsed),
        "csv": (st.one_of(_tables(), st.binary(max_size=200)), _labels(scratch / "targets.csv")),
        "images": (_images(), _image(scratch / "image")),
        "layouts": (_layouts(), _folder(scratch / "layouts")),
    }
    for kind, (drawn, act) in kinds.items():
        yield _of(kind, drawn, act, size)


class _Over(Exception):
    """The row has had its time."""


def _of(kind: str, drawn: st.SearchStrategy[Any], act: Callable[[Any], object], size: Size) -> Row:
    row = Row("inputs of every kind", kind, size.seed)
    began = time.monotonic()

    @seed(size.seed)
    @settings(
        max_examples=round(size.cases * SHARES[kind]),
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn)
    def each(case: object) -> None:
        if time.monotonic() - began > size.seconds:
            raise _Over
        try:
            kept = act(case)
        except UserError:
            row.count("refused")  # the command line makes one line of it
        except Exception as error:
            row.count("lost", f"{case!r}: {type(error).__name__}: {error}")
        else:
            row.count("harmless" if kept else "silent", repr(case))

    with contextlib.suppress(_Over):
        each()
    row.seconds = time.monotonic() - began
    return row


def _settings() -> st.SearchStrategy[Any]:
    names = st.sampled_from([name for name, _ in list_field_types()])
    pair = st.tuples(
        st.one_of(names, names.map(lambda name: name[:-1]), st.text(max_size=6)), CELLS
    )
    return st.lists(pair, min_size=1, max_size=3)


def _parsed(pairs: list[tuple[str, str]]) -> bool:
    """What is taken is kept as it is in experiment.json."""
    experiment = override_fields(
        Experiment(name="fuzz", claim="none"), [f"--{name}={text}" for name, text in pairs]
    )
    check_types(experiment)
    return from_json(to_json(experiment)) == experiment


def _tables() -> st.SearchStrategy[Any]:
    heading = st.lists(st.one_of(st.sampled_from(NAMES), CELLS), max_size=16)
    lines = st.lists(st.lists(CELLS, max_size=16), max_size=5)
    full = st.tuples(
        st.just(list(NAMES)), st.lists(st.lists(CELLS, min_size=15, max_size=15), max_size=4)
    )
    table = st.one_of(st.tuples(heading, lines), full)
    return table.map(
        lambda rows: "\n".join(",".join(row) for row in [rows[0], *rows[1]]).encode(
            "utf-8", "replace"
        )
    )


def _labels(file: Path) -> Callable[[bytes], bool]:
    """Every label is finite or unknown, and a problem is one line."""

    def act(data: bytes) -> bool:
        file.write_bytes(data)
        try:
            read_pair_table(file)
        except UserError as error:
            if "\n" in str(error):
                return False
        targets, problems = read_targets(read_table(file), ["a", "b.png", "0"])
        numbers = np.concatenate([targets.poses, targets.moves])
        return not np.isinf(numbers).any() and not any("\n" in problem for problem in problems)

    return act


def _images() -> st.SearchStrategy[Any]:
    """Bytes; or the file of an image with a few bits flipped, or cut short."""
    kind = st.tuples(
        st.sampled_from(FORMATS), st.integers(0, 2**32 - 1), st.integers(0, 4), st.booleans()
    )
    return st.one_of(st.binary(max_size=100), kind.map(_damaged))


def _damaged(drawn: tuple[str, int, int, bool]) -> bytes:
    kind, number, flips, cut = drawn
    draw = random.Random(number)
    mode = draw.choice(("L", "RGB", "1"))
    picture = Image.effect_noise((draw.randint(1, 24), draw.randint(1, 24)), 60).convert(mode)
    stream = io.BytesIO()
    picture.save(stream, kind)
    data = stream.getvalue()
    for _ in range(flips):
        data = flipped(data, draw.randrange(8 * len(data)))
    return data[: draw.randrange(len(data))] if cut else data


def _image(file: Path) -> Callable[[bytes], bool]:
    def act(data: bytes) -> bool:
        place = file.with_suffix(".png")
        place.write_bytes(data)
        return read_image(place).ndim in (2, 3)

    return act


def _layouts() -> st.SearchStrategy[Any]:
    """Files by place: folders within folders, images, tables, and what is neither."""
    part = st.sampled_from(
        ("images", "frames_bw", "processed_images", "tap", "csv_train", "a", "é", " ", ".x")
    )
    name = st.sampled_from(
        (
            "image_1.png",
            "image_2.png",
            "x.PNG",
            "targets.csv",
            "meta.json",
            "pairs.csv",
            "y.jpg",
            "none",
        )
    )
    content = st.one_of(
        st.just("image"), st.just("table"), st.just("empty"), st.just("folder"), st.just("link")
    )
    return st.lists(st.tuples(st.lists(part, max_size=3), name, content), max_size=6)


def _folder(root: Path) -> Callable[[list], bool]:
    picture = io.BytesIO()
    Image.effect_noise((24, 24), 60).save(picture, "PNG")
    contents = {
        "image": picture.getvalue(),
        "table": ",".join(NAMES).encode() + b"\nimage_1.png" + b",1" * 14,
        "empty": b"",
    }
    made = iter(range(10**9))

    def act(files: list[tuple[list[str], str, str]]) -> bool:
        folder = root / str(next(made))
        folder.mkdir(parents=True)
        for parts, name, kind in files:
            place = folder.joinpath(*parts, name)
            if (
                any(above.is_file() for above in place.parents)
                or place.is_symlink()
                or place.exists()
            ):
                continue
            place.parent.mkdir(parents=True, exist_ok=True)
            if kind == "folder":
                place.mkdir()
            elif kind == "link":
                place.symlink_to(folder)
            else:
                place.write_bytes(contents[kind])
        for file in folder.rglob("meta.json"):
            if file.is_file():
                _json_or_refused(file)
        return len(read_recordings(folder, Preprocess(size=24)).files) > 0

    return act


def _json_or_refused(file: Path) -> None:
    try:
        read_json(file)
    except UserError as error:
        if "\n" in str(error):
            raise ValueError("a refusal of two lines") from error
