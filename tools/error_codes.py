"""List the codes of the errors of errormotion, as they stand in its source.

``python tools/error_codes.py`` prints the list; the documentation contains it. `sites` and `codeless` are for the test
that every error has a code.
"""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).parents[1] / "errormotion"
FORM = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*){1,3}")
ROOT = ("errors.py", "ErrormotionError")
OF_CAUSE = "(the message of the cause)"


class Site(NamedTuple):
    """One place where an error gets its code; ``where`` is file and line, ``template`` has ``...`` for values."""

    code: str
    kind: str
    template: str
    where: str


class Source:
    """The parsed source of a package; the key of a class is (file, name).

    Parameters
    ----------
    package : Path
        Its folder.
    """

    def __init__(self, package: Path = PACKAGE) -> None:
        self.trees = {
            p.relative_to(package).as_posix(): ast.parse(p.read_text()) for p in sorted(package.rglob("*.py"))
        }
        nodes = [(file, node) for file, tree in self.trees.items() for node in ast.walk(tree)]
        self.classes = {(file, node.name): node for file, node in nodes if isinstance(node, ast.ClassDef)}
        self.functions = {(file, node.name): node for file, node in nodes if isinstance(node, ast.FunctionDef)}
        self.imports = {
            (file, name.asname or name.name): (node.module, name.name)
            for file, node in nodes
            if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(package.name)
            for name in node.names
        }
        self.calls = [(file, node) for file, node in nodes if isinstance(node, ast.Call)]
        self._name = package.name

    @cached_property
    def errors(self) -> dict[tuple[str, str], str]:
        """The classes of errors, each with its own code; empty for one that has the code of its parent."""
        found = {ROOT: ""}
        while more := {
            key: _own_code(node)
            for key, node in self.classes.items()
            if key not in found and any(self.found(key[0], ast.unparse(base)) in found for base in node.bases)
        }:
            found |= more
        return found

    def found(self, file: str, name: str) -> tuple[str, str] | None:
        """Return the key of a class or function that a file names, or None."""
        module, _, last = name.rpartition(".")
        if not module and ((file, last) in self.classes or (file, last) in self.functions):
            return file, last
        path, inner = self.imports.get((file, module or last), ("", ""))
        if not path:
            return None
        other = self._file(f"{path}.{inner}" if module else path)
        return self.found(other, last if module else inner) if other and other != file else None

    def _file(self, module: str) -> str:
        path = "/".join(module.split(".")[1:])
        return next((name for name in (f"{path}.py", f"{path}/__init__.py".lstrip("/")) if name in self.trees), "")

    def kind(self, file: str, call: ast.Call) -> str:
        """Return the name of the class of the error that a call makes; empty if it is unknown."""
        name = ast.unparse(call.func)
        key = self.found(file, name) or (file, name.rpartition(".")[2])
        if key in self.errors:
            return key[1]
        if key in self.functions and (returned := self.functions[key].returns) is not None:
            name = ast.unparse(returned).strip("'\"").partition(" |")[0]
            return name if name.isidentifier() else ""
        return ""


def sites(source: Source) -> Iterator[Site]:
    """Yield each place where an error gets a code: by its class, where it is made, or where it is printed."""
    for (file, name), code in source.errors.items():
        if code:
            doc = (ast.get_docstring(source.classes[file, name]) or "").partition("\n")[0]
            yield Site(code, name, doc, f"{file}:{source.classes[file, name].lineno}")
    for file, call in source.calls:
        stated = [each.value for each in call.keywords if each.arg == "code"]
        if ast.unparse(call.func) == "code_of":
            stated += call.args[1:]
        for code in (code for value in stated for code in _codes(value)):
            yield Site(code, source.kind(file, call), template(call.args), f"{file}:{call.lineno}")
    for file, tree in source.trees.items():
        for node in tree.body:
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "CODES":
                for code in _codes(node.value):
                    yield Site(code, "", "", f"{file}:{node.lineno}")


def codeless(source: Source) -> list[str]:
    """Return the places where an error of the package is made without a code of its own."""
    made = ((file, call, source.found(file, ast.unparse(call.func))) for file, call in source.calls)
    return [
        f"{file}:{call.lineno}: {ast.unparse(call)[:100]}"
        for file, call, key in made
        if key in source.errors
        and key is not None
        and (not source.errors[key] or key[0] == ROOT[0])
        and all(each.arg != "code" for each in call.keywords)
    ]


def template(arguments: Sequence[ast.expr]) -> str:
    """Return the first argument that is a text, with ``...`` for its values."""
    for argument in arguments:
        text = _text(argument)
        if re.search(r"[a-z]{2}", text):
            return text
    return OF_CAUSE


def _text(node: ast.expr) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(_text(each) if isinstance(each, ast.Constant) else "..." for each in node.values)
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return _text(node.left) + (_text(node.right) or "...")
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "join" and node.args:
        first = node.args[0].elts[0] if isinstance(node.args[0], ast.List) and node.args[0].elts else None
        return _text(first) + "..." if first is not None else ""
    return ""


def _own_code(node: ast.ClassDef) -> str:
    for each in node.body:
        if (
            isinstance(each, ast.Assign)
            and ast.unparse(each.targets[0]) == "code"
            and isinstance(each.value, ast.Constant)
        ):
            return str(each.value.value)
    return ""


def _codes(value: ast.expr) -> list[str]:
    texts = [each.value for each in ast.walk(value) if isinstance(each, ast.Constant)]
    return [text for text in texts if isinstance(text, str) and FORM.fullmatch(text)]


def table(source: Source | None = None) -> str:
    """Return the list of codes as Markdown, a section for each area."""
    source = Source() if source is None else source
    found: dict[str, list[Site]] = {}
    for site in sites(source):
        found.setdefault(site.code, []).append(site)
    lines, area = [], ""
    for code in sorted(found):
        if code.partition(".")[0] != area:
            area = code.partition(".")[0]
            lines += ["", f"## {area}", "", "| code | class | messages |", "|---|---|---|"]
        kinds = ", ".join(f"`{kind}`" for kind in sorted({site.kind for site in found[code]} - {""}))
        texts = dict.fromkeys(" ".join(site.template.split()) for site in found[code] if site.template)
        texts.pop(OF_CAUSE if len(texts) > 1 else "", None)
        lines.append(f"| `{code}` | {kinds} | {'<br>'.join(map(_cell, texts))} |")
    return "\n".join(lines).strip() + "\n"


def _cell(text: str) -> str:
    return re.sub(r"([\\`*_{}\[\]<>|$~#])", r"\\\1", text)


if __name__ == "__main__":
    sys.stdout.write(table())
