"""What the Triton kernels are held to, case by case; `triton_runner` runs them in the interpreter.

Each case raises if the kernels differ from the reference.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from unittest import mock

import torch
from torch import Tensor

from lsmgeo import FrustumGrid, _sites, functional
from lsmgeo.kernels import reference
from lsmgeo.kernels.request import Options
from lsmgeo.kernels.triton import launcher, operators
from tests.kernels import cases as shared
from tests.kernels.triton_support import (
    CELLS,
    SHAPE,
    B,
    Points,
    V,
    by_kernels,
    by_reference,
    compare,
    compare_sweep,
    deterministic,
    features,
    generator,
    image_sites,
    points,
    sample_pixels,
    sweep_sites,
    unproject,
    unproject_backward,
    unproject_reference,
    volumes,
)

AUGMENTED = Options("bilinear", depth=True, direction="world")
EVERY = ("variance", "max", "mean")
SMALL_TILES = {"SITES": (16, 16), "CHANNELS": (4, 4), "PLANES": 2}


CASES: dict[str, Callable[[], object]] = {
    "images with geometric channels": lambda: compare(features(), image_sites(), AUGMENTED),
    "images at the sites of a frustum": lambda: compare(
        features(batch=2),
        image_sites(1, batch=2, projective=True, per="scene"),
        AUGMENTED._replace(padding_mode="border", direction="camera", near=0.4),
    ),
    "images, depth alone of masked views": lambda: compare(
        features(), image_sites(2, projective=True, per="view", mask=True), Options("bilinear", depth=True)
    ),
    "images, direction alone": lambda: compare(
        features(1), image_sites(3, per="view"), Options("bilinear", direction="camera")
    ),
    "images, nearest": lambda: compare(features(), image_sites(), Options("nearest")),
    "images, mean of the nearest": lambda: compare(
        features(2), image_sites(4), Options("nearest", "border", depth=True, reduce=("mean",))
    ),
    "images, mean": lambda: compare(features(), image_sites(5, mask=True), Options("bilinear", reduce=("mean",))),
    "images, variance": lambda: compare(
        features(), image_sites(6), Options("bilinear", "border", reduce=("variance",))
    ),
    "images, maximum": lambda: compare(
        features(), image_sites(7, projective=True), Options("bilinear", reduce=("max",))
    ),
    "images, every statistic of everything": lambda: compare(
        features(batch=2),
        image_sites(8, batch=2, per="view", mask=True),
        AUGMENTED._replace(padding_mode="border", reduce=EVERY),
    ),
    # A source whose channels are apart, of which so little is read that it is not copied.
    "images, few sites read in place": lambda: compare(
        features(3), image_sites(12, shape=(1, 2, 3)), Options("bilinear"), seen=False
    ),
    "images in float16": lambda: compare(features(dtype=torch.float16), image_sites(), AUGMENTED),
    "images, variance in bfloat16": lambda: compare(
        features(2, dtype=torch.bfloat16), image_sites(6), Options("bilinear", "border", reduce=("variance",))
    ),
    "volumes with geometric channels": lambda: compare_sweep(
        volumes(), sweep_sites(), Options("trilinear", depth=True, direction="world")
    ),
    "volumes with borders of masked views": lambda: compare_sweep(
        volumes(batch=2),
        sweep_sites(1, batch=2, per="view", mask=True),
        Options("trilinear", "border", depth=True, direction="camera", near=0.6),
    ),
    "volumes, nearest": lambda: compare_sweep(
        volumes(5, batch=2), sweep_sites(2, batch=2, per="scene"), Options("nearest", depth=True)
    ),
    "volumes, nearest with borders": lambda: compare_sweep(volumes(2), sweep_sites(3), Options("nearest", "border")),
    "volumes in bfloat16": lambda: compare_sweep(
        volumes(2, dtype=torch.bfloat16), sweep_sites(7), Options("trilinear", depth=True)
    ),
    "volumes of any strides": lambda: compare_sweep(
        volumes(4)[:, ::2].transpose(2, 3).contiguous().transpose(2, 3),
        sweep_sites(8),
        Options("trilinear"),
        cotangent=torch.ones(1).expand(B, 2, 2, *SHAPE),
    ),
    "pixels with given channels": lambda: compare(features(), points(), Options("bilinear")),
    "pixels, nearest": lambda: compare(features(2), points(4, extras=0), Options("nearest", "border")),
    "pixels reduced": lambda: compare(features(2), points(5, extras=3), Options("bilinear", "border", reduce=EVERY)),
}


def case(function: Callable[[], None]) -> Callable[[], None]:
    CASES[function.__name__] = function
    return function


def patched(**values: object) -> contextlib.AbstractContextManager[object]:
    """Other constants in `launcher`."""
    return mock.patch.multiple(launcher, **values)


def assert_finite(*tensors: Tensor | None) -> None:
    for tensor in tensors:
        assert tensor is None or bool(torch.isfinite(tensor).all())


# Images


@case
def images_in_many_tiles() -> None:
    """Several blocks of sites, slabs of planes and tiles of channels; sizes that fill none."""
    with patched(**SMALL_TILES):
        for views, statistics in ((1, ()), (2, ("mean", "variance"))):
            sites = image_sites(9, batch=1, views=views, shape=(2, 3, 7))
            compare(features(6, batch=1, views=views), sites, AUGMENTED._replace(reduce=statistics))


@case
def images_of_any_strides() -> None:
    sites = image_sites(10)
    last = features(4).permute(0, 1, 3, 4, 2).contiguous().permute(0, 1, 4, 2, 3)
    compare(last, sites, Options("bilinear"))
    expanded = features(4)[:, :1].expand(B, V, 4, 5, 7)
    ones = torch.ones(()).expand(B, V, 4, *SHAPE)
    compare(expanded, sites, Options("bilinear"), cotangent=ones)
    turned = torch.randn(*SHAPE, 9, B, generator=generator(11)).permute(4, 3, 0, 1, 2)
    compare(features(3).mT.contiguous().mT, sites, Options("bilinear", reduce=EVERY), cotangent=turned)


@case
def half_precision_saturates() -> None:
    """Depths and variances beyond the largest number; no gradient comes back through them."""
    sites = image_sites()
    far = sites._replace(matrix=sites.matrix * 6e4)
    source = (300.0 * features(2)).half()
    for place, options in ((far, Options("bilinear", depth=True)), (sites, Options("bilinear", reduce=EVERY))):
        shape = unproject_reference(source, place, options)[0].shape
        cotangent = torch.randn(shape, generator=generator(3)).half()
        values, visible, gradients = by_reference(unproject_reference, source, place, options, cotangent)
        found = by_kernels(source, place, options, cotangent)
        assert float(values.abs().max()) == 65504.0
        assert_finite(found[0], *found[2])
        torch.testing.assert_close(found[0], values, rtol=2e-3, atol=1e-2)
        torch.testing.assert_close(found[1], visible, rtol=0, atol=0)
        for gradient, expected in zip(found[2], gradients, strict=True):
            if expected is not None:
                torch.testing.assert_close(
                    gradient.double(), expected.double(), rtol=0, atol=2e-3 * float(expected.abs().max())
                )


@case
def the_largest_of_minus_infinity() -> None:
    """An unseen view does not stand for it, and what no view sees stays 0."""
    source, sites = torch.full_like(features(2), -torch.inf), image_sites(7, mask=True)
    options = Options("nearest", reduce=("max",))
    found, visible = unproject(source, sites, options)
    expected = torch.where(visible.any(1), -torch.inf, 0.0)[:, None].expand_as(found)
    assert bool(visible.any(1).any())
    assert not bool(visible.any(1).all())
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    torch.testing.assert_close(unproject_reference(source, sites, options)[0], expected, rtol=0, atol=0)


@case
def large_numbers_stay_finite() -> None:
    source = 3e38 * features(2).sign()
    sites, options = image_sites(), Options("bilinear", "border", reduce=EVERY)
    values, _, _ = by_reference(unproject_reference, source, sites, options, torch.ones(B, 6, *SHAPE))
    cotangent = torch.full((B, 6, *SHAPE), 1e-20)
    found = by_kernels(source, sites, options, cotangent)
    assert_finite(found[0], found[2][0])
    torch.testing.assert_close(found[0], values, rtol=1e-5, atol=1e33)
    _, _, gradients = by_reference(unproject_reference, source, sites, options, cotangent)
    torch.testing.assert_close(found[2][0], gradients[0], rtol=1e-4, atol=1e-4 * float(gradients[0].abs().max()))


@case
def far_away_matrices_keep_their_pixels() -> None:
    """Homogeneous coordinates beyond float32's, when squared."""
    sites = image_sites(11)
    huge = sites._replace(matrix=sites.matrix * 2.0**112)
    cotangent = torch.randn(B, V, 3, *SHAPE, generator=generator(4))
    expected = by_kernels(features(), sites, Options("bilinear", near=0.0), cotangent)
    found = by_kernels(features(), huge, Options("bilinear", near=0.0), cotangent)
    torch.testing.assert_close(found[0], expected[0], rtol=0, atol=0)
    torch.testing.assert_close(found[2][1] * 2.0**112, expected[2][1], rtol=1e-12, atol=0)


