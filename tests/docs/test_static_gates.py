"""The static gates find what they name, and the library passes them."""

import pytest

from tests import static_gates

BAD_LINES = [
    "torch.load(path, weights_only=False)",
    "pickle.load(file)",
    "np.load(path, allow_pickle=True)",
    "yaml.load(text)",
    "archive.extractall(folder)",
    "scipy.io.loadmat(path)",
    "eval(text)",
    "F.interpolate(x, scale_factor=2, align_corners=True)",
    "y = x / (z + 1e-8)",
    "F.grid_sample(x, g)",
    "isinstance(value, int | np.integer)",
    "torch.broadcast_shapes(a, b)",
]
GOOD_LINES = [
    "model.eval()",
    "# F.grid_sample(x, g, align_corners=True)",
    "'weights_only=False'",
    "archive.extractall(folder, filter='data')",
    "near = 1e-6",
    "isinstance(value, (int, float)) and a | b",
]


@pytest.mark.parametrize("line", BAD_LINES)
def test_a_banned_construct_is_found(line):
    assert len(static_gates.violations("lsmgeo/any.py", line + "\n")) == 1


@pytest.mark.parametrize("line", GOOD_LINES)
def test_a_harmless_line_passes(line):
    assert static_gates.violations("lsmgeo/any.py", line + "\n") == []


def test_a_gate_keeps_to_its_folders():
    assert static_gates.violations("lsmgeo/kernels/reference.py", "F.grid_sample(x, g)\n") == []
    assert static_gates.violations("lsmgeo/data/formats/mat_files.py", "scipy.io.loadmat(file)\n") == []
    assert len(static_gates.violations("lsmgeo/data/formats/format_lsm.py", "scipy.io.loadmat(file)\n")) == 1
    assert len(static_gates.violations("lsmgeo/cameras/core.py", "torch.einsum('ij,j', a, b)\n")) == 1
    assert static_gates.violations("lsmgeo/fusion.py", "torch.einsum('ij,j', a, b)\n") == []


def test_the_library_passes(capsys):
    assert static_gates.main() == 0, capsys.readouterr().out
