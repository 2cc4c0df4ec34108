"""The extended superquadric of a part, by Levenberg–Marquardt on its radial misses (PAPER §2.2; DESIGN §1, §3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hhsr.kernels.spline import HALF_RANGE, clamped_coefficients, periodic_coefficients
from hhsr.model import FloatArray, IntArray, Superquadric, frozen, rotation_matrix

# PAPER §2.2: weights of the constraint terms C1, C3, and the bound T on a spline's third derivative (rad⁻³).
ALPHA_SMOOTH = 1.0
ALPHA_VOLUME = 1.0
THIRD_DERIVATIVE_BOUND = 500.0
# C3 is one row on a part of unit size; at this share of the data rows it moves an axis that has data by 10⁻⁴ and
# still shrinks one that has none. The same share keeps logits finite and the centre near its start.
ROW_SHARE = 0.01
CENTRE_SHARE = 0.05
TURN_SHARE = 0.02
GROWTH = ((1, 1), (3, 3), (4, 4), (5, 5), (6, 6), (8, 8))
LEAST_GAIN = 0.03
MOST_STEPS = 40
LEAST_FALL = 1e-4
_TINY = 1e-9


class Start(NamedTuple):
    """Where a fit begins: centre (3,) mm, rotation vector (3,) rad."""

    centre: FloatArray
    rotation: FloatArray


class SuperquadricFit(NamedTuple):
    """centre (3,) mm; rotation (3,) rad or (0,): the axes as given; the superquadric; rms radial miss in mm."""

    centre: FloatArray
    rotation: FloatArray
    superquadric: Superquadric
    rms_mm: float


def fit_superquadric(
    points: FloatArray,
    start: Start,
    *,
    knots: bool = True,
    rotate: bool = True,
    most_numbers: int = 64,
    leash: float = CENTRE_SHARE,
) -> SuperquadricFit:
    """Fit a superquadric to surface points: three half axes, then six, then exponents with ever more knots.

    The misses are Eq. 4's, ‖P/β‖·|β − 1|, on the part scaled to unit size; knots are added while the error falls by
    at least 3 % in one of two steps.

    Parameters
    ----------
    points : (n, 3) mm, n ≥ 9; 125 to 1,000 spread over the part suffice (PAPER Fig. 2).
    start : a centre inside the part, and the axes to begin with.
    knots : whether exponents may leave 1. rotate : whether the axes may turn.
    most_numbers : most numbers that half axes and knots together may take, ≥ 6.
    leash : weight of the centre's distance from its start, in radii of the part; 10³ holds it fast.
    """
    size = float(np.sqrt(((points - start.centre) ** 2).sum(axis=1)).max())
    unit = (points - start.centre) / max(size, _TINY)
    reach = np.sqrt(((unit @ rotation_matrix(start.rotation)) ** 2).mean(axis=0))
    axes = np.log(np.maximum(1.7 * reach, 0.05))
    layout = _Layout(rotate, False, 0, 0, leash)
    values = np.concatenate([np.zeros(3), start.rotation if rotate else np.zeros(0), axes])
    fixed = np.zeros(3) if rotate else start.rotation
    values, error = _solve(layout, values, unit, fixed)
    layout, values = _six_axes(layout, values)
    values, error = _solve(layout, values, unit, fixed)
    failures = 0
    for azimuth, elevation in GROWTH if knots else ():
        if 6 + azimuth + elevation > most_numbers or failures == 2:
            break
        grown, wider = _grow(layout, values, azimuth, elevation)
        wider, lower = _solve(grown, wider, unit, fixed)
        if lower > (1.0 - LEAST_GAIN) * error:
            failures += 1
            continue
        layout, values, error, failures = grown, wider, lower, 0
    centre, rotation, log_axes, azimuth_logits, elevation_logits = layout.split(values, fixed)
    base = Superquadric(frozen(size * np.exp(log_axes)), frozen(azimuth_logits), frozen(elevation_logits))
    turned = rotation if rotation.any() else np.zeros(0)
    return SuperquadricFit(start.centre + size * centre, turned, base, size * error)


class _Layout(NamedTuple):
    """Which numbers the vector of unknowns holds: centre, rotation or not, log half axes (3 or 6), logits."""

    rotate: bool
    six: bool
    azimuth: int
    elevation: int
    leash: float

    def split(self, values: FloatArray, fixed: FloatArray) -> tuple[FloatArray, ...]:
        """Return centre (3,), rotation (3,), log half axes (6,), azimuth logits, elevation logits."""
        at = 6 if self.rotate else 3
        axes = values[at : at + 6] if self.six else np.repeat(values[at : at + 3], 2)
        at += 6 if self.six else 3
        rotation = values[3:6] if self.rotate else fixed
        return values[:3], rotation, axes, values[at : at + self.azimuth], values[at + self.azimuth :]


def _six_axes(layout: _Layout, values: FloatArray) -> tuple[_Layout, FloatArray]:
    """Return the layout and values with each half axis on its own."""
    at = 6 if layout.rotate else 3
    return layout._replace(six=True), np.concatenate([values[:at], np.repeat(values[at:], 2)])


def _grow(layout: _Layout, values: FloatArray, azimuth: int, elevation: int) -> tuple[_Layout, FloatArray]:
    """Return the layout with more knots; their values are those of the old splines at the new knots."""
    _, _, _, old_azimuth, old_elevation = layout.split(values, np.zeros(3))
    theta = np.arange(azimuth) / azimuth
    phi = np.arange(elevation) / max(elevation - 1, 1)
    kept = values[: values.size - layout.azimuth - layout.elevation]
    new = [
        kept,
        _evaluate(True, old_azimuth, theta),
        _evaluate(False, old_elevation, phi),
    ]
    return layout._replace(azimuth=azimuth, elevation=elevation), np.concatenate(new)


def _evaluate(periodic: bool, logits: FloatArray, share: FloatArray) -> FloatArray:
    """Return the spline's values at shares in [0, 1]; 0 without knots."""
    if logits.size == 0:
        return np.zeros(share.size)
    coefficients = np.einsum("ksp,k->sp", _basis_table(logits.size, periodic), logits)
    segment, x = _segment(coefficients.shape[0], share)
    return np.asarray((coefficients[segment] * np.stack([x**0, x, x**2, x**3], axis=1)).sum(axis=1))


