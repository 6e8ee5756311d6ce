"""Who may import whom, read from the source."""

from __future__ import annotations

import ast
import importlib
import io
import subprocess
import sys
import tokenize
from pathlib import Path

import pytest

import lsmgeo

PACKAGE = Path(lsmgeo.__file__).parent
MODULES = {
    ".".join(("lsmgeo", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}

# Layers of the core, lowest first; a layer's modules import those named, and no others of the library.
SHARED = {"errors", "_checks", "_dtypes", "_linalg", "_old_names", "_torch_compat", "debugging"}
MAY_IMPORT = {
    "errors": set(),
    "_checks": {"errors"},
    "_dtypes": set(),
    "_linalg": set(),
    "_old_names": set(),
    "_torch_compat": set(),
    "debugging": {"_torch_compat"},
    "cameras": SHARED | {"cameras"},
    "grids": SHARED | {"cameras"},
    "kernels": {"errors", "_checks", "_dtypes", "_torch_compat", "debugging", "kernels"},
    "_sites": SHARED | {"cameras", "grids", "kernels"},
    "functional": SHARED | {"cameras", "grids", "kernels", "_sites"},
    "layers": SHARED | {"functional", "grids", "kernels", "_sites"},
    "fusion": SHARED | {"functional", "kernels"},
    "rays": SHARED | {"functional", "layers", "grids", "kernels", "_sites"},
}
# What the parts outside may import of each other; the core is open to all of them.
MAY_ALSO_IMPORT = {
    "scenes": set(),
    "metrics": set(),
    "data": {"scenes"},
    "drawing": {"data"},
    "diagnosis": {"data", "drawing"},
    "classical": {"data", "scenes", "drawing"},
    "models": {"data", "scenes", "metrics"},
    "training": {"models", "data", "scenes", "metrics", "drawing"},
    "evaluation": {"models", "training", "classical", "data", "scenes", "metrics", "drawing"},
    "reconstruct": {"models", "classical", "data", "scenes", "drawing"},
    "cli": {
        "training", "evaluation", "reconstruct", "diagnosis", "models", "classical", "data", "scenes", "drawing",
    },
}  # fmt: skip
OUTSIDE_THE_CORE = set(MAY_ALSO_IMPORT)
# The old places of `lsmgeo.training` and `lsmgeo.evaluation`, for this version.
OLD_PLACES = {"lsmgeo.models.training", "lsmgeo.models.evaluation"}
HEAVY = {"cv2", "trimesh", "skimage", "matplotlib", "jsonargparse", "triton", "scipy", "tqdm", "PIL"}


def imported(path: Path, module: str, source: str | None = None) -> set[str]:
    """Absolute names of everything that a file imports, with ``from a import b`` as a.b if that is a module."""
    names = set()
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8") if source is None else source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = package.split(".")
            base = ".".join(parts[: len(parts) - node.level + 1]) if node.level else ""
            origin = ".".join(filter(None, (base, node.module)))
            for alias in node.names:
                full = f"{origin}.{alias.name}"
                names.add(full if full in MODULES else origin)
    return names


def part(module: str) -> str:
    """The part of the library that a module belongs to: "cameras" for lsmgeo.cameras.tensors, "" for lsmgeo itself."""
    return ".".join(module.split(".")[1:2])


def core_modules() -> list[str]:
    return [module for module in MODULES if part(module) in MAY_IMPORT]


def violations(module: str, names: set[str]) -> set[str]:
    own = {part(name) for name in names if name.split(".")[0] == "lsmgeo"}
    return own - MAY_IMPORT[part(module)] - {part(module)}


def test_every_module_has_its_place():
    parts = {part(module) for module in MODULES} - {""}
    assert parts <= set(MAY_IMPORT) | OUTSIDE_THE_CORE, "give the new module a place in this table"
    assert set(MAY_IMPORT) <= parts


@pytest.mark.parametrize("module", core_modules())
def test_the_core_imports_along_the_arrows(module):
    names = imported(MODULES[module], module)
    assert violations(module, names) == set()
    allowed = {"triton"} if module.startswith("lsmgeo.kernels.triton.") else set()  # loaded with the first call
    assert {name.split(".")[0] for name in names} & HEAVY <= allowed


@pytest.mark.parametrize(
    "module", sorted(module for module in set(MODULES) - OLD_PLACES if part(module) in MAY_ALSO_IMPORT)
)
def test_what_is_outside_the_core_imports_along_its_arrows(module):
    own = {part(name) for name in imported(MODULES[module], module) if name.split(".")[0] == "lsmgeo"}
    assert own & OUTSIDE_THE_CORE <= MAY_ALSO_IMPORT[part(module)] | {part(module)}


def test_the_networks_need_no_trainer():
    """Who has the networks alone needs neither accelerate nor the trainer."""
    for module in set(MODULES) - OLD_PLACES:
        if part(module) == "models":
            assert {name.split(".")[0] for name in imported(MODULES[module], module)} & {
                "accelerate",
                "tensorboard",
            } == set()


@pytest.mark.parametrize("name", ["training", "evaluation"])
def test_old_places_name_the_new_ones(name):
    old = importlib.import_module(f"lsmgeo.models.{name}")
    new = importlib.import_module(f"lsmgeo.{name}")
    with pytest.warns(DeprecationWarning, match=f"lsmgeo.models.{name} is now lsmgeo.{name}"):
        assert all(getattr(old, public) is getattr(new, public) for public in new.__all__)
    assert old.__all__ == new.__all__  # for ``import *``
    with pytest.raises(AttributeError, match="has no attribute"):
        old.nothing  # noqa: B018


OLD_NAMES = [
    ("lsmgeo.data", "Made", "SetResult"),
    ("lsmgeo.drawing", "Picture", "Pixels"),
    ("lsmgeo.evaluation", "Contender", "Method"),
    ("lsmgeo.evaluation", "open_contenders", "open_methods"),
    ("lsmgeo.models", "MachineSettings", "TrunkSettings"),
]


@pytest.mark.parametrize(("module", "old", "new"), OLD_NAMES)
def test_old_names_name_the_new_ones(module, old, new):
    loaded = importlib.import_module(module)
    with pytest.warns(DeprecationWarning, match=f"{module}.{old} is now {module}.{new}"):
        assert getattr(loaded, old) is getattr(loaded, new)


PACKAGES = (
    "lsmgeo.scenes",
    "lsmgeo.scenes.synthetic13",
    "lsmgeo.data",
    "lsmgeo.metrics",
    "lsmgeo.models",
    "lsmgeo.training",
    "lsmgeo.evaluation",
)


@pytest.mark.parametrize("package", PACKAGES)
def test_scenes_and_data_import_lightly(package, brought):
    new = {name.split(".")[0] for name in brought[package]}
    later = {"embreex", "manifold3d", "joblib", "distributed", "webdataset", "accelerate", "tensorboard"}
    assert new & (HEAVY | later) == set()


def test_the_front_page_imports_the_core_alone():
    names = imported(MODULES["lsmgeo"], "lsmgeo")
    assert {part(name) for name in names} - {""} <= set(MAY_IMPORT)


@pytest.mark.parametrize(
    ("module", "source", "found"),
    [
        ("lsmgeo.cameras.tensors", "from lsmgeo.grids import VoxelGrid", {"grids"}),
        ("lsmgeo.grids", "import lsmgeo.kernels.reference", {"kernels"}),
        ("lsmgeo.kernels.reference", "def f():\n    from lsmgeo import cameras", {"cameras"}),
        ("lsmgeo.kernels.reference", "from ..grids import VoxelGrid", {"grids"}),
        ("lsmgeo.functional", "from lsmgeo import data", {"data"}),
        ("lsmgeo.layers", "from lsmgeo.functional import unproject", set()),
    ],
)
def test_the_arrows_are_noticed(module, source, found):
    path = MODULES[module]
    assert violations(module, imported(path, module, source)) == found


def names_in(path: Path) -> set[str]:
    """All names in a file's code: identifiers and attributes, no comments, no strings."""
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline)
    return {token.string for token in tokens if token.type == tokenize.NAME}


def test_one_module_knows_grid_sample():
    knowing = {
        module for module, path in MODULES.items() if names_in(path) & {"grid_sample", "affine_grid", "align_corners"}
    }
    assert knowing == {"lsmgeo.kernels.reference"}


# Attributes of public objects that only PyTorch should know.
PRIVATE_ATTRIBUTES = {"_dynamo_marked_constant"}


def private_names_of_pytorch(source: str) -> set[str]:
    """Private names of PyTorch that a source imports, or reads as attributes of what it imports from PyTorch."""
    tree, found, roots = ast.parse(source), set(), {"torch"}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        theirs = [name for name in names if name.split(".")[0] == "torch"]
        found |= {name for name in theirs if any(part.startswith("_") for part in name.split("."))}
        if theirs:
            roots |= {alias.asname or alias.name.split(".")[0] for alias in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
            root = node.value
            while isinstance(root, ast.Attribute):
                root = root.value
            if node.attr in PRIVATE_ATTRIBUTES or (isinstance(root, ast.Name) and root.id in roots):
                found.add(ast.unparse(node))
    return found


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("import torch\nx = torch._C._get_tracing_state()", {"torch._C._get_tracing_state", "torch._C"}),
        ("from torch.autograd import forward_ad as ad\nx = ad._current_level", {"ad._current_level"}),
        ("from torch.utils._pytree import tree_map", {"torch.utils._pytree.tree_map"}),
        ("f._dynamo_marked_constant = True", {"f._dynamo_marked_constant"}),
        ("import torch\nx = torch.__version__, torch.zeros(1)._ours", set()),
    ],
)
def test_private_names_of_pytorch_are_noticed(source, found):
    assert private_names_of_pytorch(source) == found


