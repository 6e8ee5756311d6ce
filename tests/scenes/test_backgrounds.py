"""Random backgrounds."""

import numpy as np
import pytest
import torch

from lsmgeo.errors import ShapeError
from lsmgeo.scenes import background


def test_backgrounds_are_images():
    generator = np.random.default_rng(0)
    for height, width in [(48, 64), (64, 48), (1, 5)] * 10:
        picture = background(generator, height, width)
        assert picture.shape == (3, height, width)
        assert picture.dtype == torch.float32
        assert 0 <= picture.min() <= picture.max() <= 1


def test_equal_states_give_equal_images_and_others_do_not():
    torch.manual_seed(3)  # the global state is not read
    first = background(np.random.default_rng(5), 32, 32)
    torch.testing.assert_close(background(np.random.default_rng(5), 32, 32), first, rtol=0, atol=0)
    assert not torch.allclose(background(np.random.default_rng(6), 32, 32), first, atol=0.1)


def test_a_larger_image_is_the_same_in_more_pixels():
    for seed in range(12):
        small, large = (background(np.random.default_rng(seed), size, size) for size in (40, 120))
        # The centre of each block of three is the pixel of the small image.
        torch.testing.assert_close(large[:, 1::3, 1::3], small, rtol=0, atol=0.02)


def test_backgrounds_are_of_several_kinds():
    """Some are smooth, some have edges; colours fill the cube."""
    generator = np.random.default_rng(1)
    pictures = torch.stack([background(generator, 64, 64) for _ in range(60)])
    steps = (pictures[..., 1:] - pictures[..., :-1]).abs().amax(dim=(1, 2, 3))
    assert (steps < 0.05).sum() >= 6
    assert (steps > 0.2).sum() >= 6
    means = pictures.mean(dim=(-1, -2))
    assert (means.amin(0) < 0.25).all()
    assert (means.amax(0) > 0.75).all()
    assert (pictures.std(dim=(-1, -2)).amax(-1) > 0.02).all()


def test_a_size_below_one_is_refused():
    with pytest.raises(ShapeError, match="height"):
        background(np.random.default_rng(0), 0, 5)