def _segment(count: int, share: FloatArray) -> tuple[IntArray, FloatArray]:
    """Return each share's segment and its position within, in [0, 1]."""
    segment = np.clip((share * count).astype(np.int64), 0, count - 1)
    return segment, share * count - segment


def _solve(layout: _Layout, values: FloatArray, unit: FloatArray, fixed: FloatArray) -> tuple[FloatArray, float]:
    """Return the best values from where they stand, and their rms miss (unit size): Levenberg–Marquardt.

    scipy's least_squares took 20 times as long here: its bounded step factors an SVD, and asks twice for each point.
    """
    low, high = _bounds(layout, values.size)
    values = np.clip(values, low, high)
    rows, jacobian = _rows(layout, values, unit, fixed)
    cost, damping = float(rows @ rows), 1e-3
    for _ in range(MOST_STEPS):
        gram, slope = jacobian.T @ jacobian, jacobian.T @ rows
        scale = np.maximum(np.diag(gram), 1e-9)
        step = np.linalg.solve(gram + np.diag(damping * scale), -slope)
        tried = np.clip(values + step, low, high)
        new_rows, new_jacobian = _rows(layout, tried, unit, fixed)
        new_cost = float(new_rows @ new_rows)
        if not new_cost < cost:
            damping *= 8.0
            if damping > 1e6:
                break
            continue
        small = cost - new_cost < LEAST_FALL * cost
        values, rows, jacobian, cost = tried, new_rows, new_jacobian, new_cost
        damping = max(0.2 * damping, 1e-9)
        if small:
            break
    misses = rows[: unit.shape[0]]
    return values, float(np.sqrt((misses**2).mean()))


def _bounds(layout: _Layout, count: int) -> tuple[FloatArray, FloatArray]:
    """Return the range of each unknown: half axes from 1/20 to 3 radii of the part, exponents 0.104 … 1.896."""
    low, high = np.full(count, -10.0), np.full(count, 10.0)
    axes = slice(6 if layout.rotate else 3, count - layout.azimuth - layout.elevation)
    low[axes], high[axes] = math.log(0.05), math.log(3.0)
    logits = slice(count - layout.azimuth - layout.elevation, count)
    low[logits], high[logits] = -6.0, 6.0
    return low, high


