"""Workers that misbehave in every way: each becomes a DataError that names the file, and nothing else happens."""

import threading
from pathlib import Path

import pytest

from lsmgeo.data.guarded import run_guarded
from lsmgeo.errors import DataError

FILE = Path("some/file.mat")


def run(tmp_path, script, content=b"", **limits):
    worker = tmp_path / "worker.py"
    worker.write_text(script)
    return run_guarded(worker, content, **({"memory": 1 << 30, "seconds": 20.0, "path": FILE} | limits))


def refused(tmp_path, script, match, content=b"", **limits):
    with pytest.raises(DataError, match=match) as caught:
        run(tmp_path, script, content, **limits)
    assert caught.value.path == FILE


def test_a_worker_gets_the_bytes_and_answers(tmp_path):
    # More than a pipe holds in both directions, so that neither side may wait for the other.
    content = bytes(range(256)) * 4000
    script = "import sys; d = sys.stdin.buffer.read(); sys.stdout.buffer.write(d[::-1])"
    assert run(tmp_path, script, content) == content[::-1]


def test_a_worker_that_does_not_listen_may_answer(tmp_path):
    assert run(tmp_path, "print('done', end='')", bytes(1 << 22)) == b"done"


def test_a_worker_is_alone(tmp_path, monkeypatch):
    """Neither the folder of the script nor the caller's PYTHONPATH gives it modules, and nobody lent it the library."""
    (tmp_path / "json.py").write_text("raise SystemExit(3)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    script = "import json, sys; print(json.dumps('lsmgeo' in sys.modules or 'torch' in sys.modules), end='')"
    assert run(tmp_path, script) == b"false"


@pytest.mark.parametrize(
    ("script", "match"),
    [
        ("import os; os.kill(os.getpid(), 11)", r"crashed its parser \(SIGSEGV\)"),
        ("import os; os.abort()", r"crashed its parser \(SIGABRT\)"),
        ("import ctypes; ctypes.string_at(1)", r"crashed its parser \(SIGSEGV\)"),
        ("raise RuntimeError", "made its parser fail"),
        ("import os; os._exit(7)", "made its parser fail"),
        ("x = bytearray(1 << 31)", "needs more than 1073741824 bytes"),
        ("x = []\nwhile True: x.append(bytearray(1 << 26))", "needs more than 1073741824 bytes"),
        ("def f(): f()\nf()", "made its parser fail"),
        ("def f(", "made its parser fail"),
    ],
)
def test_a_crash_is_an_error_of_the_file(tmp_path, script, match):
    refused(tmp_path, script, match)


@pytest.mark.timeout(50)  # the first alone would take a minute
def test_time_is_limited(tmp_path):
    refused(tmp_path, "import time; time.sleep(60)", "more than 0.5 seconds", seconds=0.5)
    refused(tmp_path, "while True: pass", "more than 0.5 seconds", seconds=0.5)
    refused(tmp_path, "import sys; print('x', flush=True); sys.stdin.close()\nwhile True: pass", "0.5", seconds=0.5)


def test_an_answer_without_end_is_cut(tmp_path):
    refused(tmp_path, "while True: print('x' * 1000)", "more than the 100000 bytes", answer=100_000)
    refused(tmp_path, "print('x' * 100_001)", "more than the 100000 bytes", answer=100_000)
    assert len(run(tmp_path, "print('x' * 100_000, end='')", answer=100_000)) == 100_000


def test_a_worker_writes_no_file(tmp_path):
    target = tmp_path / "written"
    refused(tmp_path, f"open({str(target)!r}, 'wb', buffering=0).write(b'x')", "made its parser fail")
    assert target.stat().st_size == 0
    before = sorted(tmp_path.iterdir())
    run(tmp_path, "import json")
    assert sorted(tmp_path.iterdir()) == before


def test_a_missing_worker_or_interpreter_is_an_error(tmp_path, monkeypatch):
    with pytest.raises(DataError, match="made its parser fail"):
        run_guarded(tmp_path / "nowhere.py", b"", memory=1 << 30, seconds=20.0, path=FILE)
    monkeypatch.setattr("sys.executable", str(tmp_path / "no-python"))
    refused(tmp_path, "pass", "no process could be started")


def test_many_threads_may_have_workers(tmp_path):
    answers = {}
    script = "import sys; sys.stdout.buffer.write(sys.stdin.buffer.read())"
    worker = tmp_path / "worker.py"
    worker.write_text(script)

    def ask(number):
        answers[number] = run_guarded(worker, b"%d" % number, memory=1 << 30, seconds=60.0, path=FILE)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert answers == {number: b"%d" % number for number in range(6)}
