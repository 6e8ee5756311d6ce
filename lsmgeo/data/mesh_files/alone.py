"""Parse one mesh from standard input in a process of limited memory: ``python -I alone.py KIND MAX_FACES BYTES``.

Arrays go to standard output as an .npz archive; what is wrong with the file goes to standard error, with exit status 3.
"""

from __future__ import annotations

import json
import resource
import sys
from pathlib import Path

REFUSED = 3


def main(kind: str, max_faces: str, memory: str) -> int:
    """Limit this process, then parse."""
    resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Only the folder of the parsers: without the package, whose import takes seconds.
    sys.path.append(str(Path(__file__).resolve().parent.parent))
    import numpy as np
    from mesh_files import Unreadable, parse  # type: ignore[import-not-found]

    try:
        parsed = parse(sys.stdin.buffer.read(), kind, int(max_faces))
        np.savez(
            sys.stdout.buffer,
            vertices=parsed.vertices,
            faces=parsed.faces,
            colours=parsed.colours,
            material=parsed.material,
            names=np.frombuffer(json.dumps([parsed.materials, parsed.libraries]).encode(), np.uint8),
        )
    except Unreadable as error:
        print(error, file=sys.stderr)
        return REFUSED
    except MemoryError:
        print("needs more memory than it may have", file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