def _rows(layout: _Layout, values: FloatArray, unit: FloatArray, fixed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residual rows and their Jacobian: Eq. 4's misses, then C1, C3, and the weak rows of `ROW_SHARE`.

    C2 asks for positive half axes and exponents: logarithms and logits cannot hold others.
    """
    centre, rotation, log_axes, azimuth, elevation = layout.split(values, fixed)
    turn = rotation_matrix(rotation)
    p = (unit - centre) @ turn
    length = np.sqrt((p * p).sum(axis=1)) + _TINY
    norm, by_point, by_axes, by_azimuth, by_elevation = norm_gradients(p, np.exp(log_axes), azimuth, elevation)
    norm = np.maximum(norm, 1e-6)
    by_norm = length / norm**2
    by_p = p / length[:, None] * (1.0 - 1.0 / norm)[:, None] + by_norm[:, None] * by_point
    columns = [-by_p @ turn.T]
    if layout.rotate:
        columns.append(np.cross(by_p, p) @ _right_jacobian(rotation))
    by_log = by_norm[:, None] * by_axes
    columns.append(by_log if layout.six else by_log[:, ::2] + by_log[:, 1::2])
    columns += [by_norm[:, None] * by_azimuth, by_norm[:, None] * by_elevation]
    extra, extra_jacobian = _constraint_rows(layout, values, fixed, unit.shape[0])
    return (
        np.concatenate([length * (1.0 - 1.0 / norm), extra]),
        np.concatenate([np.concatenate(columns, axis=1), extra_jacobian]),
    )


def _constraint_rows(
    layout: _Layout, values: FloatArray, fixed: FloatArray, data: int
) -> tuple[FloatArray, FloatArray]:
    """Return the rows of C1 (|f‴| > T), C3 (volume), the centre's leash and the logits' ridge, and their Jacobian."""
    log_axes = layout.split(values, fixed)[2]
    share = ROW_SHARE * math.sqrt(data)
    at = 6 if layout.rotate else 3
    columns = values.size
    pairs = np.exp(log_axes).reshape(3, 2)
    volume = ALPHA_VOLUME * share * float(pairs.sum(axis=1).prod()) / 8.0
    volume_row = np.zeros(columns)
    part = volume * pairs / pairs.sum(axis=1, keepdims=True)
    volume_row[at : at + (6 if layout.six else 3)] = part.ravel() if layout.six else part.sum(axis=1)
    leash = layout.leash * math.sqrt(data) * np.eye(3, columns)
    # A ball or a cube does not say how it is turned: without this row its axes spin.
    turn = TURN_SHARE * math.sqrt(data) * np.eye(3 if layout.rotate else 0, columns, k=3)
    logits = layout.azimuth + layout.elevation
    ridge = share * np.eye(logits, columns, k=columns - logits) if logits else np.zeros((0, columns))
    third = _third_derivatives(layout, columns)
    bend = third @ values
    over = ALPHA_SMOOTH * np.sign(bend) * np.maximum(np.abs(bend) - THIRD_DERIVATIVE_BOUND, 0.0)
    rows = np.concatenate([[volume], leash @ values, turn @ values, ridge @ values, over])
    jacobian = np.concatenate([volume_row[None], leash, turn, ridge, third * (over != 0.0)[:, None] * ALPHA_SMOOTH])
    return rows, jacobian


def _third_derivatives(layout: _Layout, columns: int) -> FloatArray:
    """Return the matrix that gives f‴ (rad⁻³) of each spline segment's logits from the vector of unknowns."""
    blocks = [np.zeros((0, columns))]
    start = columns - layout.azimuth - layout.elevation
    for count, span, periodic in ((layout.azimuth, 2.0 * math.pi, True), (layout.elevation, math.pi, False)):
        if count > 1:
            leading = _basis_table(count, periodic)[:, :, 3].T
            block = np.zeros((leading.shape[0], columns))
            block[:, start : start + count] = 6.0 * leading * (leading.shape[0] / span) ** 3
            blocks.append(block)
        start += count
    return np.concatenate(blocks)


def _right_jacobian(vector: FloatArray) -> FloatArray:
    """Return J with exp(ω + δ) ≈ exp(ω) exp(J δ), (3, 3)."""
    angle = float(np.sqrt((vector * vector).sum()))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-6:
        return np.eye(3) - 0.5 * cross
    return np.asarray(
        np.eye(3) - (1.0 - math.cos(angle)) / angle**2 * cross + (angle - math.sin(angle)) / angle**3 * (cross @ cross)
    )


def norm_gradients(
    points: FloatArray, half_axes: FloatArray, azimuth: FloatArray, elevation: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the superquadric norm N of points in its frame, and its derivatives.

    Returns
    -------
    N (n,); by the point (n, 3); by the logarithms of the half axes (n, 6); by azimuth logits; by elevation logits.
    """
    ring = np.sqrt(points[:, 0] ** 2 + points[:, 1] ** 2) + _TINY
    square = ring**2 + points[:, 2] ** 2
    theta = np.arctan2(points[:, 1], points[:, 0]) / (2.0 * math.pi) + 0.5
    phi = np.arctan2(points[:, 2], ring) / math.pi + 0.5
    e2, e2_slope, e2_knots = _exponent(True, azimuth, theta)
    e1, e1_slope, e1_knots = _exponent(False, elevation, phi)
    negative = points < 0.0
    chosen = np.where(negative, half_axes[1::2], half_axes[::2])
    scaled = np.maximum(np.abs(points) / chosen, _TINY)
    ring_norm, ring_x, ring_y, ring_e = _p_norm_gradients(scaled[:, 0], scaled[:, 1], e2)
    norm, norm_w, norm_z, norm_e1 = _p_norm_gradients(ring_norm, scaled[:, 2], e1)
    norm_e2 = norm_w * ring_e
    by_scaled = np.stack([norm_w * ring_x, norm_w * ring_y, norm_z], axis=1)
    by_point = by_scaled * np.where(negative, -1.0, 1.0) / chosen
    # The exponents are taken at the point's own azimuth and elevation, so they turn with it.
    turn_theta = norm_e2 * e2_slope / (2.0 * math.pi) / ring**2
    by_point[:, 0] -= turn_theta * points[:, 1]
    by_point[:, 1] += turn_theta * points[:, 0]
    turn_phi = norm_e1 * e1_slope / math.pi / square
    by_point[:, 0] -= turn_phi * points[:, 2] * points[:, 0] / ring
    by_point[:, 1] -= turn_phi * points[:, 2] * points[:, 1] / ring
    by_point[:, 2] += turn_phi * ring
    by_axes = np.zeros((points.shape[0], 6))
    by_axes[:, ::2] = np.where(negative, 0.0, -by_scaled * scaled)
    by_axes[:, 1::2] = np.where(negative, -by_scaled * scaled, 0.0)
    return norm, by_point, by_axes, norm_e2[:, None] * e2_knots, norm_e1[:, None] * e1_knots


@lru_cache(maxsize=64)
def _basis_table(count: int, periodic: bool) -> FloatArray:
    """Return the coefficients (knot, segment, power) of the splines that are 1 at one knot and 0 at the others."""
    coefficients: Callable[[FloatArray], FloatArray] = periodic_coefficients if periodic else clamped_coefficients
    return np.stack([coefficients(row) for row in np.eye(count)])


def _exponent(periodic: bool, logits: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ε (n,), dε/dshare (n,), dε/dlogits (n, k) of an exponent spline at shares of its range."""
    count = logits.size
    if count == 0:
        return np.ones(share.size), np.zeros(share.size), np.zeros((share.size, 0))
    table = _basis_table(count, periodic)
    segments = table.shape[1]
    segment, x = _segment(segments, share)
    power = np.stack([x**0, x, x**2, x**3], axis=1)
    basis = np.einsum("ksp,sp->sk", table[:, segment], power)
    slope = np.stack([0.0 * x, x**0, 2.0 * x, 3.0 * x**2], axis=1) * segments
    chosen = np.einsum("ksp,k->sp", table, logits)[segment]
    value, rise = (chosen * power).sum(axis=1), (chosen * slope).sum(axis=1)
    squash = np.tanh(0.5 * value)
    steep = 0.5 * HALF_RANGE * (1.0 - squash * squash)
    return 1.0 + HALF_RANGE * squash, steep * rise, steep[:, None] * basis


def _p_norm_gradients(
    x: FloatArray, y: FloatArray, exponent: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return M = (x^(2/ε) + y^(2/ε))^(ε/2) of x, y > 0, its derivatives by x, y and ε (M times half the entropy)."""
    power = 2.0 / exponent
    large = np.maximum(x, y)
    log_x, log_y = power * np.log(x / large), power * np.log(y / large)
    total = np.exp(log_x) + np.exp(log_y)
    norm = large * np.exp(0.5 * exponent * np.log(total))
    log_a, log_b = log_x - np.log(total), log_y - np.log(total)
    a, b = np.exp(log_a), np.exp(log_b)
    return norm, a * norm / x, b * norm / y, -0.5 * norm * (a * log_a + b * log_b)
