"""The report of a made-up run: complete, self-contained, escaped, and reproducible."""

import base64
import contextlib
import io
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from PIL import Image

from jaxunshear.errors import UserError
from jaxunshear.perception.drawing import MISSING, SURPLUS, compare_images
from jaxunshear.report import montage
from jaxunshear.report.html import encode_pixels
from jaxunshear.report.report import write_report


@pytest.fixture(scope="module")
def page(template, tmp_path_factory):
    """The report of the run as it was made, in a folder of its own."""
    folder = shutil.copytree(template, tmp_path_factory.mktemp("page") / "run")
    path = write_report(folder)
    assert path == folder / "report.html"
    return path


@pytest.fixture
def bare_run(made_up_run):
    """Without logs, whose curves take most of the time."""
    for log in made_up_run[0].glob("*/log.jsonl"):
        log.unlink()
    return made_up_run


def test_the_page_is_full_and_needs_nothing_else(page, read):
    html = page.read_text()
    reader = read(html)
    pictures = [address for address in reader.addresses if not address.startswith("#")]
    assert len(pictures) >= 15 + 4
    assert all(address.startswith("data:image/") for address in pictures)
    assert not re.search(r"url\(|@import", html)
    assert len(html) < 3_000_000
    for address in pictures:
        kind, data = address.split(";base64,")
        if kind.endswith("png"):
            Image.open(io.BytesIO(base64.b64decode(data))).verify()
        else:
            ElementTree.fromstring(base64.b64decode(data))


def test_the_figures_of_the_results_are_on_it(page, read_page):
    results = json.loads((page.parent / "results.json").read_text())
    text = read_page(page)
    for kind, group in (("disentangled", "overall"), ("sheared", "disk")):
        assert f"{results['ms_ssim'][kind][group]:.3f}" in text
    assert f"{results['pose_mae']['disentangled']['edge_mm']:.2f} mm" in text
    shown = ("ms_ssim@4", "simulated", "real", "passed", "0.93", "22.20", "DS(z_p,z_s)")
    for words in (*shown, "jaxunshear run", "0.10.1"):
        assert words in text
    assert "missed ·" not in text
    assert "8 min 18 s" in text  # the sum of times.json, which has grown since the evaluation
    assert "sum of its stages" in text and "killed outright is lost" in text


def test_what_readers_of_another_make_err_by_is_reported(page, bare_run, read_page, read_report):
    folder, results = bare_run
    reported = read_page(page).split("Pose errors of another estimator")[1]
    for reader, kinds in results["readers"].items():
        for errors in kinds.values():
            assert all(f"{value:.2f}" in reported for value in errors.values()), reader
    assert "kernel ridge on pixels: 3000 taps; kernel ridge on pins: 2999 taps" in reported
    assert "8 1 left out" in reported
    del results["readers"]  # of an earlier version
    assert "another estimator" not in read_report(folder, results)


def test_intervals_say_that_they_are_of_one_training(page, bare_run, read_page, read_report):
    folder, results = bare_run
    said = "Intervals are over test poses of one training and say nothing of other trainings."
    text = read_page(page)
    titles = ("How alike the images are", "Pose errors of PoseNet", "of another estimator")
    for title in titles:
        assert said in text.split(title)[1][:700], title
    del results["spread"]["over"]  # of an earlier version
    assert said not in read_report(folder, results)


def test_a_missed_bar_is_shown(bare_run):
    folder, results = bare_run
    results["ms_ssim"]["disentangled"]["overall"] = 0.89
    (folder / "results.json").write_text(json.dumps(results))
    html = write_report(folder).read_text()
    assert html.count("<span class=bad>missed</span>") == 1


def test_names_from_files_are_escaped_wherever_they_stand(made_up_run, read_page):
    folder, results = made_up_run
    name = "<script>\"'&</script>"
    shown = dict(np.load(folder / "montage.npz"))
    shown["stimulus"] = np.where(shown["stimulus"] == "disk", name, shown["stimulus"])
    np.savez(folder / "montage.npz", **shown)
    results |= {"experiment": name, "command": name}
    results["machine"]["processor"] = results["versions"][name] = name
    results["metric"]["ms_ssim"] = results["settings"]["name"] = name
    for part in (results["pose_by_stimulus"], results["contact"]):
        part[name] = part.pop(next(iter(part)))
    (folder / "results.json").write_text(json.dumps(results))
    (folder / "servo").mkdir()
    row = dict.fromkeys(("stimulus", "way"), name) | dict.fromkeys(("starts", "closed"), 1)
    row |= dict.fromkeys(("mean_mm", "p95_mm", "largest_mm", "perceive_ms"), 0)
    (folder / "servo" / "servo.json").write_text(json.dumps({"rows": [row], "command": name}))
    text = read_page(write_report(folder))  # which also refuses a script
    assert text.count(name) >= 12 and "<b>numbers & images</b>" in text


def test_the_same_run_gives_the_same_bytes(page, tmp_path):
    """Also where a report is there already."""
    folder = shutil.copytree(page.parent, tmp_path / "run")
    assert write_report(folder).read_bytes() == page.read_bytes()


def test_without_logs_and_times_the_rest_is_still_shown(bare_run, read_report):
    folder, _ = bare_run
    (folder / "times.json").unlink()
    text = read_report(folder)
    assert "no training logs" in text and "5 min 14 s" in text


