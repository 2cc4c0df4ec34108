"""Calibration: where is the tip in the tool, found by pivoting; and poses relative to a reference tool."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.frame import ToolStatus, TrackerFrame
from guidance.errors import GuidanceError, InputError
from guidance.rigid import invert, is_rigid

__all__ = [
    "CalibrationError",
    "PivotCalibration",
    "calibrate_pivot",
    "dwell_points",
    "find_pivot_dwells",
    "reference_relative_pose",
    "relative_poses",
]

Array = NDArray[np.float64]


class CalibrationError(GuidanceError, ValueError):
    """Motion that does not determine the tip; the message says what was missing."""


@dataclass(frozen=True, eq=False)
class PivotCalibration:
    """The tip of a tool, from pivoting about one or several resting points.

    Parameters
    ----------
    tip_mm : (3,) array
        Tip in the tool's frame.
    pivots_mm : (k, 3) array
        The resting points, in the frame of the poses, in the order of the dwells.
    rms_mm, max_mm : float
        Residual of the tip about its pivots, over the poses used.
    tip_error_mm : float
        Standard error of the tip in its worst direction if residuals are independent.
    spread_rad : float
        rms angle of the motion in the direction that the motion determines least; 0 where it was static or a swing
        about one axis.
    used : (n,) bool array
        False where a pose was refused as an outlier, or belongs to no dwell.
    dwells : tuple of (start, stop)
        Ranges of rows, one per pivot.
    """

    tip_mm: Array
    pivots_mm: Array
    rms_mm: float
    max_mm: float
    tip_error_mm: float
    spread_rad: float
    used: NDArray[np.bool_]
    dwells: tuple[tuple[int, int], ...]

    @property
    def T_tool_tip(self) -> Array:
        """(4, 4) transform with the tool's own axes and the tip as origin, mm."""
        T = np.eye(4)
        T[:3, 3] = self.tip_mm
        return T


