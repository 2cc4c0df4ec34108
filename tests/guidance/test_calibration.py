"""Pivot calibration: the tip is found where the motion tells it, and refused where it does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from devices import ToolPose, ToolStatus, TrackerFrame
from devices.recording import read_recording
from guidance.calibration import (
    CalibrationError,
    calibrate_pivot,
    dwell_points,
    find_pivot_dwells,
    reference_relative_pose,
    relative_poses,
)
from guidance.errors import InputError
from guidance.registration import match_landmarks, register_landmarks
from guidance.rigid import invert, pose

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "tracker"
TIP = np.array([12.0, -3.0, 148.0])


def pivoting(
    n: int, cone_rad: float, noise_mm: float, seed: int = 0, pivot: tuple = (40.0, -80.0, -900.0)
) -> np.ndarray:
    """Poses of a tool whose tip rests on `pivot` while its axis wanders in a cone, with white noise."""
    generator = np.random.default_rng(seed)
    vectors = generator.uniform(-cone_rad, cone_rad, (n, 3))
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(vectors).as_matrix() @ Rotation.from_rotvec([0.3, 2.0, -0.4]).as_matrix()
    T[:, :3, 3] = np.asarray(pivot) - T[:, :3, :3] @ TIP + noise_mm * generator.standard_normal((n, 3))
    return T


def test_an_exact_pivot_gives_the_exact_tip() -> None:
    result = calibrate_pivot(pivoting(200, 0.4, 0.0))
    np.testing.assert_allclose(result.tip_mm, TIP, atol=1e-9)
    np.testing.assert_allclose(result.pivots_mm, [[40.0, -80.0, -900.0]], atol=1e-9)
    assert result.rms_mm < 1e-9
    np.testing.assert_allclose(result.T_tool_tip[:3, 3], TIP, atol=1e-9)


def test_the_stated_error_is_the_real_one() -> None:
    misses, stated = [], []
    for seed in range(60):
        result = calibrate_pivot(pivoting(150, 0.35, 0.3, seed))
        misses.append(result.tip_mm - TIP)
        stated.append(result.tip_error_mm)
        assert result.rms_mm == pytest.approx(0.3 * np.sqrt(3), rel=0.15)
    worst_axis = np.sqrt((np.array(misses) ** 2).mean(axis=0)).max()
    assert 0.5 * worst_axis < np.mean(stated) < 2.0 * worst_axis


def test_a_few_bad_poses_are_left_out() -> None:
    T = pivoting(200, 0.4, 0.2, seed=5)
    T[[20, 90, 150], :3, 3] += [30.0, -20.0, 10.0]
    result = calibrate_pivot(T)
    assert np.flatnonzero(~result.used).tolist() == [20, 90, 150]
    np.testing.assert_allclose(result.tip_mm, TIP, atol=0.3)


def test_static_and_narrow_motion_is_refused() -> None:
    with pytest.raises(CalibrationError, match="turned too little"):
        calibrate_pivot(np.tile(pose([1, 2, 3], [0, 0, 1]), (50, 1, 1)))
    with pytest.raises(CalibrationError, match="turned too little"):
        calibrate_pivot(pivoting(200, 0.02, 0.2))


def test_a_swing_about_one_axis_is_refused() -> None:
    angles = np.linspace(-0.6, 0.6, 100)
    T = np.tile(np.eye(4), (100, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.0, 0.6, 0.8])).as_matrix()
    T[:, :3, 3] = -T[:, :3, :3] @ TIP
    with pytest.raises(CalibrationError, match="all directions"):
        calibrate_pivot(T)


def test_a_sliding_tip_is_refused() -> None:
    T = pivoting(200, 0.4, 0.1)
    T[:, 0, 3] += np.linspace(0.0, 25.0, 200)
    with pytest.raises(CalibrationError, match="did not rest"):
        calibrate_pivot(T)


def test_poses_must_be_poses() -> None:
    T = pivoting(30, 0.4, 0.0)
    T[7, 0, 3] = np.nan
    with pytest.raises(InputError, match=r"\[7\]"):
        calibrate_pivot(T)
    with pytest.raises(InputError, match="shape"):
        calibrate_pivot(np.eye(4))
    with pytest.raises(CalibrationError, match="at least 10"):
        calibrate_pivot(pivoting(5, 0.4, 0.0))


def test_dwells_are_found_between_travels() -> None:
    pivots = np.array([[0.0, 0, 0], [60, 0, 10], [60, 50, -20]])
    parts = []
    for k, place in enumerate(pivots):
        parts.append(pivoting(80, 0.3, 0.1, seed=k, pivot=tuple(place)))
        travel = pivoting(30, 0.3, 0.1, seed=10 + k)
        travel[:, :3, 3] += np.random.default_rng(k).uniform(20, 80, (30, 3))
        parts.append(travel)
    T = np.concatenate(parts)
    still = np.tile(pose([300, 0, 0], [0, 1, 0]), (100, 1, 1))
    T = np.concatenate([still, T])
    result = find_pivot_dwells(np.arange(len(T)) / 20.0, T)
    assert len(result.dwells) == 3
    np.testing.assert_allclose(result.tip_mm, TIP, atol=0.2)
    np.testing.assert_allclose(result.pivots_mm, pivots, atol=0.2)
    np.testing.assert_allclose(dwell_points(T, result.dwells, TIP), pivots, atol=0.2)
    with pytest.raises(CalibrationError, match="resting tip"):
        find_pivot_dwells(np.arange(100) / 20.0, still)


def test_the_reference_takes_common_motion_away() -> None:
    generator = np.random.default_rng(2)
    T_reference_tool = pose([10, 20, 30], [1, 1, 0])
    common = np.array([pose(generator.normal(size=3) * 100, generator.normal(size=3)) for _ in range(5)])
    np.testing.assert_allclose(relative_poses(common, common @ T_reference_tool), [T_reference_tool] * 5, atol=1e-10)
    ok, lost = ToolPose(ToolStatus.OK, common[0]), ToolPose(ToolStatus.OUT_OF_VOLUME, common[1])
    frame = TrackerFrame(0, 0.0, 0.0, {"ref": ok, "tool": ToolPose(ToolStatus.OK, common[1]), "far": lost})
    np.testing.assert_allclose(reference_relative_pose(frame, "tool", "ref"), invert(common[0]) @ common[1], atol=1e-12)
    assert reference_relative_pose(frame, "far", "ref") is None
    assert reference_relative_pose(frame, "tool", "absent") is None


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared tracker recordings are not here")
def test_eight_landmarks_of_a_real_phantom() -> None:
    frames = read_recording(DATA / "plus" / "EightLandmarkPointsTrackedForPhantomRegistration.csv")
    T = np.array([reference_relative_pose(frame, "StylusToTracker", "ReferenceToTracker") for frame in frames])
    result = find_pivot_dwells([frame.time_s for frame in frames], T)
    assert len(result.dwells) == 8
    assert result.rms_mm <= 0.50
    landmarks = np.array(
        [
            [104.3, 5, 20],
            [104.3, 45, 20],
            [104.3, 45, 0],
            [104.3, -5, 0],
            [-34.3, 45, 15],
            [-34.3, -5, 20],
            [-34.3, -5, 0],
            [-34.3, 45, 0],
        ]
    )
    shuffled = landmarks[[3, 6, 1, 0, 7, 4, 2, 5]]
    # the stylus has a blunt tip: the centre it turns about lies 1.6 mm from the published tip
    assert np.linalg.norm(result.tip_mm - [108.565, 7.77385, 2.5389]) < 2.0
    points = dwell_points(T, result.dwells, [108.565, 7.77385, 2.5389])
    order = match_landmarks(points, shuffled)
    registration = register_landmarks(points, shuffled[order])
    assert registration.fiducial_registration_error_mm <= 0.40
    by_own_tip = register_landmarks(result.pivots_mm, shuffled[match_landmarks(result.pivots_mm, shuffled)])
    assert by_own_tip.fiducial_registration_error_mm < 1.5
