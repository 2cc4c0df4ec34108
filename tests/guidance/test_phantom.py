from __future__ import annotations

import numpy as np
import pytest

from guidance.errors import InputError
from guidance.phantom import LABELS, TUMOUR_RADIUS_MM, make_phantom


@pytest.fixture(scope="module")
def phantom():
    return make_phantom(3, label_spacing_mm=3.0)


def test_it_is_a_plausible_patient(phantom):
    volume = {name: mesh.volume / 1000.0 for name, mesh in phantom.meshes.items()}
    assert 1200.0 < volume["liver"] < 2000.0
    assert volume["tumour"] == pytest.approx(4.19, rel=0.02)  # a ball of 20 mm
    assert 10.0 < volume["gallbladder"] < 60.0
    assert phantom.meshes["ribs"].body_count == 12
    for mesh in phantom.meshes.values():
        assert mesh.is_watertight


def test_everything_lies_where_it_should(phantom):
    skin, liver = phantom.meshes["skin"].bounds, phantom.meshes["liver"].bounds
    assert (skin[0] < liver[0]).all()
    assert (liver[1] < skin[1]).all()
    np.testing.assert_allclose(phantom.meshes["tumour"].center_mass, phantom.tumour, atol=0.05)
    gap = np.linalg.norm(phantom.meshes["portal vein"].vertices - phantom.tumour, axis=1).min() - TUMOUR_RADIUS_MM
    assert gap > 5.0


def test_the_label_map_holds_the_same_solids(phantom, tmp_path):
    import nibabel

    files = phantom.save(tmp_path)
    assert set(files) == set(LABELS)
    image = nibabel.load(tmp_path / "labels.nii.gz")
    labels = np.asarray(image.dataobj)
    index = np.argwhere(labels == LABELS["tumour"])
    ras = index.mean(axis=0) @ image.affine[:3, :3].T + image.affine[:3, 3]
    np.testing.assert_allclose(ras * [-1, -1, 1], phantom.tumour, atol=0.3)
    volume = len(index) * phantom.spacing_mm**3
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * TUMOUR_RADIUS_MM**3, rel=0.1)


def test_seeds_move_things_and_repeat():
    a, b, c = (make_phantom(s, 6.0) for s in (3, 3, 1))
    np.testing.assert_array_equal(a.labels, b.labels)
    assert np.linalg.norm(a.tumour - c.tumour) > 1.0


@pytest.mark.parametrize("bad", [{"seed": -1}, {"seed": 0, "label_spacing_mm": 0.2}])
def test_it_refuses_nonsense(bad):
    with pytest.raises(InputError):
        make_phantom(**bad)
