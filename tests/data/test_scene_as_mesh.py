"""The same object as an analytic scene and as a rendered mesh: two renderers that share nothing but the shading."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from lsmgeo import scenes
from lsmgeo.data import from_trimesh, render_mesh, voxelise
from lsmgeo.scenes import synthetic13
from lsmgeo.scenes.meshing import to_mesh


@pytest.mark.parametrize("category", synthetic13.CATEGORIES)
def test_scene_and_mesh_look_alike(category):
    index = list(synthetic13.CATEGORIES).index(category)
    shape = synthetic13.shape(1, index)
    # A mesh has one colour a face.
    plain = [solid.painted(dataclasses.replace(solid.material, texture="plain")) for solid in shape.scene.solids]
    scene = scenes.Scene(plain)
    mesh = from_trimesh(to_mesh(scene))
    assert mesh.watertight
    cameras = synthetic13.views(1, index, 2, 224)
    batch = type(cameras)(*(torch.as_tensor(value)[None] for value in cameras))
    expected = scenes.render([scene], batch, shape.lights)
    found = render_mesh(mesh, cameras, shape.lights, shadows=False)
    both, either = found.mask & expected.mask[0], found.mask | expected.mask[0]
    assert float(both.sum() / either.sum()) >= 0.99
    error = (found.images - expected.images[0]).square().mean(1)[both].mean()
    assert -10 * np.log10(float(error)) >= 30
    # Facets of a round part lie within it, by 0.1 % of its radius at 64 segments.
    away = (found.depth - expected.depth[0]).abs()[both]
    assert float(away.median()) < 5e-4
    agreeing = (found.normals * expected.normals[0]).sum(1)[both] > 0.9
    assert float(agreeing.double().mean()) > 0.99
    # Facets so fine that no voxel's centre lies between them and the round part.
    fine = from_trimesh(to_mesh(scene, segments=256))
    assert torch.equal(voxelise(fine, 32), scenes.voxels([scene], 32)[0])
