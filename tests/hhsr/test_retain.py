"""Retained parts: whole, or running 1 mm past their region's cuts and capped there."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hhsr.errors import FitError
from hhsr.fitting.cuts import Plane
from hhsr.fitting.retain import require_room, retained_part


def box() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box((20.0, 10.0, 10.0))
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


def test_whole_is_kept_to_the_bit_without_orphans() -> None:
    vertices, faces = box()
    part = retained_part(np.concatenate([vertices, [[99.0, 0.0, 0.0]]]), faces)
    assert np.array_equal(part.vertices, vertices)
    assert np.array_equal(part.faces, faces)
    assert part.parameters == vertices.size + faces.size


def test_a_part_runs_one_millimetre_past_its_cut_and_is_closed() -> None:
    vertices, faces = box()
    part = retained_part(vertices, faces, [(Plane(np.array([1.0, 0.0, 0.0]), 2.0), -1)])
    mesh = trimesh.Trimesh(part.vertices, part.faces, process=False)
    assert mesh.is_watertight
    assert part.vertices[:, 0].max() == pytest.approx(3.0)
    assert mesh.volume == pytest.approx(13.0 * 100.0)
    other = retained_part(vertices, faces, [(Plane(np.array([1.0, 0.0, 0.0]), 2.0), 1)])
    assert other.vertices[:, 0].min() == pytest.approx(1.0)


def test_a_region_without_source_is_an_empty_part() -> None:
    vertices, faces = box()
    part = retained_part(vertices, faces, [(Plane(np.array([1.0, 0.0, 0.0]), 50.0), 1)])
    assert part.parameters == 0


def test_no_room_names_the_numbers() -> None:
    require_room(100, None, "it")
    require_room(100, 100, "it")
    with pytest.raises(FitError, match=r"101 numbers, max_parameters is 100"):
        require_room(101, 100, "it")
