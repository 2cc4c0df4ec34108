"""Label maps into surfaces: place, size and side right for any affine; thin parts kept; refusals."""

from __future__ import annotations

import itertools
from pathlib import Path

import nibabel
import numpy as np
import pytest
from skimage.measure import marching_cubes

import hhsr
from hhsr.errors import InputError, SurfaceError
from hhsr.read.iso_surface import surface_of_mask
from hhsr.read.topology import edge_counts

LPS_OF_RAS = np.diag([-1.0, -1.0, 1.0])
Triple = tuple[float, float, float]


def turned(
    spacing: tuple[float, float, float], angles: tuple[float, float, float], signs: tuple[int, int, int]
) -> np.ndarray:
    """Return an affine: voxels of a spacing, turned about the three axes, mirrored by signs, somewhere in space."""
    rotation = np.eye(3)
    for (i, j), angle in zip(((0, 1), (1, 2), (0, 2)), angles, strict=True):
        step = np.eye(3)
        step[[i, j], [i, j]] = np.cos(angle)
        step[i, j], step[j, i] = -np.sin(angle), np.sin(angle)
        rotation = rotation @ step
    affine = np.eye(4)
    affine[:3, :3] = rotation @ np.diag(np.array(spacing) * signs)
    affine[:3, 3] = (31.5, -200.25, 77.0)
    return affine


