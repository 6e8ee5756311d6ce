"""`lsmgeo demo`: both operators on an analytic scene."""

from __future__ import annotations

from pathlib import Path

__all__ = ["demo"]


def demo(out: str = "lsmgeo-demo") -> None:
    """Recover the depth of an analytic scene from six images, and draw the steps.

    Args:
        out: folder for the figure; created if it does not exist.
    """
    from lsmgeo.cli.demo_scene import run_demo, write_figure

    result = run_demo()
    errors = result.error[result.error.isfinite()]
    path = write_figure(result, Path(out) / "demo.png")
    print(f"voxels:                        {' x '.join(map(str, result.grid.shape))}")  # type: ignore[arg-type]
    print(f"views:                         {len(result.images)}")
    print(f"surface pixels compared:       {len(errors)}")
    print(f"median relative depth error:   {100 * result.median_error:.3f} %")
    print(f"pixels within 1 %:             {100 * float((errors < 0.01).double().mean()):.1f} %")
    print(f"time of the operators:         {result.seconds:.1f} s")
    print(f"figure:                        {path.resolve()}")
