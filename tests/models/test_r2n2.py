"""3D-R2N2 against the same network written with numpy, value by value; parameters counted by hand; what it reads."""

import numpy as np
import pytest
import torch

from lsmgeo.cameras import CameraTensors, orbit
from lsmgeo.errors import CameraError, OptionError, ShapeError
from lsmgeo.models import R2N2, create
from tests.models.inputs import count
from tests.models.recurrences import sigmoid

SMALL = {
    "image_size": 9,
    "channels": (3, 4, 4),
    "shortcuts": ("none", "convolution", "identity"),
    "features": 5,
    "pose_features": 3,
    "coarse": 2,
    "hidden": 3,
    "decoder": (3, 4, 2),
}


def cameras_of(B, V, *, size=9):
    azimuth = torch.arange(B * V, dtype=torch.float64).reshape(B, V) * 77 + 10
    return orbit(azimuth, azimuth % 40 - 15, 2.0, focal_length=1.875 * size, height=size, width=size)


def small(*, pose=False):
    torch.manual_seed(0)
    return R2N2(**SMALL, pose=pose).double().eval()


def scenes(B=2, V=3):
    images = torch.rand(B, V, 3, 9, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    return images, cameras_of(B, V)


def leaky(x):
    return np.where(x > 0, x, 0.01 * x)


def correlated(x, weight, bias):
    """A convolution (C, *sides) -> (O, *sides) in any number of dimensions: a sum over shifts of the padded input."""
    sides, kernel = x.shape[1:], weight.shape[2:]
    padded = np.pad(x, [(0, 0), *((k // 2, k // 2) for k in kernel)])
    total = np.zeros((len(weight), *sides))
    for shift in np.ndindex(*kernel):
        window = padded[(slice(None), *(slice(s, s + n) for s, n in zip(shift, sides, strict=True)))]
        total += np.tensordot(weight[(slice(None), slice(None), *shift)], window, 1)
    return total + bias.reshape(-1, *(1 for _ in sides))


def pooled(x):
    """Maxima over 2 x 2 pixels of an image with a border of one pixel that never wins."""
    channels, height, width = x.shape
    padded = np.pad(x, [(0, 0), (1, 1), (1, 1)], constant_values=-np.inf)
    h, w = height // 2 + 1, width // 2 + 1
    return padded[:, : 2 * h, : 2 * w].reshape(channels, h, 2, w, 2).max((2, 4))


def unpooled(x):
    """Twice the side, 0 between."""
    wide = np.zeros((x.shape[0], *(2 * side for side in x.shape[1:])))
    wide[:, ::2, ::2, ::2] = x
    return wide


def quaternion(R):
    """w, x, y, z with z >= 0: the eigenvector of Bar-Itzhack's matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g], [c + g, f + h, i - a - e, d - b],
         [h - f, c - g, d - b, a + e + i]]
    )  # fmt: skip
    x, y, z, w = np.linalg.eigh(K / 3)[1][:, -1]
    return np.array([w, x, y, z]) * (-1 if z < 0 else 1)


def expected_logits(model, images, rotations):
    """Of one scene, (V, D, H, W), by the formulas of the paper with the model's weights."""
    weights = {name: value.numpy() for name, value in model.state_dict().items()}

    def layer(x, name, *, transposed=False):
        weight = weights[name + ".weight"]
        if transposed:  # of a grid with zeros between: channels change places, and the kernel is turned about
            weight = np.flip(weight.swapaxes(0, 1), (2, 3, 4))
        return correlated(x, weight, weights[name + ".bias"])

    def linear(x, name):
        return weights[name + ".weight"] @ x + weights[name + ".bias"]

    hidden, coarse = SMALL["hidden"], SMALL["coarse"]
    state, logits = np.zeros((hidden, coarse, coarse, coarse)), []
    for image, rotation in zip(images, rotations, strict=True):
        x = image
        for block, shortcut in enumerate(SMALL["shortcuts"]):
            y = leaky(layer(leaky(layer(x, f"encoder.{block}.first")), f"encoder.{block}.second"))
            if shortcut == "convolution":
                y = y + layer(x, f"encoder.{block}.shortcut")
            x = pooled(y + x if shortcut == "identity" else y)
        vector = leaky(linear(x.ravel(), "vector"))
        if model.settings.pose:
            turned = leaky(linear(leaky(linear(quaternion(rotation), "rotation.0")), "rotation.2"))
            vector = np.concatenate((vector, turned))
        read = (weights["recurrence.read.weight"] @ vector).reshape(3, *state.shape)
        W, b = weights["recurrence.gates.weight"], weights["recurrence.gates.bias"]
        update = sigmoid(read[0] + correlated(state, W[:hidden], b[:hidden]))
        reset = sigmoid(read[1] + correlated(state, W[hidden:], b[hidden:]))
        candidate = np.tanh(read[2] + layer(reset * state, "recurrence.candidate"))
        state = update * state + (1 - update) * candidate
        x = state
        for block in (0, 1):
            wide = unpooled(x)
            y = leaky(layer(wide, f"decoder.{block}.first", transposed=True))
            y = leaky(layer(y, f"decoder.{block}.second"))
            x = y + (wide if block == 0 else layer(wide, "decoder.1.shortcut", transposed=True))
        y = leaky(layer(x, "decoder.2.first"))
        empty, solid = layer(leaky(layer(y, "decoder.2.second")) + layer(y, "decoder.2.shortcut"), "decoder.2.classes")
        # Softmax of two classes, as a logit.
        odds = np.exp(solid) / (np.exp(solid) + np.exp(empty))
        logits.append(np.log(odds / (1 - odds)))
    return np.stack(logits)


@pytest.mark.parametrize("pose", [False, True])
def test_it_is_the_network_of_the_papers(pose):
    model, (images, cameras) = small(pose=pose), scenes()
    rotations = cameras.cam_from_world[..., :3, :3].numpy()
    expected = np.stack([expected_logits(model, images[b].numpy(), rotations[b]) for b in range(2)])
    logits = model(images, cameras).logits
    assert logits.shape == (2, 3, 8, 8, 8)
    np.testing.assert_allclose(logits.detach().numpy(), expected, rtol=1e-9, atol=1e-9)
    assert expected.std() > 0.05
    torch.testing.assert_close(model(images, cameras, steps="last").logits, logits[:, 2:])
    torch.testing.assert_close(model(images, cameras, steps=[2, 0]).logits, logits[:, [2, 0]])
    result = model.train().run(images, cameras)
    assert model.training
    torch.testing.assert_close(result.by_view, logits.detach().float().sigmoid())
    torch.testing.assert_close(result.occupancy, result.by_view[:, -1])
    assert model.run(images, cameras, by_view=False).by_view is None


def test_parameters_by_hand():
    """Of the original: images of 127 pixels, whose last maps have 3 x 3 pixels."""
    images = 3 * 96 * 49 + 96 + (96 * 96 * 9 + 96)
    images += (96 * 128 + 128 * 128) * 9 + 96 * 128 + 3 * 128
    images += (128 * 256 + 256 * 256) * 9 + 128 * 256 + 3 * 256
    images += 3 * (2 * 256 * 256 * 9 + 2 * 256) + 256 * 256 + 256
    recurrence = 3 * (1024 * 128 * 4**3 + 128 * 128 * 27 + 128)
    decoder = 2 * (2 * 128 * 128 * 27 + 2 * 128)
    decoder += (128 * 64 + 64 * 64) * 27 + 128 * 64 + 3 * 64
    decoder += (64 * 32 + 2 * 32 * 32) * 27 + 3 * 32 + (32 * 2 * 27 + 2)
    by_size = {127: 3, 224: 5}

    with torch.device("meta"):
        for size, side in by_size.items():
            expected = images + side * side * 256 * 1024 + 1024 + recurrence + decoder
            assert count(create("r2n2", image_size=size)) == expected
            pose = 4 * 128 + 128 + 128 * 128 + 128 + 3 * 128 * 128 * 4**3
            assert count(create("r2n2-pose", image_size=size)) == expected + pose
        assert images + 3 * 3 * 256 * 1024 + 1024 + recurrence + decoder == 35_968_706
        for name in ("r2n2", "r2n2-pose"):
            assert count(create(name, preset="tiny")) < 60_000


@pytest.mark.parametrize(
    ("preset", "sizes"), [("tiny", (32, 16)), ("compact", (64, 32)), ("standard", (64, 32)), ("paper", (224, 32))]
)
def test_presets_have_their_sizes(preset, sizes):
    for name in ("r2n2", "r2n2-pose"):
        with torch.device("meta"):
            model = create(name, preset=preset)
        assert (model.image_size, model.resolution) == sizes
        assert (model.name, model.output) == (name, "voxels")
        assert model.grid.shape == (sizes[1],) * 3
        assert model.settings.pose == (name == "r2n2-pose")


def test_rotations_are_read_only_with_pose():
    images, cameras = scenes()
    # Farther away, at another focal length: a rotation is all that is read.
    moved = cameras.cam_from_world.clone()
    moved[..., 2, 3] *= 3
    elsewhere = CameraTensors(2 * cameras.intrinsics, moved, cameras.height, cameras.width)
    elsewhere.intrinsics[..., 2, 2] = 1
    turned = cameras._replace(cam_from_world=cameras.cam_from_world.flip(1))
    plain, posed = small(), small(pose=True)
    assert torch.equal(plain(images, cameras).logits, plain(images, turned).logits)
    assert torch.equal(plain(images, cameras).logits, plain(images, None).logits)
    assert torch.equal(posed(images, cameras).logits, posed(images, elsewhere).logits)
    # Both changes reach the first view's answer.
    before, after = posed(images, cameras).logits[:, 0], posed(images, turned).logits[:, 0]
    assert (before - after).abs().max() > 1e-3


@pytest.mark.parametrize("pose", [False, True])
def test_ragged_scenes_equal_their_views_alone(pose):
    model, (images, cameras) = small(pose=pose), scenes(B=2, V=4)
    mask = torch.tensor([[True, False, True, False], [True, True, True, True]])
    kept = [0, 2]
    alone = model(images[:1, kept], CameraTensors(*(field[:1, kept] for field in cameras))).logits[0]
    full = model(images, cameras).logits[1]
    images[0, [1, 3]] = torch.nan
    extrinsics = cameras.cam_from_world.clone()
    extrinsics[0, [1, 3]] = torch.nan
    images.requires_grad_()
    logits = model(images, cameras._replace(cam_from_world=extrinsics), mask).logits
    torch.testing.assert_close(logits[0], alone[[0, 0, 1, 1]])
    assert torch.equal(logits[0, 0], logits[0, 1])
    assert torch.equal(logits[0, 2], logits[0, 3])
    torch.testing.assert_close(logits[1], full)
    logits.square().sum().backward()
    assert images.grad[0, [1, 3]].eq(0).all()
    assert images.grad[0, [0, 2]].abs().amax((1, 2, 3)).gt(0).all()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in model.parameters())


def test_a_view_more_changes_the_answer_and_none_that_went_before():
    model, (images, cameras) = small(), scenes()
    three = model(images, cameras).logits
    two = model(images[:, :2], cameras_of(2, 2)).logits
    torch.testing.assert_close(three[:, :2], two)
    assert (three[:, 2] - three[:, 1]).abs().max() > 1e-3


def test_a_rotation_has_one_quaternion():
    """Cameras all around: no jump but one, at the level of the horizon neither."""
    model = small(pose=True)
    azimuth = torch.arange(0, 360, 2, dtype=torch.float64)
    for elevation in (-20.0, 0.0, 30.0):
        views = orbit(azimuth[None], elevation, 2.0, focal_length=9.0, height=9, width=9)
        mask = torch.ones(1, len(azimuth), dtype=torch.bool)
        found = model._quaternions(views, mask, torch.zeros(1, dtype=torch.float64))[0]
        torch.testing.assert_close(found.norm(dim=-1), torch.ones(len(azimuth), dtype=torch.float64))
        steps = (found - found.roll(1, 0)).norm(dim=-1)
        assert int((steps > 0.1).sum()) == 1
    below, above = (orbit(azimuth[None] + 1, e, 2.0, focal_length=9.0, height=9, width=9) for e in (-1e-6, 1e-6))
    ends = [model._quaternions(views, mask, torch.zeros(1, dtype=torch.float64)) for views in (below, above)]
    torch.testing.assert_close(*ends, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"chanels": (1, 2)}, "no setting 'chanels'"),
        ({"channels": ()}, "channels must be"),
        ({"shortcuts": ("none",)}, "shortcuts must be one for each"),
        ({"shortcuts": ("none", "identity", "none")}, "where channels change"),
        ({"shortcuts": ("none", "none", "other")}, "shortcuts must be .*'none', 'convolution', 'identity'"),
        ({"features": 0}, "features must be int, from 1 to 65536; got int 0"),
        ({"pose": 1}, "pose must be bool; got int 1"),
    ],
)
def test_impossible_settings_are_named(change, message):
    with pytest.raises(OptionError, match=message):
        R2N2(**{**SMALL, **change})


def test_what_does_not_belong_together_is_named():
    model, (images, cameras) = small(pose=True), scenes()
    with pytest.raises(ShapeError, match=r"images must be \(B, V, 3, 9, 9\)"):
        model(images[..., :8], cameras)
    with pytest.raises(ShapeError, match="leading shape"):
        model(images[:, :2], cameras)
    with pytest.raises(CameraError, match="rotation"):
        model(images, cameras._replace(cam_from_world=cameras.cam_from_world.sign()))
    with pytest.raises(OptionError, match="steps"):
        model(images, cameras, steps=[3])
    with pytest.raises(OptionError, match="steps"):
        model(images, cameras, steps="first")