def test_private_names_of_pytorch_are_in_one_file():
    found = {module for module, path in MODULES.items() if private_names_of_pytorch(path.read_text(encoding="utf-8"))}
    assert found == {"lsmgeo._torch_compat"}


def test_only_cameras_know_the_camera_classes_of_kornia():
    classes = {"PinholeCamera", "PinholeCamerasList"}
    knowing = {part(module) for module, path in MODULES.items() if names_in(path) & classes}
    assert knowing - OUTSIDE_THE_CORE == {"cameras"}


def test_kernels_know_no_kornia():
    for module in core_modules():
        if part(module) not in ("cameras",):
            assert not any(name.startswith("kornia") for name in imported(MODULES[module], module)), module


@pytest.mark.parametrize(
    "module", [module for module in core_modules() if part(module) in ("cameras", "grids", "_linalg", "_sites")]
)
def test_geometry_is_elementwise(module):
    path = MODULES[module]
    assert names_in(path) & {"matmul", "einsum", "bmm", "mm", "mv", "tensordot", "baddbmm", "inv", "solve"} == set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        assert not (isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult)), node.lineno


# One new interpreter imports torch and kornia, which takes seconds, and is forked for each piece of code.
IMPORTS = """
import os, sys, warnings, torch, kornia.geometry
warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads
theirs = set(sys.modules)
for code in sys.argv[1:]:
    sys.stdout.flush()
    child = os.fork()
    if child == 0:
        exec(code)
        print(*sorted(set(sys.modules) - theirs), flush=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0, code
"""
FIRST_CALLS = """
views = cameras.orbit(torch.tensor([0.0, 120.0]), 20.0, 2.0, focal_length=250.0, height=192, width=256)
for name in ("opencv", "opengl", "colmap", "pytorch3d"):
    parts = getattr(cameras, f"to_{name}")(views)
    getattr(cameras, f"from_{name}")(*parts, height=192, width=256)
"""
OPERATORS = f"""
sys.modules |= dict.fromkeys({HEAVY | {"safetensors", "jinja2"}!r})  # which cannot be imported then
from lsmgeo import *
from lsmgeo.fusion import ConvGRU3d, Variance
views = cameras.orbit(torch.tensor([[0.0, 120.0]]), 20.0, 2.0, focal_length=20.0, height=16, width=20)
views = cameras.crop(cameras.perturb(views, 5.0), 1, 2, 12, 14)
features, grid = torch.rand(1, 2, 3, 6, 7, requires_grad=True), VoxelGrid(4)
volume, visible = Unproject(grid, augment=("depth", "direction"))(features, views)
points = functional.unproject_points(features, views, grid.centers().flatten(0, 2)[None], reduce="mean")
fused = Variance()(volume, visible) + ConvGRU3d(7, 7)(volume)
maps, seen = PlaneSweepProject(grid, depth_planes(1.0, 3.0, 5), size=(6, 7), flatten=False)(fused, views)
depth = rays.expected_depth(maps[:, :, 0], depth_planes(1.0, 3.0, 5))
reduced = rays.ProjectReduce(7, 2, grid, depth_planes(1.0, 3.0, 5), (6, 7))(fused, views)
(depth.sum() + points.volume.sum() + reduced.maps.sum()).backward()
assert features.grad.abs().sum() > 0
"""
CODE = {
    "lsmgeo": "from lsmgeo import *",
    "operators": OPERATORS,
    "first calls": f"from lsmgeo import *\n{FIRST_CALLS}",
    **{package: f"import {package}" for package in PACKAGES},
}


