"""Print the groups of sources of uncertainty as Markdown: earlier names, meaning, and the methods that use each."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "errormotion"
USERS = ("methods/*", "compensation/thermal_model")
"""Folders whose source states the groups that they use."""


def used_by(package: Path = PACKAGE) -> dict[str, set[str]]:
    """Return the texts that each method states as groups, by its name."""
    folders = [
        folder for pattern in USERS for folder in sorted(package.glob(pattern)) if (folder / "__init__.py").exists()
    ]
    engine = set().union(*(_stated(package / name) for name in ("estimation", "measurement")))
    return {folder.name: _stated(folder) | (engine if _uses_the_model(folder) else set()) for folder in folders}


def _stated(folder: Path) -> set[str]:
    return {
        text
        for file in folder.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        for part in _stating(node)
        for text in _texts(part)
    }


def _uses_the_model(folder: Path) -> bool:
    return any("from errormotion.measurement" in file.read_text(encoding="utf-8") for file in folder.rglob("*.py"))


def _stating(node: ast.AST) -> list[ast.expr]:
    """Return the parts of a node that can state groups: constants of a module, and arguments of sources."""
    if (
        isinstance(node, ast.Assign)
        and ast.unparse(node.targets[0]).isupper()
        and isinstance(node.value, ast.Constant | ast.Tuple | ast.BinOp)
    ):
        return [node.value]
    if isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple):
        return node.value.elts[-1:]
    if isinstance(node, ast.keyword) and node.arg in ("group", "groups", "source_groups"):
        return [node.value]
    if isinstance(node, ast.Call) and ast.unparse(node.func) in ("constant", "scalar", "_constant", "kinds.append"):
        return node.args
    return []


def _texts(node: ast.AST) -> list[str]:
    """Return the texts in tuples, lists, sums and choices of an expression; not those in calls."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if isinstance(node, ast.Call | ast.Dict):
        return []
    return [text for each in ast.iter_child_nodes(node) for text in _texts(each)]


def table(package: Path = PACKAGE) -> str:
    """Return the table of earlier names and that of all groups."""
    stated = runpy.run_path(str(package / "datasets" / "groups.py"))
    texts = used_by(package)
    lines = ["| earlier name | present name |", "|---|---|"]
    lines += [f"| {old} | {new} |" for old, new in sorted(stated["ALIASES"].items())]
    lines += ["", "| group | meaning | used by |", "|---|---|---|"]
    for name, meaning in sorted(stated["GROUPS"].items()):
        users = ", ".join(f"`{user}`" for user, own in texts.items() if name in own and user != "__pycache__")
        lines.append(f"| {name} | {meaning} | {users} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.stdout.write(table())
