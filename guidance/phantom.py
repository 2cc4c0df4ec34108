"""A synthetic patient made by code: skin, ribs, a lobed liver with vessels, gallbladder and a tumour. LPS, mm.

Every organ is an implicit function (< 0 inside, roughly in mm), sampled on one grid. The label map holds the same
solids as the meshes: there the later structure wins, as in a segmentation; a mesh is its organ alone and whole.
Nothing here is anyone's anatomy; sizes and places are plausible for an adult (liver 1.2 to 2 l).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from skimage.measure import marching_cubes

from guidance.errors import InputError
from guidance.needle import Array

Field = Callable[[Array], Array]

LABELS = {
    "skin": 1,
    "ribs": 2,
    "liver": 3,
    "hepatic veins": 4,
    "portal vein": 5,
    "gallbladder": 6,
    "tumour": 7,
}
TUMOUR_RADIUS_MM = 10.0
_SPACING_MM = {"skin": 5.0, "ribs": 3.0, "liver": 3.0, "gallbladder": 1.5, "tumour": 1.0}
_VESSEL_SPACING_MM = 1.25


@dataclass(frozen=True, eq=False)
class Phantom:
    """A synthetic patient.

    meshes: closed triangles per structure, LPS mm. labels: (nx, ny, nz) uint8 on voxels of `spacing_mm`, the centre of
    voxel (0, 0, 0) at `origin` (3,). tumour: its centre (3,).
    """

    meshes: dict[str, trimesh.Trimesh]
    labels: np.ndarray
    spacing_mm: float
    origin: Array
    tumour: Array

    def save(self, folder: Path) -> dict[str, Path]:
        """Write `labels.nii.gz` (RAS affine) and one binary PLY per structure (LPS); return the meshes' files."""
        import nibabel

        folder.mkdir(parents=True, exist_ok=True)
        affine = np.diag([-self.spacing_mm, -self.spacing_mm, self.spacing_mm, 1.0])
        affine[:3, 3] = self.origin * [-1.0, -1.0, 1.0]
        image = nibabel.Nifti1Image(self.labels, affine)  # type: ignore[no-untyped-call]
        nibabel.save(image, folder / "labels.nii.gz")
        files = {}
        for name, mesh in self.meshes.items():
            files[name] = folder / f"{name.replace(' ', '_')}.ply"
            mesh.export(files[name])
        return files


def make_phantom(seed: int = 0, label_spacing_mm: float = 2.0) -> Phantom:
    """Make a synthetic patient; another seed moves lobes, vessels and tumour a little.

    Parameters
    ----------
    seed : int
        0 or more.
    label_spacing_mm : float
        Voxel size of the label map, 1 to 6 mm.

    Raises
    ------
    InputError
        If an argument is out of range.
    """
    if seed < 0:
        raise InputError(f"seed is {seed}; expected 0 or more")
    if not 1.0 <= label_spacing_mm <= 6.0:
        raise InputError(f"label_spacing_mm is {label_spacing_mm}; expected 1 to 6")
    rng = np.random.default_rng(seed)
    fields, tumour = _anatomy(rng)
    meshes = {
        name: _surface(field, box, _SPACING_MM.get(name, _VESSEL_SPACING_MM)) for name, (field, box) in fields.items()
    }
    lows, highs = zip(*(box for _, box in fields.values()), strict=True)
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    labels = _label_map(fields, low, high, label_spacing_mm)
    return Phantom(meshes, labels, label_spacing_mm, low, tumour)


def _anatomy(rng: np.random.Generator) -> tuple[dict[str, tuple[Field, tuple[Array, Array]]], Array]:
    """Implicit functions with the boxes that hold them, and the tumour's centre."""
    wobble = rng.normal(size=(4, 3)) * 3.0
    liver = _liver(wobble)
    veins = _tree(rng, np.array([-20.0, 38.0, 55.0]), _HEPATIC, 4.5)
    portal = _tree(rng, np.array([5.0, 8.0, -45.0]), _PORTAL, 5.0)
    tumour = _tumour_place(rng, liver, (veins, portal))
    fields: dict[str, tuple[Field, tuple[Array, Array]]] = {
        "skin": (_skin, (np.array([-186.0, -134.0, -150.0]), np.array([186.0, 134.0, 150.0]))),
        "ribs": (_ribs, (np.array([-172.0, -124.0, -135.0]), np.array([172.0, 124.0, 135.0]))),
        "liver": (liver, (np.array([-150.0, -100.0, -110.0]), np.array([110.0, 100.0, 100.0]))),
        "hepatic veins": (_within(_capsules(veins), liver), _box(veins)),
        "portal vein": (_within(_capsules(portal), liver), _box(portal)),
        "gallbladder": (_gallbladder, (np.array([-80.0, -85.0, -105.0]), np.array([0.0, 5.0, -20.0]))),
        "tumour": (_ball(tumour, TUMOUR_RADIUS_MM), (tumour - 14.0, tumour + 14.0)),
    }
    return fields, tumour