def ball_labels(affine: np.ndarray, radius: float, offset: Triple, value: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return a label map of the ball of a radius (mm), voxels whose centre lies in it, and the centre in LPS mm."""
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    shape = tuple(int(np.ceil(2 * radius / s)) + 7 for s in spacing)
    middle = (np.array(shape) - 1) / 2 + np.array(offset)
    index = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)
    away = np.linalg.norm((index - middle) @ affine[:3, :3].T, axis=-1)
    return (value * (away < radius)).astype(np.uint8), LPS_OF_RAS @ (affine[:3, :3] @ middle + affine[:3, 3])


def moments(surface: hhsr.Surface) -> tuple[float, np.ndarray]:
    """Return volume in mm³ and centre of mass."""
    corners = surface.vertices[surface.faces]
    sixfold = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return float(sixfold.sum()) / 6, (sixfold[:, None] * corners.sum(axis=1)).sum(axis=0) / (4 * sixfold.sum())


SHEARED = np.array([[1.0, 0.15, 0, 5], [0, 1.0, 0.1, -3], [0.05, 0, 1.2, 9], [0, 0, 0, 1]])
CASES = [
    (turned((1, 1, 1), (0, 0, 0), signs), 8.0, offset)
    for signs, offset in zip(
        itertools.product((1, -1), repeat=3),
        [(0.21, 0.43, 0.12), (-0.37, 0.08, 0.3), (0.11, 0.27, -0.4), (0.31, -0.22, 0.07)] * 2,
        strict=True,
    )
] + [
    (turned((0.7, 0.9, 2.5), (0.3, -0.2, 0.5), (-1, -1, 1)), 20.0, (0.2, 0.1, -0.3)),
    (turned((0.5, 0.5, 3.0), (0, 0.11, 0), (-1, 1, 1)), 24.0, (0.05, 0.3, 0.45)),
    (turned((3.0, 0.6, 0.6), (0, 0, 0.4), (1, 1, 1)), 24.0, (0.33, 0.1, 0.2)),
    (SHEARED, 12.0, (0.17, -0.23, 0.31)),
]


@pytest.mark.parametrize(("affine", "radius", "offset"), CASES)
def test_a_sphere_comes_back_where_it_is(affine: np.ndarray, radius: float, offset: Triple) -> None:
    labels, centre = ball_labels(affine, radius, offset)
    surface = hhsr.Surface.from_labels(labels, affine)
    volume, middle = moments(surface)
    assert np.linalg.norm(middle - centre) < 0.05
    assert volume == pytest.approx(4 / 3 * np.pi * radius**3, rel=0.01)
    assert (edge_counts(surface.faces) == 2).all()
    assert (surface.quality.bodies, surface.quality.genus, surface.quality.repairs) == (1, 0, ())
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    gap = np.abs(np.linalg.norm(surface.vertices - centre, axis=1) - radius)
    assert np.sqrt((gap**2).mean()) < 0.12 * spacing.max()  # marching cubes' stairs: 0.2


def test_the_surface_stays_near_the_mask_and_keeps_its_volume() -> None:
    rng = np.random.default_rng(0)
    mask = np.zeros((24, 24, 24), dtype=bool)
    mask[4:20, 4:20, 4:20] = rng.random((16, 16, 16)) < 0.6
    vertices, faces = surface_of_mask(mask)
    stairs = marching_cubes(mask.astype(np.float32), 0.5, gradient_direction="ascent")[0]
    assert np.abs(vertices - stairs).max() <= 0.5 + 0.25  # half a voxel to bend less, a quarter for the volume
    assert (np.unique(edge_counts(faces)) % 2 == 0).all()
    corners = vertices[faces]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(mask.sum(), rel=0.01)


@pytest.mark.parametrize("width", [1, 2])
def test_thin_parts_are_kept(width: int) -> None:
    rod = np.zeros((9, 9, 60), dtype=bool)
    rod[4 : 4 + width, 4 : 4 + width, 5:55] = True
    sheet = np.zeros((40, 40, 9), dtype=bool)
    sheet[5:35, 5:35, 4 : 4 + width] = True
    for mask in (rod, sheet):
        vertices, faces = surface_of_mask(mask)
        corners = vertices[faces]
        volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
        assert volume == pytest.approx(mask.sum(), rel=0.05)
        assert np.ptp(vertices, axis=0).max() == pytest.approx(np.ptp(np.argwhere(mask), axis=0).max() + 1, abs=0.8)


def test_a_label_at_the_images_border_is_closed_and_said() -> None:
    labels = np.zeros((20, 20, 20), dtype=np.uint8)
    labels[:12, 4:16, :] = 1
    surface = hhsr.Surface.from_labels(labels, np.eye(4))
    assert moments(surface)[0] == pytest.approx(labels.sum(), rel=0.01)
    assert any("border" in words for words in surface.quality.warnings)


def test_labels_are_chosen_or_refused() -> None:
    one, _ = ball_labels(np.eye(4), 8, (0, 0, 0), value=1)
    both = one.copy()
    both[one == 0] = 7
    with pytest.raises(SurfaceError, match=r"2 labels \(1, 7\).*--label"):
        hhsr.Surface.from_labels(both, np.eye(4))
    assert hhsr.Surface.from_labels(both, np.eye(4), label=1).label == 1
    assert hhsr.Surface.from_labels(both, np.eye(4), label=7).quality.cavities == 1
    with pytest.raises(SurfaceError, match=r"label 3 is empty.*1, 7"):
        hhsr.Surface.from_labels(both, np.eye(4), label=3)
    with pytest.raises(SurfaceError, match="empty"):
        hhsr.Surface.from_labels(np.zeros((5, 5, 5)), np.eye(4))


@pytest.mark.parametrize(
    ("values", "affine", "says"),
    [
        (np.full((9, 9, 9), 0.5), np.eye(4), "fractions"),
        (np.full((9, 9, 9), np.nan), np.eye(4), "finite"),
        (np.ones((9, 9)), np.eye(4), "three dimensions"),
        (np.ones((9, 9, 9, 2)), np.eye(4), "three dimensions"),
        (np.ones((9, 9, 9)), np.diag([1.0, 1, 0, 1]), "plane"),
        (np.ones((9, 9, 9)), np.eye(3), "affine"),
        (np.ones((2, 2, 2)), np.eye(4), "longest side"),
    ],
)
def test_what_is_no_label_map_is_refused(values: np.ndarray, affine: np.ndarray, says: str) -> None:
    with pytest.raises(InputError, match=says):
        hhsr.Surface.from_labels(values, affine)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.float32, np.float64])
def test_nifti_files(tmp_path: Path, kind: type) -> None:
    affine = turned((0.8, 0.8, 2.0), (0.1, 0, 0.2), (-1, -1, 1))
    labels, centre = ball_labels(affine, 18.0, (0.2, 0.1, 0.3), value=3)
    file = tmp_path / "organ.nii.gz"
    nibabel.save(nibabel.Nifti1Image(labels.astype(kind)[..., None], affine), file)
    surface = hhsr.read_surface(file)
    volume, middle = moments(surface)
    assert np.linalg.norm(middle - centre) < 0.05
    assert volume == pytest.approx(4 / 3 * np.pi * 18**3, rel=0.01)
    assert (surface.frame, surface.label) == ("RAS", 3)
    with pytest.raises(InputError, match="NIfTI"):
        hhsr.read_surface(file, frame="LPS")


def test_metres_and_a_missing_orientation(tmp_path: Path) -> None:
    labels, _ = ball_labels(np.eye(4), 10, (0, 0, 0))
    image = nibabel.Nifti1Image(labels, np.diag([0.001, 0.001, 0.001, 1]))
    image.header.set_xyzt_units("meter")
    nibabel.save(image, tmp_path / "metres.nii")
    assert max(hhsr.read_surface(tmp_path / "metres.nii").quality.extent_mm) == pytest.approx(20, abs=1)
    image = nibabel.Nifti1Image(labels, None)
    nibabel.save(image, tmp_path / "nowhere.nii")
    assert any("guess" in words for words in hhsr.read_surface(tmp_path / "nowhere.nii").quality.warnings)


def test_a_damaged_nifti_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "bad.nii.gz"
    file.write_bytes(b"\x1f\x8b not really")
    with pytest.raises(SurfaceError, match="readable"):
        hhsr.read_surface(file)


def test_the_real_gland(data: Path) -> None:
    file = data / "segmentation" / "10043_1000043_wholegland_Bosma22b.nii.gz"
    image = nibabel.load(file)
    mask = np.asarray(image.dataobj) > 0
    surface = hhsr.read_surface(file)
    volume, middle = moments(surface)
    voxel = abs(np.linalg.det(image.affine[:3, :3]))
    centre = LPS_OF_RAS @ (image.affine[:3, :3] @ np.argwhere(mask).mean(axis=0) + image.affine[:3, 3])
    assert volume == pytest.approx(mask.sum() * voxel, rel=0.002)
    assert np.linalg.norm(middle - centre) < 0.1
    assert surface.quality.genus == 0
