"""Settings, tables, images and folders, drawn by hypothesis: one line and exit code 2, or an answer."""

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
from jaxunshear.config.sensor import Preprocess
from jaxunshear.config.serialization import from_json, to_json
from jaxunshear.config.types import check_types
from jaxunshear.data.labels import read_pair_table, read_targets
from jaxunshear.data.recordings import read_image, read_recordings
from jaxunshear.data.tables import read_table
from jaxunshear.errors import UserError
from jaxunshear.files import read_json
from tests.faults.outcome import Row, Size, flip_bit
from tests.faults.places import Places

FORMATS = ("PNG", "TIFF", "BMP", "JPEG", "WEBP")
POSES = [f"{kind}_{i}" for kind in ("pose", "move") for i in range(1, 7)]
NAMES = ["sensor_image", "obj_id", "pose_id", *POSES]
WORDS = ["", "0", "-1", "1e308", "nan", "inf", "1_0", "0x1", "None", "True", "()", "1,2"]
WORDS += ["٣", "a", "../x", "\x00"]
CELLS = st.one_of(
    st.sampled_from(WORDS),
    st.integers(-10, 10).map(str),
    st.floats().map(repr),
    st.text(max_size=8),
)
FOLDERS = ("images", "frames_bw", "processed_images", "tap", "csv_train", "a", "é", " ", ".x")
FILES = ("image_1.png", "image_2.png", "x.PNG", "targets.csv", "meta.json", "pairs.csv")
CONTENTS = ("image", "table", "empty", "folder", "link")
Check = Callable[[Any], bool]  # whether an input is kept as it is


def list_rows(places: Places, size: Size, scratch: Path) -> Iterator[Row]:
    """Yield a row for each kind of input."""
    scratch.mkdir(exist_ok=True)
    table = st.one_of(_draw_tables(), st.binary(max_size=200))
    yield _fuzz("settings", 0.45, _draw_settings(), _check_settings, size)
    yield _fuzz("csv", 0.35, table, _make_table_check(scratch / "targets.csv"), size)
    yield _fuzz("images", 0.15, _draw_images(), _make_image_check(scratch / "image.png"), size)
    yield _fuzz("layouts", 0.05, _draw_layouts(), _make_folder_check(scratch / "layouts"), size)


class _TimeOver(Exception):
    """The row has had its time."""


def _fuzz(kind: str, share: float, drawn: st.SearchStrategy, check: Check, size: Size) -> Row:
    row = Row("inputs of every kind", kind, size.seed)
    start = time.monotonic()

    @seed(size.seed)
    @settings(
        max_examples=round(size.cases * share),
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(drawn)
    def try_case(case: object) -> None:
        if time.monotonic() - start > size.seconds:
            raise _TimeOver
        try:
            kept = check(case)
        except UserError:
            row.count("refused")  # the command line makes one line of it
        except Exception as error:
            row.count("lost", f"{case!r}: {type(error).__name__}: {error}")
        else:
            row.count("harmless" if kept else "silent", repr(case))

    with contextlib.suppress(_TimeOver):
        try_case()
    row.seconds = time.monotonic() - start
    return row


def _draw_settings() -> st.SearchStrategy:
    names = st.sampled_from(list(list_field_types()))
    near = st.one_of(names, names.map(lambda name: name[:-1]), st.text(max_size=6))
    return st.lists(st.tuples(near, CELLS), min_size=1, max_size=3)


def _check_settings(pairs: list[tuple[str, str]]) -> bool:
    """Check that what is taken is kept as it is in experiment.json."""
    words = [f"--{name}={text}" for name, text in pairs]
    experiment = override_fields(Experiment(name="fuzz", claim="none"), words)
    check_types(experiment)
    return from_json(to_json(experiment)) == experiment


def _draw_tables() -> st.SearchStrategy:
    heading = st.lists(st.one_of(st.sampled_from(NAMES), CELLS), max_size=16)
    lines = st.lists(st.lists(CELLS, max_size=16), max_size=5)
    full = st.lists(st.lists(CELLS, min_size=15, max_size=15), max_size=4)
    tables = st.one_of(st.tuples(heading, lines), st.tuples(st.just(NAMES), full))

    def encode(table: tuple[list[str], list[list[str]]]) -> bytes:
        return "\n".join(map(",".join, [table[0], *table[1]])).encode("utf-8", "replace")

    return tables.map(encode)


def _make_table_check(file: Path) -> Check:
    """Make a check that every label is finite or unknown, and a problem is one line."""

    def check(data: bytes) -> bool:
        file.write_bytes(data)
        try:
            read_pair_table(file)
        except UserError as error:
            if "\n" in str(error):
                return False
        targets, problems = read_targets(read_table(file), ["a", "b.png", "0"])
        numbers = np.concatenate([targets.poses, targets.moves])
        return not np.isinf(numbers).any() and not any("\n" in problem for problem in problems)

    return check


@st.composite
def _draw_images(draw: st.DrawFn) -> bytes:
    """Draw bytes; or the file of an image with a few bits flipped, or cut short."""
    if draw(st.booleans()):
        return draw(st.binary(max_size=100))
    number = random.Random(draw(st.integers(0, 2**32 - 1)))
    size = (number.randint(1, 24), number.randint(1, 24))
    stream = io.BytesIO()
    picture = Image.effect_noise(size, 60).convert(number.choice(("L", "RGB", "1")))
    picture.save(stream, draw(st.sampled_from(FORMATS)))
    data = stream.getvalue()
    for _ in range(draw(st.integers(0, 4))):
        data = flip_bit(data, number.randrange(8 * len(data)))
    return data[: number.randrange(len(data))] if draw(st.booleans()) else data


def _make_image_check(file: Path) -> Check:
    def check(data: bytes) -> bool:
        file.write_bytes(data)
        return read_image(file).ndim in (2, 3)

    return check


def _draw_layouts() -> st.SearchStrategy:
    """Draw files by place: folders within folders, images, tables, and what is neither."""
    parts = st.lists(st.sampled_from(FOLDERS), max_size=3)
    names = st.sampled_from((*FILES, "y.jpg", "none"))
    return st.lists(st.tuples(parts, names, st.sampled_from(CONTENTS)), max_size=6)


def _make_folder_check(root: Path) -> Check:
    picture = io.BytesIO()
    Image.effect_noise((24, 24), 60).save(picture, "PNG")
    table = ",".join(NAMES).encode() + b"\nimage_1.png" + b",1" * 14
    contents = {"image": picture.getvalue(), "table": table, "empty": b""}
    numbers = iter(range(10**9))

    def check(files: list[tuple[list[str], str, str]]) -> bool:
        folder = root / str(next(numbers))
        folder.mkdir(parents=True)
        for parts, name, kind in files:
            place = folder.joinpath(*parts, name)
            if any(map(Path.is_file, place.parents)) or place.is_symlink() or place.exists():
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
                _check_json(file)
        return len(read_recordings(folder, Preprocess(size=24)).files) > 0

    return check


def _check_json(file: Path) -> None:
    try:
        read_json(file)
    except UserError as error:
        if "\n" in str(error):
            raise ValueError("a refusal of two lines") from error
