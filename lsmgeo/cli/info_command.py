"""`lsmgeo info`: whether cameras and images are consistent."""

from __future__ import annotations

from pathlib import Path

__all__ = ["info"]


def info(path: str, out: str = "lsmgeo-info") -> int:
    """Describe what a path holds, check that its cameras fit its images, and name the likely error if they do not.

    Args:
        path: scene, calibration or voxels: a folder, or one of several files in it.
        out: folder for the figures; created if it does not exist.

    Returns:
        The exit status: 0 good, 1 bad, 3 nothing could be measured (2: the path cannot be read).
    """
    import time

    from lsmgeo import data
    from lsmgeo.data.formats.detection import detect
    from lsmgeo.diagnosis import examine
    from lsmgeo.diagnosis.check_images import examine_images
    from lsmgeo.diagnosis.examination_figures import draw_examination
    from lsmgeo.diagnosis.findings import report

    start = time.perf_counter()
    source = Path(path)
    content = detect(source).read(source)
    drawn: dict[str, tuple[str, bytes]] = {}
    if isinstance(content, data.PosedImages):
        examination = examine_images(content)
        findings = examination.findings
        verdict = findings.verdict if findings.cause is None else findings.cause.name
        drawn = draw_examination(content, examination, f"{source.resolve().name}: {verdict}")
    else:
        findings = examine(content, source)
    written = {what: data.write_atomic(Path(out) / name, content) for what, (name, content) in drawn.items()}
    print(report(findings))
    print(f"{'time:':<18}{time.perf_counter() - start:.1f} s")
    for what, file in written.items():
        print(f"{what + ':':<28}{file.resolve()}")
    if not written:
        print(f"no figures are drawn of {'voxels only' if findings.kind == 'voxels' else 'a calibration'}")
    return {"good": 0, "bad": 1, "unknown": 3}[findings.verdict]