@case
def nan_reaches_its_footprint_alone() -> None:
    source, sites = features(2, batch=2), image_sites(batch=2, mask=True)
    source[0, 0] = source[-1, -1] = torch.nan  # views left out
    source[0, 1, :, 2, 3] = torch.nan
    source[0, 1, :, 4, 6] = torch.inf
    for options in (
        Options("bilinear"),
        Options("nearest", "border", reduce=("mean",)),
        Options("bilinear", reduce=EVERY),
    ):
        values, visible = unproject_reference(source, sites, options)
        found, seen = unproject(source, sites, options)
        assert bool(values.isnan().any())
        assert not bool(values.isnan().all())
        torch.testing.assert_close(found, values, rtol=1e-4, atol=1e-4, equal_nan=True)
        torch.testing.assert_close(seen, visible, rtol=0, atol=0)
        clean = torch.ones_like(values)
        clean[0] = 0.0  # no gradient comes from where the NaN are
        assert_finite(*unproject_backward(clean, source, sites, options, (True, False, False, False)))
        if "variance" not in options.reduce:  # finite gradients do not meet the features
            expected = by_reference(unproject_reference, source, sites, options, torch.ones_like(values))[2][0]
            gradient, *_ = unproject_backward(
                torch.ones_like(values), source, sites, options, (True, False, False, False)
            )
            torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-4)


