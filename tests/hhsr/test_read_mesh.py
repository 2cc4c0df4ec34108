"""Mesh files into LPS surfaces: frames, formats, repairs that are stated, refusals that say what to do."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import hhsr
from hhsr.errors import InputError, SurfaceError
from hhsr.io.mesh_writer import write_mesh
from hhsr.read.frames import matrix_to_lps
from hhsr.read.topology import body_of_faces, edge_counts

CODES = [
    "".join(letters) for axes in itertools.permutations(("LR", "PA", "SI")) for letters in itertools.product(*axes)
]


def wedge() -> trimesh.Trimesh:
    """Return a closed body without any symmetry, 10 × 20 × 40 mm, outward."""
    box = trimesh.creation.box(extents=(10, 20, 40))
    box.vertices[box.vertices[:, 0] > 0] *= (1, 0.5, 0.8)
    box.apply_translation((100, -40, 7))
    return box


def ball(radius: float = 20.0, subdivisions: int = 3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def volume_ml(surface: hhsr.Surface) -> float:
    return float(trimesh.Trimesh(surface.vertices, surface.faces, process=False).volume) / 1000.0


def test_there_are_48_orientation_codes() -> None:
    assert len(set(CODES)) == 48
    assert len({matrix_to_lps(code).tobytes() for code in CODES}) == 48
    assert all(abs(np.linalg.det(matrix_to_lps(code))) == 1 for code in CODES)


def test_the_frames_of_the_field() -> None:
    point = np.array([1.0, 2.0, 3.0])
    assert (matrix_to_lps("LPS") @ point).tolist() == [1, 2, 3]
    assert (matrix_to_lps("ras") @ point).tolist() == [-1, -2, 3]
    assert (matrix_to_lps("LSA") @ point).tolist() == [1, -3, 2]  # LPS = (x, −z, y)


@pytest.mark.parametrize("code", CODES)
def test_every_frame_gives_the_same_outward_solid(code: str) -> None:
    body = wedge()
    inverse = np.linalg.inv(matrix_to_lps(code))
    there = body.vertices @ inverse.T
    faces = body.faces if np.linalg.det(inverse) > 0 else body.faces[:, ::-1]  # outward where the file was written
    surface = hhsr.Surface.from_mesh(there, faces, frame=code)
    assert np.allclose(surface.vertices, body.vertices, atol=1e-12)
    assert volume_ml(surface) == pytest.approx(body.volume / 1000)
    assert surface.frame == code
    assert surface.quality.repairs == ()


@pytest.mark.parametrize("code", ["", "LP", "LPX", "LRS", "LPSA", "AAA"])
def test_other_codes_are_refused(code: str) -> None:
    with pytest.raises(InputError, match="three letters"):
        hhsr.Surface.from_mesh(wedge().vertices, wedge().faces, frame=code)


@pytest.mark.parametrize("suffix", [".ply", ".stl", ".obj"])
def test_every_format_gives_the_same_surface(tmp_path: Path, suffix: str) -> None:
    body = wedge()
    for writer in ("trimesh", "own"):
        file = tmp_path / f"{writer}{suffix}"
        if writer == "trimesh":
            body.export(file)
        else:
            write_mesh(file, body.vertices, body.faces)
        surface = hhsr.read_surface(file)
        assert len(surface.vertices) == 8
        assert len(surface.faces) == 12
        assert volume_ml(surface) == pytest.approx(body.volume / 1000, rel=1e-6)
        stated = [word for word in surface.quality.warnings if "taken as LPS" in word]
        assert len(stated) == (writer == "trimesh")  # our own files say SPACE=LPS
        if writer == "own" and suffix != ".stl":
            assert np.array_equal(surface.vertices, body.vertices)  # float64, bit for bit


def test_ascii_stl_is_welded(tmp_path: Path) -> None:
    file = tmp_path / "ascii.stl"
    file.write_text(trimesh.exchange.stl.export_stl_ascii(ball()))
    surface = hhsr.read_surface(file, frame="LPS")
    assert surface.quality.bodies == 1
    assert surface.quality.genus == 0
    assert surface.quality.warnings == ()


@pytest.mark.parametrize("space", ["LPS", "RAS"])
def test_a_slicer_space_comment_is_honoured(tmp_path: Path, space: str) -> None:
    body = wedge()
    file = tmp_path / "slicer.ply"
    write_mesh(file, body.vertices @ matrix_to_lps(space), body.faces)
    file.write_bytes(file.read_bytes().replace(b"SPACE=LPS", b"SPACE=" + space.encode(), 1))
    surface = hhsr.read_surface(file)
    assert surface.frame == space
    assert np.allclose(surface.vertices, body.vertices)
    assert surface.quality.warnings == ()
    other = hhsr.read_surface(file, frame="LSA")
    assert "SPACE=" in other.quality.warnings[0]
    assert other.frame == "LSA"


def test_the_hash_is_the_files(tmp_path: Path) -> None:
    import hashlib

    file = tmp_path / "body.ply"
    write_mesh(file, wedge().vertices, wedge().faces)
    assert hhsr.read_surface(file).source_hash == hashlib.sha256(file.read_bytes()).hexdigest()


def test_several_bodies_and_a_cavity_are_one_shape() -> None:
    outer, inner, far = ball(30), ball(10), ball(8).apply_translation((60, 0, 0))
    inner.invert()
    both = trimesh.util.concatenate([outer, inner, far])
    surface = hhsr.Surface.from_mesh(both.vertices, both.faces)
    assert surface.quality.bodies == 3
    assert surface.quality.cavities == 1
    assert surface.quality.genus == 0
    assert volume_ml(surface) == pytest.approx((outer.volume + inner.volume + far.volume) / 1000)
    assert surface.quality.repairs == ()


def test_genus_counts_handles() -> None:
    ring = trimesh.creation.torus(major_radius=30, minor_radius=8)
    assert hhsr.Surface.from_mesh(ring.vertices, ring.faces).quality.genus == 1


def test_an_inward_mesh_is_turned_and_said() -> None:
    body = ball()
    body.invert()
    surface = hhsr.Surface.from_mesh(body.vertices, body.faces)
    assert volume_ml(surface) > 0
    assert any("inward" in words for words in surface.quality.repairs)


def test_one_inward_body_beside_another_is_turned() -> None:
    one, other = ball(20), ball(15).apply_translation((50, 0, 0))
    other.invert()
    both = trimesh.util.concatenate([one, other])
    surface = hhsr.Surface.from_mesh(both.vertices, both.faces)
    assert volume_ml(surface) == pytest.approx((one.volume + abs(other.volume)) / 1000)
    assert surface.quality.cavities == 0


@given(st.sets(st.integers(0, 319), min_size=1, max_size=150))
def test_mixed_winding_is_mended(turned: set[int]) -> None:
    body = ball(subdivisions=2)
    faces = body.faces.copy()
    rows = sorted(turned)
    faces[rows] = faces[rows][:, ::-1]
    surface = hhsr.Surface.from_mesh(body.vertices, faces)
    assert volume_ml(surface) == pytest.approx(body.volume / 1000)
    assert any("against their neighbours" in words for words in surface.quality.repairs)


def test_small_holes_are_filled_and_said() -> None:
    body = ball(subdivisions=3)
    vertex = 200
    around = np.flatnonzero((body.faces == vertex).any(axis=1))
    faces = np.delete(body.faces, [*around, 0], axis=0)
    surface = hhsr.Surface.from_mesh(body.vertices, faces)
    assert surface.quality.holes_filled == 2
    assert surface.quality.orphan_vertices == 1
    assert (edge_counts(surface.faces) == 2).all()
    assert volume_ml(surface) == pytest.approx(body.volume / 1000, rel=0.01)


def test_a_ring_of_many_edges_is_filled() -> None:
    tube = trimesh.creation.cylinder(radius=5, height=100, sections=200)
    sides = tube.faces[np.abs(tube.face_normals[:, 2]) < 0.5]
    surface = hhsr.Surface.from_mesh(tube.vertices, sides)
    assert surface.quality.holes_filled == 2
    assert volume_ml(surface) == pytest.approx(tube.volume / 1000, rel=1e-6)


def test_a_bowl_is_open_beyond_repair() -> None:
    body = ball()
    faces = body.faces[body.triangles_center[:, 2] < 0]
    with pytest.raises(SurfaceError, match="open beyond repair"):
        hhsr.Surface.from_mesh(body.vertices, faces)


def test_orphans_copies_and_thin_triangles_are_removed() -> None:
    body = ball()
    vertices = np.vstack([body.vertices, [[900, 900, 900]]])
    faces = np.vstack([body.faces, body.faces[:3], [[5, 5, 6]]])
    quality = hhsr.Surface.from_mesh(vertices, faces).quality
    assert (quality.orphan_vertices, quality.duplicate_faces, quality.degenerate_faces) == (1, 3, 1)
    assert max(quality.extent_mm) < 41


def test_a_mesh_drawn_from_both_sides_is_one_surface() -> None:
    body = ball()
    surface = hhsr.Surface.from_mesh(body.vertices, np.vstack([body.faces, body.faces[:, ::-1]]))
    assert volume_ml(surface) == pytest.approx(body.volume / 1000)


def test_cracks_by_rounding_are_welded() -> None:
    body = ball()
    rng = np.random.default_rng(0)
    corners = body.vertices[body.faces].reshape(-1, 3)
    corners = corners + rng.uniform(-1e-7, 1e-7, corners.shape)
    surface = hhsr.Surface.from_mesh(corners, np.arange(len(corners)).reshape(-1, 3))
    assert surface.quality.bodies == 1
    assert len(surface.vertices) == len(body.vertices)


def test_touching_boxes_stay_two_closed_bodies() -> None:
    one, other = trimesh.creation.box(extents=(10, 10, 10)), trimesh.creation.box(extents=(10, 10, 10))
    other.apply_translation((10, 10, 0))
    both = trimesh.util.concatenate([one, other])
    welded = trimesh.Trimesh(both.vertices, both.faces, process=True)
    surface = hhsr.Surface.from_mesh(welded.vertices, welded.faces)
    assert surface.quality.touching_edges == 1
    assert volume_ml(surface) == pytest.approx(2.0)


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        (ball().vertices * [[np.nan, 1, 1]], ball().faces, "not finite"),
        (ball().vertices, np.zeros((0, 3), dtype=np.int64), "no triangles"),
        (ball().vertices, ball().faces + 10**6, "outside"),
        (ball(0.002).vertices, ball().faces, r"longest side is 0.004 mm.*unit"),
        (ball(2000).vertices, ball().faces, "longest side is 4000 mm"),
        (ball().vertices * [1, 1, 0], ball().faces, "encloses"),
    ],
)
def test_what_is_no_organ_is_refused(vertices: np.ndarray, faces: np.ndarray, says: str) -> None:
    with pytest.raises(SurfaceError, match=says):
        hhsr.Surface.from_mesh(vertices, faces)


def test_a_moebius_strip_is_refused() -> None:
    turn = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    rows = []
    for side in (-1, 1):
        radius = 30 + side * 5 * np.cos(turn / 2)
        rows.append(np.stack([radius * np.cos(turn), radius * np.sin(turn), side * 5 * np.sin(turn / 2)], axis=1))
    vertices = np.concatenate(rows)
    following = {i: i + 1 for i in range(39)} | {i + 40: i + 41 for i in range(39)} | {39: 40, 79: 0}
    faces = np.array(
        [[i, following[i], i + 40] for i in range(40)] + [[following[i], following[i + 40], i + 40] for i in range(40)]
    )
    with pytest.raises(SurfaceError):
        hhsr.Surface.from_mesh(vertices, faces)


def test_a_wall_inside_is_refused() -> None:
    body = trimesh.creation.box(extents=(10, 10, 10))
    wall = [[0, 3, 7], [0, 7, 4]]
    with pytest.raises(SurfaceError):
        hhsr.Surface.from_mesh(body.vertices, np.vstack([body.faces, wall]))


def test_units_and_force() -> None:
    small = ball(0.02)
    assert max(hhsr.Surface.from_mesh(small.vertices, small.faces, unit="m").quality.extent_mm) == pytest.approx(
        40, 0.01
    )
    assert max(hhsr.Surface.from_mesh(small.vertices, small.faces, unit="mm").quality.extent_mm) < 0.05
    forced = hhsr.Surface.from_mesh(small.vertices, small.faces, force=True)
    assert any("taken as meant" in words for words in forced.quality.warnings)
    with pytest.raises(InputError, match="unit"):
        hhsr.Surface.from_mesh(small.vertices, small.faces, unit="mile")


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.ply", b"ply\nthis is not one", "readable|no points"),
        ("a.stl", b"", "readable|no points"),
        ("a.obj", b"v 1 2\nf 1 2 3", "readable|no points"),
        ("a.vtk", b"", "expected a mesh"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n", "readable|no points"),
    ],
)
def test_unreadable_files_are_refused(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(InputError, match=says):
        hhsr.read_surface(file)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        hhsr.read_surface(tmp_path / "none.ply")


def test_arguments_are_not_modified() -> None:
    body = ball()
    vertices, faces = body.vertices.copy(), np.ascontiguousarray(body.faces[:, ::-1])
    kept = vertices.copy(), faces.copy()
    hhsr.Surface.from_mesh(vertices, faces, frame="RAS")
    assert np.array_equal(vertices, kept[0])
    assert np.array_equal(faces, kept[1])


def test_bodies_are_numbered_as_they_appear() -> None:
    both = trimesh.util.concatenate([ball(5), ball(6).apply_translation((30, 0, 0))])
    bodies = body_of_faces(np.asarray(both.faces))
    assert bodies[0] == 0
    assert bodies[-1] == 1


@pytest.mark.parametrize(
    ("path", "bodies", "genus"),
    [
        ("liver/liver_sksurgery_C.ply", 1, 2),
        ("scene_liver/livercysts_sksurgery_A.ply", 23, 0),
        ("scene_liver/portalvein_sksurgery_A.ply", 2, 0),
        ("prostate/lesion_picai_10074_1.ply", 1, 1),
    ],
)
def test_real_organs(data: Path, path: str, bodies: int, genus: int) -> None:
    surface = hhsr.read_surface(data / path, frame="LPS")
    assert (surface.quality.bodies, surface.quality.genus, surface.quality.repairs) == (bodies, genus, ())


def cloud(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return points and outward normals of an ellipsoid with half axes 30, 20, 15 mm."""
    rng = np.random.default_rng(seed)
    axes = np.array([30, 20, 15])
    direction = rng.normal(size=(8 * count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    stretch = np.linalg.norm(direction / axes, axis=1)  # area element over the sphere's, up to a factor
    kept = rng.random(len(direction)) < stretch / stretch.max()
    points = (direction * axes)[kept][:count]
    normals = points / axes**2
    return points, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def write_cloud(file: Path, points: np.ndarray, normals: np.ndarray | None) -> None:
    columns = points if normals is None else np.hstack([points, normals])
    names = "xyz" if normals is None else ("x", "y", "z", "nx", "ny", "nz")
    header = "".join(f"property float {name}\n" for name in names)
    with file.open("w", encoding="ascii") as out:
        out.write(f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{header}end_header\n")
        np.savetxt(out, columns, fmt="%.6f")


@pytest.mark.parametrize("side", [1, -1])
def test_a_point_cloud_becomes_a_closed_surface(tmp_path: Path, side: int) -> None:
    points, normals = cloud(4000)
    write_cloud(tmp_path / "cloud.ply", points, side * normals)
    surface = hhsr.read_surface(tmp_path / "cloud.ply", frame="LPS")
    assert (surface.quality.bodies, surface.quality.genus) == (1, 0)
    assert volume_ml(surface) == pytest.approx(4 / 3 * np.pi * 30 * 20 * 15 / 1000, rel=0.01)
    height = np.linalg.norm(surface.vertices / [30, 20, 15], axis=1) - 1
    assert np.abs(height).mean() * 20 < 0.1
    assert any("reconstructed from 4000 points" in words for words in surface.quality.warnings)


def test_clouds_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    points, normals = cloud(2000)
    write_cloud(tmp_path / "bare.ply", points, None)
    with pytest.raises(SurfaceError, match="no normals"):
        hhsr.read_surface(tmp_path / "bare.ply")
    half = points[:, 0] < -5
    write_cloud(tmp_path / "half.ply", points[half], normals[half])
    with pytest.raises(SurfaceError, match="bare of points"):
        hhsr.read_surface(tmp_path / "half.ply")
    write_cloud(tmp_path / "few.ply", points[:50], normals[:50])
    with pytest.raises(SurfaceError, match="at least 100"):
        hhsr.read_surface(tmp_path / "few.ply")
