"""Reads files of cv2.FileStorage for `storage`, as a script in a process that they may crash; imports nothing else.

Standard input holds the files, each after its length in four bytes. Standard output gets one line of JSON a file:
``{"entries": [[name, value], ...]}`` or ``{"error": ...}``; a value is a number, a text, a list of texts, or
``{"rows": ..., "columns": ..., "values": [...]}``. Everything else in a file is left out.
"""

from __future__ import annotations

import json
import struct
import sys
from typing import Any

MOST_ENTRIES = 1000
MOST_VALUES = 20_000
MOST_TEXT = 512


def _number(node: Any) -> float | int | None:
    if node.isInt():
        return int(node.real())
    return float(node.real()) if node.isReal() else None


def _matrix(node: Any) -> dict[str, Any] | None:
    data = node.getNode("data")
    rows, columns = (_number(node.getNode(name)) for name in ("rows", "cols"))
    sizes = node.getNode("sizes")
    if sizes.isSeq() and sizes.size() in (1, 2):
        # OpenCV 5 writes vectors so.
        rows, columns = _number(sizes.at(0)), _number(sizes.at(1)) if sizes.size() == 2 else 1
    elif sizes.isInt():  # the same as XML
        rows, columns = _number(sizes), 1
    if rows is None or columns is None or not data.isSeq() or data.size() > MOST_VALUES:
        return None
    # The numbers as they stand, not `node.mat()`: that one allocates what rows and columns ask for.
    return {"rows": rows, "columns": columns, "values": [_number(data.at(index)) for index in range(data.size())]}


def _value(node: Any) -> Any:
    if node.isMap():
        return _matrix(node)
    if node.isString():
        text = node.string()
        return text if len(text) <= MOST_TEXT else None
    if node.isSeq():
        items = [node.at(index) for index in range(min(node.size(), MOST_ENTRIES + 1))]
        if len(items) > MOST_ENTRIES or not all(item.isString() for item in items):
            return None
        return [item.string()[: MOST_TEXT + 1] for item in items]
    return _number(node)


def _read(content: bytes) -> list[tuple[str, Any]]:
    import cv2

    storage = cv2.FileStorage(content.decode(), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
    root = storage.root()
    if not root.isMap():
        raise ValueError("it holds no names")
    names = root.keys()
    if len(names) > MOST_ENTRIES or len(set(names)) != len(names):
        raise ValueError("it holds too many names, or one twice")
    values = [(name, _value(root.getNode(name))) for name in names]
    return [(name, value) for name, value in values if value is not None]


def main() -> None:
    """Answer for every file on standard input."""
    while header := sys.stdin.buffer.read(4):
        (length,) = struct.unpack("<I", header)
        content = sys.stdin.buffer.read(length)
        try:
            answer: dict[str, Any] = {"entries": _read(content)}
        except (ImportError, MemoryError):
            raise
        # OpenCV's binding raises SystemError for what it cannot parse, and cv2.error for the rest.
        except Exception as error:
            answer = {"error": str(error.__cause__ or error)[:200]}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