@case
def cameras_of_masked_views_are_not_read() -> None:
    sites = image_sites(mask=True)
    mask, options = sites.view_mask, AUGMENTED
    cotangent = torch.randn(B, V, 6, *SHAPE, generator=generator(6))
    expected = by_kernels(features(2), sites, options, cotangent)
    spoilt = sites._replace(
        matrix=torch.where(mask[..., None, None], sites.matrix, torch.nan),
        direction=torch.where(mask[..., None, None], sites.direction, torch.inf),
    )
    found = by_kernels(features(2), spoilt, options, cotangent)
    for left, right in zip((found[0], found[1], *found[2]), (expected[0], expected[1], *expected[2]), strict=True):
        torch.testing.assert_close(left, right, rtol=0, atol=0)


@case
def a_site_in_the_cameras_centre() -> None:
    sites = image_sites(13)
    q = torch.tensor([1.0, 2.0, 1.0], dtype=torch.float64)
    shift = sites.direction[..., :3] @ q + sites.direction[..., 3]
    direction = torch.cat((sites.direction[..., :3], sites.direction[..., 3:] - shift[..., None]), -1)
    M = sites.matrix[..., :3]
    matrix = torch.cat((M, -(M @ q)[..., None]), -1)
    at = sites._replace(matrix=matrix, direction=direction)
    cotangent = torch.randn(B, V, 6, *SHAPE, generator=generator(6))
    values, visible, gradients = by_kernels(features(2), at, AUGMENTED, cotangent)
    assert_finite(values, *gradients)
    there = values[..., 1, 2, 1]
    torch.testing.assert_close(there[:, :, 2], torch.zeros(B, V), rtol=0, atol=1e-6)  # the depth
    assert not bool(there[:, :, :2].any())
    assert not bool(there[:, :, 3:].any())
    assert not bool(visible[..., 1, 2, 1].any())


