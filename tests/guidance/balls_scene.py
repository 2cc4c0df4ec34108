"""A scene of balls and rods, on which everything has a closed form."""

from __future__ import annotations

import numpy as np

from devices.frame import ToolPose, ToolStatus, TrackerFrame
from guidance.budget import ErrorBudget
from guidance.needle import Needle
from guidance.scene import Entry, Scene, Structure, Target
from guidance.simulation import Rig
from tests.guidance.closed_form import Rod, ball

NEEDLE = Needle(150.0, 0.9)
RIG = Rig.usual(NEEDLE)


def balls_scene(**changes):
    """A ball-shaped organ with a target, a vessel across the far side, and a bag; `changes` replace Scene fields."""
    structures = (
        Structure("organ", ball([0, 0, 0], 75, fit_error=(0.2, 0.5, 2.0)), "entry"),
        Structure("tumour", ball([20, 0, 0], 10), "target"),
        Structure("vein", Rod([0, -40, -30], [10, 50, 20], 4), "avoid", 3.0),
        Structure("bag", Rod([40, -30, -40], [40, -10, -30], 12, fit_error=(0.1, 0.3, 0.8)), "avoid", 3.0),
    )
    parts = {
        "name": "balls",
        "structures": structures,
        "target": Target(np.array([20.0, 0.0, 0.0]), 5.0, "tumour"),
        "entry": Entry(structure="organ", count=200),
        "needle": NEEDLE,
        "errors": ErrorBudget(1.0, 0.3, 0.5),
    }
    return Scene(**{**parts, **changes})


def tip_pose(tip, direction):
    """T_patient_tip of a tip (3,) and a direction (3,)."""
    from guidance.rigid import pose

    return pose(tip, direction)


def frame_at(number, time_s, tip, direction, delay_s=0.0, error_mm=0.1):
    """A frame whose needle has its tip and direction there (patient's frame, through RIG)."""
    T = RIG.tool_pose(tip_pose(tip, direction))
    return TrackerFrame(number, time_s, time_s + delay_s, {RIG.tool: ToolPose(ToolStatus.OK, T, error_mm)})
