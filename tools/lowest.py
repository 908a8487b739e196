"""Run tests with the lowest versions of packages that pyproject.toml allows: python tools/lowest.py [words of pytest].

The environment (--venv) is made with uv if it is installed, else with pip. Packages in pyproject.toml have exactly
their lower bounds, which must be existing versions; their dependencies have the newest allowed versions, and the test
tools the versions of requirements.lock.
"""

from __future__ import annotations

import argparse
import platform
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

ROOT = Path(__file__).parent.parent
TOOLS = ("hypothesis", "packaging", "pytest", "pytest-timeout", "pytest-xdist")
PEERS = ("canopen", "cesapi", "geocompy", "metrolopy", "minimalmodbus", "mtconnect", "pyvisa", "pyvisa-py")
CORE = (
    *("test_compiling.py", "datasets/test_storage.py", "datasets/test_bounded_reading.py", "datasets/test_units.py"),
    *("datasets/test_golden_datasets.py", "datasets/test_zarr_folder.py", "datasets/test_tomlfile.py"),
    *("campaign/test_batch.py", "campaign/test_files.py", "campaign/test_store.py", "campaign/test_beam_campaign.py"),
    *("compensation/test_thermal_model.py", "kinematics/test_fits.py", "methods/beam_direction/test_planning.py"),
    *("methods/multilateration/test_layout.py", "methods/multilateration/test_solver.py"),
    *("methods/crossbeam_registration/test_registration.py", "methods/spindle_drift"),
    *("instruments/test_transports.py", "instruments/test_modbus_peers.py", "instruments/test_can_temperature.py"),
    *("instruments/test_profile_files.py", "instruments/controller/test_opcua.py"),
    *("report/test_exports.py", "report/test_canvas.py", "dashboard/test_server.py"),
    *("cli/test_commands.py", "cli/test_progress.py"),
)
"""Tests that use all packages: files, instruments, fits, compiled loops, pages, the command line."""
TITLE = "Lowest versions"

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
            raise ValueError(f"requirements.lock: expected {name}; found none")
        found.append(f"{name}=={match[1]}")
    return found


def pins() -> list[str]:
    """Return the pinned packages of the environment."""
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


def section(result: str) -> str:
    """Return the section of the page from the last line of pytest."""
    own = pins()[: -len(TOOLS + PEERS)]
    return "\n".join(
        [
            "Tests with all packages at the lowest versions that `pyproject.toml` allows: "
            + ", ".join(pin.partition(";")[0].replace("==", " ").strip() for pin in own) + ".",
            "",
            f"{result}.",
            "",
            f"`make lowest`, {datetime.now(UTC):%Y-%m-%d}, Python {platform.python_version()}.",
        ]
    )  # fmt: skip


def main() -> None:
    """Make the environment and run the tests there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--venv", type=Path, default=ROOT / ".venv-lowest", help="environment, replaced each time")
    parser.add_argument("--python", default=sys.executable, help="of the environment; the lowest is 3.11")
    options, words = parser.parse_known_args()
    python = install(options.venv, options.python)
    whole = not words
    words = words or ["-n", "auto", "--dist", "loadfile", "-q", "-m", "not slow", *(f"tests/{name}" for name in CORE)]
    ended = subprocess.run([python, "-m", "pytest", *words], cwd=ROOT, check=False, stdout=subprocess.PIPE, text=True)
    print(ended.stdout)
    if whole:
        sys.path[:0] = [str(ROOT / "tests" / "support"), str(ROOT / "tools")]
        from fuzz import PAGE, write_section

        write_section(PAGE, TITLE, section(ended.stdout.strip().splitlines()[-1].strip("= ")))
    sys.exit(ended.returncode)


if __name__ == "__main__":
    main()