@case
def whole_indices_belong_to_the_cell_above() -> None:
    """Sites on pixel centres, on the outermost ones too: derivatives jump there."""
    matrix = torch.zeros(B, V, 3, 4, dtype=torch.float64)
    matrix[..., 0, 0] = matrix[..., 1, 1] = matrix[..., 2, 3] = 1.0
    matrix[..., 0, 3] = matrix[..., 1, 3] = -1.0
    sites = image_sites(shape=(1, 7, 9))._replace(matrix=matrix, direction=None)
    for padding in ("zeros", "border"):
        options = Options("bilinear", padding)
        cotangent = torch.randn(B, V, 2, 1, 7, 9, generator=generator(8))
        values, visible, gradients = by_reference(unproject_reference, features(2), sites, options, cotangent)
        found = by_kernels(features(2), sites, options, cotangent)
        torch.testing.assert_close(found[1], visible, rtol=0, atol=0)
        torch.testing.assert_close(found[0], values, rtol=0, atol=1e-4)
        torch.testing.assert_close(found[2][0], gradients[0], rtol=0, atol=1e-4)
        torch.testing.assert_close(found[2][1], gradients[1], rtol=1e-4, atol=1e-3)
    halves = sites._replace(matrix=matrix + torch.tensor([0.0, 0.0, 0.0, 0.5])[:, None].mT * matrix[..., 2:, 3:])
    options = Options("nearest")
    expected, visible = unproject_reference(features(2), halves, options)
    found, seen = unproject(features(2), halves, options)
    torch.testing.assert_close(found, expected, rtol=0, atol=0)
    torch.testing.assert_close(seen, visible, rtol=0, atol=0)


@case
def of_equal_views_the_first_has_the_gradient() -> None:
    sites = image_sites()
    same = sites._replace(matrix=sites.matrix[:, :1].expand(B, V, 3, 4))
    source = features(2)[:, :1].expand(B, V, 2, 5, 7)
    _, _, gradients = compare(source, same, Options("bilinear", reduce=("max",)))
    assert bool(gradients[0][:, 0].any())
    assert not bool(gradients[0][:, 1:].any())


@case
def nothing_gives_nothing() -> None:
    compare(features(0), image_sites(), AUGMENTED)
    compare(features(0), image_sites(), Options("bilinear", reduce=("mean",)))
    empty = image_sites(batch=0)
    values, visible, gradients = by_kernels(features(batch=0), empty, AUGMENTED, torch.zeros(0, V, 7, *SHAPE))
    assert (values.shape, visible.shape) == ((0, V, 7, *SHAPE), (0, V, *SHAPE))
    assert [gradient.shape for gradient in gradients] == [(0, V, 3, 5, 7), (0, V, 3, 4), (0, V, 3, 4), (0, V, 2)]
    none = image_sites(shape=(2, 3, 4))._replace(z=torch.zeros(0, dtype=torch.float64))
    values, _, gradients = by_kernels(features(), none, AUGMENTED, torch.zeros(B, V, 7, 0, 3, 4))
    assert values.shape == (B, V, 7, 0, 3, 4)
    assert not any(bool(gradient.any()) for gradient in gradients)
    compare(features(), points(count=0), Options("bilinear"), seen=False)
    compare_sweep(volumes(0), sweep_sites(), Options("trilinear"))


@case
def only_what_is_needed() -> None:
    sites, source = image_sites(14, batch=1, views=2), features(2, batch=1, views=2)
    cotangent = torch.randn(1, 2, 6, *SHAPE, generator=generator(9))
    everything = unproject_backward(cotangent, source, sites, AUGMENTED, (True,) * 4)
    for index in range(4):
        needs = tuple(index == other for other in range(4))
        found = unproject_backward(cotangent, source, sites, AUGMENTED, needs)
        assert [gradient is not None for gradient in found] == list(needs)
        torch.testing.assert_close(found[index], everything[index], rtol=1e-6, atol=1e-6)


# Volumes