# Trees as (from, to, radius at the end) in units of the tree's own nodes: node 0 is the root.
_HEPATIC = (
    *((0, (-48.0, 22.0, 32.0), 4.0), (1, (-82.0, 10.0, 8.0), 3.2), (2, (-100.0, -8.0, -22.0), 2.5)),
    *((0, (-30.0, -8.0, 36.0), 4.0), (4, (-38.0, -42.0, 18.0), 3.0), (5, (-46.0, -58.0, -8.0), 2.4)),
    *((0, (14.0, 4.0, 36.0), 3.6), (7, (46.0, -18.0, 24.0), 2.8), (1, (-70.0, 45.0, 5.0), 2.6)),
)
_PORTAL = (
    *((0, (-18.0, 10.0, -24.0), 4.6), (1, (-52.0, 14.0, -20.0), 4.0), (2, (-80.0, 32.0, -32.0), 3.0)),
    *((2, (-78.0, -18.0, -38.0), 3.0), (1, (12.0, -16.0, -2.0), 3.6), (5, (42.0, -34.0, 4.0), 2.6)),
    *((3, (-96.0, 42.0, -44.0), 2.4), (4, (-88.0, -40.0, -50.0), 2.4)),
)


@dataclass(frozen=True, eq=False)
class _Branches:
    starts: Array
    ends: Array
    start_radii: Array
    end_radii: Array


def _tree(
    rng: np.random.Generator, root: Array, branches: tuple[tuple[int, tuple[float, ...], float], ...], radius: float
) -> _Branches:
    nodes, radii = [root + rng.normal(size=3)], [radius]
    rows = []
    for parent, end, end_radius in branches:
        nodes.append(np.array(end) + rng.normal(size=3) * 2.0)
        radii.append(end_radius)
        rows.append((nodes[parent], nodes[-1], radii[parent], end_radius))
    starts, ends, start_radii, end_radii = (np.array(column) for column in zip(*rows, strict=True))
    return _Branches(starts, ends, start_radii, end_radii)


def _capsules(tree: _Branches) -> Field:
    """Distance to the union of tapered branches (the taper taken along the axis: right to a few hundredths)."""

    def field(p: Array) -> Array:
        nearest = np.full(p.shape[:-1], np.inf)
        for a, b, ra, rb in zip(tree.starts, tree.ends, tree.start_radii, tree.end_radii, strict=True):
            along = b - a
            t = np.clip((p - a) @ along / (along @ along), 0.0, 1.0)
            gap = np.linalg.norm(p - a - t[..., None] * along, axis=-1) - (ra + t * (rb - ra))
            nearest = np.minimum(nearest, gap)
        return nearest

    return field


def _box(tree: _Branches) -> tuple[Array, Array]:
    ends = np.concatenate([tree.starts, tree.ends])
    return ends.min(axis=0) - 9.0, ends.max(axis=0) + 9.0


def _within(inner: Field, outer: Field, depth_mm: float = 4.0) -> Field:
    """What of `inner` lies at least so deep in `outer`."""
    return lambda p: np.maximum(inner(p), outer(p) + depth_mm)


def _ball(centre: Array, radius: float) -> Field:
    return lambda p: np.linalg.norm(p - centre, axis=-1) - radius


def _ellipsoid(p: Array, centre: tuple[float, ...] | Array, half_axes: tuple[float, ...]) -> Array:
    """About the distance to an ellipsoid: |q| (|q| − 1) / |∇q|, exact to first order at the surface."""
    axes = np.asarray(half_axes)
    q = (p - np.asarray(centre)) / axes
    size = np.linalg.norm(q, axis=-1)
    slope = np.linalg.norm(q / axes, axis=-1)
    return np.asarray(np.where(slope > 1e-9, size * (size - 1.0) / np.maximum(slope, 1e-9), -axes.min()))


