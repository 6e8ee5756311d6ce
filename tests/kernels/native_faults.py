"""Faults in the C++ kernels: each a substitution in their source, compiled for itself."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import lsmgeo

SOURCES = Path(lsmgeo.__file__).parent / "kernels" / "native"

# name: (what stands in the source, what is put in its place)
FAULTS = {
    "half a pixel": ("const float index = tile.index[axis][s];", "const float index = tile.index[axis][s] + 0.5f;"),
    "x and y swapped": ("tile.index[0][s] = front ? (slope[0]", "tile.index[0][s] = front ? (slope[1]"),
    "no front test": ("const bool front = height > threshold;", "const bool front = height != 0.0f;"),
    "near ignored": ("const float bound = float(call.near) * float(unit);", "const float bound = 0.0f;"),
    "near ignored by volumes": ("tile.depth[s] > float(call.near) && !view.masked", "!view.masked"),
    "mask ignored": ("tile.depth[s] > float(call.near) && !view.masked", "tile.depth[s] > float(call.near)"),
    "floor for nearest": ("nearest && fraction >= 0.5f ? floor + 1.0f : floor", "floor"),
    "closed image": ("int32_t(index < size - 0.5f)", "int32_t(index < size + 0.5f)"),
    "border always": ("border = call.border != 0;", "border = true;"),
    "slope beyond the border": ("index > 0.0f && index < size - 1.0f ? 1.0f : 0.0f", "1.0f"),
    "weights of x and y swapped": ("tile.weight[1][s] = x * near;", "tile.weight[1][s] = (1.0f - x) * next;"),
    "last tap dropped": ("tile.weight[7][s] = x * y * z;", "tile.weight[7][s] = 0.0f;"),
    "edge taps not weighted": (
        "const float weight = weight_of<DIMS>(tile, s, tap) * factor;",
        "const float weight = factor;",
    ),
    "one channel's tap astray": ("places[2][s] = corner + down;", "places[2][s] = corner;"),
    "one channel's unread sites": ("values[s] = tile.reads[s] ? values[s] : 0.0f;", ""),
    "one channel's rest forgotten": ("s < padded; s += LANES", "s + LANES <= n; s += LANES"),
    "tiles at the volume's edge passed over": (
        "if (index[axis][0] < -1.01 && index[axis][1] < -1.01) return true;",
        "if (index[axis][0] < 0.4 && index[axis][1] < 0.4) return true;",
    ),
    "rest of the channels forgotten": ("for (; c < channels; c++) body", "for (; c < channels - 1; c++) body"),
    "slope with the wrong sign": (
        "slope[tap][axis] = tap >> axis & 1 ? rest : -rest;",
        "slope[tap][axis] = tap >> axis & 1 ? -rest : rest;",
    ),
    "depth without its slope": ("rows[2][s] += float(by_height);", ""),
    "height's part forgotten": (
        "rows[2][s] = -(rows[0][s] * tile.index[0][s]",
        "rows[2][s] = -(0.0f * tile.index[0][s]",
    ),
    "inverse depth's part forgotten": ("by_z[s] -= double(by_plane) * tile.plane[row][s] * tile.depth[s];", ""),
    "direction's slope not projected": (
        "(by_direction[row][s] - along * tile.direction[row][s])",
        "by_direction[row][s]",
    ),
    "direction not normalised": (
        "tile.shrink[s] = away ? 1.0f / std::sqrt(away ? squares : 1.0f) : 0.0f;",
        "tile.shrink[s] = 1.0f;",
    ),
    "direction in y, z, x order": (
        "*out++ = tile.direction[row][s];",
        "*out++ = tile.direction[(row + 1) % 3][s];",
    ),
    "mean over all views": (
        "mean += read<W>(values + v * step) * share;",
        "mean += read<W>(values + v * step) * 0.3333333f;",
    ),
    "blind views counted": ("if (!tiles[v].visible[s]) continue;\n        float *out", "float *out"),
    "unbiased variance": (
        "result += apart * apart * share;",
        "result += apart * apart / float(count > 1 ? count - 1 : 1);",
    ),
    "maximum's gradient to all views": ("part = taker == int32_t(v) ? gradient : Floats<W>{};", "part = gradient;"),
    "mean's gradient not shared": ("Floats<W> part = gradient * share;", "Floats<W> part = gradient;"),
    "first chunk's channels for all": (
        "const S *source = source_of<S>(call, scene, view) + channel;",
        "const S *source = source_of<S>(call, scene, view);",
    ),
    "gradient not cleared": ("if (!call.source_gradient || call.accumulate) return;", "return;"),
    "bfloat16 cut off": ("(bits + 0x7fff + (bits >> 16 & 1)) >> 16;", "bits >> 16;"),
    "float16 denormals lost": ("magnitude < (113u << 23) ? small : normal", "magnitude < (113u << 23) ? 0u : normal"),
}


def compiler() -> str | None:
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


def build(folder: Path, fault: str | None) -> Path:
    """The kernels with one fault, or none, for the plainest instruction set and quickly compiled."""
    found = 0
    for source in SOURCES.iterdir():
        text = source.read_text(encoding="utf-8")
        if fault is not None:
            there, instead = FAULTS[fault]
            found += text.count(there)
            text = text.replace(there, instead)
        (folder / source.name).write_text(text, encoding="utf-8")
    assert fault is None or found, f"{fault}: the source has changed"
    library = folder / "kernels.so"
    flags = ["-std=c++17", "-O0", "-w", "-fPIC", "-shared", "-DLSMGEO_ONE_SET"]
    subprocess.run([str(compiler()), *flags, "-o", str(library), str(folder / "kernels.cpp")], check=True)
    return library
