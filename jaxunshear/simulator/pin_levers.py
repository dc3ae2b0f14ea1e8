"""Pins as rigid levers on a face of the mesh: the displacements of their tips."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxunshear.errors import UserError
from jaxunshear.simulator.mesh import Mesh, compute_shape_functions

_ON_AXIS_MM = 1e-9


def compute_interpolation(
    mesh: Mesh, points: Float[np.ndarray, "P 2"]
) -> Float[np.ndarray, "3 P V"]:
    """Compute the shape functions at points of the half-plane, and their slopes.

    Slopes are in r and in z. Newton's method finds the point in each near element. Where elements
    meet, the result is their mean; their slopes along the line where they meet agree.
    """
    centres = mesh.nodes[mesh.elements[:, :4]].mean(1)
    at = np.zeros((3, len(points), len(mesh.nodes)))
    for p, point in enumerate(points):
        near = mesh.elements[np.argsort(np.sum((centres - point) ** 2, -1))[:32]]
        local = np.zeros((len(near), 2))
        for _ in range(20):
            values, gradients = compute_shape_functions(local)
            jacobian = np.einsum("enl,enx->exl", gradients, mesh.nodes[near])
            miss = point - np.einsum("en,enx->ex", values, mesh.nodes[near])
            local = np.clip(local + np.linalg.solve(jacobian, miss[..., None])[..., 0], -1.5, 1.5)
        inside = np.abs(local).max(axis=1) < 1 + 1e-6
        if not inside.any():
            raise UserError(
                f"pin at r = {point[0]:.2f} mm, z = {point[1]:.2f} mm lies outside the gel: "
                "check the sensor's pins"
            )
        slopes = np.einsum("enl,elx->xen", gradients, np.linalg.inv(jacobian))
        for entries, matrix in zip((values, *slopes), at, strict=True):
            np.add.at(matrix[p], near[inside], entries[inside] / inside.sum())
    return at


@dataclass(frozen=True)
class PinLevers:
    """Rigid pins at Q places of a face, along its normal."""

    places: np.ndarray  # (Q, 2) r, z
    levers: np.ndarray  # (Q, 2) from the place to the tip
    at: np.ndarray  # (3, Q, V) as `compute_interpolation` returns it

    def motion(self, field: Float[np.ndarray, "V3 K"], m: int) -> Float[np.ndarray, "Q3 K"]:
        """Compute harmonic m of the tips' displacement from displacements `field`.

        With length L, normal n and linearised rotation a tip moves by
        u - L [(n . du/ds) t + (n . du/ds_theta) theta], t being the tangent in the half-plane. On
        the axis the face turns with harmonic 1 alone, and 1/r becomes a slope.
        """
        value, in_r, in_z = np.einsum(
            "xqv,vuk->xuqk", self.at, field.reshape(-1, 3, field.shape[1]), optimize=True
        )
        r, length = self.places[:, :1], np.linalg.norm(self.levers, axis=1)[:, None]
        n_r, n_z = np.divide(
            self.levers, length, out=np.zeros_like(self.levers), where=length > 0
        ).T[..., None]
        on_axis = r < _ON_AXIS_MM
        over_r = np.where(on_axis, in_r, value / np.where(on_axis, 1.0, r))
        turned = length * (~on_axis | (m == 1))
        along = turned * (
            n_r * (n_z * in_r[0] - n_r * in_z[0]) + n_z * (n_z * in_r[2] - n_r * in_z[2])
        )
        around = turned * (n_r * (m * over_r[0] + over_r[1]) + n_z * m * over_r[2])
        tips = value + np.stack([-along * n_z, around, along * n_r])
        return tips.swapaxes(0, 1).reshape(-1, field.shape[1])
