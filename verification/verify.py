"""The contact simulator against closed forms, another solver, and its symmetries.

    rows = run_verification()
    print(format_rows(rows))
    ok = all(row.holds for row in rows)

Each of `CHECKS` is one problem, or a few that share their work. The half-space is the solver's own
mesh, condensation and friction; the dome is the standard sensor.
"""

from collections.abc import Callable, Sequence
from functools import wraps

import numpy as np

from jaxunshear.config.sensor import TACTIP_331
from jaxunshear.progress import Progress
from verification import (
    elastic_layer,
    elements,
    full_dome,
    invariants,
    normal_contact,
    tamaas_comparison,
    tangential_contact,
)
from verification.half_space import make_half_space
from verification.selection import select_names
from verification.verification_rows import Row, Rows

INCOMPRESSIBLE = 0.499

Check = Callable[[], list[Row]]


def _on_half_space(check: Callable[..., list[Row]]) -> Check:
    @wraps(check)
    def run() -> list[Row]:
        return check(make_half_space(INCOMPRESSIBLE))

    return run


def _on_dome(check: Callable[..., list[Row]]) -> Check:
    @wraps(check)
    def run() -> list[Row]:
        return check(TACTIP_331)

    return run


def check_compressible() -> list[Row]:
    """Inform where the normal load drags the surface inwards, which the theory leaves out."""
    return tangential_contact.check_cattaneo_mindlin(
        make_half_space(0.3, rings=9), np.array([7.5]), exact=False
    )


def report_large_strain() -> list[Row]:
    """Report what the model itself leaves out: no bar, as no solver of it could meet one."""
    from verification.model_error import measure_model_error

    rows = Rows(
        "the model's own error: linear dome against neo-Hookean, pressed flat without friction"
    )
    for error in measure_model_error(TACTIP_331):
        note = (
            f"p95 {error.p95_px:.2f}, largest {error.max_px:.2f} px; "
            f"force x {error.force_ratio:.3f}, radius x {error.radius_ratio:.3f}; "
            f"{error.material_px:.2f} px rms with exact kinematics and a linear law; "
            f"strain beyond 20 % in {100 * error.strained:.0f} % of the gel"
        )
        words = (
            f"{error.depth_mm:g} mm deep: rms error of the pins, "
            f"px of their {error.motion_px:.1f} px rms motion"
        )
        settled = error.converged
        rows.expect_zero(words, error.rms_px, error.motion_px, note=note, settled=settled)
    return rows


_HALF_SPACE = (
    normal_contact.check_hertz,
    normal_contact.check_flat_punch,
    tamaas_comparison.compare_with_tamaas,
    tangential_contact.check_cattaneo_mindlin,
    tangential_contact.check_oblique,
    tangential_contact.check_cycle,
    tangential_contact.check_torsion,
)
_LAWS = (
    invariants.check_compliance,
    invariants.check_random_paths,
    invariants.check_no_contact,
    invariants.check_rotation,
    invariants.check_full_slip,
    invariants.check_closed_loop,
    invariants.check_increment_order,
    invariants.check_tolerance_order,
)
_DOME = (
    full_dome.check_rotation,
    full_dome.check_mirroring,
    full_dome.check_resuming,
    full_dome.check_frictionless,
    full_dome.check_edge_sweep,
    full_dome.check_tilt,
)
_CHECKS: tuple[Check, ...] = (
    elements.run_patch_test,
    elements.measure_manufactured_orders,
    *map(_on_half_space, _HALF_SPACE),
    check_compressible,
    *map(_on_half_space, _LAWS),
    invariants.check_scaling,
    *map(_on_dome, _DOME),
    elastic_layer.check_layer,
    report_large_strain,
)
CHECKS = {  # by names such as normal_contact.check_hertz
    f"{check.__module__.rpartition('.')[-1]}.{check.__name__}": check for check in _CHECKS
}


def run_verification(only: Sequence[str] = ()) -> list[Row]:
    """Run the checks whose name contains one of the words `only`, without words all: minutes.

    Raises UserError for a word that no name contains.
    """
    selected, rows = select_names(list(CHECKS), only), list[Row]()
    with Progress("verify", len(selected), unit="checks") as progress:
        for name in selected:
            rows += CHECKS[name]()
            progress.advance(1)
    return rows
