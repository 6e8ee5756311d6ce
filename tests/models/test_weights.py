"""Files of weights: they make the model that was written, and nothing else makes anything."""

from __future__ import annotations

import json
import os
import random
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

from lsmgeo.errors import CheckpointError, DTypeError, OptionError
from lsmgeo.models import create, load, settings_of, weights, write_weights
from lsmgeo.models.weights import read_weights
from lsmgeo.training.checkpoints import save_checkpoint
from tests.training.faults import in_child

NAMES = ("voxel-lsm", "depth-lsm", "r2n2", "r2n2-pose")


@pytest.fixture(scope="module")
def model():
    torch.manual_seed(0)
    return create("voxel-lsm", preset="tiny", encoder_channels=(4, 4), grid_channels=(4,), hidden_channels=4)


@pytest.fixture(scope="module")
def content(model, tmp_path_factory) -> bytes:
    return write_weights(tmp_path_factory.mktemp("weights") / "a.safetensors", model, about={"step": 3}).read_bytes()


@pytest.fixture
def path(tmp_path, content) -> Path:
    path = tmp_path / "model.safetensors"
    path.write_bytes(content)
    return path


def split(content: bytes) -> tuple[dict, bytes]:
    length = int.from_bytes(content[:8], "little")
    return json.loads(content[8 : 8 + length]), content[8 + length :]


def joined(header: dict | bytes, data: bytes) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def signed(tensors: dict[str, torch.Tensor], settings: object, about: object = None) -> bytes:
    """A file whose checksum is right: who can write the one can write the other."""
    metadata = {"format": weights.FORMAT, "settings": json.dumps(settings), "about": json.dumps(about or {})}
    metadata["sha256"] = weights.checksum(metadata, tensors)
    return safetensors.torch.save(tensors, metadata)


@pytest.mark.parametrize("name", NAMES)
def test_a_model_comes_back_as_it_was(tmp_path, name):
    torch.manual_seed(1)
    model = create(name, preset="tiny")
    path = write_weights(tmp_path / "folder" / "model.safetensors", model)
    state = torch.get_rng_state()
    loaded = load(path)
    assert torch.equal(torch.get_rng_state(), state)
    assert type(loaded) is type(model)
    assert settings_of(loaded) == settings_of(model)
    torch.testing.assert_close(loaded.state_dict(), model.state_dict(), rtol=0, atol=0)
    assert not any(tensor.is_meta for tensor in [*loaded.parameters(), *loaded.buffers()])
    assert [p.requires_grad for p in loaded.parameters()] == [p.requires_grad for p in model.parameters()]
    assert not loaded.training
    assert os.listdir(path.parent) == ["model.safetensors"]


def test_it_is_an_ordinary_safetensors_file_with_settings_and_notes(path, model):
    tensors = safetensors.torch.load_file(path)
    torch.testing.assert_close(tensors, dict(model.state_dict()), rtol=0, atol=0)
    found = read_weights(path)
    assert found.settings == settings_of(model)
    assert found.about == load(path).about == {"step": 3}


def test_a_checkpoint_and_a_run_folder_are_read_too(tmp_path, model):
    for step in (1, 2):
        save_checkpoint(tmp_path / "checkpoints", step, model=model, state={}, config={"run": {"batch": 4}})
    second = tmp_path / "checkpoints" / "step_00000002"
    for path in (tmp_path, tmp_path / "checkpoints", second, second / "model.safetensors"):
        assert read_weights(path).about == {"step": 2, "training": {"run": {"batch": 4}}}
        assert load(str(path)).name == "voxel-lsm"
    (second / "model.safetensors").write_bytes(b"")
    with pytest.warns(UserWarning, match=r"step_00000002.* Going back to .*step_00000001"):
        assert read_weights(tmp_path).about["step"] == 1
    with pytest.raises(CheckpointError, match="step_00000002"):
        load(second)
    shutil.rmtree(tmp_path / "checkpoints" / "step_00000001")
    with pytest.raises(CheckpointError, match=r"no checkpoint verifies: .*step_00000002"):
        load(tmp_path)