def _smooth_min(a: Array, b: Array, width: float) -> Array:
    """The smaller of two distances, rounded over `width` mm where they are alike."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0.0, 1.0)
    return np.asarray(b + h * (a - b) - width * h * (1.0 - h))


def _liver(wobble: Array) -> Field:
    """A big right lobe, a flat left lobe, a lower tip; the gallbladder's bed and the hilum carved out from below."""

    def field(p: Array) -> Array:
        right = _ellipsoid(p, np.array([-62.0, 8.0, 0.0]) + wobble[0], (66.0, 66.0, 76.0))
        left = _ellipsoid(p, np.array([22.0, -26.0, 22.0]) + wobble[1], (72.0, 40.0, 38.0))
        tip = _ellipsoid(p, np.array([-92.0, 2.0, -58.0]) + wobble[2], (34.0, 42.0, 42.0))
        body = _smooth_min(_smooth_min(right, left, 25.0), tip, 20.0)
        bed = _ellipsoid(p, np.array([-36.0, -42.0, -62.0]), (20.0, 34.0, 34.0))
        hilum = _ellipsoid(p, np.array([12.0, 26.0, -52.0]), (48.0, 40.0, 34.0))
        body = -_smooth_min(-body, bed, 10.0)
        return -_smooth_min(-body, hilum, 14.0)

    return field


def _gallbladder(p: Array) -> Array:
    """A pear below the liver."""
    body = _ellipsoid(p, (-36.0, -44.0, -66.0), (13.0, 20.0, 20.0))
    neck = _ellipsoid(p, (-33.0, -28.0, -50.0), (7.0, 14.0, 9.0))
    return _smooth_min(body, neck, 8.0)


def _trunk(p: Array, grow_mm: float) -> Array:
    """Distance to an elliptic trunk about the z axis, tapering a little upwards, `grow_mm` outside the rib cage."""
    taper = 1.0 - 0.0006 * p[..., 2]
    a, b = (148.0 + grow_mm) * taper, (103.0 + grow_mm) * taper
    size = np.hypot(p[..., 0] / a, p[..., 1] / b)
    slope = np.hypot(p[..., 0] / a**2, p[..., 1] / b**2)
    return np.asarray(np.where(slope > 1e-9, size * (size - 1.0) / np.maximum(slope, 1e-9), -b))


def _skin(p: Array) -> Array:
    ends = np.abs(p[..., 2]) - 140.0
    return -_smooth_min(-_trunk(p, 12.0), -ends, 25.0)


def _ribs(p: Array) -> Array:
    """Six oblique ribs a side along the trunk's wall, 10 × 7 mm, falling forwards, open at spine and breastbone."""
    wall = _trunk(p, -1.0)
    angle = np.arctan2(p[..., 1], np.abs(p[..., 0]))  # 0 at the side, π/2 at the back
    height = p[..., 2] - 38.0 * np.sin(angle)
    step = 26.0
    row = height - step * np.clip(np.round(height / step), -3.0, 2.0)
    tube = np.sqrt((row / 5.0) ** 2 + (wall / 3.5) ** 2)
    rib = (tube - 1.0) * 3.5
    gap = 14.0 - np.abs(p[..., 0])  # open in the middle, front and back
    return np.maximum(rib, gap)


def _tumour_place(rng: np.random.Generator, liver: Field, trees: tuple[_Branches, ...]) -> Array:
    """A place in the right lobe, 22 mm or more under the capsule and 9 mm or more between tumour and vessels."""
    centre = np.array([-72.0, -10.0, -6.0])
    spots = centre + rng.uniform(-1.0, 1.0, size=(4000, 3)) * [26.0, 30.0, 26.0]
    gap = np.min([_capsules(t)(spots) for t in trees], axis=0) - TUMOUR_RADIUS_MM
    room = np.minimum(gap - 9.0, -liver(spots) - 22.0)
    good = np.flatnonzero(room > 0.0)
    return np.asarray(spots[good[0]] if len(good) else spots[int(np.argmax(room))])


def _grid(low: Array, high: Array, spacing: float) -> Array:
    axes = [np.arange(a, b + 0.5 * spacing, spacing) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def _surface(field: Field, box: tuple[Array, Array], spacing: float) -> trimesh.Trimesh:
    values = field(_grid(box[0], box[1], spacing))
    values = np.pad(values, 1, constant_values=spacing)
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(spacing,) * 3)  # type: ignore[no-untyped-call]
    mesh = trimesh.Trimesh(vertices + box[0] - spacing, faces, process=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    if mesh.volume < 0.0:
        mesh.invert()
    return mesh


def _label_map(
    fields: dict[str, tuple[Field, tuple[Array, Array]]], low: Array, high: Array, spacing: float
) -> np.ndarray:
    axes = [np.arange(a, b + 0.5 * spacing, spacing) for a, b in zip(low, high, strict=True)]
    labels = np.zeros([len(a) for a in axes], dtype=np.uint8)
    for name, (field, box) in fields.items():
        part = [slice(*np.searchsorted(a, [lo, hi])) for a, lo, hi in zip(axes, box[0], box[1], strict=True)]
        points = np.stack(np.meshgrid(*(a[s] for a, s in zip(axes, part, strict=True)), indexing="ij"), axis=-1)
        labels[tuple(part)][field(points) < 0.0] = LABELS[name]
    return labels
