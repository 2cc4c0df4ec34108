from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from devices.frame import ToolPose, ToolStatus, TrackerFrame
from guidance.errors import InputError
from guidance.limits import Limits
from guidance.monitor import Monitor
from guidance.states import State
from tests.guidance.balls_scene import RIG, balls_scene, frame_at

DOWN = np.array([-1.0, 0.0, 0.0])
DT = 1.0 / 30.0


def make_monitor(scene=None, **changes):
    args = {"T_patient_tracker": RIG.T_patient_tracker, "T_tool_tip": RIG.T_tool_tip, **changes}
    return Monitor(scene or balls_scene(), tool=RIG.tool, **args)


def drive(monitor, start, velocity, seconds, first=0, t0=0.0, direction=DOWN):
    """Frames of a needle that moves steadily; the reports."""
    reports = []
    for k in range(int(seconds / DT)):
        tip = np.asarray(start, float) + np.asarray(velocity, float) * k * DT
        reports.append(monitor.update(frame_at(first + k, t0 + k * DT, tip, direction)))
    return reports


def states(report):
    return {s.name: s.state for s in report.structures}


def bad_frames():
    T = RIG.tool_pose(np.eye(4))
    nan, scaled, mirrored = T.copy(), T.copy(), T.copy()
    nan[0, 0] = np.nan
    scaled[:3, :3] *= 1.01
    mirrored[:3, 0] *= -1.0
    ok = ToolStatus.OK
    tool = RIG.tool
    return {
        "NaN": {tool: ToolPose(ok, nan)},
        "infinite": {tool: ToolPose(ok, np.where(np.eye(4) > 0, np.inf, 0.0))},
        "scaled": {tool: ToolPose(ok, scaled)},
        "mirrored": {tool: ToolPose(ok, mirrored)},
        "missing": {tool: ToolPose(ToolStatus.MISSING, None)},
        "out of volume with a pose": {tool: ToolPose(ToolStatus.OUT_OF_VOLUME, T)},
        "disabled": {tool: ToolPose(ToolStatus.DISABLED, None)},
        "another tool": {"stylus": ToolPose(ok, T)},
        "no tools": {},
        "low quality": {tool: ToolPose(ok, T, 5.0)},
    }


def test_before_the_first_pose_everything_is_unknown():
    report = make_monitor().tick(0.0)
    assert set(states(report).values()) == {State.UNKNOWN}
    assert report.state is State.UNKNOWN
    assert report.events == ()


@pytest.mark.parametrize("tools", bad_frames().values(), ids=bad_frames().keys())
def test_what_cannot_be_trusted_is_unknown_at_once_and_never_clear(tools):
    monitor = make_monitor()
    before = drive(monitor, [140, 0, 0], [0, 0, 0], 0.5)[-1]
    assert before.state is State.CLEAR
    report = monitor.update(TrackerFrame(100, 0.6, 0.6, tools))
    assert set(states(report).values()) == {State.UNKNOWN}
    assert {e.after for e in report.events} == {State.UNKNOWN}
    assert len(report.events) == 4
    assert all(np.isnan(s.distance_mm) for s in report.structures)
    # silence after it does not make it known again, a good frame does
    assert monitor.tick(0.62).state is State.UNKNOWN
    assert monitor.update(frame_at(101, 0.65, [140, 0, 0], DOWN)).state is State.CLEAR


def test_silence_makes_everything_unknown_after_half_a_second():
    monitor = make_monitor()
    last = drive(monitor, [140, 0, 0], [0, 0, 0], 1.0)[-1]
    assert monitor.tick(last.time_s + 0.45).state is State.CLEAR
    report = monitor.tick(last.time_s + 0.55)
    assert report.state is State.UNKNOWN
    assert "0.55 s old" in report.structures[0].reason
    assert report.pose_age_s == pytest.approx(0.55)


def test_a_frame_that_arrives_too_late_is_unknown():
    report = make_monitor().update(frame_at(0, 0.0, [140, 0, 0], DOWN, delay_s=0.6))
    assert report.state is State.UNKNOWN


def test_repeated_and_late_frames_are_old_data():
    monitor = make_monitor()
    drive(monitor, [140, 0, 0], [0, 0, 0], 0.5)
    stuck = frame_at(14, 14 * DT, [140, 0, 0], DOWN)
    for now in np.arange(0.5, 0.9, 0.1):
        report = monitor.update(replace(stuck, arrival_s=float(now)))
        assert report.state is State.CLEAR
        assert report.pose_age_s == pytest.approx(now - 14 * DT)
    # the same number with another pose brings nothing either
    liar = frame_at(14, 0.95, [20, 0, 0], DOWN)
    assert monitor.update(liar).structure("tumour").state is State.CLEAR
    assert monitor.update(replace(stuck, arrival_s=1.1)).state is State.UNKNOWN


def test_a_restarted_tracker_is_believed_again():
    monitor = make_monitor()
    drive(monitor, [140, 0, 0], [0, 0, 0], 0.5, first=1000)
    assert monitor.tick(2.0).state is State.UNKNOWN
    assert monitor.update(frame_at(0, 2.1, [140, 0, 0], DOWN)).state is State.CLEAR


@pytest.mark.parametrize("missing", ["T_patient_tracker", "T_tool_tip"])
def test_unregistered_or_uncalibrated_is_unknown(missing):
    monitor = make_monitor(**{missing: None})
    report = drive(monitor, [140, 0, 0], [0, 0, 0], 0.2)[-1]
    assert set(states(report).values()) == {State.UNKNOWN}
    assert missing in report.structures[0].reason


