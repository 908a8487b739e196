"""The campaign files of one folder: read, checked as a form, planned, saved, and started."""

from __future__ import annotations

import base64
import io
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from errormotion.campaign.files import CampaignPlan, TestPlan
from errormotion.campaign.form.fields import Form, form_of, with_field, with_test, without_test
from errormotion.campaign.planning.expected import expected, planned
from errormotion.campaign.planning.motions import Motions, beside_limits, headline, motions, picture
from errormotion.dashboard.lab import NotFoundError
from errormotion.datasets.files.reading import read_bytes, visible
from errormotion.datasets.files.tomlfile import Key, parse_toml, read_toml
from errormotion.datasets.files.tomltext import MAX_TEXT, value
from errormotion.datasets.files.writing import replace_text
from errormotion.errors import BenchError, ErrormotionError
from errormotion.report.text import rounded, signs

MAX_FILES = 200
"""Number of campaign files that are listed."""
MAX_EXAMINED = 2000
"""Number of files of the folder that are examined."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,80}\.toml")
"""Name of a file that a page may write."""
DPI = 100
NEW = """\
schema = "errormotion.campaign/1"
name = "New campaign"
bench = {bench}

[[test]]
name = "test"
method = ""
"""


@dataclass(frozen=True)
class Campaigns:
    """A folder of campaign files; ``control`` states whether pages may write into it.

    Without control, a text may name only those files outside the folder that the saved file of this name states, so
    that a page cannot probe for other files.
    """

    folder: Path
    control: bool = False
    bench: Path | None = None

    def names(self) -> list[str]:
        """Return the names of the campaign files."""
        examined = visible(self.folder, "*.toml")[:MAX_EXAMINED]
        return [path.name for path in examined if _is_campaign(path)][:MAX_FILES]

    def read(self, name: str) -> str:
        """Return the text of a file, or without a name that of a new campaign.

        Raises
        ------
        NotFoundError
            The campaign file does not exist.
        """
        if not name:
            bench = "bench.toml" if self.bench is None else os.path.relpath(self.bench, self.folder)
            return NEW.format(bench=value(bench))
        if Path(name).name != name or "\0" in name or not _is_campaign(self.folder / name):
            raise NotFoundError(f"No campaign file {name[:100]!r} in {self.folder}.", code="campaign.file.not_found")
        try:
            return read_bytes(self.folder / name, MAX_TEXT).decode("utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise BenchError(
                f"{self.folder / name}: cannot be read: {error}", code="campaign.file.unreadable"
            ) from error

    def with_test(self, name: str, text: str) -> Form:
        """Return the form of a text to which a test was added."""
        return self.form(name, with_test(self._short(text)))

    def without_test(self, name: str, text: str, number: int) -> Form:
        """Return the form of a text from which a test was removed."""
        return self.form(name, without_test(self._short(text), number))

    def form(self, name: str, text: str, place: tuple[Key, ...] = (), written: str = "") -> Form:
        """Return the form of a text; if ``place`` is not empty, after the change of a field.

        Raises
        ------
        DatasetError
            The text is too long, or the field cannot be changed separately.
        BenchError
            The text names files that this page may not read.
        """
        text = self._short(text)
        if place:
            text = with_field(text, place, written)
        self._inside(name, text)
        return form_of(text, self._path(name))

    def plan(self, name: str, text: str) -> list[dict[str, Any]]:
        """Return motions and expected uncertainty of each test, as text and drawings.

        Raises
        ------
        BenchError
            The text has mistakes.
        """
        plan = self._valid(name, text)
        return [_planned(plan, test) for test in plan.tests]

    def save(self, name: str, text: str, before: str) -> Path:
        """Write a campaign file without mistakes; ``before`` is the hash of the text that was edited.

        Raises
        ------
        BenchError
            The name is invalid, the text has mistakes, or the file was changed since it was opened.
        """
        if not NAME.fullmatch(name):
            raise BenchError(
                f"expected a file name such as drift.toml; found {name[:100]!r}", code="campaign.file.name"
            )
        self._valid(name, text)
        path = self._path(name)
        if path.exists() or path.is_symlink():
            found = self.read(name)
            if found == text:
                return path
            if hash_of(found) != before:
                raise BenchError(
                    f"{name} was changed by another program since it was opened; choose another name",
                    code="campaign.file.changed",
                )
        try:
            replace_text(path, text)
        except OSError as error:
            raise BenchError(f"{path}: cannot be written: {error.strerror}", code="campaign.file.unwritable") from error
        return path

    def _valid(self, name: str, text: str) -> CampaignPlan:
        form = self.form(name, text)
        if form.plan is None:
            raise BenchError(f"The campaign has {form.count} mistakes; correct them first.", code="toml.mistakes")
        return form.plan

    @staticmethod
    def _short(text: str) -> str:
        if len(text) > MAX_TEXT:
            raise BenchError(
                f"expected a campaign of at most {MAX_TEXT} characters; found {len(text)}", code="campaign.too_long"
            )
        return text

    def _path(self, name: str) -> Path:
        return self.folder / (name if NAME.fullmatch(name) else "new.toml")

    def _inside(self, name: str, text: str) -> None:
        if self.control:
            return
        try:
            new = set(_strings(parse_toml(text, "text")))
        except ErrormotionError:
            return  # the form states the mistake
        with suppress(ErrormotionError):  # a file that does not exist states no files
            new -= set(_strings(parse_toml(self.read(name), "text")))
        for each in new:
            windows = PureWindowsPath(each)
            if PurePosixPath(each).is_absolute() or windows.drive or windows.root or ".." in windows.parts:
                raise BenchError(
                    f"{each[:100]!r}: this dashboard was started without --allow-control, and reads files of its "
                    "folder only",
                    code="campaign.file.outside",
                )


def hash_of(text: str) -> str:
    """Return the hash of a text, by which a change is detected."""
    return sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def _is_campaign(path: Path) -> bool:
    try:
        return path.suffix == ".toml" and str(read_toml(path).get("schema", "")).startswith("errormotion.campaign/")
    except ErrormotionError:
        return False


def _strings(content: Any) -> Iterator[str]:
    if isinstance(content, str):
        yield content
    elif isinstance(content, (dict, list)):
        for each in content.values() if isinstance(content, dict) else content:
            yield from _strings(each)


def _limits(plan: CampaignPlan, found: Motions) -> list[list[str]]:
    return [[signs(text) for text in row] for row in beside_limits(found.extent, plan.bench.limits)]


def _planned(plan: CampaignPlan, test: TestPlan) -> dict[str, Any]:
    """Return the plan of a test; unknown parts are replaced by the reason."""
    found: dict[str, Any] = {"test": test.name, "method": test.method.info.id, "notes": []}
    try:
        planned_motions = motions(plan, test)
        drawn = io.BytesIO()
        picture(plan, planned_motions).savefig(drawn, format="png", dpi=DPI)
        image = base64.b64encode(drawn.getvalue()).decode()
        found |= {"headline": headline(planned_motions), "limits": _limits(plan, planned_motions)}
        found |= {"picture": f"data:image/png;base64,{image}"}
    except ErrormotionError as error:
        found |= {"headline": str(error), "limits": [], "picture": ""}
    try:
        errors = planned(plan, test)
        rows = expected(errors)
        texts = [rounded(row["expanded_uncertainty"], row["expanded_uncertainty"])[1] for row in rows]
        found["expected"] = [[row["name"], text, signs(row["unit"])] for row, text in zip(rows, texts, strict=True)]
        found["notes"] = [signs(str(note)) for note in errors.em.notes]
    except ErrormotionError as error:
        found |= {"expected": [], "notes": [f"The expected uncertainty is unknown: {error}"]}
    return found
