"""``python -m studies.thesis``."""

import sys

from emb_runtime.system.entry import start

sys.exit(start("studies.thesis.cli", "python -m studies.thesis: interrupted"))
