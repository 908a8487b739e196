"""``errormotion plugins new``: writes a distribution with a plugin that passes the conformance kit."""

from __future__ import annotations

import keyword
import re
import sys
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from errormotion import plugins
from errormotion.cli.output import show, show_json
from errormotion.errors import PluginError

TEMPLATES = files("errormotion.cli") / "scaffold"


def new(what: str, name: str, out: Path | None, as_json: bool) -> None:
    """Write the files of a new plugin.

    Parameters
    ----------
    what : str
        ``instrument``, ``method`` or ``compensator``.
    name : str
        The id of the plugin, or words from which the id is made: "LG7 gauge" gives ``lg7_gauge``.
    out : Path, optional
        A folder that is empty or does not exist; default: the name of the distribution.
    as_json : bool

    Raises
    ------
    PluginError
        The name cannot be an id or is used already, or the folder is not empty.
    """
    plugin_id = id_of(name)
    words = {
        "id": plugin_id,
        "package": plugin_id,
        "dashed": plugin_id.replace("_", "-"),
        "class_name": "".join(word.capitalize() for word in plugin_id.split("_")),
        "title": name.strip()[:1].upper() + name.strip()[1:].replace("_", " "),
    }
    folder = out or Path(f"errormotion-{words['dashed']}")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise PluginError(
            f"{folder}: expected a new or empty folder. Nothing was written.", code="plugin.folder.not_empty"
        )
    written = [_write(folder, path, template, words) for path, template in _templates(TEMPLATES / what, plugin_id)]
    if as_json:
        show_json({"ok": True, "plugin": plugin_id, "folder": str(folder), "files": [str(path) for path in written]})
        return
    for path in written:
        show(str(path))
    show(f"\nInstall and check it:\n  pip install -e {folder}\n  errormotion plugins check {plugin_id}")


def id_of(name: str) -> str:
    """Return the id of a name: lower case, words joined by underscores.

    Raises
    ------
    PluginError
        The id is not an identifier, or it is the name of a standard package of Python or of another plugin.
    """
    found = re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")
    if not found.isidentifier() or keyword.iskeyword(found) or len(found) > 40:
        raise PluginError(
            f"'{name}': expected a name that starts with a letter, such as 'my sensor'; found '{found}'",
            code="plugin.name.form",
        )
    taken = {plugin.id for group in plugins.GROUPS for plugin in plugins.available(group)}
    if found in taken or found in sys.stdlib_module_names or found == "errormotion":
        raise PluginError(
            f"'{found}' is the name of another plugin or package; choose another name", code="plugin.name.used"
        )
    return found


def _templates(folder: Traversable, plugin_id: str) -> list[tuple[str, str]]:
    """Return path and template of every file of a plugin."""
    found = []
    for each in sorted(folder.iterdir(), key=lambda each: each.name):
        if each.is_dir():
            found += [(f"tests/test_{plugin_id}.py", (each / "test_plugin.py.j2").read_text(encoding="utf-8"))]
        elif each.name.endswith(".j2"):
            name = each.name.removesuffix(".j2").replace("package.py", "__init__.py")
            path = name if not name.endswith(".py") else f"{plugin_id}/{name}"
            found.append((path, each.read_text(encoding="utf-8")))
    return found


def _write(folder: Path, path: str, template: str, words: dict[str, str]) -> Path:
    """Write one file."""
    environment = Environment(undefined=StrictUndefined, keep_trailing_newline=True, autoescape=False)
    target = folder / path
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(environment.from_string(template).render(words), encoding="utf-8")
    return target
