"""Results in docs/results: their code, their seals, and whether that code has changed since."""

import json
import shutil

import pytest
from PIL import Image

from docs.code_changes import (
    compare_modules,
    find_programs,
    list_lost_definitions,
    read_modules,
    run_git,
)
from docs.keep import keep
from docs.provenance import (
    RESULTS,
    ROOT,
    describe_origin,
    find_changed_code,
    find_changed_settings,
    format_note,
    list_commands,
    list_sources,
    read_result,
    read_stale,
)
from jaxunshear.errors import UserError
from jaxunshear.files import CHECKSUM_FIELD, read_json, write_json

NAMES = sorted(path.stem for path in (ROOT / "docs" / "results").glob("*.json"))
KEPT = [name for name in NAMES if list_sources(read_result(name))]


def test_results_without_a_commit_are_listed():
    """A new result needs no entry; one that was made anew leaves the list."""
    assert read_stale().not_kept.keys() == set(NAMES) - set(KEPT)
    assert set(read_stale().changed) <= set(KEPT)


@pytest.mark.parametrize("name", KEPT)
def test_results_are_sealed(name):
    """Neither a figure nor a command was edited, and the code was committed."""
    assert CHECKSUM_FIELD in read_result(name), f"{name}.json bears no checksum: use docs/keep.py"
    read_json(ROOT / "docs" / "results" / f"{name}.json")
    for source in list_sources(read_result(name)):
        assert source.commit and source.clean, (
            f"{name}.json was made with code that no commit has: make it again"
        )


@pytest.fixture
def history():
    """Skip a test where the project's history is not there."""
    try:
        if run_git(ROOT, "rev-parse", "--is-shallow-repository").strip() == b"true":
            pytest.skip("this clone has no history")
    except LookupError as error:
        pytest.skip(f"no history: {error}")


def test_commits_of_results_that_did_not_keep_theirs_have_the_file(history):
    for name, commit in read_stale().not_kept.items():
        shown = run_git(ROOT, "show", "--name-only", "--format=%h of %cs", commit.split()[0])
        assert shown.decode().startswith(commit[:7]), name
        assert commit.endswith(shown.decode().split("\n")[0][-10:]), name
        assert f"docs/results/{name}.json" in shown.decode().split(), name


def test_results_whose_code_has_changed_are_listed(history):
    assert KEPT  # else nothing would be compared
    found = {name: changed for name in KEPT if (changed := find_changed_code(name))}
    assert found.keys() == read_stale().changed.keys(), (
        "docs/stale.toml differs; make the result again, or list it with a reason: "
        + "; ".join(f"{name}: {', '.join(changed)}" for name, changed in found.items())
    )


@pytest.mark.parametrize("name", NAMES)
def test_commands_give_the_settings_of_their_results(name):
    """So a command that was edited, or an experiment that was changed later, is listed."""
    found = find_changed_settings(name)
    assert bool(found) == (name in read_stale().settings), f"docs/stale.toml: {name}: {found}"


STEP = '''"""A module."""
from jaxunshear.models.net import layer

SCALE = 2.0  # of what is returned

def step(x):
    """Return twice the layer."""
    return SCALE * layer(x)
'''
NET = "def layer(x):\n    return x + 1\n\ndef other(x):\n    return x\n"
TEXTS = {
    "jaxunshear.training.step": STEP,
    "jaxunshear.models.net": NET,
    "jaxunshear.perception.draw": "def draw(): ...\n",
}
REWORDED = STEP.replace("twice", "some multiple of").replace("# of what", "# a factor on what")
SPREAD = STEP.replace("SCALE * layer(x)", "(SCALE\n        * layer(x))")


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        ({}, []),
        ({"training.step": REWORDED}, []),
        ({"training.step": SPREAD}, []),
        ({"training.step": STEP + "\ndef more(): ...\n"}, []),
        ({"models.net": "", "models.layers": NET}, []),  # moved
        ({"perception.draw": ""}, []),  # not used
        ({"training.step": STEP.replace("2.0", "3.0")}, ["jaxunshear.training.step: SCALE"]),
        ({"models.net": NET.replace("x + 1", "x + 2")}, ["jaxunshear.models.net: layer"]),
    ],
)
def test_changes_by_more_than_words_are_named(texts, expected):
    today = TEXTS | {f"jaxunshear.{name}": text for name, text in texts.items()}
    assert compare_modules(TEXTS, today, ("jaxunshear.training.step",)) == expected


