"""``errormotion doctor``: whether this machine has what errormotion needs."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import requires, version
from pathlib import Path

from errormotion.cli.guard import log_file
from errormotion.errors import InstrumentError

LEAST_DISK = 2 * 2**30
"""Bytes; four hours of five packed channels at 20 kHz take about 1 GB."""


@dataclass(frozen=True)
class Finding:
    """What one look found."""

    name: str
    ok: bool
    message: str


def examine() -> list[Finding]:
    """Look at everything; a look that fails is a finding, too."""
    looks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        ("packages", _packages),
        ("compiled kernels", _kernels),
        ("plugins", _plugins),
        ("simulators", _loopback),
        ("serial ports", _serial),
        ("LinuxCNC", _linuxcnc),
        ("disk here", _disk),
        ("temporary folder", _temporary),
        ("log file", _log),
    ]
    findings = []
    for name, look in looks:
        try:
            findings.append(Finding(name, True, look()))
        except Exception as error:  # noqa: BLE001 - each look is on its own, and its failure is the answer
            findings.append(
                Finding(name, False, f"{error}" if isinstance(error, _Trouble) else f"{type(error).__name__}: {error}")
            )
    return findings


class _Trouble(Exception):  # noqa: N818 - a finding, not an error of the program
    """What is wrong, in words that say what to do."""


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
        raise _Trouble(f"cannot import {', '.join(missing)}; install errormotion again into this environment")
    return f"errormotion {version('errormotion')}, {len(requires('errormotion') or [])} requirements, all import"


def _kernels() -> str:
    import numba
    import numpy as np

    if numba.njit(lambda x: x.sum())(np.ones(3)) != 3.0:
        raise _Trouble("numba computes 1 + 1 + 1 wrongly; install numba and llvmlite again")
    return f"numba {numba.__version__}, {numba.get_num_threads()} threads"


def _plugins() -> str:
    from errormotion import plugins

    found = {group: plugins.available(group) for group in plugins.GROUPS}
    broken = [f"{plugin.id}: {plugin.error}" for each in found.values() for plugin in each if plugin.error]
    if broken:
        raise _Trouble("; ".join(broken))
    return ", ".join(f"{len(each)} {group}" for group, each in found.items())


def _loopback() -> str:
    from errormotion import plugins

    driver = plugins.get("instruments", "optoncdt")("sim://cframe/doctor?seed=0", None)
    with driver:
        identity = driver.identify()
    return f"a simulated {identity.model} answers over the wire"


def _serial() -> str:
    ports = [str(path) for pattern in ("ttyUSB*", "ttyACM*") for path in sorted(Path("/dev").glob(pattern))]
    closed = [port for port in ports if not os.access(port, os.R_OK | os.W_OK)]
    if closed:
        raise _Trouble(f"no permission for {', '.join(closed)}; join the group that owns them (often 'dialout')")
    return ", ".join(ports) or "no USB serial adapter plugged in"


def _linuxcnc() -> str:
    """LinuxCNC is wanted by nobody but those who simulate one, so its absence is no trouble; a broken one is."""
    from errormotion.instruments.simulators.linuxcnc_process import installed, why_not

    if shutil.which("linuxcnc") is None:
        return f"none here, and so no sim://.../linuxcnc: {why_not()}"
    if reason := why_not():
        raise _Trouble(reason)
    try:
        return f"{installed()}, for sim://.../linuxcnc"
    except InstrumentError as error:
        raise _Trouble(str(error)) from None


def _disk() -> str:
    free = shutil.disk_usage(Path.cwd()).free
    if free < LEAST_DISK:
        raise _Trouble(f"{free / 2**30:.1f} GiB free in {Path.cwd()}; a long record wants {LEAST_DISK / 2**30:.0f} GiB")
    return f"{free / 2**30:.0f} GiB free"


def _temporary() -> str:
    with tempfile.NamedTemporaryFile() as file:
        return str(Path(file.name).parent)


def _log() -> str:
    return str(log_file())
