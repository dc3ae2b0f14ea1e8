"""A contact with duplicate nodes, whose compliance is singular."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxunshear.config.sensor import Sensor
from jaxunshear.simulator.contact_problem import (
    RHO,
    ContactProblem,
    System,
    count_node_states,
    make_undeformed_skins,
)
from jaxunshear.simulator.contacts import Contacts
from jaxunshear.simulator.dome import load_shared_dome
from jaxunshear.simulator.friction import Solver, follow_path
from jaxunshear.simulator.level import Level
from jaxunshear.simulator.paths import Paths, cut_increments
from jaxunshear.simulator.stimuli import sample_obstacles


def solve_with_duplicates(
    sensor: Sensor, points: np.ndarray, friction: float, level: Level, twice: int = 7
) -> Contacts:
    """Solve one path (K, 6) over the disk, with the first `twice` of the nodes once more."""
    full = load_shared_dome(sensor)
    count = len(full.nodes)
    index = np.concatenate([np.arange(count), np.arange(twice)])
    columns = (3 * index[:, None] + np.arange(3)).ravel()
    scale = np.trace(full.w) / len(full.w)
    w = full.w[np.ix_(columns, columns)] / scale
    inverse = np.linalg.inv(w + RHO * np.eye(len(w)))
    poses, _ = cut_increments(
        Paths(np.zeros(1, int), np.array([friction]), points[None]), level, sensor.radius_mm
    )
    with jax.enable_x64(level.precision == "float64"):
        fields = (w, inverse, w, full.nodes[index], sensor.pivot_mm, sensor.radius_mm)
        system = System(*(jnp.asarray(field, level.precision) for field in fields))
        path = jnp.asarray(poses[0, :, None], level.precision)
        mu = jnp.asarray([friction], level.precision)
        obstacles = sample_obstacles(("disk",))
        problem = ContactProblem(system, obstacles, jnp.zeros(1, jnp.int32), mu)
        skin, quality = follow_path(
            problem,
            path[1:],
            make_undeformed_skins(system, path[0]),
            Solver(level.tolerance, level.limit),
        )
        skin, quality, counts = jax.device_get((skin, quality, count_node_states(problem, skin)))
    force = skin.force[0].astype(np.float64) / scale
    pins = full.pins + (full.g[:, columns] @ force.ravel()).reshape(-1, 3)
    converged = (quality.residual_mm <= quality.tolerance_mm) & np.isfinite(pins).all()
    return Contacts(
        pins=pins[None],
        residual_mm=quality.residual_mm,
        converged=converged,
        iterations=quality.iterations,
        stuck_nodes=counts.stuck,
        slipping_nodes=counts.slipping,
        free_nodes=counts.free,
        force_n=force.sum(axis=0)[None],
        nodes=np.array([len(index)]),
        retried=np.zeros(1, bool),
    )