def _checked_poses(T: ArrayLike, name: str) -> Array:
    poses = np.array(T, dtype=np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise InputError(f"{name}: expected (n, 4, 4) poses in mm, got shape {poses.shape}")
    wrong = [row for row, pose in enumerate(poses) if not is_rigid(pose)]
    if wrong:
        raise InputError(
            f"{name}: poses {wrong[:8]} are not rigid or not finite; leave frames without a trusted pose out"
        )
    return poses


def _solve(poses: Array, groups: Sequence[NDArray[np.intp]]) -> tuple[Array, Array, Array, float]:
    """Tip, pivots (k, 3), residual vectors per pose (groups in a row), smallest rms spread of the rotations.

    R_i tip + t_i = pivot of the group. The pivots drop out by taking each group's mean away.
    """
    rows, right = [], []
    for group in groups:
        R, t = poses[group, :3, :3], poses[group, :3, 3]
        rows.append((R - R.mean(axis=0)).reshape(-1, 3))
        right.append(-(t - t.mean(axis=0)).reshape(-1))
    matrix, vector = np.concatenate(rows), np.concatenate(right)
    tip, _, _, singular = np.linalg.lstsq(matrix, vector, rcond=None)
    pivots = np.array([(poses[group, :3, :3] @ tip + poses[group, :3, 3]).mean(axis=0) for group in groups])
    residuals = (matrix @ tip - vector).reshape(-1, 3)
    return tip, pivots, residuals, float(singular[-1]) / math.sqrt(len(matrix) / 3)


def _calibrate(
    poses: Array, dwells: Sequence[tuple[int, int]], least_spread_rad: float, most_rms_mm: float
) -> PivotCalibration:
    used = np.zeros(len(poses), dtype=bool)
    for start, stop in dwells:
        used[start:stop] = True
    total = int(used.sum())
    while True:
        groups = [start + np.flatnonzero(used[start:stop]) for start, stop in dwells]
        tip, pivots, residuals, spread = _solve(poses, groups)
        size = np.linalg.norm(residuals, axis=1)
        # 1.48 × the median per axis is a standard deviation that outliers do not move; 0.05 mm is a tracker's grain
        limit = max(5.0 * float(np.median(size)), 0.05)
        bad = np.concatenate(groups)[size > limit]
        if len(bad) == 0 or used.sum() - len(bad) < 0.8 * total:
            break
        used[bad] = False
    if spread < least_spread_rad:
        raise CalibrationError(
            f"the tool turned too little: {math.degrees(spread):.2f}° rms about its least-used axis, at least "
            f"{math.degrees(least_spread_rad):.2f}° needed; swing the tool in a cone of ±20° about the resting tip, "
            "in all directions"
        )
    rms = float(np.sqrt((size**2).mean()))
    if rms > most_rms_mm:
        raise CalibrationError(
            f"the tip did not rest: residual {rms:.2f} mm rms, at most {most_rms_mm:g} mm allowed; "
            "hold the tip in a divot and leave its way in and out of the recording"
        )
    error = rms / (spread * math.sqrt(3.0 * len(size)))
    return PivotCalibration(tip, pivots, rms, float(size.max()), error, spread, used, tuple(dwells))


def calibrate_pivot(
    T_tracker_tool: ArrayLike, least_spread_rad: float = 0.05, most_rms_mm: float = 2.0
) -> PivotCalibration:
    """Find the tip of a tool that was swung about its resting tip.

    Parameters
    ----------
    T_tracker_tool : (n, 4, 4) array_like
        Poses, mm, in any frame in which the resting point rests; n ≥ 10.
    least_spread_rad : float
        Least rms angle about the axis that was used least. A swing in one plane leaves the tip free along its axis; it
        is refused as a static tool is, though least squares would return numbers for both.
    most_rms_mm : float
        Largest rms residual: a tip that slid is refused.

    Returns
    -------
    PivotCalibration

    Raises
    ------
    InputError
        Where a pose is not rigid or not finite.
    CalibrationError
        Where the motion does not determine the tip or the tip did not rest.
    """
    poses = _checked_poses(T_tracker_tool, "T_tracker_tool")
    if len(poses) < 10:
        raise CalibrationError(f"{len(poses)} poses, at least 10 are needed")
    return _calibrate(poses, [(0, len(poses))], least_spread_rad, most_rms_mm)


def find_pivot_dwells(
    times_s: ArrayLike,
    T_frame_tool: ArrayLike,
    shortest_s: float = 2.0,
    radius_mm: float = 2.0,
    least_spread_rad: float = 0.03,
) -> PivotCalibration:
    """Find the places where an uncalibrated tool pivoted on its tip, and the tip, in one free-hand recording.

    Windows of `shortest_s` in which a resting tip explains the motion give a first tip; the tip's path then shows the
    dwells, and all dwells together the final tip. Where the tool only lay still, nothing tells where its tip is: that
    is no dwell.

    Parameters
    ----------
    times_s : (n,) array_like
        Rising, s.
    T_frame_tool : (n, 4, 4) array_like
        Poses in the frame of the thing that is touched (a reference tool), mm.
    shortest_s : float
        Shortest dwell.
    radius_mm : float
        Farthest that the tip may be from the middle of its dwell.
    least_spread_rad : float
        Least rms angle of all dwells together about their least-used axis.

    Returns
    -------
    PivotCalibration
        With one pivot per dwell, in order of time.

    Raises
    ------
    CalibrationError
        Where no dwell is found.
    """
    poses = _checked_poses(T_frame_tool, "T_frame_tool")
    times = np.asarray(times_s, dtype=np.float64)
    if times.shape != (len(poses),) or not (np.diff(times) > 0.0).all():
        raise InputError(f"times_s: expected {len(poses)} rising times, got shape {times.shape}")
    tip = _tip_from_windows(times, poses, shortest_s)
    dwells: list[tuple[int, int]] = []
    for _ in range(3):
        dwells = _resting_runs(times, _tip_path(poses, tip), shortest_s, radius_mm)
        dwells = [(start, stop) for start, stop in dwells if _spread(poses[start:stop]) > 0.2 * least_spread_rad]
        if not dwells:
            raise CalibrationError("no dwell found: the tip never rested while the tool was swung about it")
        groups = [np.arange(start, stop) for start, stop in dwells]
        tip = _solve(poses, groups)[0]
    return _calibrate(poses, dwells, least_spread_rad, radius_mm)


def dwell_points(T_frame_tool: ArrayLike, dwells: Sequence[tuple[int, int]], tip_mm: ArrayLike) -> Array:
    """Where a known tip rested in each dwell: the median of its path there, mm.

    `PivotCalibration.pivots_mm` are the centres of the motion; with a ball-ended or blunt tip they lie inside the tip.
    To register with a tip known from elsewhere (its drawing, a better calibration), take these points.

    Parameters
    ----------
    T_frame_tool : (n, 4, 4) array_like
    dwells : sequence of (start, stop)
        As `find_pivot_dwells` gives them.
    tip_mm : (3,) array_like
        In the tool's frame.

    Returns
    -------
    (k, 3) ndarray
    """
    path = _tip_path(_checked_poses(T_frame_tool, "T_frame_tool"), np.asarray(tip_mm, dtype=np.float64))
    return np.array([np.median(path[start:stop], axis=0) for start, stop in dwells])


def _tip_path(poses: Array, tip: Array) -> Array:
    return np.asarray(poses[:, :3, :3] @ tip + poses[:, :3, 3])


def _spread(poses: Array) -> float:
    return _solve(poses, [np.arange(len(poses))])[3]


def _tip_from_windows(times: Array, poses: Array, window_s: float) -> Array:
    """Tip that most windows agree on: each solved alone, those that rest and turn weighed by how well they tell."""
    step_s = window_s / 4.0
    tips, weights = [], []
    for begin in np.arange(times[0], times[-1] - window_s, step_s):
        rows = np.flatnonzero((times >= begin) & (times < begin + window_s))
        if len(rows) < 10:
            continue
        tip, _, residuals, spread = _solve(poses, [rows])
        rms = float(np.sqrt((residuals**2).sum(axis=1).mean()))
        # a window tells the tip to rms/spread; 50 mm would be no help
        if rms < 1.0 and spread > 0.02:
            tips.append(tip)
            weights.append((spread / max(rms, 0.05)) ** 2)
    if not tips:
        raise CalibrationError(
            f"no {window_s:g} s found in which the tool turned about a resting tip; swing it while the tip rests"
        )
    return np.array([_weighted_median(axis, np.array(weights)) for axis in np.array(tips).T])


def _weighted_median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(share, 0.5 * share[-1])])


