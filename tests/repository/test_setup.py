"""The set-up uses pinned packages, runs once, and reports missing tools."""

import ast
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PIN = re.compile(r"^([a-z0-9.-]+)==(\S+?)(?: ; (.*?))? \\$")


def _pins(name: str) -> set[tuple[str, str, str]]:
    lines = (ROOT / name).read_text().splitlines()
    return {(match[1], match[2], match[3] or "") for line in lines if (match := PIN.match(line))}


def _wanted() -> tuple[list[Requirement], list[Requirement]]:
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())
    core = [*data["project"]["dependencies"], *data["dependency-groups"]["build"]]
    extras = [item for group in data["project"]["optional-dependencies"].values() for item in group]
    return [Requirement(item) for item in core], [
        Requirement(item) for item in extras + data["dependency-groups"]["dev"]
    ]


@pytest.mark.parametrize("lock", ["requirements.lock", "requirements-core.lock"])
def test_every_pin_has_hashes_and_no_address(lock: str) -> None:
    text = (ROOT / lock).read_text()
    entries = re.split(r"^(?=[a-zA-Z0-9])", text, flags=re.MULTILINE)
    unpinned = [entry.splitlines()[0] for entry in entries if entry.strip() and "--hash=sha256:" not in entry]
    assert not unpinned
    assert len(_pins(lock)) > 40
    assert "://" not in text
    assert "--index" not in text
    assert "--find-links" not in text


def test_core_lock_is_part_of_the_full_one() -> None:
    full = {(name, version) for name, version, _ in _pins("requirements.lock")}
    assert {(name, version) for name, version, _ in _pins("requirements-core.lock")} <= full


def test_locks_contain_the_requirements_of_pyproject() -> None:
    core, rest = _wanted()
    for lock, wanted in (("requirements-core.lock", core), ("requirements.lock", core + rest)):
        pins = _pins(lock)
        for requirement in wanted:
            versions = [v for name, v, _ in pins if name == canonicalize_name(requirement.name)]
            assert versions, f"{requirement} is not in {lock}: run make lock"
            assert all(requirement.specifier.contains(v) for v in versions), (
                f"{requirement} against {versions} in {lock}"
            )


def test_the_citation_names_the_version_that_is_built() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = (ROOT / "CITATION.cff").read_text().splitlines()
    assert f"version: {project['version']}" in citation
    assert f"license: {project['license']}" in citation


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """Return a copy of the files that set-up uses; its setup only counts how often it is called."""
    for name in ("Makefile", "pyproject.toml", "requirements.lock", "requirements-core.lock"):
        shutil.copy2(ROOT / name, tmp_path / name)
    (tmp_path / "tools").mkdir()
    setup = tmp_path / "tools" / "setup"
    setup.write_text(
        "#!/bin/sh\nmkdir -p .venv\necho $1 >>calls\ntouch .venv/.core\n[ $1 = core ] || touch .venv/.dev\n"
    )
    setup.chmod(0o755)
    return tmp_path


def _make(house: Path, target: str) -> list[str]:
    subprocess.run(["make", target], cwd=house, check=True, capture_output=True)
    calls = house / "calls"
    return calls.read_text().split() if calls.exists() else []


def _renew(path: Path) -> None:
    later = time.time() + 60
    os.utime(path, (later, later))


def test_the_environment_is_set_up_once(house: Path) -> None:
    assert _make(house, ".venv/.core") == ["core"]
    assert _make(house, ".venv/.core") == ["core"]
    assert _make(house, "setup") == ["core", "dev"]
    assert _make(house, "setup") == ["core", "dev"]
    assert _make(house, ".venv/.core") == ["core", "dev"]


@pytest.mark.parametrize("changed", ["requirements.lock", "requirements-core.lock", "pyproject.toml"])
def test_a_changed_lock_sets_up_again(house: Path, changed: str) -> None:
    _make(house, "setup")
    _renew(house / changed)
    assert _make(house, "setup") == ["dev", "dev"]


def _real_setup(tmp_path: Path, path: str, **environment: str) -> subprocess.CompletedProcess[str]:
    (tmp_path / "tools").mkdir()
    shutil.copy2(ROOT / "tools" / "setup", tmp_path / "tools" / "setup")
    return subprocess.run(
        [tmp_path / "tools" / "setup", "core"], env={"PATH": path, **environment}, capture_output=True, text=True
    )