@pytest.fixture(scope="module")
def brought() -> dict[str, set[str]]:
    """Names of the modules that each piece of code imports, beyond those of torch and kornia."""
    command = [sys.executable, "-c", IMPORTS, *CODE.values()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    return {name: set(line.split()) for name, line in zip(CODE, done.stdout.splitlines(), strict=True)}


def test_the_import_is_light(brought):
    ours = brought["lsmgeo"]
    assert "lsmgeo.kernels.reference" in ours
    assert {name.split(".")[0] for name in ours} & HEAVY == set()
    assert {part(name) for name in ours if name.startswith("lsmgeo.")} <= set(MAY_IMPORT)


def test_the_operators_run_on_pytorch_kornia_and_numpy_alone(brought):
    """As after ``pip install --no-deps``; `make test-floors` runs their tests so."""
    assert "lsmgeo.layers" in brought["operators"]


def test_the_first_orbit_and_converters_import_nothing(brought):
    """PyTorch's own helpers can: `torch.broadcast_shapes` takes a third of a second to import sympy."""
    assert brought["first calls"] - brought["lsmgeo"] == set()


@pytest.mark.parametrize("arguments", [["--help"], ["--version"], ["train", "--help"]])
def test_the_command_line_answers_without_pytorch(arguments):
    code = """
import sys
from lsmgeo import cli
try:
    cli.main(sys.argv[1:])
finally:
    print(*sys.modules, file=sys.stderr)
"""
    command = [sys.executable, "-c", code, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert "lsmgeo" in done.stdout
    modules = {name.split(".")[0] for name in done.stderr.split()}
    assert "jsonargparse" in modules
    assert modules & {"torch", "kornia", "numpy"} == set()


def test_the_names_of_the_front_page_are_listed():
    assert set(lsmgeo.__all__) <= set(dir(lsmgeo))
    with pytest.raises(AttributeError, match="module 'lsmgeo' has no attribute 'VoxelGird'"):
        lsmgeo.VoxelGird  # noqa: B018


def test_no_test_asserts_a_time():
    """Timings belong to the benchmarks: on a busy machine a test of one fails for no reason."""
    clocks = {"perf_counter", "perf_counter_ns", "process_time", "monotonic", "monotonic_ns", "timeit"}
    clocked = []
    for path in sorted(Path(__file__).parents[1].rglob("test_*.py")):
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(function, ast.FunctionDef):
                continue
            used = {item.attr for item in ast.walk(function) if isinstance(item, ast.Attribute)}
            used |= {item.id for item in ast.walk(function) if isinstance(item, ast.Name)}
            if used & clocks:
                clocked.append(f"{path.name}:{function.lineno}")
    assert clocked == []


@pytest.mark.parametrize("module", core_modules())
def test_every_exported_name_exists(module):
    loaded = importlib.import_module(module)
    for name in getattr(loaded, "__all__", []):
        assert hasattr(loaded, name), name


def test_names_of_files_are_unique():
    """A reader who is told a file's name finds one; an old place holds nothing."""
    names: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        if path.name != "__init__.py" and module not in OLD_PLACES:
            names.setdefault(path.name, []).append(module)
    assert {name: modules for name, modules in names.items() if len(modules) > 1} == {}


def test_folders_are_small():
    folders = {path for path in PACKAGE.rglob("*") if path.is_dir() and path.name != "__pycache__"}
    crowded = {folder.name for folder in folders if sum(path.suffix != ".so" for path in folder.iterdir()) > 25}
    assert crowded == set()


def test_functions_are_short():
    long = [
        f"{module}.{node.name}"
        for module, path in MODULES.items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and node.end_lineno - node.lineno + 1 > 90
    ]
    assert long == []