def test_what_is_not_there_is_reported(tmp_path):
    with pytest.raises(CheckpointError, match="no such file"):
        load(tmp_path / "none.safetensors")
    with pytest.raises(CheckpointError, match=r"holds neither model\.safetensors nor a checkpoint"):
        load(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(CheckpointError, match="no such file"):
        load(tmp_path / "pipe")


def test_what_cannot_be_written_is_reported(tmp_path, model):
    (tmp_path / "file").write_text("")
    with pytest.raises(CheckpointError, match="cannot be written"):
        write_weights(tmp_path / "file" / "model.safetensors", model)
    with pytest.raises(OptionError, match="about must consist of what JSON has"):
        write_weights(tmp_path / "model.safetensors", model, about={"path": tmp_path})
    with pytest.raises(DTypeError, match=r"model must be one of lsmgeo\.models\.create, not wrapped"):
        write_weights(tmp_path / "model.safetensors", torch.nn.Linear(1, 1))
    assert os.listdir(tmp_path) == ["file"]


# Damage (F3, F4)


def test_a_truncated_file_is_refused(path, content):
    for length in np.linspace(0, len(content) - 1, 64).astype(int):
        path.write_bytes(content[:length])
        with pytest.raises(CheckpointError, match=r"model\.safetensors"):
            load(path)
    path.write_bytes(content + b"\0")
    with pytest.raises(CheckpointError, match=r"model\.safetensors"):
        load(path)


def test_a_flipped_bit_is_refused(path, content, model):
    """200 of them, half in the header: names, shapes, settings and notes count as much as numbers."""
    header = int.from_bytes(content[:8], "little") + 8
    rng = random.Random(0)
    for bit in rng.sample(range(8 * header), 100) + rng.sample(range(8 * header, 8 * len(content)), 100):
        flipped = bytearray(content)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        with pytest.raises(CheckpointError, match=r"model\.safetensors"):
            read_weights(path)


# Files made to harm


def test_a_header_that_promises_too_much_is_refused_unread(path, content):
    for length in (2**63, 2**40, len(content), weights.MAX_HEADER_BYTES + 1):
        path.write_bytes(length.to_bytes(8, "little") + content[8:])
        with pytest.raises(CheckpointError, match="is not a whole file of weights"):
            load(path)


def changed(content: bytes, change) -> bytes:
    header, data = split(content)
    change(header)
    return joined(header, data)


def first(header: dict) -> dict:
    return next(entry for name, entry in header.items() if name != "__metadata__")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda header: header.pop("__metadata__"), "is damaged, or not a file of weights"),
        (lambda header: header.update(__metadata__=[]), "is damaged, or not a file of weights"),
        (lambda header: header["__metadata__"].pop("format"), "is damaged, or not a file of weights"),
        (lambda header: header["__metadata__"].update(format="lsmgeo-weights-2"), "is of format 'lsmgeo-weights-2'"),
        (lambda header: header["__metadata__"].update(format=3), "is damaged, or not a file of weights"),
        (lambda header: header["__metadata__"].update(about=3), "is damaged, or not a file of weights"),
        (lambda header: header["__metadata__"].pop("settings"), "is damaged"),
        (lambda header: header["__metadata__"].update(settings="{"), "is damaged"),
        (lambda header: header["__metadata__"].pop("sha256"), "is damaged"),
        (lambda header: header["__metadata__"].update(extra="x"), "is damaged"),
        (lambda header: first(header).update(shape=[2**39, 2**39]), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(shape=[-1]), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(shape=[1.5]), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(shape=[1] * 9), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(shape=7), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(dtype="F8_E5M2"), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(dtype=[]), "is damaged, or not a file of weights"),
        (lambda header: first(header).update(data_offsets=[0, 2**39]), "is damaged, or not a file of weights"),
        (lambda header: header.update(twice=first(header)), "is damaged, or not a file of weights"),
        (lambda header: header.update({f"t{n}": first(header) for n in range(10_001)}), "the limit is 10000"),
        (lambda header: header.update(more=3), "is damaged, or not a file of weights"),
    ],
)
def test_a_header_that_lies_is_refused(path, content, change, match):
    path.write_bytes(changed(content, change))
    with pytest.raises(CheckpointError, match=match):
        load(path)


