"""The same errors under confidences that are strongly, weakly and not related to them."""

import matplotlib.pyplot as plt
import torch

from lsmgeo.metrics import density_curve

generator = torch.Generator().manual_seed(0)
number = 100_000
# One value in five is a wrong match, anywhere; the others have small errors.
wrong = torch.rand(number, generator=generator) < 0.2
errors = torch.where(wrong, 20 * torch.rand(number, generator=generator), 0.3 * torch.rand(number, generator=generator))
noise = torch.rand(number, generator=generator)
confidences = {
    "knows the error": 1 / (1 + errors),
    "knows it roughly": 1 / (1 + errors + 8 * noise),
    "knows nothing": noise,
}
densities = [k / 50 for k in range(1, 51)]
figure, axes = plt.subplots(figsize=(6, 3), layout="constrained")
for name, confidence in confidences.items():
    curve = density_curve(errors, confidence, densities, statistic="bad", threshold=1.0)
    axes.plot(100 * curve.density, 100 * curve.error, label=f"the confidence {name}")
axes.set(xlabel="density, % of the pixels", ylabel="off by more than 1, %", xlim=(0, 100), ylim=(0, None))
axes.legend(fontsize=8)