@case
def volumes_in_many_tiles() -> None:
    sites = sweep_sites(4, batch=1, views=1, shape=(3, 2, 5))
    for stacked in (False, True):
        options = Options("trilinear", depth=True, direction="world", flatten=stacked)
        with patched(**SMALL_TILES):
            given = torch.randn(1, 1, 2, 5, 9, 3, generator=generator(2))
            given = given.permute(0, 1, 4, 5, 2, 3) if stacked else given.permute(0, 1, 4, 5, 2, 3).contiguous()
            values, _, _ = compare_sweep(volumes(5, batch=1), sites, options, cotangent=given)
        if stacked:
            assert values.permute(0, 1, 4, 5, 2, 3).is_contiguous()
            assert values.flatten(2, 3).data_ptr() == values.data_ptr()
        else:
            assert values.permute(0, 1, 3, 4, 5, 2).is_contiguous()


@case
def volumes_written_where_told() -> None:
    sites, options = sweep_sites(5), Options("trilinear", depth=True)
    for room in (torch.zeros(B, 4, 2, *SHAPE), torch.zeros(4, B, *SHAPE, 3).permute(1, 5, 0, 2, 3, 4)[:, :2]):
        out = room.transpose(1, 2) if room.shape[1] == 4 else room
        values, _, _ = compare_sweep(volumes(), sites, options, out=out)
        assert values is out
    half, maps = volumes(dtype=torch.float16), torch.zeros(B, 2, 4, *SHAPE)
    expected, _ = reference.plane_sweep_project(half.float(), sites, options)
    operators.plane_sweep_project(half, sites, options, out=maps)
    torch.testing.assert_close(maps, expected, rtol=1e-5, atol=1e-5)


@case
def volumes_gradients_are_added() -> None:
    sites, options = sweep_sites(6), Options("trilinear")
    cotangent = torch.randn(B, 2, 3, *SHAPE, generator=generator(5))
    expected, *_ = operators.plane_sweep_project_backward(
        cotangent, volumes(), sites, options, (True, False, False, False)
    )
    for mode in (contextlib.nullcontext, deterministic):
        into = torch.ones(3, *CELLS, B).movedim(-1, 0)
        with mode():
            found, *_ = operators.plane_sweep_project_backward(
                cotangent, volumes(), sites, options, (True, False, False, False), into
            )
        assert found is into
        torch.testing.assert_close(found, expected + 1.0, rtol=1e-5, atol=1e-5)


# Pixels


@case
def pixels_in_many_tiles() -> None:
    with patched(**SMALL_TILES):
        compare(features(6), points(6), Options("bilinear"))


@case
def pixels_of_half_precision_saturate() -> None:
    given = points(7, extras=1)
    given = Points(given.pixels, given.front, 1e5 * given.extra)
    source, options = features(2).half(), Options("bilinear")
    cotangent = torch.randn(B, V, 3, 11, generator=generator(1)).half()
    values, _, gradients = by_reference(sample_pixels, source, given, options, cotangent)
    found = by_kernels(source, given, options, cotangent)
    torch.testing.assert_close(found[0], values, rtol=2e-3, atol=2e-3)
    torch.testing.assert_close(found[2][2], gradients[2], rtol=0, atol=0)


@case
def pixels_far_outside() -> None:
    """Infinite coordinates too, where they are not in front."""
    given = points(8)
    given.pixels[..., 0, :] = 1e30
    given.pixels[..., 1, :] = -1e30
    given.pixels[..., 2, :] = torch.nan
    given.front[..., 2] = False
    for padding in ("zeros", "border"):
        _, _, gradients = compare(features(2), given, Options("bilinear", padding))
        assert_finite(*gradients)


# Order of summation


@case
def deterministic_sums() -> None:
    sites = image_sites(15)
    for options in (AUGMENTED, AUGMENTED._replace(padding_mode="border", reduce=("variance", "mean"))):
        count = 14 if options.reduce else 7
        shape = (B, count, *SHAPE) if options.reduce else (B, V, count, *SHAPE)
        cotangent = 1e-9 * torch.randn(shape, generator=generator(2))
        needs = (True, True, True, True)
        expected = unproject_backward(cotangent, features(), sites, options, needs)
        with deterministic():
            found = [unproject_backward(cotangent, features(), sites, options, needs) for _ in range(2)]
        for first, second, other in zip(*found, expected, strict=True):
            torch.testing.assert_close(first, second, rtol=0, atol=0)
            torch.testing.assert_close(first, other, rtol=0, atol=1e-6 * float(other.abs().max()))


# Depths of sites, correlation, contiguous memory: the scenes of the C++ kernels

