"""``errormotion doctor``: checks that this computer has what errormotion needs."""

from __future__ import annotations

import importlib
import os
import platform
import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path

from errormotion.cli.guard import log_file
from errormotion.errors import ErrormotionError

MIN_FREE_DISK = 2 * 2**30
"""Required free disk space, bytes; four hours of five packed channels at 20 kHz take about 1 GB."""


@dataclass(frozen=True)
class Finding:
    """Result of one check; ``absent`` if it is of something optional that is not installed."""

    name: str
    ok: bool
    message: str
    absent: bool = False


def examine() -> list[Finding]:
    """Run every check, and return the findings; a failed check is a finding."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        ("packages", _packages),
        ("compiled kernels", _kernels),
        ("plugins", _plugins),
        ("simulators", _loopback),
        ("serial ports", _serial),
        *_checks_of_plugins(),
        *_checks_of_extras(),
        ("disk here", _disk),
        ("temporary folder", _temporary),
        ("log file", _log),
    ]
    findings = []
    for name, check in checks:
        try:
            findings.append(Finding(name, True, check()))
        except _AbsentError as error:
            findings.append(Finding(name, True, str(error), absent=True))
        except Exception as error:  # noqa: BLE001 - the failure of a check is its result
            findings.append(
                Finding(
                    name,
                    False,
                    f"{error}"
                    if isinstance(error, _FailedError | ErrormotionError)
                    else f"{type(error).__name__}: {error}",
                )
            )
    return findings


class _AbsentError(Exception):
    """Something optional is not installed; the message states how to install it."""


class _FailedError(Exception):
    """A failed check; the message states the cause and the remedy."""


def _python() -> str:
    return f"{platform.python_version()} on {platform.platform()}"


def _packages() -> str:
    names = {"h5netcdf", "h5py", "jinja2", "matplotlib", "numba", "numpy", "pint", "pydantic", "rich", "scipy"}
    names |= {"serial", "xarray", "zarr"}
    missing = []
    for name in sorted(names):
        try:
            importlib.import_module(name)
        except ImportError as error:
            missing.append(f"{name} ({error})")
    if missing:
        raise _FailedError(f"cannot import {', '.join(missing)}. Install: {_pip('--force-reinstall errormotion')}")
    lacking = _lacking("")
    if lacking:
        raise _FailedError(f"not installed: {', '.join(lacking)}. Install: {_pip(' '.join(lacking))}")
    return f"errormotion {version('errormotion')}, {len(requires('errormotion') or [])} requirements, all import"


def _checks_of_extras() -> list[tuple[str, Callable[[], str]]]:
    """Return a check for each extra of the distribution; a missing extra is not a failure."""
    return [
        (f"optional: {name}", partial(_extra, name)) for name in metadata("errormotion").get_all("Provides-Extra") or ()
    ]


def _extra(name: str) -> str:
    if lacking := _lacking(name):
        raise _AbsentError(f"not installed ({', '.join(lacking)}). Install: {_pip(f'errormotion[{name}]')}")
    return "installed"


def _lacking(extra: str) -> list[str]:
    """Return the packages that the distribution, or one of its extras, requires and that are not installed."""
    found = []
    for requirement in requires("errormotion") or ():
        text, _, marker = requirement.partition(";")
        asked = re.search(r"extra *== *['\"]([^'\"]+)['\"]", marker)
        if (asked[1] if asked else "") != extra or not _applies(marker):
            continue
        name = re.match(r"[A-Za-z0-9._-]+", text.strip())
        try:
            if name is not None:
                version(name[0])
        except PackageNotFoundError:
            found.append(text.strip())
    return found


def _applies(marker: str) -> bool:
    """Return whether a requirement applies to this version of Python."""
    limit = re.search(r"python_version *(<|>=) *['\"](\d+)\.(\d+)['\"]", marker)
    if limit is None:
        return True
    below = sys.version_info[:2] < (int(limit[2]), int(limit[3]))
    return below if limit[1] == "<" else not below


def _pip(what: str) -> str:
    """Return the command that installs packages into this environment."""
    quoted = f"'{what}'" if any(sign in what for sign in "[<>=") and " " not in what else what
    return f"{sys.executable} -m pip install {quoted}"


def _kernels() -> str:
    import numba
    import numpy as np

    if numba.njit(lambda x: x.sum())(np.ones(3)) != 3.0:
        raise _FailedError("numba computes a wrong sum; install numba and llvmlite again")
    return f"numba {numba.__version__}, {numba.get_num_threads()} threads"


def _plugins() -> str:
    from errormotion import plugins

    found = {group: plugins.available(group) for group in plugins.GROUPS}
    broken = [f"{plugin.id}: {plugin.error}" for each in found.values() for plugin in each if plugin.error]
    if broken:
        raise _FailedError("; ".join(broken))
    return ", ".join(f"{len(each)} {group}" for group, each in found.items())


def _loopback() -> str:
    """Open the first instrument whose simulator answers, over a real connection."""
    from errormotion import plugins

    found: list[str] = []
    for cls in plugins.loaded("instruments"):
        if not cls.info.simulator:
            continue
        try:
            with cls("sim://cframe/doctor?seed=0", None) as driver:
                return f"a simulated {driver.identify().model} answers over the wire"
        except ErrormotionError as error:
            found.append(f"{cls.info.id}: {error}")
    raise _FailedError("; ".join(found) or "no instrument plugin has a simulator")


def _checks_of_plugins() -> list[tuple[str, Callable[[], str]]]:
    """Return the checks of plugins: the attribute ``doctor``, name to function."""
    from errormotion import plugins

    return [check for _, checks in plugins.brought("doctor", "instruments", "methods") for check in checks.items()]


def _serial() -> str:
    ports = [str(path) for pattern in ("ttyUSB*", "ttyACM*") for path in sorted(Path("/dev").glob(pattern))]
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        owner = _group(closed[0])
        raise _FailedError(
            f"no permission for {', '.join(closed)}. Join the group that owns them, then log in again: "
            f"sudo usermod -aG {owner} {os.environ.get('USER', 'USER')}"
        )
    return ", ".join(ports) or "no USB serial adapter plugged in"


def _group(port: str) -> str:
    try:
        return Path(port).group()
    except (KeyError, OSError, NotImplementedError):
        return "dialout"


def _disk() -> str:
    free = shutil.disk_usage(Path.cwd()).free
    if free < MIN_FREE_DISK:
        raise _FailedError(
            f"{free / 2**30:.1f} GiB free in {Path.cwd()}; a long measurement needs {MIN_FREE_DISK / 2**30:.0f} GiB"
        )
    return f"{free / 2**30:.0f} GiB free"


def _temporary() -> str:
    with tempfile.NamedTemporaryFile() as file:
        return str(Path(file.name).parent)


def _log() -> str:
    return str(log_file())
