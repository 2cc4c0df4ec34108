"""Voids behind cuts are closed: bounds that a leaf still breaks weigh more and more until it keeps them (DESIGN §3)."""

from __future__ import annotations

import numpy as np

from hhsr.fitting.refine import improved, radii_of
from hhsr.fitting.section import Section
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import MOST_URGENT, SLACK_OF_DEPTH, SLACK_OF_REACH, Task
from hhsr.model import ModelLeaf

ROUNDS = 6
STEPS = 3
HARDER = 3.0
MARGIN = 0.3


def closed(solid: Solid, task: Task, section: Section, leaf: ModelLeaf, power: float) -> ModelLeaf:
    """Return a leaf after further Gauss-Newton steps in which the bounds that it breaks count ever more.

    A bound is broken where the radius is less than the plane's distance and 0.3 of the slack.
    """
    task = with_section(task, section)
    margin = task.bound - (1.0 - MARGIN) * task.slack
    for _ in range(ROUNDS):
        broken = radii_of(leaf, task.behind) < margin
        if not broken.any():
            break
        task = task._replace(urgency=np.where(broken, HARDER * task.urgency, task.urgency))
        leaf = improved(solid, task, leaf, STEPS, power)[0]
    return leaf


def with_section(task: Task, section: Section) -> Task:
    """Return a task with bounds at those points of its sections that it sees."""
    seen = section.hit > section.reach
    along, reach = section.along[seen], section.reach[seen]
    slack = np.minimum(SLACK_OF_DEPTH * section.depth[seen], SLACK_OF_REACH * reach)
    slack = np.minimum(slack, 0.5 * (section.hit[seen] - reach))
    return task._replace(
        behind=np.concatenate([task.behind, along]),
        bound=np.concatenate([task.bound, reach + slack]),
        slack=np.concatenate([task.slack, slack]),
        urgency=np.concatenate([task.urgency, np.full(slack.size, MOST_URGENT)]),
        directions=np.concatenate([task.directions, along]),
    )
