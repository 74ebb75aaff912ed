"""``python -m studies.thesis``."""

import sys

from emb_runtime.system.entry import run_command

sys.exit(run_command("studies.thesis.cli", "python -m studies.thesis: interrupted"))
