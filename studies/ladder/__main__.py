"""``python -m studies.ladder``."""

import sys

from emb_runtime.system.entry import start

sys.exit(start("studies.ladder.cli", "python -m studies.ladder: interrupted"))