def test_a_registration_that_is_not_rigid_is_refused():
    with pytest.raises(InputError, match="T_patient_tracker"):
        make_monitor(T_patient_tracker=np.diag([1.0, 1.0, -1.0, 1.0]))


def test_a_missing_model_is_unknown_while_the_others_are_watched():
    scene = balls_scene()
    structures = tuple(replace(s, shape=None) if s.name == "vein" else s for s in scene.structures)
    report = drive(make_monitor(replace(scene, structures=structures)), [140, 0, 0], [0, 0, 0], 0.2)[-1]
    assert report.structure("vein").state is State.UNKNOWN
    assert report.structure("bag").state is State.CLEAR
    assert report.state is State.UNKNOWN


def test_an_outlier_is_unknown_and_a_new_place_is_believed_after_three():
    monitor = make_monitor()
    drive(monitor, [140, 0, 0], [0, 0, 0], 0.5)
    jump = monitor.update(frame_at(50, 0.52, [1500, 0, 0], DOWN))
    assert jump.state is State.UNKNOWN
    assert "outlier" in jump.structures[0].reason
    assert monitor.update(frame_at(51, 0.55, [140, 0, 0], DOWN)).state is State.CLEAR
    there = [monitor.update(frame_at(52 + k, 0.58 + k * DT, [600, 0, 0], DOWN)).state for k in range(3)]
    assert there == [State.UNKNOWN, State.UNKNOWN, State.CLEAR]


def test_approaching_comes_before_contact_and_inside_with_one_event_each():
    monitor = make_monitor()
    # straight at the bag's side, from outside of the organ
    start, aim = np.array([140.0, -20.0, -35.0]), np.array([-1.0, 0.0, 0.0])
    reports = drive(monitor, start, 6.0 * aim, 18.0, direction=aim)
    events = [e for r in reports for e in r.events if e.structure == "bag"]
    assert [e.after for e in events] == [State.CLEAR, State.APPROACHING, State.CONTACT, State.INSIDE]
    assert [e.alarm for e in events] == [False, True, True, True]
    approaching = events[1]
    assert approaching.forecast.earliest_s <= approaching.forecast.seconds <= approaching.forecast.latest_s
    truth = (140.0 - 40.0 - 12.0 - 0.9) / 6.0
    stated = approaching.forecast
    assert approaching.time_s + stated.earliest_s <= truth <= approaching.time_s + stated.latest_s
    assert events[2].time_s == pytest.approx(truth, abs=2 * DT)


def test_reaching_the_target_is_an_event_but_no_alarm():
    reports = drive(make_monitor(), [100, 0, 0], [-6, 0, 0], 13.0)
    events = [e for r in reports for e in r.events if e.structure in ("tumour", "organ")]
    assert [e.after for e in events if e.structure == "tumour"][-1] is State.INSIDE
    assert not any(e.alarm for e in events)


def test_a_noisy_distance_at_the_threshold_does_not_flutter():
    rng = np.random.default_rng(0)
    monitor = make_monitor()
    needed = 3.0 + 1.8 + 0.8
    height = 12.0 + 0.9 + needed  # beside the bag, at the very distance that margin and errors need
    events = []
    for k in range(600):
        tip = np.array([-20.0, -20.0, -35.0 + height]) + 0.15 * rng.normal(size=3)
        report = monitor.update(frame_at(k, k * DT, tip, DOWN))
        events += [e for e in report.events if e.structure == "bag"]
    assert len(events) <= 3


def test_leaving_is_reported_after_the_hold():
    monitor = make_monitor()
    start = np.array([60.0, -20.0, -35.0])
    aim = np.array([-1.0, 0.0, 0.0])
    inside = drive(monitor, start, 6.0 * aim, 3.0, direction=aim)[-1]
    assert inside.structure("bag").state is State.INSIDE
    tip = start + 6.0 * aim * (3.0 - DT)
    out = drive(monitor, tip, -8.0 * aim, 6.0, first=1000, t0=3.0, direction=aim)
    after = [e.after for r in out for e in r.events if e.structure == "bag"]
    assert after[-1] is State.CLEAR
    assert after == sorted(after, key=[State.INSIDE, State.CONTACT, State.APPROACHING, State.CLEAR].index)


def test_reports_say_what_they_rest_on():
    scene = balls_scene()
    report = drive(make_monitor(scene), [140, 0, 0], [0, 0, 0], 0.2)[-1]
    assert report.frame_number == 5
    assert report.scene_hash == scene.hash
    assert report.structure("vein").shape_hash == scene.structure("vein").hash
    assert report.errors["registration_mm"] == 1.0
    assert report.structure("bag").needed_mm == pytest.approx(3.0 + 1.8 + 0.8)


def test_the_same_frames_give_the_same_reports():
    runs = [[r.digest for r in drive(make_monitor(), [100, 0, 0], [-6, 0.3, 0], 5.0)] for _ in range(2)]
    assert runs[0] == runs[1]
    assert len(set(runs[0])) == len(runs[0])


def test_limits_refuse_nonsense():
    for bad in ({"stale_s": 0.0}, {"approach_s": -1.0}, {"hold_s": np.nan}):
        with pytest.raises(InputError):
            Limits(**bad)
