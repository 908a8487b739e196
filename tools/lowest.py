"""Run tests with the lowest versions of packages that pyproject.toml allows: python tools/lowest.py [words of pytest].

The environment (--venv) is made with uv where it is installed, else with pip. Packages that pyproject.toml names have
exactly their lower bounds; what they need in turn is the newest version that fits, and the tools of the tests are those
of requirements.lock. A lower bound must therefore be a version that exists.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parent.parent
TOOLS = ("hypothesis", "packaging", "pytest", "pytest-timeout", "pytest-xdist")
PEERS = ("canopen", "cesapi", "geocompy", "metrolopy", "minimalmodbus", "mtconnect", "pyvisa", "pyvisa-py")
CORE = ("datasets", "campaign", "instruments", "kinematics", "plugins", "record", "tolerances", "twin", "montecarlo")
"""Folders of tests that touch every package: files, instruments, fits, compiled loops."""

_REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)>=([0-9][0-9.]*)(\s*;.+)?")


def lowest(requirements: Iterable[str]) -> list[str]:
    """Return each requirement at its lower bound, ``name==version``.

    Raises
    ------
    ValueError
        A requirement is not ``name>=version``.
    """
    found = []
    for text in requirements:
        match = _REQUIREMENT.fullmatch(text)
        if match is None:
            raise ValueError(f"pyproject.toml: expected a requirement such as 'numpy>=2.1'; found '{text}'")
        found.append(f"{match[1]}=={match[2]}{match[3] or ''}")
    return found


def locked(names: Iterable[str], lock: str) -> list[str]:
    """Return packages at their versions in the text of a lock file.

    Raises
    ------
    ValueError
        A package is not locked.
    """
    found = []
    for name in names:
        match = re.search(rf"^{re.escape(name)}==([^\s;]+)", lock, re.MULTILINE)
        if match is None:
            raise ValueError(f"requirements.lock: expected {name}; it is not there")
        found.append(f"{name}=={match[1]}")
    return found


def pins() -> list[str]:
    """Return what the environment contains of the project's own choice."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = [text for texts in project["optional-dependencies"].values() for text in texts]
    lock = (ROOT / "requirements.lock").read_text(encoding="utf-8")
    return [*lowest([*project["dependencies"], *extras]), *locked([*TOOLS, *PEERS], lock)]


def install(venv: Path, python: str) -> Path:
    """Make the environment, and return its Python."""
    inside = venv / "bin" / "python"
    shutil.rmtree(venv, ignore_errors=True)
    if uv := shutil.which("uv"):
        subprocess.run([uv, "venv", "--quiet", "--seed", "--python", python, venv], check=True)
        command = [uv, "pip", "install", "--quiet", "--python", inside]
    else:
        subprocess.run([python, "-m", "venv", venv], check=True)
        command = [inside, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*command, *pins(), "setuptools>=77"], check=True)
    subprocess.run([*command, "--no-deps", "--no-build-isolation", "--editable", ROOT], check=True)
    return inside


def main() -> None:
    """Make the environment and run the tests there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv-lowest", help="made anew each time")
    parser.add_argument("--python", default=sys.executable, help="of the environment; the lowest is 3.11")
    options, words = parser.parse_known_args()
    python = install(options.venv, options.python)
    words = words or ["-n", "auto", "--dist", "loadfile", "-m", "not slow", *(f"tests/{name}" for name in CORE)]
    sys.exit(subprocess.run([python, "-m", "pytest", *words], cwd=ROOT, check=False).returncode)


if __name__ == "__main__":
    main()