def test_edge_angles_are_also_given_where_the_edge_has_one_direction(
    page, bare_run, read_page, read_report
):
    folder, results = bare_run
    assert "has one direction" not in read_page(page)
    spread = {"pose_mae": {"tap": {"edge_deg": [4.5, 5.6]}}}
    results["pose_smooth"] = {"pose_mae": {"tap": {"edge_deg": 5.04}}, "spread": spread}
    results["counts"]["test_smooth"] = 670
    text = read_report(folder, results)
    said = "whose nearest edge has one direction: tap (no slide) 5.0 [4.5, 5.6]"
    assert f"on the 93% of contacts {said}" in text


def test_nulls_are_shown_as_dashes(bare_run):
    folder, results = bare_run
    results["ms_ssim"]["sheared"]["disk"] = None
    results["spread"]["ms_ssim"]["sheared"]["disk"] = None
    for kind in ("entangled", "disentangled"):
        results["pin_error"][kind]["rms_px"] = None
    results["swap"].pop("DC(z_s)")
    recovery = results["pose_recovery"]
    recovery["disentangled"] = dict.fromkeys(recovery["disentangled"])
    (folder / "results.json").write_text(json.dumps(results))
    page = write_report(folder).read_text()
    assert "\u2013" in page.split("Where the pins are")[1] and "\u2013 px" in page


@pytest.mark.parametrize(
    ("table", "by"), [("pose_by_stimulus", "shape"), ("pose_by_depth", "depth")]
)
def test_recovery_is_reported_by_shape_and_by_depth(page, bare_run, table, by):
    folder, results = bare_run
    part, found = next((part, found) for part, found in results[table].items() if found)
    recovery = found["pose_recovery"]["disentangled"]["x_mm"]
    html = page.read_text()
    reported = html.split(f"<summary>By {by}</summary>")[1].split("</details>")[0]
    assert f"recovery, by {by}" in reported
    assert f"<td>{recovery:.2f} <small>" in reported.split(part)[1].split("</tr>")[0]
    del results[table]  # of an earlier version
    (folder / "results.json").write_text(json.dumps(results))
    assert f"By {by}" not in write_report(folder).read_text()


@pytest.mark.parametrize("name", ["results.json", "montage.npz"])
@pytest.mark.parametrize("damage", ["missing", "truncated"])
def test_damaged_files_are_named(made_up_run, name, damage):
    folder, _ = made_up_run
    path = folder / name
    full = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes(full[: len(full) // 2])
    with pytest.raises(UserError, match=name):
        write_report(folder)
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("name", ["settings", "pin_error"])
def test_results_of_another_kind_are_refused(made_up_run, name):
    folder, results = made_up_run
    del results[name]
    (folder / "results.json").write_text(json.dumps(results))
    with pytest.raises(UserError, match=rf"{name}.*evaluate"):
        write_report(folder)


def test_a_montage_with_a_spoilt_byte_or_a_missing_array_is_named(made_up_run):
    folder, _ = made_up_run
    path = folder / "montage.npz"
    full = path.read_bytes()
    found = []
    for place in range(100, len(full), len(full) // 20):
        path.write_bytes(full[:place] + bytes([full[place] ^ 0xFF]) + full[place + 1 :])
        with contextlib.suppress(UserError):  # nothing else: a traceback would end the test
            found.append(montage.read_montage(path))
    assert len(found) < 15
    path.write_bytes(full)
    arrays = dict(np.load(path))
    np.savez(path, **{name: array for name, array in arrays.items() if name != "tap"})
    with pytest.raises(UserError, match=r"montage\.npz is missing or damaged"):
        write_report(folder)


def test_a_run_that_unshears_nothing_is_held_against_no_bar(bare_run):
    folder, results = bare_run
    for table in ("ms_ssim", "pose_mae", "pose_recovery", "pose_ratio", "difference", "pin_error"):
        for kind in ("entangled", "disentangled"):
            results[table].pop(kind, None)
    (folder / "results.json").write_text(json.dumps(results))
    shown = dict(np.load(folder / "montage.npz"))
    kept = {name: array for name, array in shown.items() if "entangled" not in name}
    np.savez(folder / "montage.npz", **kept)
    text = write_report(folder).read_text()
    assert "passed" not in text.split("<h2")[0] and "Recovery" not in text


def test_a_simulated_run_may_have_other_targets(made_up_run, read_report):
    folder, results = made_up_run
    text = json.dumps(results)
    others = {"edge_mm": "y_mm", "edge_deg": "depth_mm", '"yaw_deg"': '"Rx_deg"'}
    for name, other in others.items():
        text = text.replace(name, other)
    reported = read_report(folder, json.loads(text))
    error = results["pose_mae"]["disentangled"]
    for words in (f"{error['x_mm']:.2f} mm", f"{error['yaw_deg']:.1f} deg"):
        assert words in reported
    assert all(f"Error in {name} " in reported for name in ("x", "Rx", "y"))
    assert "x mm paper" in reported and "yaw" not in reported.split("All settings")[0]
    assert "depth 0.7" in reported.split("Recovery, the part")[1]


def test_difference_colours():
    tap = np.array([[255, 255, 0, 0]], np.uint8)
    image = np.array([[255, 0, 255, 0]], np.uint8)
    colours = [[90, 90, 90], list(MISSING), list(SURPLUS), [0, 0, 0]]
    assert compare_images(image, tap)[0].tolist() == colours


def test_encoded_pixels_stay_the_same():
    pixels = np.arange(256, dtype=np.uint8).reshape(16, 16)
    data = base64.b64decode(encode_pixels(pixels).split(",")[1])
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(data))), pixels)
