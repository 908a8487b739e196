"""Commands and options that the docs mention exist."""

import re
from pathlib import Path
from typing import Any

import pytest
import typer

from errormotion.cli.app import app

ROOT = Path(__file__).parents[2]
COMMAND: Any = typer.main.get_command(app)
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
# A call is at the start of a line of a block (after "$ " or not), or in backquotes.
CALL = re.compile(r"(?:^(?:\$ )?|`|&& |python -m )errormotion[ \t]+([^`\n#|&;]*)", re.MULTILINE)


def _calls(page: Path) -> list[str]:
    blocks = "\n".join(re.findall(r"^```\{?(?:console|sh|code-block\} console).*?^```", page.read_text(), re.M | re.S))
    inline = "\n".join(re.findall(r"`[^`\n]+`", page.read_text()))
    return [match[1] for text in (blocks.replace("\\\n", " "), inline) for match in CALL.finditer(text)]


def mistake(call: str) -> str | None:
    """Return the mistake in the words after ``errormotion``; None for a valid call."""
    command = COMMAND
    words = call.split()
    while (commands := getattr(command, "commands", None)) and words and not words[0].startswith("-"):
        name = words.pop(0)
        alternatives = [commands.get(part) for part in name.split("|")]
        if None in alternatives:
            return f"there is no command '{name}'"
        command = alternatives[0] or command
    known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
    unknown = [word for word in words if re.match(r"--?[a-z]", word) and word.split("=")[0] not in {*known, "--help"}]
    return f"there is no option {unknown[0]}" if unknown else None


@pytest.mark.parametrize("page", [pytest.param(page, id=str(page.relative_to(ROOT))) for page in PAGES if _calls(page)])
def test_docs_mention_only_commands_that_exist(page: Path) -> None:
    assert [f"errormotion {call}: {wrong}" for call in _calls(page) if (wrong := mistake(call))] == []


@pytest.mark.parametrize("call", ["measure", "plugins show optoncdt --color", "demo --fast", "plugins list|remove"])
def test_a_missing_command_is_detected(call: str) -> None:
    assert mistake(call)


@pytest.mark.parametrize(
    "call", ["--help", "plugins list|show|check", "run campaign.toml --resume", "report RUN --out a.html"]
)
def test_an_existing_command_is_accepted(call: str) -> None:
    assert mistake(call) is None
