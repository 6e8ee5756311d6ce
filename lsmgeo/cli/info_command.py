"""`lsmgeo info`: whether cameras and images belong together."""

from __future__ import annotations

from pathlib import Path

__all__ = ["info"]


def info(path: str, out: str = "lsmgeo-info") -> int:
    """Say what a path holds and whether its cameras and pictures belong together; name the likely mistake where not.

    Args:
        path: scene, calibration or voxels: a folder, or the file that is meant where a folder holds several.
        out: folder for the pictures; created where it does not exist.

    Returns:
        The exit status: 0 all is well, 1 it is not, 3 nothing could be measured (2 is for what cannot be read).
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
        print(f"no pictures are drawn of {'voxels alone' if findings.kind == 'voxels' else 'a calibration'}")
    return {"good": 0, "bad": 1, "unknown": 3}[findings.verdict]
