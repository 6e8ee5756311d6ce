"""Faults in the C++ kernels: each a substitution in their source. One library has them all and makes one at a time."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import lsmgeo

SOURCES = Path(lsmgeo.__file__).parent / "kernels" / "native"

# name: (a line of the source, the replacement of the expression between the dollars)
FAULTS = {
    "half a pixel": ("const float index = $tile.index[axis][s]$;", "tile.index[axis][s] + 0.5f"),
    "x and y swapped": ("tile.index[0][s] = front ? ($slope[0]$", "slope[1]"),
    "no front test": ("const bool front = $height > threshold$;", "height != 0.0f"),
    "near ignored": ("const float bound = $float(call.near) * float(unit)$;", "0.0f"),
    "near ignored by volumes": ("$tile.depth[s] > float(call.near)$ && !view.masked", "true"),
    "mask ignored": ("tile.depth[s] > float(call.near) && $!view.masked$", "true"),
    "floor for nearest": ("nearest && fraction >= 0.5f ? $floor + 1.0f$ : floor", "floor"),
    "closed image": ("int32_t($index < size - 0.5f$)", "index < size + 0.5f"),
    "border always": ("border = $call.border != 0$;", "true"),
    "slope beyond the border": ("$!border || (index > 0.0f && index < size - 1.0f) ? 1.0f : 0.0f$;", "1.0f"),
    "weights of x and y swapped": ("tile.weight[1][s] = $x * near$;", "(1.0f - x) * next"),
    "last tap dropped": ("tile.weight[7][s] = $x * y * z$;", "0.0f"),
    "edge taps not weighted": ("const float weight = $tap_weight<DIMS>(tile, s, tap) * factor$;", "factor"),
    "one channel's tap astray": ("offsets[2][s] = $corner + down$;", "corner"),
    "one channel's unread sites": ("values[s] = $tile.in_range[s] ? values[s] : 0.0f$;", "values[s]"),
    "one channel's rest forgotten": ("$s < padded$; s += LANES", "s + LANES <= n"),
    "tiles at the volume's edge passed over": (
        "if ($most[axis] < -1.01$ || least[axis] > double(call.size[axis]) + 0.01) return true;",
        "most[axis] < 0.4",
    ),
    "rest of the channels forgotten": ("for (; $c < channels$; c++) body", "c < channels - 1"),
    "slope with the wrong sign": (
        "slope[tap][axis] = $tap >> axis & 1 ? rest : -rest$;",
        "tap >> axis & 1 ? -rest : rest",
    ),
    "depth without its slope": ("rows[2][s] += $float(grad_height)$;", "0.0f"),
    "height's part forgotten": ("rows[2][s] = -($rows[0][s]$ * tile.index[0][s]", "0.0f"),
    "inverse depth's part forgotten": (
        "grad_z[s] += per_site ? grad_depth : $-grad_depth * tile.depth[s] * tile.depth[s]$;",
        "0.0",
    ),
    "direction's slope not projected": (
        "($site.grad_direction[row][s] - along * tile.direction[row][s]$)",
        "site.grad_direction[row][s]",
    ),
    "direction not normalised": (
        "tile.inverse_length[s] = $away ? 1.0f / std::sqrt(away ? squares : 1.0f) : 0.0f$;",
        "1.0f",
    ),
    "direction in y, z, x order": ("*out++ = $tile.direction[row][s]$;", "tile.direction[(row + 1) % 3][s]"),
    "mean over all views": ("mean += load<W>(values + v * step) * $share$;", "0.3333333f"),
    "blind views counted": ("if ($!tiles[v].visible[s]$) continue;\n        float *out", "false"),
    "unbiased variance": ("result += deviation * deviation * $share$;", "1.0f / float(count > 1 ? count - 1 : 1)"),
    "maximum's gradient to all views": ("part = $argmax == int32_t(v) ? gradient : Floats<W>{}$;", "gradient"),
    "mean's gradient not shared": ("Floats<W> part = gradient * $share$;", "1.0f"),
    "first chunk's channels for all": ("const S *source = source_pointer<S>(call, scene, view) + $channel$;", "0"),
    "depths that saturate differentiated": (
        "site_gradients.grad_distance[s] = $distance < LARGEST && distance <= limit ? *gradient : 0.0f$;",
        "*gradient",
    ),
    "given channels that saturate differentiated": (
        "call.extras_gradient[at] = $std::fabs(call.extras[at]) <= limit ? *gradient : 0.0f$;",
        "*gradient",
    ),
    "statistics that saturate differentiated": (
        "gradient = $clamped_lanes<W>(result, limit) == result ? gradient : Floats<W>{}$;",
        "gradient",
    ),
    "one depth for a whole row": ("tile.depth[s] = $depths[s * step]$;", "depths[0]"),
    "depths of another plane": ("tile.view * stride[1] + $tile.k$ * stride[2] + tile.j * stride[3] +\n", "0"),
    "own depths of all views": (
        "call.depths_gradient + chunk * stride[0] + tile.scene * stride[1] + $tile.view * stride[2]$ +",
        "0",
    ),
    "w forgotten in the depth": ("height[s] = (slope[2] * x + base[2]) * $w$ + inner[2] * z;", "1.0f"),
    "w forgotten in the direction": ("vector[row][s] = (slope * tile.x[s] + base) * $tile.w[s]$ +", "1.0f"),
    "near not in units of own depths": ("bound = $near * z$;", "near"),
    "own depth's gradient of the wrong sign": (
        "grad_depth[s] -= $double(rows[row][s]) * view.matrix[row][2]$ * tile.z[s]",
        "-double(rows[row][s]) * view.matrix[row][2]",
    ),
    "own depth's direction forgotten": ("grad_z[s] += per_site ? $-along * inner * tile.z[s] / tile.depth[s]$", "0.0"),
    "own depth of a volume forgotten": ("grad_z[s] += per_site ? $grad_depth$ : -grad_depth", "0.0"),
    "matrix's gradient by the planes": ("to[2] += view.scale * (per_site ? $double(sum_z)$ :", "double(sum)"),
    "nearest of own depths passed over": ("range[1] = $std::max(range[1], tile.depth[s])$;", "range[0]"),
    "correlation not a mean": ("const float share = $float(call.share)$;\n    for (int64_t group", "1.0f"),
    "reference of the first plane": (
        "Layout at = $layout(stride, tile)$;",
        "Layout{layout(stride, tile).base - tile.k * stride[3], layout(stride, tile).site, stride[2]}",
    ),
    "groups mixed up": ("*b = reference + $group * size$;", "0"),
    "correlation's gradient not a mean": (
        "const float factor = $gradient[group] * float(call.share)$;",
        "gradient[group]",
    ),
    "last view's part of the reference's gradient": ("for (; c < end; c++) out[c] += $factor * other[c]$;", "0.0f"),
    "mean's share forgotten for correlations": (
        "workspace.value_gradients[group] = $gradient[group] * share$;",
        "gradient[group]",
    ),
    "correlations that saturate differentiated": (
        "$std::fabs(workspace.value_gradients[group]) <= limit ? gradient[group] : 0.0f$;",
        "gradient[group]",
    ),
    "features of the last column": ("i = tile.i + ($tile.along_z ? 0 : s$);", "0"),
    "features of the first view": ("tile.scene * stride[0] + $tile.view * stride[1]$ + k * stride[2]", "0"),
    "splat without its weights": (
        "factor + channel,\n                                      $gradient[0] * float(call.share)$);",
        "1.0f",
    ),
    "sites outside with geometric channels passed over": ("if ($appended == 0$ && misses_volume", "true"),
    "segments of a copy forgotten": (
        "last = $std::min<int64_t>(x + 1, call.size[0] - 1)$ / SEGMENT;",
        "std::max(x, 0)",
    ),
    "rows of a copy forgotten": ("last_y = $std::min<int64_t>(y + 1, call.size[1] - 1)$;", "y"),
    "segments of a copy from the row's start": ("y * from[4] + $first$ * from[5];", "0"),
    "views' sums of gradients in one place": ("sums.view = $sums.axes[2] * size[2]$;", "0"),
    "gradient not cleared": ("if ($call.accumulate$) return sums;", "true"),
    "bfloat16 cut off": ("$(bits + 0x7fff + (bits >> 16 & 1)) >> 16$;", "bits >> 16"),
    "float16 denormals lost": ("magnitude < (113u << 23) ? $small$ : normal", "Bits<W>{}"),
}

NONE = 0
NUMBERS = {name: number for number, name in enumerate(FAULTS, NONE + 1)}


def compiler() -> str | None:
    return shutil.which("c++") or shutil.which("g++") or shutil.which("clang++")


def with_faults(text: str, found: set[str]) -> str:
    """A source in which ``lsmgeo_fault`` decides between the code and each fault; adds the faults' names."""
    places = []
    for name, (original, replacement) in FAULTS.items():
        before, sound, after = original.split("$")
        start = text.find(before + sound + after)
        if start >= 0:
            found.add(name)
            start += len(before)
            places.append(
                (start, start + len(sound), f"(lsmgeo_fault == {NUMBERS[name]} ? ({replacement}) : ({sound}))")
            )
    last = len(text)
    for start, end, switch in sorted(places, reverse=True):
        assert end <= last, f"faults overlap in {text[start:end]!r}"
        text = text[:start] + switch + text[end:]
        last = start
    return text


def build(folder: Path) -> Path:
    """The kernels with all faults, for the plainest instruction set and quickly compiled."""
    found: set[str] = set()
    for source in (*SOURCES.glob("*.h"), *SOURCES.glob("*.cpp")):
        (folder / source.name).write_text(with_faults(source.read_text(encoding="utf-8"), found), encoding="utf-8")
    assert not FAULTS.keys() - found, f"the source has changed: {FAULTS.keys() - found}"
    main = folder / "kernels.cpp"
    switch = f'extern "C" __attribute__((visibility("default"))) int lsmgeo_fault = {NONE};\n'
    main.write_text(switch + main.read_text(encoding="utf-8"), encoding="utf-8")
    library = folder / "kernels.so"
    flags = ["-std=c++17", "-O0", "-w", "-fPIC", "-shared", "-DLSMGEO_ONE_SET"]
    subprocess.run([str(compiler()), *flags, "-o", str(library), str(main)], check=True)
    return library


def commit(library: ctypes.CDLL, fault: str | None) -> None:
    """Have the kernels make a fault, or none."""
    ctypes.c_int.in_dll(library, "lsmgeo_fault").value = NONE if fault is None else NUMBERS[fault]
