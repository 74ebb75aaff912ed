"""``python -m emb_export``: which commands there are."""

from __future__ import annotations

import sys

from emb_runtime.__main__ import main

if __name__ == "__main__":
    sys.exit(main("emb_export"))
