"""``python -m studies.comparison``."""

import sys

from emb_runtime.system.entry import start

sys.exit(start("studies.comparison.cli", "python -m studies.comparison: interrupted"))