def _path_with(folder: Path, **commands: str) -> str:
    """Return a PATH of one folder: the basic tools, and the given commands as shell scripts."""
    folder.mkdir()
    for tool in ("sh", "dirname", "cut", "env", "mkdir", "touch"):
        (folder / tool).symlink_to(str(shutil.which(tool)))
    for name, script in commands.items():
        (folder / name).write_text(f"#!{shutil.which('sh')}\n{script}\n")
        (folder / name).chmod(0o755)
    return str(folder)


def test_a_missing_python_is_reported(tmp_path: Path) -> None:
    # The shim of a version manager without a Python must not be used as a Python.
    done = _real_setup(tmp_path, _path_with(tmp_path / "bin", python3="echo 'no such version' >&2; exit 127"))
    assert done.returncode == 1
    assert "no Python 3.11 or newer found" in done.stderr
    assert "make setup PYTHON=" in done.stderr


def test_an_invalid_python_is_reported(tmp_path: Path) -> None:
    done = _real_setup(tmp_path, _path_with(tmp_path / "bin"), PYTHON="/nowhere/python")
    assert done.returncode == 1
    assert "PYTHON=/nowhere/python" in done.stderr


def test_a_missing_venv_module_is_reported(tmp_path: Path) -> None:
    python = f'case "$*" in *venv*) exit 1;; *) exec {sys.executable} "$@";; esac'
    done = _real_setup(tmp_path, _path_with(tmp_path / "bin", python3=python))
    assert done.returncode == 1
    assert "apt install python3-venv" in done.stderr


@pytest.mark.parametrize("fails", [False, True])
def test_the_output_of_the_installer_is_shown_only_if_it_fails(tmp_path: Path, fails: bool) -> None:
    uv = f"""case "$*" in
        venv*) mkdir -p .venv/bin; printf '#!{shutil.which("sh")}\necho Python 3.11.7\n' >.venv/bin/python
                PATH={os.environ["PATH"]} chmod +x .venv/bin/python;;
        *--version*) echo uv 1.0;;
        *) echo 'WARNING: Location is ignored' >&2; echo 'Collecting numpy'; exit {int(fails)};;
    esac"""
    done = _real_setup(tmp_path, _path_with(tmp_path / "bin", uv=uv, python3=f'exec {sys.executable} "$@"'))
    assert done.returncode == int(fails)
    assert ("WARNING: Location is ignored" in done.stderr) == fails
    assert ("Collecting numpy" in done.stderr) == fails
    assert ("the installation failed" in done.stderr) == fails
    assert done.stdout == "setup: installing requirements-core.lock into .venv (Python 3.11.7, uv 1.0)\n"
    assert (tmp_path / ".venv" / ".core").exists() != fails


@pytest.mark.skipif(sys.version_info >= (3, 13), reason="open3d has no wheels for this Python")
def test_open3d_loads_with_the_system_libraries_that_ci_installs() -> None:
    done = subprocess.run([sys.executable, "-c", "import open3d"], capture_output=True, text=True)
    if "cannot open shared object file" in done.stderr or "No module named" in done.stderr:
        pytest.skip(f"Open3D cannot be loaded: {done.stderr.strip().splitlines()[-1].partition(': ')[2]}")
    assert done.returncode == 0, done.stderr


def test_every_dependency_is_imported_by_the_package() -> None:
    imported = set()
    for path in (ROOT / "errormotion").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                imported |= {alias.name.partition(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                imported.add(node.module.partition(".")[0])
    modules: dict[str, set[str]] = {}
    for module, distributions in packages_distributions().items():
        for each in distributions:
            modules.setdefault(canonicalize_name(each), set()).add(module)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = [Requirement(item).name for item in project["dependencies"]]
    assert [name for name in needed if not modules[canonicalize_name(name)] & imported] == []


def test_ci_without_root_fails_and_says_so(tmp_path: Path) -> None:
    """The commands that it needs before are those of the system; `id` states another user."""
    for name in ("bash", "dirname"):
        (tmp_path / name).symlink_to(str(shutil.which(name)))
    (tmp_path / "id").write_text("#!/bin/sh\necho 1000\n")
    (tmp_path / "id").chmod(0o755)
    command = [str(tmp_path / "bash"), str(ROOT / ".ci" / "run")]
    found = subprocess.run(command, env={"PATH": str(tmp_path)}, capture_output=True, text=True, timeout=60)
    assert found.returncode == 1
    assert found.stderr.startswith(".ci/run: it needs root")
    assert "== setup" not in found.stdout
