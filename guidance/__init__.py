"""What happens next? Scenes, plans, forecasts, warnings, simulated insertions: on top of shapes and trackers.

Names are imported on first use, so that `import guidance` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from guidance.budget import ErrorBudget
    from guidance.errors import GuidanceError, InputError, SceneError
    from guidance.event_log import EventLog, replay
    from guidance.limits import Limits
    from guidance.live import watch
    from guidance.monitor import Monitor
    from guidance.needle import Needle
    from guidance.planning import Plan, Plans, plan
    from guidance.scene import Entry, Scene, Structure, Target
    from guidance.simulation import Insertion, Rig, simulate
    from guidance.states import Event, Forecast, Report, State, StructureReport
    from guidance.trajectory import Trajectory

_HOMES = {
    "budget": ("ErrorBudget",),
    "errors": ("GuidanceError", "InputError", "SceneError"),
    "event_log": ("EventLog", "replay"),
    "limits": ("Limits",),
    "live": ("watch",),
    "monitor": ("Monitor",),
    "needle": ("Needle",),
    "planning": ("Plan", "Plans", "plan"),
    "scene": ("Entry", "Scene", "Structure", "Target"),
    "simulation": ("Insertion", "Rig", "simulate"),
    "states": ("Event", "Forecast", "Report", "State", "StructureReport"),
    "trajectory": ("Trajectory",),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Entry",
    "ErrorBudget",
    "Event",
    "EventLog",
    "Forecast",
    "GuidanceError",
    "InputError",
    "Insertion",
    "Limits",
    "Monitor",
    "Needle",
    "Plan",
    "Plans",
    "Report",
    "Rig",
    "Scene",
    "SceneError",
    "State",
    "Structure",
    "StructureReport",
    "Target",
    "Trajectory",
    "plan",
    "replay",
    "simulate",
    "watch",
]


def __getattr__(name: str) -> Any:
    try:
        home = _HOME_OF[name]
    except KeyError:
        raise AttributeError(f"module 'guidance' has no attribute {name!r}") from None
    value = getattr(import_module(f"guidance.{home}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
