"""``python -m studies.reproduce``."""

import sys

from emb_runtime.system.entry import start

sys.exit(start("studies.reproduce.cli", "python -m studies.reproduce: interrupted"))
