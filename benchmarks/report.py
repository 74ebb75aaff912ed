"""Pages, bytes and seconds of reports: of a good, a misfitting and a stopped run, and of six runs of a drifting brake.

    python benchmarks/report.py [--out DIR] [--image FILE]

All are simulated anew. The times are those of the processor for the whole command, imports included. Pages are counted
in a PDF printed by Chromium (``apt-get install chromium poppler-utils``). ``--out`` keeps the logs and pages, with
screenshots at 1200 and 400 pixels, light and dark, and the PDFs; ``--image`` makes the picture of the README.
"""

from __future__ import annotations

import argparse
import re
import resource
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

from emb_runtime.errors import EXIT_DONE, EXIT_USAGE

CRITERIA = """\
[acceptance.parameters]
k_m.relative = 0.01
k_1.relative = 0.01
T_c.relative = 0.05
f_v = { relative = 0.01, reference = 3e-5 }

[acceptance.budgets]
missed = 0.001
lost = 0.01
"""
RUNS = {
    "good": (["sim:f_v=3e-5"], ["--acceptance", "criteria.toml"]),
    "misfit": (["sim:plant=stribeck"], ["--model", "exact"]),
    "stopped": (["sim:k_m=0.0385"], ["--acceptance", "criteria.toml"]),
    "campaign": ([f"sim:f_v={3e-5 * (1.0 + 5e-4 * n)},seed={n}" for n in range(1, 7)], []),
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
HEADLESS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars")


def command(name: str, *arguments: str, folder: Path) -> None:
    """Runs one of our commands; a run that is stopped is meant to be."""
    module, entry = {"emb-run": ("runtime.system", "emb_run"), "emb-replay": ("bench.cli", "emb_replay")}[name]
    code = f"import sys; from emb_{module}.entry import {entry}; sys.argv[0] = '{name}'; sys.exit({entry}())"
    subprocess.run([sys.executable, "-c", code, *arguments], cwd=folder, capture_output=True, check=False)


def processor_seconds() -> float:
    """Time of all processes that have ended [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def look(browser: str, page: Path, *arguments: str) -> None:
    """Opens a page in a browser without a screen."""
    with tempfile.TemporaryDirectory() as profile:
        place = [f"--user-data-dir={profile}", *arguments, page.as_uri()]
        subprocess.run([browser, *HEADLESS, *place], capture_output=True, check=True, timeout=120)


def pages(browser: str, page: Path) -> int:
    """Prints a page to a PDF beside it; returns the number of its sheets."""
    paper = page.with_suffix(".pdf")
    look(browser, page, "--no-pdf-header-footer", f"--print-to-pdf={paper}")
    told = subprocess.run(["pdfinfo", paper], capture_output=True, text=True, check=True).stdout
    found = re.search(r"Pages:\s+(\d+)", told)
    return int(found[1]) if found else 0


def main() -> int:
    """Makes and measures the reports."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--out", type=Path, metavar="DIR", help="keep everything there")
    p.add_argument("--image", type=Path, metavar="FILE", help="picture of the good one, PNG")
    args = p.parse_args()
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None or shutil.which("pdfinfo") is None:
        print(f"needs {' or '.join(BROWSERS)}, and pdfinfo: apt-get install chromium poppler-utils", file=sys.stderr)
        return EXIT_USAGE
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.out or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "criteria.toml").write_text(CRITERIA, encoding="utf-8")
        for name, (buses, options) in RUNS.items():
            logs = [f"{name}{n if len(buses) > 1 else ''}.mcap" for n in range(1, len(buses) + 1)]
            for bus, log in zip(buses, logs, strict=True):
                (folder / log).unlink(missing_ok=True)
                who = ["--operator", "A. Tester", "--serial", "4711-08"]
                command("emb-run", "--iface", bus, "--log", log, *who, folder=folder)
            page, begin = folder / f"{name}.html", processor_seconds()
            command("emb-replay", "report", *logs, "-o", page.name, *options, folder=folder)
            seconds = processor_seconds() - begin
            size = page.stat().st_size
            print(f"{name:9} {len(logs)} run(s): {pages(browser, page)} pages, {size / 1e6:.2f} MB, {seconds:.1f} s")
            if args.out is not None:
                for label, width, dark in (("1200", 1200, False), ("400", 400, False), ("dark", 1200, True)):
                    shot = [f"--screenshot={folder / f'{name}-{label}.png'}", f"--window-size={width},3600"]
                    look(browser, page, *shot, *(["--blink-settings=preferredColorScheme=0"] if dark else []))
        if args.image is not None:
            shot = [f"--screenshot={args.image.absolute()}", "--window-size=1000,1400"]
            look(browser, folder / "good.html", *shot)
            with Image.open(args.image) as picture:  # few colours, so that it is small
                few = picture.convert("RGB").quantize(32, dither=Image.Dither.NONE)
            few.save(args.image, optimize=True)
    return EXIT_DONE


if __name__ == "__main__":
    sys.exit(main())
