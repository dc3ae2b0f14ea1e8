"""The contact simulator against closed forms, another solver, and the symmetries that it must have.

    rows = verify()
    print(table(rows))
    ok = all(row.holds for row in rows)

Each of `CHECKS` is one problem, or a few that share their work. The half-space is the solver's own mesh, condensation and
friction; the dome is the sensor as everybody uses it.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from jaxunshear.progress import Progress
from jaxunshear.settings.sensor import TACTIP_331
from verification import elements, full_dome, laws, normal, periodic, shear
from verification.half_space import half_space
from verification.tables import Row, vanishes

INCOMPRESSIBLE = 0.499

Check = Callable[[], list[Row]]


def _on_half_space(check: Callable[..., list[Row]]) -> Check:
    return lambda: check(half_space(INCOMPRESSIBLE))


def compressible() -> list[Row]:
    """Where the normal load drags the surface inwards, which Cattaneo and Mindlin leave out."""
    return shear.cattaneo_mindlin(half_space(0.3, rings=9), np.array([7.5]), exact=False)


def large_strain() -> list[Row]:
    """What the model itself leaves out: no bar, as no solver of it could meet one."""
    from verification.model_error import model_error

    group = "the model's own error: linear dome against neo-Hookean, pressed flat without friction"
    rows = []
    for made in model_error(TACTIP_331):
        note = f"p95 {made.p95_px:.2f}, largest {made.max_px:.2f} px; force x {made.force_ratio:.3f}, radius x {made.radius_ratio:.3f}"
        note += f"; {made.material_px:.2f} px rms with exact kinematics and a linear law"
        note += f"; strain beyond 20 % in {100 * made.strained:.0f} % of the gel"
        words = f"{made.depth_mm:g} mm deep: rms error of the pins, px of their {made.motion_px:.1f} px rms motion"
        rows.append(
            vanishes(
                group, words, made.rms_px, made.motion_px, None, settled=made.converged, note=note
            )
        )
    return rows


_HALF_SPACE = (
    *(normal.hertz, normal.flat_punch, periodic.against_tamaas),
    *(shear.cattaneo_mindlin, shear.oblique, shear.cycle, shear.torsion),
)
_LAWS = (
    *(laws.of_the_compliance, laws.of_random_paths, laws.no_contact, laws.turned, laws.full_slip),
    *(laws.closed_loop, laws.of_increments, laws.of_tolerance),
)
_DOME = (
    *(full_dome.turned, full_dome.mirrored, full_dome.resumed, full_dome.frictionless),
    *(full_dome.edge_sweep, full_dome.tilted),
)
CHECKS: tuple[Check, ...] = (
    *(elements.patch_test, elements.made_up_orders),
    *(_on_half_space(check) for check in _HALF_SPACE),
    compressible,
    *(_on_half_space(check) for check in _LAWS),
    laws.scaled,
    *(partial(check, TACTIP_331) for check in _DOME),
    large_strain,
)


def verify(progress: Progress | None = None) -> list[Row]:
    """All rows; `progress` is advanced by one for each of `CHECKS`. Minutes on two cores."""
    rows = []
    for check in CHECKS:
        rows += check()
        if progress is not None:
            progress.advance(1)
    return rows
