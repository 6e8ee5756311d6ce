"""IoU after one to four views against the steps of training, of the run that `benchmark_tables.CURVE` names."""

import matplotlib.pyplot as plt
from benchmark_tables import CURVE, load

COLORS = ("#9ecae1", "#6baed6", "#3182bd", "#08519c")
HULLS = {"visual hull": "--", "visual hull, strict": ":"}

found = load(CURVE)
figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
if found is None:
    axes.set_title("not measured yet")
else:
    steps = [line["step"] for line in found["curve"]]
    measured = found["evaluation"]
    for view, color in enumerate(COLORS, 1):
        iou = [100 * line["iou"][str(view)] for line in found["curve"]]
        axes.plot(steps, iou, "o-", ms=3, color=color, label=f"V-LSM, {view} view{'s' * (view > 1)}")
        hulls = [name for name in measured["iou"] if name in HULLS]
        for name in hulls:
            value = measured["iou"][name][view - 1]
            axes.axhline(value, color=color, linestyle=HULLS[name], linewidth=1.2)
    names = [name for name in HULLS if name in measured["iou"]]
    for name in names:
        axes.plot([], [], color="0.4", linestyle=HULLS[name], label=f"{name}, 1 to 4 views")
    axes.legend(fontsize=8, frameon=False, ncols=3, loc="upper left")
    axes.set(xlim=(0, None), ylim=(0, 80))
axes.set(xlabel="steps of training", ylabel="voxel IoU of shapes held back, %")
