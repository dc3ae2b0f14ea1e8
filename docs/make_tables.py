"""Puts the tables of docs/results into README and docs: `make tables`; a test compares them.

A table stands where a page has its first line. Under it stands how its files were made
(`provenance.py`). For a new table write a function in one of the modules of tables, add it to
TABLES, write its first line into the page, and call `make tables`.
"""

from collections.abc import Iterable
from functools import partial

from docs import (
    application_tables,
    code_tables,
    recorded_tables,
    simulated_tables,
    simulator_tables,
)
from docs.provenance import NOTE, ROOT, format_note
from docs.reading import USED

TABLES = {
    "README.md": (
        partial(recorded_tables.tabulate_real_skin, "pins"),
        simulated_tables.tabulate_standard_first,
    ),
    "docs/benchmark.md": (
        recorded_tables.tabulate_edge_benchmark,
        recorded_tables.tabulate_surface_benchmark,
    ),
    "docs/pairings.md": (recorded_tables.tabulate_pairings,),
    "docs/another-day.md": (
        recorded_tables.tabulate_other_recordings,
        recorded_tables.tabulate_adapted,
    ),
    "docs/few-labels.md": (
        recorded_tables.tabulate_few_labels,
        recorded_tables.tabulate_simulated_slides,
    ),
    "docs/how-many-contacts.md": (
        partial(recorded_tables.tabulate_contacts, "edge_2d"),
        partial(recorded_tables.tabulate_contacts, "surface_3d"),
    ),
    "docs/several-tasks.md": (
        recorded_tables.tabulate_tasks,
        recorded_tables.tabulate_taps_alone,
    ),
    "docs/skin.md": (recorded_tables.tabulate_released_skin, recorded_tables.tabulate_transfer),
    "docs/unshear-or-directly.md": (
        partial(recorded_tables.tabulate_rivals, "rivals"),
        partial(recorded_tables.tabulate_rivals, "rivals_block"),
        partial(recorded_tables.tabulate_real_skin, "images"),
        recorded_tables.tabulate_rivals_images,
        recorded_tables.tabulate_rivals_epochs,
    ),
    "docs/calibration.md": (
        simulator_tables.tabulate_fits,
        simulator_tables.tabulate_fitted_images,
        simulator_tables.tabulate_validation,
        simulator_tables.tabulate_refit,
    ),
    "docs/simulator-checks.md": (
        simulator_tables.tabulate_problems,
        simulator_tables.tabulate_large_strain,
        simulator_tables.tabulate_levels,
    ),
    "docs/negative-results.md": (
        recorded_tables.tabulate_rival_differences,
        simulated_tables.tabulate_shear_code,
        code_tables.tabulate_parted_leaks,
    ),
    "docs/pins.md": (application_tables.tabulate_detected_pins,),
    "docs/geometry.md": (application_tables.tabulate_geometry,),
    "docs/contour-following.md": (
        application_tables.tabulate_servo,
        application_tables.tabulate_servo_pins,
    ),
    "docs/objects.md": (application_tables.tabulate_objects,),
    "docs/disentangling-recorded.md": (
        code_tables.tabulate_parted_skin,
        code_tables.tabulate_parted_skin_errors,
        code_tables.tabulate_parted_skin_images,
        code_tables.tabulate_parted_skin_images_errors,
    ),
    "docs/disentangling-simulated.md": (
        code_tables.tabulate_parted_leaks,
        code_tables.tabulate_parted_pins,
        code_tables.tabulate_end_to_end,
        code_tables.tabulate_end_to_end_exchanged,
    ),
    "docs/slides.md": (code_tables.tabulate_slide_read, recorded_tables.tabulate_joint),
    "docs/experiments.md": (
        simulated_tables.tabulate_standard,
        simulated_tables.tabulate_recoveries,
        simulated_tables.tabulate_demo,
    ),
    "docs/layouts.md": (simulated_tables.tabulate_layouts,),
    "docs/pads.md": (simulated_tables.tabulate_pad,),
    "docs/pose-estimators.md": (simulated_tables.tabulate_ridge,),
    "docs/error-against-time.md": (
        simulated_tables.tabulate_frontier,
        simulated_tables.tabulate_perception,
    ),
    "docs/paper-training.md": (
        simulated_tables.tabulate_tenth,
        simulated_tables.tabulate_tenth_poses,
        simulated_tables.tabulate_short,
    ),
    "docs/ablations.md": (
        simulated_tables.tabulate_shear_code,
        simulated_tables.tabulate_lambda_split,
        simulated_tables.tabulate_regularisation,
    ),
    "docs/cluster.md": (application_tables.tabulate_sizes,),
    "docs/exported-files.md": (application_tables.tabulate_exported_speed,),
    "docs/stream.md": (application_tables.tabulate_filter,),
    "docs/worn-dome.md": (application_tables.tabulate_lost_pins,),
    "docs/touch.md": (
        application_tables.tabulate_touch,
        application_tables.tabulate_recorded_touch,
    ),
    "docs/explore.md": (application_tables.tabulate_explorer,),
    "docs/speed.md": (
        simulator_tables.tabulate_training,
        simulator_tables.tabulate_inference,
        application_tables.tabulate_stream,
        simulator_tables.tabulate_omissions,
        application_tables.tabulate_input,
        application_tables.tabulate_pin_networks,
    ),
    "docs/faults.md": (application_tables.tabulate_faults,),
    "docs/limits.md": (
        simulated_tables.tabulate_few_pairs,
        simulated_tables.tabulate_twisted,
        simulated_tables.tabulate_tilted,
    ),
}


def make_tables(page: str) -> list[tuple[str, str]]:
    """Return the tables of a page in its order, each with its note."""
    tables = []
    for tabulate in TABLES[page]:
        USED.clear()
        table = tabulate()
        tables.append((table, format_note(dict.fromkeys(USED), page)))
    return tables


def replace_tables(text: str, tables: Iterable[tuple[str, str]]) -> str:
    """Return the text of a page with each table in the place of the one with the same first line.

    Notes under tables are replaced with them. Of several tables that begin alike each takes the
    next place. Raises LookupError if there is none.
    """
    lines, after = text.splitlines(), dict[str, int]()
    for table, note in tables:
        head = table.splitlines()[0]
        try:
            start = lines.index(head, after.get(head, 0))
        except ValueError:
            raise LookupError(
                f"no table is left that begins with {head!r}: write this line where it belongs"
            ) from None
        end = start
        while end < len(lines) and lines[end].startswith("|"):
            end += 1
        if lines[end + 1 : end + 2] and lines[end + 1].startswith(NOTE):
            end += 2
        replacement = [*table.splitlines(), "", note]
        lines[start:end] = replacement
        after[head] = start + len(replacement)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    for page in TABLES:
        path = ROOT / page
        before = path.read_text()
        after = replace_tables(before, make_tables(page))
        path.write_text(after)
        change = "changed" if after != before else "as they were"
        print(f"{page}: {len(TABLES[page])} tables, {change}")
