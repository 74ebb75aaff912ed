"""``python -m studies.comparison``."""

import sys

from emb_runtime.errors import EXIT_INTERRUPTED
from emb_runtime.system.entry import start

sys.exit(start("studies.comparison.cli", EXIT_INTERRUPTED))
