"""Check that the catalogues of texts of a method are complete."""

from __future__ import annotations

from errormotion.plugins import MethodSubject
from errormotion.report.page.language import LANGUAGES
from errormotion.testing.kit import require
from errormotion.testing.results import raw_data


def languages_of(subject: MethodSubject) -> list[str]:
    """Return the languages of the catalogues of a method."""
    return [language for language in LANGUAGES if subject.plugin().texts(language)]


def why_no_texts(subject: MethodSubject) -> str:
    """Return why the check of the texts does not apply; empty if it applies."""
    return "" if languages_of(subject) else "the method has no texts in another language"


def chapters_translated(subject: MethodSubject) -> str:
    """No text of a chapter is missing in the catalogues of the method."""
    from errormotion.report.untranslated import untranslated

    raw = raw_data(subject)
    errors, _ = subject.outcome(0)
    languages = languages_of(subject)
    for language in languages:
        missing = untranslated(subject.plugin(), errors, raw, language=language)
        listed = "".join(f"\n  {text}" for text in missing[:20])
        require(not missing, f"texts('{language}') lacks {len(missing)} texts of the chapters:{listed}")
    return f"the chapters are complete in {', '.join(languages)}"
