"""Monte Carlo validation: coverage of the stated intervals, and efficiency compared with the Cramer-Rao bound.

``make validate`` runs it and writes ``docs/validation.md``; ``make validate ARGS="crossbeam_scan --seeds 50"`` runs one
part and does not change the other sections. The truth is that of the virtual machine; the bound is the Cramer-Rao bound
of the model of each estimator. The coverage over S independent seeds has a standard deviation of
sqrt(0.05 * 0.95 / S), which is stated.
"""

from __future__ import annotations

import argparse
import pkgutil
import re
import time
from importlib import import_module
from inspect import signature
from pathlib import Path

import validation

from errormotion import __version__

PAGE = Path(__file__).parent.parent / "docs" / "validation.md"
PARTS = {
    module.name: import_module(f"validation.{module.name}")
    for module in pkgutil.iter_modules(validation.__path__)
    if not module.ispkg
}
"""The modules of the folder ``validation``, each with ``TITLE``, ``SEEDS`` and ``section(seeds)``.

A section with the arguments ``workers`` and ``cache`` runs in several processes and stores results.
"""
INTRODUCTION = """\
# Validation

All figures on this page are results of `make validate`. The truth is that of the
[virtual machine](explanation/virtual-machine.md); bounds are Cramer-Rao bounds of the models of the estimators.
A ratio of 1 is the optimum of unbiased estimators.
"""


def sections(page: Path) -> dict[str, str]:
    """Return the sections of the page by title."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    found = re.split(r"^## (.+)\n", text, flags=re.MULTILINE)[1:]
    return {title: body.strip("\n") for title, body in zip(found[::2], found[1::2], strict=True)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(PARTS)}; default: all")
    parser.add_argument("--seeds", type=int, help="number of virtual machines; each part has its own default")
    parser.add_argument("--workers", type=int, default=1, help="processes, for the parts that can use several")
    parser.add_argument("--cache", type=Path, help="folder of results of single machines, to continue a run")
    parser.add_argument("--out", type=Path, default=PAGE)
    options = parser.parse_args()
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"expected parts of {', '.join(PARTS)}; found {', '.join(sorted(unknown))}")
    found = sections(options.out)
    for name in options.parts or [name for name, part in PARTS.items() if getattr(part, "DEFAULT", True)]:
        part, start = PARTS[name], time.perf_counter()
        seeds = options.seeds or part.SEEDS
        given = {"workers": options.workers, "cache": options.cache}
        more = {name: value for name, value in given.items() if name in signature(part.section).parameters}
        lines = [*part.section(seeds, **more), "", f"errormotion {__version__}, {seeds} seeds."]
        found[part.TITLE] = "\n".join(lines)
        print(f"## {part.TITLE}\n\n{found[part.TITLE]}\n\n{time.perf_counter() - start:.0f} s\n", flush=True)
    shown = [part.TITLE for part in PARTS.values() if part.TITLE in found]
    page = INTRODUCTION + "".join(f"\n## {title}\n\n{found[title]}\n" for title in shown)
    options.out.write_text(page, encoding="utf-8")
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
