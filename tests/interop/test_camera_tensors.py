"""`CameraTensors` as a value: `at`, `map`, `to`, what it says of itself, and a named tuple to PyTorch."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from torch.utils import _pytree

from lsmgeo import CameraTensors, cameras
from lsmgeo.errors import DTypeError, ShapeError
from tests.interop.models import views

MADE = views(2, 3)
SHARED = MADE._replace(height=torch.tensor([24, 12]), width=32)
EACH = (slice(None), 0)
INDICES = {
    "a scene": 1, "from behind": -1, "a view": EACH, "a range": slice(0, 1), "a list": [1, 0], "one camera": (1, 2),
    "a tensor": torch.tensor([1, 1, 0]), "a mask": torch.tensor([False, True]), "a new axis": None,
    "ellipsis": (..., 2),
    "pairs": (torch.tensor([0, 1]), torch.tensor([2, 0])), "views in an order": (slice(None), [2, 0]),
    "a mask of all": torch.tensor([[True, False, False], [False, True, True]]),
}  # fmt: skip


@pytest.mark.parametrize("name", INDICES)
def test_at_indexes_the_leading_shape(name):
    index, numbers = INDICES[name], torch.arange(6).reshape(2, 3)
    expected = numbers[tuple(index) if isinstance(index, tuple) else (index,)]
    for given in (MADE, SHARED):
        found = given.at(index)
        assert isinstance(found, CameraTensors)
        assert found.shape == expected.shape
        plain = cameras.as_tensors(given)
        for mine, other in zip(cameras.as_tensors(found), plain, strict=True):
            assert torch.equal(mine, other.flatten(0, 1)[expected])
    assert SHARED.at(index).width == 32
    # As a kornia camera, which has no views: rows of the flattened cameras.
    assert torch.equal(CameraTensors.from_kornia(MADE.to_kornia()).at(4).cam_from_world, MADE.cam_from_world[1, 1])


@pytest.mark.parametrize(
    "index", [2, (0, 3), (0, 0, 0), "left", 1.5, torch.tensor([5]), torch.ones(3, dtype=torch.bool), slice(0, 2, -1)]
)
def test_at_names_an_index_that_does_not_fit(index):
    with pytest.raises(ShapeError, match=r"CameraTensors.at: index must fit the leading shape \(2, 3\); got"):
        MADE.at(index)


def test_gradients_pass_at_and_select_is_at():
    K = MADE.intrinsics.clone().requires_grad_()
    given = MADE._replace(intrinsics=K)
    given.at((1, slice(1, None))).intrinsics.sum().backward()
    assert K.grad[1, 1:].eq(1).all()
    assert K.grad.sum() == 18
    for mine, other in zip(cameras.select(MADE, 1, 2), MADE.at((slice(None), 2)), strict=True):
        assert torch.equal(mine, other)


def test_map_and_to_and_what_cameras_say_of_themselves():
    assert (SHARED.shape, SHARED.dtype, SHARED.device) == ((2, 3), torch.float32, torch.device("cpu"))
    mapped = SHARED.map(lambda matrix: 2.0 * matrix)
    assert torch.equal(mapped.intrinsics, 2.0 * SHARED.intrinsics)
    assert torch.equal(mapped.cam_from_world, 2.0 * SHARED.cam_from_world)
    assert mapped[2:] == SHARED[2:]
    for moved in (MADE.to(torch.float64), MADE.to("cpu", torch.float64), MADE.to(dtype=torch.float64)):
        assert moved.dtype == torch.float64
        assert torch.equal(moved.height, MADE.height)
    assert MADE.to("meta").device.type == "meta"
    with pytest.raises(DTypeError, match="dtype must be float32 or float64"):
        MADE.to(torch.float16)


def test_errors_say_what_to_call_instead():
    assert MADE[0] is MADE.intrinsics  # of all cameras: a tuple of four fields
    assert MADE[:2] == (MADE.intrinsics, MADE.cam_from_world)
    with pytest.raises(IndexError, match=r"cameras\[4\]: the fields are intrinsics, .*; a view is cameras.at\(4\)"):
        MADE[4]
    with pytest.raises(TypeError, match=r"a view is cameras.at\(\(slice\(None, None, None\), 0\)\)"):
        MADE[:, 0]
    with pytest.raises(AttributeError, match="no 'extrinsics'; it has intrinsics, cam_from_world, height, width"):
        MADE.extrinsics  # noqa: B018
    assert not hasattr(MADE, "pin_memory")


def test_it_stays_a_named_tuple():
    leaves, spec = _pytree.tree_flatten(MADE)
    assert len(leaves) == 4
    assert isinstance(_pytree.tree_unflatten(leaves, spec), CameraTensors)
    for twin in (copy.copy(MADE), copy.deepcopy(MADE), pickle.loads(pickle.dumps(MADE))):
        assert isinstance(twin, CameraTensors)
        assert all(torch.equal(mine, other) for mine, other in zip(twin, MADE, strict=True))
    batch = torch.utils.data.default_collate([MADE.at(0), MADE.at(1)])
    assert isinstance(batch, CameraTensors)
    assert batch.shape == (2, 3)


class Geometry(torch.nn.Module):
    """Points to pixels and depth to points, of some of the cameras."""

    def forward(self, intrinsics, cam_from_world, points):
        given = CameraTensors(intrinsics, cam_from_world, 24, 32)
        found = cameras.project(given, points)
        first = given.at((slice(None), slice(0, 1)))
        back = cameras.unproject_depth(first, found.depth[:, :1, :, None])
        return (*found, back, cameras.centers(given), given.to(torch.float64).at(EACH).intrinsics)


def given_geometry(scenes, count, number):
    made = views(scenes, count)
    points = torch.rand(scenes, number, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    return made.intrinsics, made.cam_from_world, points


def test_one_graph():
    torch._dynamo.reset()
    compiled = torch.compile(Geometry(), fullgraph=True, backend="aot_eager", dynamic=True)
    for size in ((2, 3, 7), (4, 5, 9)):
        given = given_geometry(*size)
        torch.testing.assert_close(compiled(*given), Geometry()(*given))
    torch._dynamo.reset()


def test_one_program_of_any_size():
    scenes, count, number = (torch.export.Dim(name, min=1, max=64) for name in ("scenes", "views", "number"))
    shapes = ({0: scenes, 1: count}, {0: scenes, 1: count}, {0: scenes, 1: number})
    program = torch.export.export(Geometry(), given_geometry(2, 3, 7), dynamic_shapes=shapes).module()
    for size in ((1, 1, 1), (4, 5, 9)):
        given = given_geometry(*size)
        torch.testing.assert_close(program(*given), Geometry()(*given))


def test_vmap_over_scenes():
    K, E, points = given_geometry(2, 3, 7)
    run = torch.func.vmap(lambda K, E, p: tuple(cameras.project(CameraTensors(K, E, 24, 32), p[None])))
    for mine, other in zip(run(K, E, points), cameras.project(MADE, points), strict=True):
        torch.testing.assert_close(mine[:, 0], other)
