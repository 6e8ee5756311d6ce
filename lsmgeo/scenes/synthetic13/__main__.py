"""A table of how varied each category is: ``python -m lsmgeo.scenes.synthetic13 [shapes a category]``."""

from __future__ import annotations

import sys

from lsmgeo.scenes.synthetic13 import CATEGORIES, measure


def main() -> None:
    """Print the table, a line at a time."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    print(f"{count} shapes a category, voxels 32^3, all pairs")
    print(
        f"{'category':10} {'structures':>10} {'parameters':>10} {'fewest':>6} {'parts':>6} {'fill':>6} {'pair IoU':>8}"
    )
    for category in CATEGORIES:
        found = measure(category, count=count)
        numbers = f"{found.structures:10d} {found.parameters:10d} {found.fewest:6d}"
        print(f"{category:10} {numbers} {found.parts:6.1f} {found.fill:6.3f} {found.iou:8.3f}", flush=True)


if __name__ == "__main__":
    main()