@pytest.mark.parametrize("header", [b"", b"[]", b"null", b"{", b"[" * 100_000, b'{"a":' * 50_000, b"\xff\xfe", b"7"])
def test_a_header_that_is_none_is_refused(path, header):
    path.write_bytes(joined(header, b""))
    with pytest.raises(CheckpointError, match="is damaged, or not a file of weights"):
        load(path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda tensors: tensors.popitem(), r"lacks \S+, \("),
        (lambda tensors: tensors.update(extra=torch.zeros(1)), "holds extra, which the model does not have"),
        (
            lambda tensors: tensors.update({k: v[:1].clone() for k, v in [*tensors.items()][:1]}),
            r"as \(1,.*; the model has",
        ),
        (lambda tensors: tensors.update({k: v.double() for k, v in [*tensors.items()][:1]}), "float64; the model has"),
    ],
)
def test_tensors_that_do_not_fit_the_settings_are_refused_by_name(path, model, change, match):
    tensors = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    change(tensors)
    path.write_bytes(signed(tensors, settings_of(model)))
    with pytest.raises(CheckpointError, match=match):
        load(path)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ([], "holds invalid settings"),
        ({}, "holds settings of no model"),
        ({"name": "voxel-lsn"}, "holds settings of no model .*voxel-lsm"),
        ({"name": "voxel-lsm", "colour": "red"}, "holds settings of no model"),
        ({"name": "voxel-lsm", "hidden_channels": "many"}, "holds settings of no model"),
        ({"name": "voxel-lsm", "encoder_channels": None}, "holds settings of no model"),
        ({"name": ["voxel-lsm"]}, "holds settings of no model"),
        ({"name": "depth-lsm", "far": 10**400}, "holds settings of no model .*far must be float, above 0"),
        ({"name": "depth-lsm", "far": float("nan")}, "holds settings of no model .*far must be float, above 0"),
    ],
)
def test_settings_of_no_model_are_refused(path, settings, match):
    path.write_bytes(signed({}, settings))
    with pytest.raises(CheckpointError, match=match):
        load(path)


@pytest.mark.parametrize("name", NAMES)
def test_settings_of_a_huge_model_take_no_memory(path, name):
    """A hundred bytes that describe a model of many gigabytes."""
    keys = [key for key in settings_of(create(name, preset="tiny")) if key.endswith("channels")]
    key = "hidden_channels" if "hidden_channels" in keys else keys[0]
    path.write_bytes(signed({}, {"name": name, key: 4096}))

    def work() -> None:
        with open("/proc/self/statm") as file:
            used = int(file.read().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (used + (256 << 20), resource.RLIM_INFINITY))
        with pytest.raises(CheckpointError, match=r"lacks|holds settings of no model"):
            load(path)

    assert in_child(work) == 0


def test_a_pickle_is_no_file_of_weights(path, tmp_path, model):
    torch.save(model.state_dict(), path)
    with pytest.raises(CheckpointError, match="is not a"):
        load(path)


@pytest.mark.long
def test_loading_weights_loads_no_other_systems():
    """A model on the meta device would import sympy, which takes seconds."""
    code = (
        "import sys, tempfile; from lsmgeo.models import *\n"
        "with tempfile.TemporaryDirectory() as folder:\n"
        "    for name in ('depth-lsm', 'r2n2'):\n"
        "        load(write_weights(folder + '/a.safetensors', create(name, preset='tiny')))\n"
        "assert not {'sympy', 'accelerate', 'tensorboard'} & set(sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_half_precision_takes_half_the_space_and_loads_as_float32(tmp_path, model, content):
    path = write_weights(tmp_path / "half.safetensors", model, about={"step": 3}, half=True)
    assert path.stat().st_size < 0.65 * len(content)
    found, expected = load(path).state_dict(), model.state_dict()
    for name, tensor in found.items():
        assert tensor.dtype == torch.float32
        torch.testing.assert_close(tensor, expected[name].half().float(), rtol=0, atol=0)
    other = create("voxel-lsm", preset="tiny", encoder_channels=(4, 4), grid_channels=(4,), hidden_channels=4)
    weights.fill_model(other, read_weights(path))
    torch.testing.assert_close(other.state_dict(), found, rtol=0, atol=0)


def test_half_precision_that_overflows_is_refused(tmp_path):
    model = create("voxel-lsm", preset="tiny", encoder_channels=(4, 4), grid_channels=(4,), hidden_channels=4)
    with torch.no_grad():
        next(model.parameters()).fill_(1e6)
    with pytest.raises(OptionError, match="not finite in float16"):
        write_weights(tmp_path / "half.safetensors", model, half=True)
    assert not (tmp_path / "half.safetensors").exists()


def test_half_precision_is_for_float32_only(tmp_path, model):
    """A file whose tensors are half of what the model has otherwise is no file of this model."""
    path = tmp_path / "double.safetensors"
    halves = {name: tensor.half() for name, tensor in model.state_dict().items()}
    path.write_bytes(signed(halves, settings_of(model)))
    weights.fill_model(create(**settings_of(model)), read_weights(path))
    with pytest.raises(CheckpointError, match=r"as .* float16; the model has .* float64"):
        weights.fill_model(create(**settings_of(model)).double(), read_weights(path))
