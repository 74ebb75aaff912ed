"""Runs the job that docs/howto/kernel-with-can.md has to copy, as the page has it: ``job.py DIST``.

As root it runs in a Debian of its own, which debootstrap makes; else, or where that cannot be made or mounted (in a
container), in an empty folder without the environment, which then has what the page puts into /opt. Only root installs
packages. Each run of the page's table must end with its exit codes.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

from emb_runtime.system.terminal import show

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "kernel-with-can.md"
CERTIFICATES = "PIP_CERT"  # Of this computer's network, if it has own ones
NODE = "emb-node --iface vcan0"


def blocks(kind: str, page: str) -> list[str]:
    """The page's code blocks of a kind."""
    return re.findall(rf"^```{kind}\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)


def runs(page: str) -> list[tuple[str, tuple[int, int]]]:
    """The node of each run of the page's table, and the exit codes of run and report."""
    rows = re.findall(rf"^\|[^|]*\| `({NODE}[^`]*)` \| (\d+) \| (\d+) \|$", page, re.MULTILINE)
    return [(node, (int(run), int(report))) for node, run, report in rows]


def debian(root: Path) -> list[str]:
    """What begins a command in a new Debian with this computer's network; empty where there can be none."""
    make = ["debootstrap", "--variant=minbase", "bookworm", str(root)]
    for command in (["unshare", "--mount", "true"], make):
        is_possible = os.geteuid() == 0 and shutil.which(command[0])
        if not is_possible or subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode != 0:
            return []
    shutil.copy("/etc/resolv.conf", root / "etc")
    mounts = f'mount -t proc proc {root}/proc && mount -t tmpfs tmpfs {root}/dev/shm && exec chroot {root} "$@"'
    return ["unshare", "--mount", "--pid", "--fork", "sh", "-c", mounts, "sh"]


def main(dist: Path) -> None:
    """Run the job."""
    page = PAGE.read_text(encoding="utf-8")
    (workflow,), acceptance = blocks("yaml", page), blocks("toml", page)[-1]
    *installs, run, report = (
        step["run"] for step in yaml.safe_load(workflow)["jobs"]["brake"]["steps"] if "run" in step
    )
    made = re.findall(r"^RUN (.*)$", blocks("dockerfile", page)[0], re.MULTILINE)
    assert made == [one.replace(" dist ", " /dist ") for one in installs[:2]], "the image is not made as the job is"
    with tempfile.TemporaryDirectory(prefix="job-") as name:
        root = Path(name) / "root"
        enter = debian(root)
        own = bool(enter)
        work = root / "work" if own else Path(name) / "work"
        place = Path("/work") if own else work
        work.mkdir(exist_ok=True)
        shutil.copytree(dist, work / "dist")
        environment = {key: value for key, value in os.environ.items() if key.startswith("PIP_")}
        if CERTIFICATES in environment:
            shutil.copy(environment[CERTIFICATES], work / "certificates.pem")
            environment[CERTIFICATES] = f"{place}/certificates.pem"
        environment |= {"HOME": str(place), "GITHUB_PATH": f"{place}/paths"}
        (work / "paths").touch()
        (work / "acceptance.toml").write_text(acceptance, encoding="utf-8")
        show("in a Debian of its own" if own else f"in {work}")

        def play(command: str) -> int:
            path = ":".join([*(work / "paths").read_text().split(), "/usr/sbin:/usr/bin:/sbin:/bin"])
            variables = [f"{key}={value}" for key, value in (environment | {"PATH": path}).items()]
            here = command if own else command.replace("/opt", str(place))
            line = [*enter, "env", "-i", *variables, "bash", "-e", "-c", f"cd {place} && {here}"]
            begin = time.monotonic()
            code = subprocess.run(line, check=False).returncode
            show(f"{time.monotonic() - begin:.0f} s, exit code {code}: {command}")
            return code

        begin = time.monotonic()
        for command in installs:
            if own or os.geteuid() == 0 or not command.startswith("apt-get"):
                assert play(command) == 0, command
        for n, (node, codes) in enumerate(runs(page)):
            found = play(run.replace(NODE, node)), play(report)
            assert found == codes, f"{node}: expected {codes}, got {found}"
            if n == 0:
                show(f"the job took {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
