"""Parses OpenCV's FileStorage (YAML, XML, JSON) for `format_opencv`; imports nothing of this package.

`parse_storage` runs in an isolated process, since a damaged file can crash OpenCV's parser.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["is_storage", "parse_storage"]

SUFFIXES = (".yml", ".yaml", ".xml", ".json")
MATRIX = re.compile(rb"opencv-(nd-)?matrix")
IMAGE_NAME = re.compile(rb"\.(png|jpe?g)\b", re.IGNORECASE)
MOST_ENTRIES = 1000
MOST_VALUES = 20_000
MOST_TEXT = 512


def is_storage(path: Path) -> bool:
    """Whether a file looks like one of FileStorage: it has matrices, or (not JSON) names of images."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    with path.open("rb") as stream:
        start = stream.read(1 << 16).lstrip(b"\xef\xbb\xbf \t\r\n")
    if path.suffix.lower() == ".xml":
        return b"<opencv_storage>" in start
    if path.suffix.lower() == ".json":
        return start.startswith(b"{") and MATRIX.search(start) is not None
    return start.startswith(b"%YAML") and (MATRIX.search(start) or IMAGE_NAME.search(start)) is not None


def parse_storage(content: bytes) -> dict[str, np.ndarray]:
    """The top-level numbers (), texts (), lists of texts (N,) and matrices (rows, columns) of a file.

    Numbers are float64; elements of matrices that are not numbers become NaN. All other values are left out.
    """
    import cv2

    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError("is not a text file (invalid UTF-8)") from error
    if "\0" in text:
        raise ValueError("is not a text file (it holds a zero byte)")
    try:
        # As text, so that the parser opens no file: not this one, another one, or a compressed one.
        storage = cv2.FileStorage(text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        root = storage.root()
        names = root.keys() if root.isMap() else []
        if not 0 < len(names) <= MOST_ENTRIES or len(set(names)) != len(names):
            raise ValueError("it has no names, too many, or a repeated one")
        values = {name: _value(root.getNode(name)) for name in names}
    except MemoryError:
        raise
    # OpenCV's binding raises SystemError for text that it cannot parse, and cv2.error otherwise.
    except Exception as error:
        raise ValueError(f"is not a file of OpenCV's FileStorage ({str(error.__cause__ or error)[:200]})") from error
    return {name: value for name, value in values.items() if value is not None}


def _value(node: Any) -> np.ndarray | None:
    if node.isMap():
        return _matrix(node)
    if node.isSeq():
        items = [node.at(index) for index in range(min(node.size(), MOST_ENTRIES + 1))]
        if len(items) > MOST_ENTRIES or not all(item.isString() for item in items):
            return None
        return np.array([item.string()[: MOST_TEXT + 1] for item in items], np.str_)
    if node.isString():
        return np.array(node.string()) if len(node.string()) <= MOST_TEXT else None
    return np.array(_number(node)) if node.isInt() or node.isReal() else None


def _matrix(node: Any) -> np.ndarray | None:
    data, sizes = node.getNode("data"), node.getNode("sizes")
    rows, columns = (_number(node.getNode(name)) for name in ("rows", "cols"))
    if sizes.isSeq() and sizes.size() in (1, 2):
        # The form of vectors in OpenCV 5.
        rows, columns = _number(sizes.at(0)), _number(sizes.at(1)) if sizes.size() == 2 else 1.0
    elif sizes.isInt():  # the same in XML
        rows, columns = _number(sizes), 1.0
    # Matrices of several channels, such as corners of chessboards, are not used.
    if not data.isSeq() or data.size() > MOST_VALUES or rows <= 0 or rows * columns != data.size():
        return None
    # Not `node.mat()`, which allocates the stated rows and columns.
    return np.array([_number(data.at(index)) for index in range(data.size())]).reshape(int(rows), int(columns))


def _number(node: Any) -> float:
    return float(node.real()) if node.isInt() or node.isReal() else np.nan
