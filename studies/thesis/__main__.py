"""``python -m studies.thesis``."""

import sys

from emb_runtime.errors import EXIT_INTERRUPTED
from emb_runtime.system.entry import start

sys.exit(start("studies.thesis.cli", EXIT_INTERRUPTED))
