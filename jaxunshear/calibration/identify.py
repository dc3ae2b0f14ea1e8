"""Friction and the ratio of the moduli from where pins are seen: gradients of the contact at work.

Pins are simulated for a sensor whose friction and skin:gel ratio the fit is not given, along finer increments than the fit will use,
and blurred by noise; the camera sees x and y only. The fit starts from guesses far off and knows the compliance at three
ratios. Two ways down: L-BFGS-B on the loss and its gradient (the transposed rule of `contact.implicit`), and Gauss-Newton on
the pins' Jacobian (the forward rule). Both work on logarithms, within bounds.

The Jacobian also says, before any fit, what each kind of motion can determine: `determines`.
"""

import io
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from jaxunshear.contact.gradient import PinModel, pin_model, pins
from jaxunshear.progress import Progress
from jaxunshear.scene.paths import Paths
from jaxunshear.settings.sensor import TACTIP_331
from jaxunshear.storage import Json, write_bytes

KNOTS = (3.0, 10.0, 30.0)  # skin:gel ratios at which the compliance is computed
BOUNDS = np.log([[0.05, 3.0], [KNOTS[0], KNOTS[-1]]])
TRUTH = np.array([0.55, 17.0])  # friction and ratio
NOISE_MM = 0.02
STARTS = ((0.2, 4.0), (0.2, 25.0), (1.5, 4.0), (1.5, 25.0))  # friction and ratio
STIMULUS = "disk"
GRID = 8  # values of each, at which the figure's contours are computed
EVALUATIONS = 15  # of Gauss-Newton, at most
GROUPS = {  # from (x, y) mm: down to a depth in mm, then along (dx, dy) mm
    "press": ((-2.0, 0.0, 2.0, 0.0, 0.0), (0.0, 1.0, 1.5, 0.0, 0.0)),
    "partial slip": ((-2.0, 0.0, 2.0, 0.4, 0.2), (0.0, 1.0, 1.5, -0.4, 0.3)),
    "full slip": ((-2.0, 0.0, 2.0, 1.5, 0.8), (0.0, 1.0, 1.5, -1.0, 1.5)),
}


class Descent(NamedTuple):
    """One fit: (I, 2) friction and ratio at each evaluation, and the loss (I,) there, 1 where only noise is left."""

    tried: np.ndarray
    loss: np.ndarray
    best: np.ndarray  # (2,)
    seconds: float


def scenes() -> tuple[Paths, np.ndarray]:
    """The motions, and the name (B,) of the group of each."""
    motions = [(name, motion) for name, group in GROUPS.items() for motion in group]
    points = np.zeros((len(motions), 3, 6))
    for row, (_, (x, y, depth, dx, dy)) in zip(points, motions, strict=True):
        row[:, :2] = [[x, y], [x, y], [x + dx, y + dy]]
        row[1:, 3] = depth
    count = len(motions)
    return Paths(np.zeros(count, int), np.full(count, TRUTH[0]), points), np.array([name for name, _ in motions])


def seen(model: PinModel, points: jax.Array, theta: jax.Array) -> jax.Array:
    """Pins (B, P, 2) mm in x and y at theta = log(friction), log(skin : gel modulus)."""
    friction = jnp.broadcast_to(jnp.exp(theta[0]), points.shape[:1])
    return pins(model, points, friction, theta[1]).pins[..., :2]


@jax.jit
def _loss(model: PinModel, points: jax.Array, theta: jax.Array, target: jax.Array, noise_mm: float) -> jax.Array:
    return jnp.mean((seen(model, points, theta) - target) ** 2) / noise_mm**2


_loss_and_slope = jax.jit(jax.value_and_grad(_loss, argnums=2))


