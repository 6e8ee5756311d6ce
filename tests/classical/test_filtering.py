"""The guided filter against its equations, written out pixel by pixel."""

import numpy as np
import pytest
import torch

from lsmgeo.classical import guided_filter
from lsmgeo.errors import DTypeError, OptionError, ShapeError


def written_out(image, plane, radius, eps):
    """He, Sun and Tang, equations 14 to 16, for a picture (h, w, C), in float64; right where windows are whole."""
    height, width, channels = image.shape
    a, b = np.zeros((height, width, channels)), np.zeros((height, width))
    inside = range(radius, height - radius), range(radius, width - radius)
    for y in inside[0]:
        for x in inside[1]:
            window = np.s_[y - radius : y + radius + 1, x - radius : x + radius + 1]
            colours, costs = image[window].reshape(-1, channels), plane[window].ravel()
            covariance = np.cov(colours.T, bias=True).reshape(channels, channels)
            shared = (colours * costs[:, None]).mean(0) - colours.mean(0) * costs.mean()
            a[y, x] = np.linalg.solve(covariance + eps * np.eye(channels), shared)
            b[y, x] = costs.mean() - a[y, x] @ colours.mean(0)
    result = np.full((height, width), np.nan)
    for y in range(2 * radius, height - 2 * radius):
        for x in range(2 * radius, width - 2 * radius):
            window = np.s_[y - radius : y + radius + 1, x - radius : x + radius + 1]
            result[y, x] = a[window].reshape(-1, channels).mean(0) @ image[y, x] + b[window].mean()
    return result


@pytest.mark.parametrize(("channels", "radius", "eps"), [(1, 2, 1e-2), (3, 2, 1e-2), (3, 3, 1e-1)])
def test_planes_are_filtered_as_the_equations_say(channels, radius, eps):
    generator = np.random.default_rng(channels + radius)
    image = generator.random((17, 22, channels))
    planes = generator.random((2, 17, 22))
    filtered = guided_filter(torch.from_numpy(image).permute(2, 0, 1).float(), radius=radius, eps=eps)
    found = filtered(torch.from_numpy(planes).float())
    for plane, result in zip(planes, found.numpy(), strict=True):
        expected = written_out(image, plane, radius, eps)
        use = np.isfinite(expected)
        assert use.sum() >= 50
        np.testing.assert_allclose(result[use], expected[use], rtol=1e-4, atol=1e-4)


def test_a_constant_stays_and_the_input_is_left_alone():
    planes = torch.full((3, 12, 15), 0.7)
    before = planes.clone()
    image = torch.rand(3, 12, 15, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(guided_filter(image, radius=4)(planes), before, rtol=0, atol=1e-4)
    torch.testing.assert_close(planes, before, rtol=0, atol=0)


def test_slabs_are_filtered_plane_by_plane():
    generator = torch.Generator().manual_seed(0)
    image, planes = (
        torch.rand(3, 12, 15, generator=generator),
        torch.rand(15, 12, 4, generator=generator).permute(2, 1, 0),
    )
    filtered = guided_filter(image, radius=3)
    together = filtered(planes)
    apart = torch.cat([filtered(planes[:1]), filtered(planes[1:])])
    torch.testing.assert_close(together, apart, rtol=0, atol=0)


def test_wrong_arguments_are_named():
    image = torch.rand(3, 12, 15)
    with pytest.raises(ShapeError, match=r"image must be .* got \(2, 12, 15\)"):
        guided_filter(image[:2])
    with pytest.raises(OptionError, match="radius must be a whole number from 1 to 32768; got int 0"):
        guided_filter(image, radius=0)
    with pytest.raises(OptionError, match=r"radius must be a whole number .* got float"):
        guided_filter(image, radius=1.5)
    with pytest.raises(OptionError, match="eps must be a positive number; got str"):
        guided_filter(image, eps="small")
    with pytest.raises(DTypeError, match="image must be a tensor"):
        guided_filter(None)
    with pytest.raises(OptionError, match="eps must be a positive number; got float 0"):
        guided_filter(image, eps=0.0)
    with pytest.raises(ShapeError, match=r"image's size \(12, 15\); got \(1, 12, 14\)"):
        guided_filter(image)(torch.rand(1, 12, 14))
