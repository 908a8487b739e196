"""The part of XPath in requests that selects data items: ``//Linear[@name="X"]/DataItems/DataItem[@id='a']``."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from xml.etree.ElementTree import Element

_STEP = re.compile(r"(//?)(\*|[A-Za-z_][\w.:-]*)")
_TEST = re.compile(r"""\s*@([A-Za-z_][\w:-]*)\s*=\s*(?:"([^"]*)"|'([^']*)')\s*""")
_WORD = re.compile(r"(and|or)\b")
MAX_PATH = 4096

Test = Callable[[Element], bool]


class PathError(ValueError):
    """A path that is not in this part of XPath."""


def select(root: Element, path: str) -> list[Element]:
    """Return the elements below ``root`` that a path selects, each once; ``root`` stands for the document.

    Raises
    ------
    PathError
        The path cannot be read.
    """
    if len(path) > MAX_PATH:
        raise PathError(path)
    found: dict[int, Element] = {}
    for alternative in path.split("|"):
        chosen = [root]
        for deep, name, tests in _steps(alternative.strip()):
            step = {id(each): each for parent in chosen for each in (parent.iter() if deep else parent)}
            chosen = [
                each
                for each in step.values()
                if each is not root and name in ("*", each.tag) and all(test(each) for test in tests)
            ]
        found |= {id(each): each for each in chosen}
    return list(found.values())


def _steps(path: str) -> Iterator[tuple[bool, str, list[Test]]]:
    position = 0
    while position < len(path):
        step = _STEP.match(path, position)
        if step is None:
            raise PathError(path)
        position = step.end()
        tests: list[Test] = []
        while position < len(path) and path[position] == "[":
            end = path.find("]", position)
            if end < 0:
                raise PathError(path)
            tests.append(_predicate(path[position + 1 : end]))
            position = end + 1
        yield step[1] == "//", step[2], tests
    if not path:
        raise PathError(path)


def _predicate(text: str) -> Test:
    """Return the test of one predicate: comparisons of attributes, joined by ``and`` and ``or``."""
    alternatives: list[list[tuple[str, str]]] = [[]]
    position = 0
    while True:
        test = _TEST.match(text, position)
        if test is None:
            raise PathError(text)
        alternatives[-1].append((test[1], test[2] if test[2] is not None else test[3]))
        position = test.end()
        if position == len(text):
            break
        word = _WORD.match(text, position)
        if word is None:
            raise PathError(text)
        position = word.end()
        if word[1] == "or":
            alternatives.append([])
    return lambda element: any(all(element.get(name) == value for name, value in each) for each in alternatives)
