"""What happens to the processes of a command when emb-hil itself is killed and can no longer end them."""

from __future__ import annotations

import subprocess

# Standard input ends without a line when emb-hil dies, by kill -9 too.
_SCRIPT = 'read -r _ || { kill -s KILL -- "-$1"; rm -rf -- "$2"; }'


class Leash:
    """A shell that waits for the death of this process, then ends the process group and removes the directory."""

    def __init__(self, group: int, directory: str) -> None:
        self._shell = subprocess.Popen(
            ["/bin/sh", "-c", _SCRIPT, "emb-hil", str(group), directory],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )

    def release(self) -> None:
        """All was ended in order; nothing is left to watch."""
        self._shell.communicate(b"done\n")