@jax.jit
def jacobian(model: PinModel, points: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """`seen`, and its derivatives (B, P, 2, 2) by theta."""
    push = lambda tangent: jax.jvp(lambda x: seen(model, points, x), (theta,), (tangent,))  # noqa: E731
    return jax.vmap(push, out_axes=(None, -1))(jnp.eye(2, dtype=theta.dtype))


def lbfgs(model: PinModel, points: jax.Array, target: jax.Array, start: tuple[float, float]) -> Descent:
    """Down the loss by its gradient (scipy's L-BFGS-B)."""
    tried: list[np.ndarray] = []
    losses: list[float] = []
    begin = time.perf_counter()

    def evaluate(theta: np.ndarray) -> tuple[float, np.ndarray]:
        loss, slope = _loss_and_slope(model, points, jnp.asarray(theta), target, NOISE_MM)
        tried.append(theta.copy())
        losses.append(float(loss))
        return losses[-1], np.asarray(slope, float)

    minimize(evaluate, np.log(start), jac=True, method="L-BFGS-B", bounds=BOUNDS, options={"ftol": 1e-6, "maxfun": 60})
    return _descent(tried, losses, begin)


def gauss_newton(model: PinModel, points: jax.Array, target: jax.Array, start: tuple[float, float]) -> Descent:
    """Least squares on the linearised pins, at most half a decade a step; a step that worsens the loss is halved."""
    theta, step = np.log(start), np.zeros(2)
    tried: list[np.ndarray] = []
    losses: list[float] = []
    begin = time.perf_counter()
    while len(tried) < EVALUATIONS:
        found, slopes = jacobian(model, points, jnp.asarray(theta + step))
        miss = np.asarray(found - target).ravel()
        tried.append(theta + step)
        losses.append(float(np.mean(miss**2)) / NOISE_MM**2)
        if losses[-1] > min(losses):
            step = step / 2
        else:
            theta = theta + step
            step = -np.linalg.lstsq(np.asarray(slopes).reshape(-1, 2), miss, rcond=None)[0]
            step /= max(1.0, np.abs(step).max() / (np.log(10) / 2))
            step = np.clip(theta + step, *BOUNDS.T) - theta
        if np.abs(step).max() < 1e-5:
            break
    return _descent(tried, losses, begin)


def _descent(tried: list[np.ndarray], losses: list[float], begin: float) -> Descent:
    values = np.exp(np.array(tried))
    return Descent(values, np.array(losses), values[int(np.argmin(losses))], time.perf_counter() - begin)


METHODS: dict[str, Callable[..., Descent]] = {"L-BFGS-B": lbfgs, "Gauss-Newton": gauss_newton}


def determines(slopes: np.ndarray, group: np.ndarray) -> list[Json]:
    """What each group of scenes determines, from the Jacobian (B, P, 2, 2) by log(friction) and log(ratio).

    `*_mm`: rms motion of a pin in x and y per factor e. Singular values are over the noise: how many standard deviations all pins
    together move per unit of the best and the worst determined mixture, whose share of log(friction) is `best_friction`.
    `*_std`: standard deviation of each logarithm, both unknown; `correlation` of the two.
    """
    rows = []
    for name in [*dict.fromkeys(group), "all"]:
        chosen = slopes[(group == name) | (name == "all")]
        matrix = chosen.reshape(-1, 2) / NOISE_MM
        _, values, mixture = np.linalg.svd(matrix, full_matrices=False)
        spread = np.linalg.pinv(matrix.T @ matrix)
        friction_mm, ratio_mm = np.sqrt(np.mean(np.sum(chosen**2, axis=2), axis=(0, 1)))
        rows.append(
            {
                "kind": "determines",
                "scenes": str(name),
                "friction_mm": friction_mm,
                "ratio_mm": ratio_mm,
                "largest_singular": values[0],
                "smallest_singular": values[1],
                "best_friction": abs(mixture[0, 0]),
                "friction_std": np.sqrt(spread[0, 0]),
                "ratio_std": np.sqrt(spread[1, 1]),
                "correlation": spread[0, 1] / np.sqrt(spread[0, 0] * spread[1, 1]),
            }
        )
    return rows


def run(out: Path | None = None) -> Json:
    """The experiment: `rows` of kind "determines", "fit" and "step" (of a fit), and `text`; the figure identify.svg in `out`."""
    paths, group = scenes()
    steps = 2 + len(STARTS) * len(METHODS) + (GRID if out is not None else 0)
    with jax.enable_x64(True), Progress("identify", steps, unit="steps") as progress:
        points, theta = jnp.asarray(paths.points), jnp.log(TRUTH)
        actual = replace(TACTIP_331, skin_modulus_mpa=TRUTH[1] * TACTIP_331.gel_modulus_mpa)
        exact = seen(pin_model(actual, (STIMULUS,), paths, "reference"), points, theta)
        target = exact + NOISE_MM * np.random.default_rng(0).normal(size=exact.shape)
        progress.advance(1)
        model = pin_model(TACTIP_331, (STIMULUS,), paths, "default", ratios=KNOTS, wide=False)
        found, slopes = jacobian(model, points, theta)
        rows = determines(np.asarray(slopes), group)
        model_mm = float(jnp.sqrt(jnp.mean(jnp.sum((found - exact) ** 2, -1))))
        progress.advance(1)
        fits = {}
        for start in STARTS:
            for name, method in METHODS.items():
                fits[name, start] = method(model, points, target, start)
                progress.advance(1)
        rows += [_fit_row(name, start, fit, rows[-1], model_mm) for (name, start), fit in fits.items()]
        if out is not None:
            axes = [np.geomspace(*ends, GRID) for ends in ((0.12, 2.0), (KNOTS[0], KNOTS[-1]))]
            losses = np.zeros((GRID, GRID))
            for row, ratio in zip(losses, axes[1], strict=True):
                places = [jnp.log(jnp.array([friction, ratio])) for friction in axes[0]]
                row[:] = [_loss(model, points, place, target, NOISE_MM) for place in places]
                progress.advance(1)
            write_bytes(Path(out) / "identify.svg", _figure(fits, axes, losses))
    text = table(rows)
    for (name, start), fit in fits.items():
        named = {"kind": "step", "method": name, "start_friction": start[0], "start_ratio": start[1]}
        for k, (one, loss) in enumerate(zip(fit.tried, fit.loss, strict=True)):
            rows.append({**named, "evaluation": k, "friction": one[0], "ratio": one[1], "loss": loss})
    return {"rows": rows, "text": text}


def _fit_row(name: str, start: tuple[float, float], fit: Descent, reported: Json, model_mm: float) -> Json:
    """`*_std`: what noise alone would leave; `model_mm`: rms distance of the fit's pins, coarser in increments, nodes and the
    compliance between its knots, from the noiseless ones at the true values."""
    return {
        "kind": "fit",
        "method": name,
        "start_friction": start[0],
        "start_ratio": start[1],
        "evaluations": len(fit.loss),
        "friction": fit.best[0],
        "ratio": fit.best[1],
        "friction_error": fit.best[0] / TRUTH[0] - 1,
        "ratio_error": fit.best[1] / TRUTH[1] - 1,
        "friction_std": reported["friction_std"],
        "ratio_std": reported["ratio_std"],
        "loss": fit.loss.min(),
        "model_mm": model_mm,
        "seconds": fit.seconds,
    }


def table(rows: list[Json]) -> str:
    """Plain text."""
    lines = [
        "what each kind of motion determines (mm: rms motion of a pin per factor e; std: of the value, both unknown)"
    ]
    lines.append(
        f"{'':14} {'friction':>11} {'ratio':>11} {'singular values':>18} {'std friction':>13} {'std ratio':>10} {'corr.':>6}"
    )
    for row in (row for row in rows if row["kind"] == "determines"):
        lines.append(
            f"{row['scenes']:14} {row['friction_mm']:>8.4f} mm {row['ratio_mm']:>8.4f} mm "
            f"{row['largest_singular']:>9.1f}{row['smallest_singular']:>9.1f} {100 * row['friction_std']:>11.2f} % "
            f"{100 * row['ratio_std']:>8.2f} % {row['correlation']:>6.2f}"
        )
    lines += [
        "",
        f"{'method':14} {'start':>12} {'evaluations':>12} {'friction':>18} {'ratio':>18} {'loss':>7} {'time':>8}",
    ]
    for row in (row for row in rows if row["kind"] == "fit"):
        lines.append(
            f"{row['method']:14} {row['start_friction']:>6g}, {row['start_ratio']:>4g} {row['evaluations']:>12} "
            f"{row['friction']:>8.4f} ({100 * row['friction_error']:>+5.1f} %) {row['ratio']:>8.2f} ({100 * row['ratio_error']:>+5.1f} %) "
            f"{row['loss']:>7.3f} {row['seconds']:>6.1f} s"
        )
    return "\n".join(lines)


def _figure(fits: dict, axes: list[np.ndarray], losses: np.ndarray) -> bytes:
    """Loss over evaluations, and the way down over its contours."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from jaxunshear.style import STYLE

    styles = {"L-BFGS-B": ("#d9822b", "-"), "Gauss-Newton": ("#1f6feb", "--")}
    with rc_context(STYLE):
        figure = Figure(figsize=(8.6, 3.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        right.contour(*axes, np.log10(losses), levels=14, colors="#9aa4b2", linewidths=0.7)
        for number, ((name, _), fit) in enumerate(fits.items()):
            colour, dash = styles[name]
            label = name if number < len(styles) else None
            left.plot(np.arange(1, len(fit.loss) + 1), np.minimum.accumulate(fit.loss), dash, color=colour, label=label)
            better = np.flatnonzero(fit.loss == np.minimum.accumulate(fit.loss))
            right.plot(*fit.tried[better].T, dash, marker=".", markersize=4, linewidth=1.2, color=colour, label=label)
        right.plot(*TRUTH, "k+", markersize=12, label="truth")
        left.axhline(1, color="#8a93a3", linewidth=0.8)
        left.set(xlabel="evaluation", ylabel="best loss so far, over the noise", yscale="log")
        right.set(
            xscale="log",
            yscale="log",
            xlabel="friction",
            ylabel="skin : gel modulus",
            xlim=axes[0][[0, -1]],
            ylim=axes[1][[0, -1]],
        )
        left.legend()
        right.legend()
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()