def _resting_runs(times: Array, path: Array, shortest_s: float, radius_mm: float) -> list[tuple[int, int]]:
    """Longest runs (start, stop) in which a path stays within a radius of its own middle, left to right."""
    runs: list[tuple[int, int]] = []
    start = 0
    while start < len(path):
        stop = int(np.searchsorted(times, times[start] + shortest_s)) + 1
        if stop > len(path):
            break
        if not _within(path[start:stop], radius_mm):
            start += 1
            continue
        while stop < len(path) and _within(path[start : stop + 1], radius_mm):
            stop += 1
        middle = path[start:stop].mean(axis=0)
        previous = path[slice(*runs[-1])].mean(axis=0) if runs else None
        if (
            previous is not None
            and np.linalg.norm(middle - previous) < radius_mm
            and start - runs[-1][1] < stop - start
        ):
            runs[-1] = (runs[-1][0], stop)  # a short slip and back: the same dwell
        else:
            runs.append((start, stop))
        start = stop
    return runs


def _within(path: Array, radius_mm: float) -> bool:
    return bool((((path - path.mean(axis=0)) ** 2).sum(axis=1) <= radius_mm**2).all())


def relative_poses(T_tracker_reference: ArrayLike, T_tracker_tool: ArrayLike) -> Array:
    """T_reference_tool of poses measured together: what the reference sees, however tracker and patient move.

    Parameters
    ----------
    T_tracker_reference, T_tracker_tool : (..., 4, 4) array_like
        Poses of the same frames, mm.

    Returns
    -------
    (..., 4, 4) ndarray
    """
    return np.asarray(invert(T_tracker_reference) @ np.asarray(T_tracker_tool, dtype=np.float64))


def reference_relative_pose(frame: TrackerFrame, tool: str, reference: str) -> Array | None:
    """T_reference_tool of one frame, mm, or None unless both tools are `OK` and rigid in it."""
    poses = []
    for name in (reference, tool):
        pose = frame.tools.get(name)
        if pose is None or pose.status is not ToolStatus.OK or not is_rigid(pose.T_tracker_tool):
            return None
        poses.append(pose.T_tracker_tool)
    return relative_poses(poses[0], poses[1])  # type: ignore[arg-type]
