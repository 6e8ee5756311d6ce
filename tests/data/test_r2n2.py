"""3D-R2N2's renderings: the views and voxels of a ball traced with Blender's own turns agree with the readers."""

import shutil

import numpy as np
import pytest
import torch

from lsmgeo import data
from lsmgeo.errors import DataError
from tests.data.hostile import TRIALS, judged, mutated
from tests.data.release_writers import CENTRE, MODEL, R2N2_VIEWS, RADIUS, SYNSET, write_r2n2
from tests.fuzz.forked import outcomes


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_r2n2(tmp_path_factory.mktemp("r2n2"))


@pytest.fixture
def folder(written, tmp_path):
    shutil.copytree(written, tmp_path / SYNSET / MODEL)
    return tmp_path / SYNSET / MODEL


def refused(folder, match, file=None):
    with pytest.raises(DataError, match=match) as caught:
        data.read_r2n2(folder)
    if file is not None:
        assert str(caught.value.path).endswith(file)


def test_images_show_the_ball_where_the_cameras_see_it(written):
    """A ray that is half a pixel off, or turned the other way, misses the ball's edge or its colours."""
    scene = data.open(written)
    assert (scene.source, scene.category, len(scene)) == ("r2n2", "chair", len(R2N2_VIEWS))
    for view, (*_, distance) in enumerate(R2N2_VIEWS):
        K, E = scene.cameras.intrinsics[view], scene.cameras.cam_from_world[view]
        assert K.tolist() == [[70.0, 0.0, 31.5], [0.0, 70.0, 31.5], [0.0, 0.0, 1.0]]
        center = -E[:3, :3].T @ E[:3, 3]
        np.testing.assert_allclose(float(center.norm()), 1.75 * distance)
        v, u = torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij")
        pixels = torch.stack([u, v, torch.ones_like(u)], -1).double()
        rays = pixels @ torch.linalg.inv(K).T @ E[:3, :3]
        rays = rays / rays.norm(dim=-1, keepdim=True)
        offset = center - torch.from_numpy(CENTRE)
        along = (rays @ offset)[..., None]
        miss = (offset - along * rays).norm(dim=-1)
        mask = scene.load_mask(view)
        assert int(mask.sum()) > 150
        assert torch.equal(mask, miss <= RADIUS)
        # The colour is the normal, so it tells where on the ball a pixel looks.
        points = offset - (along + (RADIUS**2 - miss**2).clamp(min=0).sqrt()[..., None]) * rays
        expected = 0.5 + 0.4 * points / RADIUS
        error = (scene.load(view).permute(1, 2, 0).double() - expected)[mask].abs().max()
        assert float(error) < 0.5 / 255 + 1e-6


@pytest.mark.parametrize("apart", [False, True])
def test_voxels_are_the_ball_whatever_their_header_says(tmp_path, apart):
    home = write_r2n2(tmp_path, apart=apart)
    for path in (home, home / "rendering", home / "rendering" / "rendering_metadata.txt"):
        voxels = data.open(path).voxels
        assert voxels.grid.lower == (-0.45,) * 3
        inside = torch.linalg.norm(voxels.grid.centers().double() - torch.from_numpy(CENTRE), dim=-1) <= RADIUS
        assert torch.equal(voxels.occupancy, inside)
    sample = data.open(home).sample()
    assert (sample.name, sample.category) == (MODEL, "chair")
    # The cube of voxels becomes the unit cube, and the distance of the camera is scaled with it.
    np.testing.assert_allclose(float(sample.cameras.cam_from_world[0, 2, 3]), 1.75 * 0.8 / 0.9)


def test_what_may_be_missing(folder):
    (folder / "model.binvox").unlink()
    (folder / "rendering" / "renderings.txt").unlink()
    scene = data.open(folder)
    assert scene.voxels is None
    assert scene.names == ("00.png", "01.png", "02.png", "03.png", "04.png")


def test_names_come_from_their_list(folder):
    (folder / "rendering" / "renderings.txt").write_text("03.png 01.png 02.png 00.png 04.png")
    assert data.open(folder).names[0] == "03.png"


GOOD = "30 20 0 0.8 25\n"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "1 to 1000 lines"),
        (GOOD * 1001, "1 to 1000 lines"),
        ("30 20 0 0.8\n" * 5, "lines of azimuth"),
        ("30 20 0 0.8 25 1\n" * 5, "lines of azimuth"),
        ("a b c d e\n" * 5, "expected numbers"),
        (GOOD * 4 + "nan 20 0 0.8 25\n", "finite"),
        (GOOD * 4 + "30 20 1e999 0.8 25\n", "finite"),
        (GOOD * 4 + "30 20 0 0 25\n", "an invalid distance"),
        (GOOD * 4 + "30 20 0 -1 25\n", "an invalid distance"),
        (GOOD * 4 + "30 20 0 1e300 25\n", "an invalid distance"),
        (GOOD * 4 + "1e300 20 0 1 25\n", "an angle beyond"),
        (GOOD * 4 + "9" * 5000 + " 20 0 1 25\n", "number too long"),
        (GOOD * 6, "must name 6 different images"),
        ("\0" + GOOD * 5, "zero byte"),
        (GOOD * 100_000, "larger than the limit"),
    ],
)
def test_metadata_that_lies_is_refused(folder, text, match):
    (folder / "rendering" / "rendering_metadata.txt").write_text(text)
    refused(folder, match, "renderings.txt" if "different" in match else "rendering_metadata.txt")


@pytest.mark.parametrize(
    ("names", "match"),
    [
        (["00.png"] * 5, "different"),
        (["../../secret.png", *"1234"], "outside its folder"),
        (["/etc/passwd", *"1234"], "outside its folder"),
        (["nothing.png", *"1234"], "no such file"),
        (["renderings.txt", *"1234"], "not a readable"),
        (["a\x07", *"1234"], "unusable file name"),
    ],
)
def test_lists_of_names_that_lie_are_refused(folder, names, match):
    (folder / "rendering" / "renderings.txt").write_text("\n".join(names))
    refused(folder, match)


def test_links_are_refused(folder, tmp_path):
    secret = tmp_path / "secret.binvox"
    (folder / "model.binvox").rename(secret)
    (folder / "model.binvox").symlink_to(secret)
    refused(folder, "outside its folder")
    (folder / "model.binvox").unlink()
    secret.rename(folder / "model.binvox")
    (folder / "model.binvox").write_text("#binvox 1\n")
    refused(folder, "no binvox header", "model.binvox")


def test_damaged_files_are_refused_or_read(folder):
    files = [folder / "rendering" / name for name in ("rendering_metadata.txt", "renderings.txt")]
    originals = [file.read_bytes() for file in files]
    rng = np.random.default_rng(0)
    cases = [(number % 2, mutated(rng, originals[number % 2])) for number in range(TRIALS)]

    def judge(case):
        which, content = case

        def run():
            for number, file in enumerate(files):
                file.write_bytes(content if number == which else originals[number])
            assert bool(data.read_r2n2(folder).cameras.cam_from_world.isfinite().all())

        return judged(run)

    before = sorted(folder.rglob("*"))
    results = outcomes(cases, judge)
    assert set(results) == {"read", "refused"}, set(results)
    assert results.count("refused") > TRIALS // 2
    assert sorted(folder.rglob("*")) == before