def test_what_moved_out_of_the_package_or_only_shows_is_not_lost():
    today = {"jaxunshear.training.step": STEP, "verification.net": NET}
    assert not compare_modules(TEXTS, today, ("jaxunshear.training.step",))
    assert compare_modules({"verification.net": NET}, {}, ("verification.net",))
    shown = {"jaxunshear.report.html": NET, "jaxunshear.config.data": NET}
    assert not compare_modules(shown, {}, tuple(shown))


@pytest.fixture
def repository(tmp_path):
    """Return a folder with one module, and a function that commits another text of it."""
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    module = tmp_path / "jaxunshear" / "models" / "net.py"
    module.parent.mkdir(parents=True)
    run_git(tmp_path, "init", "-q")

    def commit(text: str) -> str:
        module.write_text(text)
        run_git(tmp_path, "add", "-A")
        run_git(tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-qm", "Change")
        return run_git(tmp_path, "rev-parse", "HEAD").decode().strip()

    return module, commit


def test_changes_on_a_bridge_do_not_count(repository, tmp_path):
    module, commit = repository
    renamed = NET.replace("def other", "def another")
    first, second, third = map(commit, (NET, renamed, renamed.replace("x + 1", "1 + x")))
    name = "jaxunshear.models.net"

    def changed_since(commit, *bridges):
        return list_lost_definitions(tmp_path, commit, (name,), bridges)

    assert changed_since(first) == [f"{name}: layer", f"{name}: other"]
    assert changed_since(first, (second, third)) == [f"{name}: other"]
    assert changed_since(first, (first, third)) == changed_since(third) == []
    module.write_text(renamed.replace("x + 1", "2 + x"))
    read_modules.cache_clear()
    assert changed_since(first, (first, third)) == [f"{name}: layer"]


def test_modules_of_a_commit_are_those_that_were_committed(repository, tmp_path):
    module, commit = repository
    first = commit("MORE = 'ü'\n")
    module.write_text("MORE = 2\n")
    assert read_modules(tmp_path, first) == {"jaxunshear.models.net": "MORE = 'ü'\n"}
    assert read_modules(tmp_path) == {"jaxunshear.models.net": "MORE = 2\n"}
    with pytest.raises(LookupError):
        read_modules(tmp_path, "0" * 40)


@pytest.mark.parametrize("name", [name for name in NAMES if list_commands(read_result(name))])
def test_every_command_has_its_programs(name):
    """All of them are modules that there are."""
    for command in list_commands(read_result(name)):
        assert set(find_programs(command)) <= read_modules(ROOT).keys(), command


@pytest.mark.parametrize(
    ("command", "starts"),
    [
        ("python -m verification verify --json FILE", ["verification.verify"]),
        ("jaxunshear check verify --json FILE", ["verification.verify"]),
        ("jaxunshear check bench sim --out DIR", ["benchmarks.bench_sim"]),
        ("jaxunshear check identify --json FILE", []),
        ("python -m tests.faults", []),
    ],
)
def test_commands_of_earlier_versions_have_the_programs_of_today(command, starts):
    assert find_programs(command) == starts


def test_a_command_names_where_its_file_is_today():
    assert "(now `python -m benchmarks train`)" in format_note(
        ["bench_train_xeon"], "docs/speed.md"
    )
    moved = format_note(["lambda_split"], "README.md")
    assert "(now experiments/ablations/lambda_split.py)" in moved
    assert "(now" not in format_note(["standard"], "README.md")
    assert format_note(["few_pairs"], "README.md").endswith("defaults differ).</sub>")


CODE = {"version": "0.3.0", "date": "2030-01-02", "commit": "0123456789", "clean": True}


def test_a_note_says_what_a_file_knows():
    one = {"command": "jaxunshear sweep a", "sources": [CODE]}
    assert describe_origin(one) == "`jaxunshear sweep a`, commit 0123456 of 2030-01-02"
    unclean = {"source": CODE | {"clean": False}}
    assert describe_origin(unclean) == "commit 0123456 of 2030-01-02 with uncommitted changes"
    assert describe_origin(one | {"trained_on": {"posenet": {}}}) == "`jaxunshear sweep a`"
    several = {"runs": {"a": {"command": "x", "source": CODE}, "b": {"command": "y"}}}
    assert describe_origin(several) == "`x`, and 1 more command"


def result(**more):
    rows = [{"name": "mm/deg", "value": 1.5}]
    return {"command": "jaxunshear sweep a.py", "source": CODE, "rows": rows, **more}


def test_a_result_is_kept_with_its_command_and_rows(tmp_path):
    files = [tmp_path / f"{seed}.json" for seed in (0, 1)]
    for seed, file in enumerate(files):
        write_json(file, result(seed=seed))
    kept = keep("one", [str(files[0])], tmp_path)
    assert read_json(kept) == read_json(files[0]) and len(kept.read_text().splitlines()) == 1
    several = keep("two", [f"a, seed {file.stem}={file}" for file in files], tmp_path)
    assert read_json(several) == {"runs": {f"a, seed {seed}": result(seed=seed) for seed in (0, 1)}}


def test_what_no_page_reads_is_left_out(tmp_path):
    read = ("pose/unet/x_mm", "swap/DC(z_p)/ms_ssim", "pin_error/tap/rms_px")
    read += ("found: pose/tap/x_mm",)
    unread = ("disk: pose/tap/x_mm", "found, disk: pose/tap/x_mm", "swap/DC(z_p)/mse")
    unread += ("DS(z_p,z_s)/ssim", "pin_error/tap/missed_per_image", "found: read/pins/tap/x_mm")
    figure = {"mean": 1 / 3, "per_seed": {"0": 1 / 3}}
    costs = {"0": {"ms_per_image": {"unet": {"median": 1.0, "p95": 2.0}}, "host": "a"}}
    metric = {"ms_ssim": "ms_ssim@4"}
    cell = {"metric": metric, "costs": costs}
    for group in ("metrics", "difference"):
        cell[group] = dict.fromkeys((*read, *unread), figure)
    write_json(tmp_path / "a.json", result(cells=[cell, cell], base={"loss": 1 / 3}))
    kept = read_json(keep("one", [str(tmp_path / "a.json")], tmp_path))
    assert kept["base"] == {"loss": 1 / 3} and kept["rows"] == result()["rows"]
    assert [each.get("metric") for each in kept["cells"]] == [metric, None]
    for each in kept["cells"]:
        assert each["metrics"].keys() == set(read)
        assert each["metrics"]["pose/unet/x_mm"] == {"mean": 0.333333, "per_seed": {"0": 0.333333}}
        assert each["metrics"]["pin_error/tap/rms_px"] == {"mean": 0.333333}
        assert each["difference"] == {"pose/unet/x_mm": {"mean": 0.333333}}
        assert each["costs"] == {"0": {"ms_per_image": {"unet": {"median": 1.0}}}}


def test_a_picture_is_kept_with_a_palette(tmp_path):
    Image.linear_gradient("L").convert("RGBA").save(tmp_path / "a.png")
    with Image.open(keep("one", [str(tmp_path / "a.png")], tmp_path)) as picture:
        assert picture.mode == "P" and picture.size == (256, 256)


def test_results_are_small():
    """All of them at most 2 MB: `docs/keep.py` has the rule for what a result keeps."""
    assert sum(path.stat().st_size for path in RESULTS.rglob("*.*")) <= 2_000_000


@pytest.mark.parametrize(
    ("held", "reason"),
    [
        ({"source": None}, "no commit has"),
        ({"source": CODE | {"clean": False}}, "no commit has"),
        ({"command": "jaxunshear sweep a.py --recordings /home/me/taps"}, "a place of one machine"),
        ({"settings": {"paired": {"tap_folder": "/home/me/taps"}}}, "a place of one machine"),
    ],
)
def test_what_cannot_be_published_is_refused(tmp_path, held, reason):
    write_json(tmp_path / "a.json", result(**held))
    with pytest.raises(UserError, match=reason):
        keep("one", [str(tmp_path / "a.json")], tmp_path)
    assert not (tmp_path / "one.json").exists()


def test_what_was_edited_is_refused(tmp_path):
    write_json(tmp_path / "a.json", result())
    text = (tmp_path / "a.json").read_text()
    for edited in (text.replace("a.py", "b.py"), json.dumps(result())):
        (tmp_path / "a.json").write_text(edited)
        with pytest.raises(UserError, match="checksum"):
            keep("one", [str(tmp_path / "a.json")], tmp_path)
    with pytest.raises(UserError, match="labels"):
        keep("one", [str(tmp_path / "a.json")] * 2, tmp_path)
