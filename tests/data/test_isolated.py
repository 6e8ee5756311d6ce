"""Parsers that misbehave in every way: each becomes a DataError that names the file, and nothing else happens."""

import runpy
import threading

import numpy as np

from lsmgeo.data.isolated import parse_isolated
from lsmgeo.errors import DataError

NO_ANSWER = "made its parser return an invalid answer"
HEAD = "import os, sys\nimport numpy as np\ndef parse(content, *arguments):\n"


def run(tmp_path, body, contents=(b"",), *arguments, **limits):
    script = tmp_path / "script.py"
    script.write_text(HEAD + "".join(f"    {line}\n" for line in body.split("\n")))
    paths = [tmp_path / f"{number}.bin" for number in range(len(contents))]
    for path, content in zip(paths, contents, strict=True):
        path.write_bytes(content)
    before = sorted(tmp_path.iterdir())
    parse = runpy.run_path(str(script))["parse"]
    found = parse_isolated(
        parse, paths, *arguments, **({"limit": 1 << 24, "memory": 1 << 30, "seconds": 20.0} | limits)
    )
    assert sorted(tmp_path.iterdir()) == before
    for path, answer in zip(paths, found, strict=True):
        assert not isinstance(answer, DataError) or (answer.path == path and answer.reason.isprintable())
    return found


def test_a_parser_gets_bytes_and_arguments_and_answers_with_arrays(tmp_path):
    # More than a pipe holds in both directions, so that neither side may wait for the other.
    content = bytes(range(256)) * 4000
    answer = '{"file": np.frombuffer(content, "u1")[::-1], "b/..": np.array(arguments[1]), "c": np.array([[1.5]])}'
    for arrays in run(tmp_path, f"print('text')\nreturn {answer}", [content, content], 7, ["x", "yz"]):
        assert list(arrays) == ["file", "b/..", "c"]
        assert arrays["file"].tobytes() == content[::-1]
        assert arrays["b/.."].tolist() == ["x", "yz"]
        assert (arrays["c"].dtype, arrays["c"].tolist()) == (np.float64, [[1.5]])


def test_a_parser_is_isolated(tmp_path, monkeypatch):
    """Neither the folder of the script nor the caller's PYTHONPATH gives it modules, and nobody lent it the library."""
    (tmp_path / "colorsys.py").write_text("raise SystemExit(3)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    (answer,) = run(
        tmp_path, 'import colorsys\nreturn {"a": np.array("lsmgeo" in sys.modules or "torch" in sys.modules)}'
    )
    assert not answer["a"]


def test_each_failure_is_that_of_its_file(tmp_path):
    """One call: what ends the process is found, and the files behind it are read."""
    ways = {
        "os.kill(os.getpid(), 11)": "crashed its parser (SIGSEGV)",
        "os.abort()": "crashed its parser (SIGABRT)",
        "os._exit(7)": "made its parser fail",
        "os._exit(0)": NO_ANSWER,
        "import time; time.sleep(60)": "took its parser more than 1 seconds",
        "while True: pass": "took its parser more than 1 seconds",
        "raise RuntimeError('bad \\x1b')": "bad ?",
        "raise IndexError": "IndexError",
        "def f(): f()\nf()": "maximum recursion depth exceeded",
        "np.ones(1 << 31)": "needs more than 1073741824 bytes of memory to be read",
        "return 3": "'int' object is not iterable",
        "return {'a': np.array([None])}": "Object arrays cannot be saved when allow_pickle=False",
        "return {'a': np.zeros(3, 'c16')}": NO_ANSWER,
        'os.write(1, b\'{"names": ["a"]}\\n\\x93NUMPY\\x01\\x00\'); os._exit(0)': NO_ANSWER,
        "os.write(1, b'[' * 99_999 + b'\\n'); os._exit(0)": NO_ANSWER,
        "os.write(1, b'x' * (1 << 21))\nraise OSError('unwritten')": NO_ANSWER,
    }
    bodies = [f"if content == b'{number}':\n" + "\n".join("    " + line for line in way.split("\n"))
              for number, way in enumerate(ways)]  # fmt: skip
    body = "\n".join([*bodies, "return {'a': np.array(content.decode())}"])
    contents = [content for number in range(len(ways)) for content in (b"good", b"%d" % number)]
    found = run(tmp_path, body, contents, seconds=1.0)
    assert [answer["a"] for answer in found[::2]] == ["good"] * len(ways)
    for answer, (way, reason) in zip(found[1::2], ways.items(), strict=True):
        assert isinstance(answer, DataError), way
        assert answer.reason.startswith(reason), way


def test_an_answer_without_end_is_cut(tmp_path):
    (answer,) = run(tmp_path, "while True: os.write(1, b'x' * (1 << 22))")
    assert answer.reason == "made its parser fail"


def test_a_process_that_outlives_its_alarm_is_ended(tmp_path):
    body = "import signal, time\nsignal.signal(signal.SIGALRM, signal.SIG_IGN)\ntime.sleep(60)"
    (answer,) = run(tmp_path, body, seconds=0.5)
    assert answer.reason == "took its parser more than 0.5 seconds"


def test_what_cannot_be_read_or_started_is_an_error_of_the_file(tmp_path, monkeypatch):
    body = "return {'a': np.array(len(content))}"
    small, large = run(tmp_path, body, [b"", bytes(101)], limit=100)
    assert small["a"] == 0
    assert "larger than the limit of 100 bytes" in str(large)
    (missing,) = parse_isolated(dict, [tmp_path / "nowhere"], limit=1, memory=1, seconds=1.0)
    assert "no such file" in str(missing)
    monkeypatch.setattr("sys.executable", str(tmp_path / "no-python"))
    for answer in run(tmp_path, body, [b"", b""]):
        assert "no process could be started" in answer.reason


def test_many_threads_may_have_processes(tmp_path):
    answers = {}

    def ask(number):
        folder = tmp_path / str(number)
        folder.mkdir()
        answers[number] = run(folder, "return {'a': np.array(int(content))}", [b"%d" % number], seconds=60.0)[0]["a"]

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == {0: 0, 1: 1, 2: 2}


def test_files_that_are_large_together_are_held_in_turn(tmp_path, monkeypatch):
    monkeypatch.setattr("lsmgeo.data.isolated.MAX_REQUEST_BYTES", 3)
    answers = run(
        tmp_path, "return {'a': np.array(len(content))}", [b"12", b"1234", bytes(101), b"", b"123"], limit=100
    )
    assert [answer["a"] for answer in answers if not isinstance(answer, DataError)] == [2, 4, 0, 3]
    assert "larger than the limit" in str(answers[2])
