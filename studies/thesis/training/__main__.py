"""``python -m studies.thesis.training``."""

import sys

from emb_runtime.system.entry import start

sys.exit(start("studies.thesis.training.cli", "python -m studies.thesis.training: interrupted"))
