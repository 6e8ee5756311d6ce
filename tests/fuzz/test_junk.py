"""Junk in every argument of every public function, each case in a forked child.

A case passes if an error of ours says what must be and names the argument, or if the answer is finite and has the shape
that it must have.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from lsmgeo.errors import LsmGeoError
from tests.fuzz.forked import outcomes
from tests.fuzz.junk import JUNK, NEVER, mutations
from tests.fuzz.positions import CALLS, POSITIONS, SHAPE, B, C, P, Position, V, tensors_of

# Arrays whose values pass through the operators, so that what is not finite there is not finite in the answer.
VALUES = {"features", "volume", "scores", "maps", "alpha", "values", "weight", "weights", "bias"}
# Sums of products with these have no bound below overflow.
UNBOUNDED = {"project_reduce", "ProjectReduce", "composite", "splat", "splat without weights", "Splat"}
# Calls that take any leading shape: how many leading axes the right call has.
LEADING = {"expected_depth": 1, "max_along_rays": 1, "composite": 1, "look_at": 1, "orbit": 1, "depth_planes": 0}
LEADING |= {"VoxelGrid": 0, "from_opencv": 2, "from_opengl": 2, "from_colmap": 2, "from_pytorch3d": 2}
# Valid values that ask for another shape.
IMAGE_MAPS = [(B, V, C * P, 12, 14), (B, V, P, 12, 14)]
SHAPES: dict[tuple[str, str, str], list[tuple[int, ...]]] = {
    ("unproject with reduce", "reduce", "None"): [(B, V, C, *SHAPE), (B, V, *SHAPE)],
    ("plane_sweep_project", "size", "None"): IMAGE_MAPS,
    ("PlaneSweepProject", "size", "None"): IMAGE_MAPS,
    ("project_reduce", "size", "None"): [(B, V, 2, 12, 14), (B, V, P, 12, 14)],
    ("ProjectReduce", "size", "None"): [(B, V, 2, 12, 14), (B, V, P, 12, 14)],
    ("FrustumGrid", "size", "None"): [(B, P, 12, 14, 3), (B, 4, 4)],
    ("rays", "size", "None"): [(B, V, 3), (B, V, 12, 14, 3)],
    ("unproject_depth", "depth", "transposed"): [(B, V, 9, 8, 3)],
    ("unproject_depth", "depth", "strided"): [(B, V, 8, 2, 3)],
    ("stack", "dim", "zero"): [(2, V, 3, 3), (2, V, 4, 4), (2, V), (2, V)],
}
# Whom a message blames where it is not the call's own name.
BLAMED = {
    "unproject": "Unproject",
    "plane_sweep_project": "PlaneSweepProject",
    "splat": "Splat",
    "from_kornia": "(from_kornia|cameras)",
}
BLAMED |= {"Mean": "view_statistics", "ProjectReduce": "(ProjectReduce|project_reduce)"}
WHAT_CAME = r"got |\bis -?\d|that is|must be finite|must not be zero|must span"


def shapes_of(answer: Any) -> list[tuple[int, ...]]:
    return [tuple(tensor.shape) for tensor in tensors_of(answer)]


RIGHT_SHAPES = {
    name: shapes_of(function(**arguments)) for name, (function, arguments) in CALLS.items() if name != "explain"
}
RIGHT_SHAPES["explain"] = []


def complaint_about_message(message: str, call: str, argument: str, is_never_right: bool) -> str:
    """What an error message lacks, or nothing."""
    function = call.split()[0]
    if not re.match(rf"{BLAMED.get(function, re.escape(function))}: ", message):
        return "does not begin with the function"
    # What can never be right is the fault of this argument alone; else two arguments may disagree.
    blamed = [argument] if is_never_right else list(CALLS[call][1])
    if argument == "camera" or not is_never_right:
        blamed.append("cameras")
    if not any(re.search(rf"\b{re.escape(name)}\b", message) for name in blamed):
        return "does not name the argument"
    if " must " not in f" {message} ":
        return "does not say what must be"
    return "" if re.search(WHAT_CAME, message) else "does not say what came"


def complaint_about_answer(answer: Any, position: Position, junk: str, value: Any) -> str:
    """What is wrong with an answer, or nothing."""
    if junk in NEVER:
        return "accepted"
    given = [tensor for tensor in tensors_of(value) if tensor.is_floating_point() and tensor.device.type != "meta"]
    may_overflow = position.argument in VALUES and (
        position.call in UNBOUNDED or not all(bool(tensor.isfinite().all()) for tensor in given)
    )
    for tensor in tensors_of(answer):
        if tensor.is_floating_point() and tensor.device.type != "meta" and not may_overflow:
            if not bool(tensor.isfinite().all()):
                return "not finite"
    shapes = shapes_of(answer)
    expected = SHAPES.get((*str(position)[:-1].split("("), junk), RIGHT_SHAPES[position.call])
    if position.call in LEADING and len(shapes) == len(expected):
        tails = [shape[LEADING[position.call] :] for shape in expected]
        leading = {shape[: len(shape) - len(tail)] for shape, tail in zip(shapes, tails, strict=True)}
        fits = len(leading) == 1 and shapes == [(*next(iter(leading)), *tail) for tail in tails]
    else:
        fits = shapes == expected
    return "" if fits else f"shapes {shapes}, expected {expected}"


def judge(position: Position, junk: str, make: Callable[[Any], Any], seed: int | None = None) -> str:
    """Run a case; "error", "answer", or what is wrong."""
    value = make(position.right)
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            answer = position.run(value)
    except LsmGeoError as error:
        complaint = complaint_about_message(str(error), position.call, position.argument, junk in NEVER)
        return f"{complaint}: {error}" if complaint else "error"
    except BaseException as error:
        if junk == "huge expanded" and position.call in LEADING and "can't allocate memory" in str(error):
            return "error"  # as many scenes as that: PyTorch says what is missing
        return f"{type(error).__name__}: {str(error)[:200]}"
    return complaint_about_answer(answer, position, junk, value) or "answer"


def failures(cases: list[tuple[Position, str]], results: list[str]) -> list[str]:
    return [
        f"{position} <- {junk}: {result}"
        for (position, junk), result in zip(cases, results, strict=True)
        if result not in ("error", "answer")
    ]


@pytest.mark.parametrize("call", CALLS)
def test_junk_in_any_argument(call):
    cases = [(position, junk) for position in POSITIONS if position.call == call for junk in JUNK]
    results = outcomes(cases, lambda case: judge(*case, JUNK[case[1]]))
    assert len(results) == len(cases)
    assert failures(cases, results) == []
    assert results.count("error") >= 0.5 * len(cases)  # junk is not mostly right
    for (position, junk), result in zip(cases, results, strict=True):
        if junk in NEVER:
            assert result == "error", f"{position} <- {junk}"


def test_there_are_enough_cases():
    assert len(POSITIONS) >= 30
    assert len(JUNK) >= 25
    public = {name.split()[0] for name in CALLS}
    assert {"unproject", "plane_sweep_project", "VoxelGrid", "FrustumGrid", "depth_planes", "from_colmap"} <= public


def outcomes_of_two(cases: list[int]) -> list[str]:
    """Outcomes of random damage to one or two arguments of a random call, by seed."""

    def run(seed: int) -> str:
        generator = np.random.default_rng(seed)
        torch.manual_seed(seed)
        name = list(CALLS)[generator.integers(len(CALLS))]
        function, arguments = CALLS[name]
        arguments = dict(arguments)
        for argument in generator.choice(list(arguments), size=min(len(arguments), 2), replace=False):
            arguments[argument] = next(mutations(arguments[argument], generator))
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                function(**arguments)
        except LsmGeoError as error:
            return "error" if " must " in f" {error} " else f"seed {seed}: {name}: {error}"
        except BaseException as error:
            if "can't allocate memory" in str(error):
                return "error"
            return f"seed {seed}: {name}: {type(error).__name__}: {str(error)[:200]}"
        return "answer"

    return outcomes(cases, run)


@pytest.mark.parametrize("part", range(2))
def test_damage_to_two_arguments(part):
    count = 10_000 if os.environ.get("HYPOTHESIS_PROFILE") == "long" else 500
    results = outcomes_of_two(list(range(part * count, (part + 1) * count)))
    assert [result for result in results if result not in ("error", "answer")] == []
    assert results.count("error") > 0
    assert results.count("answer") > 0


def test_a_crash_and_a_hang_are_outcomes():
    def run(case: str) -> str:
        if case == "crash":
            os.abort()
        while case == "hang":
            pass
        return case

    results = outcomes(["one", "crash", "two", "hang", "three"], run, timeout=1.0, batch=3)
    assert results == ["one", "killed by signal 6, exit 0", "two", "hangs", "three"]
