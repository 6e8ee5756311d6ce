"""Time and peak memory against one size at a time, from benchmarks/results/growth.json."""

import matplotlib.pyplot as plt
from benchmark_tables import load

AXES = {
    "voxels": "voxels along a side",
    "V": "views",
    "C": "channels",
    "size": "side of the maps, pixels",
}
COLORS = {
    "lsmgeo": "tab:blue",
    "lsmgeo, reference": "tab:cyan",
    "hand-written": "tab:red",
    "compiled gather, any size": "tab:orange",
}


def draw(operator):
    """Rows: time forward, time forward and backward, memory; columns: what grows."""
    found = load("growth")
    cases = [case for case in found["cases"] if case["operator"] == operator] if found else []
    figure, panels = plt.subplots(3, len(AXES), figsize=(11, 7.2), layout="constrained", sharex="col", sharey="row")
    for column, (axis, label) in enumerate(AXES.items()):
        along = [case for case in cases if case["axis"] == axis]
        for row, kind in enumerate(("forward", "forward+backward")):
            for name, color in COLORS.items():
                points = [(c["value"], c["times"][name]) for c in along if c["kind"] == kind and name in c["times"]]
                if points:
                    x, times = zip(*points, strict=True)
                    panels[row, column].plot(x, [t["median_ms"] for t in times], "o-", ms=3, color=color, label=name)
                    quartiles = zip(*(t["quartiles_ms"] for t in times), strict=True)
                    panels[row, column].fill_between(x, *quartiles, color=color, alpha=0.2, lw=0)
        for name, color in COLORS.items():
            measured = [(c["value"], c["memory"][name]) for c in along if name in c.get("memory", {})]
            points = [(value, taken["peak"] / 1e6) for value, taken in measured if taken.get("peak", 0) > 0]
            if points:
                panels[2, column].plot(*zip(*points, strict=True), "o-", ms=3, color=color)
        if axis == "size":
            panels[2, column].text(0.5, 0.5, "not measured", ha="center", transform=panels[2, column].transAxes)
        panels[2, column].set_xlabel(label)
        panels[2, column].set_xscale("log", base=2)
        panels[2, column].xaxis.set_major_formatter("{x:g}")
    for row, label in enumerate(("forward, ms", "forward + backward, ms", "peak above inputs, MB")):
        panels[row, 0].set_ylabel(label)
        if cases:
            panels[row, 0].set_yscale("log")
    if cases:
        handles, labels = panels[0, 1].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=len(COLORS), frameon=False)
    else:
        figure.suptitle("not measured yet")


def unproject():
    draw("Unproject, mean")


def sweep():
    draw("Sweep, trilinear")