SHARED = [
    name
    for name in shared.CASES
    if name.startswith(("depths of pixels", "sweep of pixels", "correlation", "contiguous", "splat"))
    and name not in ("splat, border", "splat, nearest", "splat, planes adjacent")
]
CASES |= {f"shared, {name}": partial(shared.CASES[name], "triton") for name in SHARED}
CASES["shared, half"] = partial(shared.HALF["correlation that saturates"], "triton")
CASES["shared, splat in half precision"] = partial(shared.HALF["splat, float16"], "triton")


@case
def splats_read_only_what_they_add() -> None:
    """NaN in masked views, behind the near plane, and at samples outside the volume."""
    features, weights = shared.MAPS.clone(), shared.SHARES.clone()
    features[~shared.MASK], weights[~shared.MASK] = torch.nan, torch.nan
    weights[:, :, shared.DEPTHS <= 1.2] = torch.nan
    inside = functional.plane_sweep_project(
        torch.ones(shared.B, 1, *shared.GRID.shape), *shared.SPLAT, shared.SIZE, flatten=False
    ).maps[:, :, 0]
    weights[inside == 0] = torch.nan
    depths = shared.DEPTHS.clone()
    leaves = [leaf.requires_grad_() for leaf in (features, weights, depths)]
    answers = []
    for backend in ("triton", "reference"):
        options = {"weights": weights, "view_mask": shared.MASK, "near": 1.2, "backend": backend}
        volume = functional.splat(features, *shared.SPLAT[:2], depths, **options)
        answers.append((volume, *torch.autograd.grad(volume.square().sum(), leaves)))
    for found, expected in zip(*answers, strict=True):
        assert expected.isfinite().all()
        assert expected.any()
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4 * float(expected.abs().max()))


@case
def deterministic_splats() -> None:
    """The same bits from run to run, and integers exactly."""
    features, weights = shared.MAPS.mul(16).round(), shared.SHARES.mul(8).round()
    call = partial(functional.splat, features, *shared.SPLAT, weights=weights, mode="nearest")
    with deterministic():
        found = [call(backend="triton") for _ in range(2)]
    assert torch.equal(*found)
    assert torch.equal(found[0], call(backend="reference"))
    assert found[0].any()


@case
def deterministic_sums_of_correlations() -> None:
    grid = FrustumGrid(shared.CAMERA, shared.PIXEL_DEPTHS[:, 0])
    options = Options("bilinear", "border", groups=5, reduce=("mean", "variance"))
    source, other = shared.WIDE, shared.REFERENCE
    sites = _sites.image_sites("test", source, shared.VIEWS, grid, None, options, other)
    cotangent = torch.randn(shared.B, 10, *grid.shape, generator=generator(2))
    arguments = (cotangent, source, sites, other, options, (True,) * 5)
    expected = operators.unproject_backward(*arguments)
    with deterministic():
        found = [operators.unproject_backward(*arguments) for _ in range(2)]
    for first, second, other in zip(*found, expected, strict=True):
        if other is None:
            continue
        torch.testing.assert_close(first, second, rtol=0, atol=0)
        torch.testing.assert_close(first, other, rtol=0, atol=1e-5 * float(other.abs().max()))


@case
def deterministic_sums_of_infinities() -> None:
    """NaN, as sums of fixed-point numbers need a bound; a NaN that is not read changes none."""
    source, sites, options = features(), image_sites(3, mask=True), Options("bilinear", "border")
    other = torch.randn(B, source.shape[2], *SHAPE, generator=generator(3))
    cotangent = torch.randn(B, V, 1, *SHAPE, generator=generator(2))

    def run(source, other):
        needs = (True, False, False, False, True)
        found = operators.unproject_backward(cotangent, source, sites, other, options, needs)
        return found[0], found[4]

    expected = run(source, other)
    with deterministic():
        hidden = source.clone()
        hidden[0, 0] = torch.nan  # a masked view
        for found, plain in zip(run(hidden, other), expected, strict=True):
            torch.testing.assert_close(found, plain, rtol=0, atol=1e-5)
        other[0, 1, 0, 1, 2] = torch.inf
        source[0, 1, 0, 2, 3] = -torch.inf
        for found in run(source, other):
            assert bool(found.isnan().all())
