"""Share of bad pixels against density on Middlebury's motorcycle, from benchmarks/results/classical.json."""

import matplotlib.pyplot as plt
from benchmark_tables import load

STYLES = {
    "ours, filtered": ("tab:blue", "-"),
    "ours, unfiltered": ("tab:cyan", "-"),
    "plain ZNCC": ("tab:gray", "-"),
    "StereoSGBM": ("tab:red", "-"),
    "StereoBM": ("tab:orange", "-"),
}

found = load("classical")
stereo = next((case for case in found["cases"] if "bad_pixel_curves" in case), None) if found else None
figure, axes = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
if stereo is None:
    axes.set_title("not measured yet")
else:
    for name, curve in stereo["bad_pixel_curves"].items():
        color, line = STYLES.get(name, ("black", ":"))
        x, y = ([100 * value for value in curve[key]] for key in ("density", "bad"))
        axes.plot(x, y, line, marker="o", ms=7 if len(x) == 1 else 3, color=color, label=name)
    axes.legend(fontsize=8, frameon=False)
    axes.set(xlim=(0, 102), ylim=(0, None))
    axes.set_ylabel(f"off by more than {stereo['threshold_px']:g} pixels, %")
axes.set_xlabel("density: the most confident pixels, % of all")
