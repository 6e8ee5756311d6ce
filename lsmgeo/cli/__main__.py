"""``python -m lsmgeo.cli``, which ``torchrun`` starts."""

import sys

from lsmgeo.cli.main import main

sys.exit(main())
