"""Voids behind cuts are closed: bounds that a leaf still breaks weigh more and more until it keeps them (DESIGN §3)."""

from __future__ import annotations

import numpy as np

from hhsr.fitting.aim import Aim
from hhsr.fitting.refine import Misses, figures, improved, misses, radii_of, view_of
from hhsr.fitting.section import Section
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import MOST_URGENT, SLACK_OF_DEPTH, SLACK_OF_REACH, Task
from hhsr.model import ModelLeaf

ROUNDS = 6
STEPS = 3
HARDER = 3.0
MARGIN = 0.3


def closed(
    solid: Solid, task: Task, section: Section, leaf: ModelLeaf, found: Misses, aim: Aim
) -> tuple[ModelLeaf, Misses]:
    """Return a leaf, and its misses, after more Gauss-Newton steps in which the bounds that it breaks count ever more.

    A bound is broken where the radius is less than the plane's distance and 0.3 of the slack. Of all rounds the one
    with the least score (mean miss and some of the largest) is kept: bounds that cannot be kept spoil the rest.
    found: what the leaf misses now.
    """
    bounded = with_section(task, section)
    margin = bounded.bound - (1.0 - MARGIN) * bounded.slack
    view, covering = view_of(bounded.directions, leaf), view_of(section.along, leaf)
    own = view._replace(starts=view.starts[: len(task.directions) + 1])
    behind = view._replace(starts=view.starts[len(bounded.along) + len(bounded.free) :])

    def score(leaf: ModelLeaf, found: Misses) -> float:
        """By how much this leaf raises the mean miss, and its largest, mm."""
        fit = figures(solid, task, section, leaf, found, covering)
        return float(fit.total * task.stride / len(solid.samples.points) + aim.worst * fit.largest)

    best, least, after = leaf, score(leaf, found), found
    for _ in range(ROUNDS):
        broken = radii_of(leaf, bounded.behind, behind) < margin
        if not broken.any():
            break
        bounded = bounded._replace(urgency=np.where(broken, HARDER * bounded.urgency, bounded.urgency))
        leaf, after = improved(solid, bounded, leaf, view, STEPS, aim.power, after)
        after = misses(task, solid, leaf, own, own=after)
        if score(leaf, after) < least:
            best, found, least = leaf, after, score(leaf, after)
    return best, found


def with_section(task: Task, section: Section) -> Task:
    """Return a task with bounds at those points of its sections that it sees."""
    seen = np.flatnonzero(section.hit > section.reach)[:: task.stride]
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
