"""Decoding of text of unknown encoding: byte order mark, UTF-8, UTF-16 without a mark, then single and double bytes."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from errormotion.errors import DatasetError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_DOUBLE = ("gb18030", "big5", "shift_jis", "euc_jp", "euc_kr", "cp949", "cp1251", "koi8_r")
"""Encodings in which letters beyond ASCII follow each other."""
_SINGLE = ("cp1252", "cp850", "mac_roman")
"""Encodings in which a letter beyond ASCII is usually alone, as in °C, µm and Ständer."""
_SAMPLE = 1 << 16
_EXPECTED = re.compile(r"°|µ|(?<=[A-Za-zÄÖÜäöüß])[ÄÖÜäöüßéèàçñå]|[ÄÖÜäöüßéèàçñå](?=[A-Za-z])|[²³±]")


def decode(data: bytes, encoding: str, path: Path) -> tuple[str, str]:
    """Return a text without its byte order mark, and its encoding.

    Parameters
    ----------
    data : bytes
        Content of the file.
    encoding : str
        A name that Python knows, or ``auto``.
    path : Path
        Named in errors.

    Raises
    ------
    DatasetError
        The bytes are not text in the stated encoding, or no text; the line is named.
    """
    known = encoding if encoding != "auto" else recognised(data, path)
    if known == "utf-8":
        known = "utf-8-sig"
    try:
        text = data.decode(known)
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise DatasetError(
            f"{path}, line {line}: byte 0x{data[error.start]:02x} is not {encoding}; set format.encoding in the map to "
            "the encoding of the file, such as 'cp1252', or leave it out",
            code="text.encoding",
        ) from error
    except UnicodeError as error:
        raise DatasetError(f"{path}: is not {encoding}: {error}", code="text.encoding") from error
    return text.removeprefix("\ufeff"), known


def recognised(data: bytes, path: Path) -> str:
    """Return the encoding of a text.

    Raises
    ------
    DatasetError
        The bytes are no text.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return encoding
    sample = data[:_SAMPLE]
    if b"\0" in sample:
        return _wide(sample, path)
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return _legacy(data)
    return "utf-8"


def _wide(sample: bytes, path: Path) -> str:
    """Return the UTF-16 without a mark in which ASCII has a zero as every second byte; DatasetError for other bytes."""
    even, odd = sample[0::2].count(0), sample[1::2].count(0)
    half = len(sample) // 2
    if odd > 0.6 * half and even < 0.1 * half:
        return "utf-16-le"
    if even > 0.6 * half and odd < 0.1 * half:
        return "utf-16-be"
    raise DatasetError(
        f"{path}: contains zero bytes; expected text. Is it a binary file of a program?", code="text.encoding"
    )


def _legacy(data: bytes) -> str:
    """Return the most plausible encoding with one or two bytes a letter.

    Letters of Chinese or Japanese, and Cyrillic ones, follow each other; those of Western text are alone.
    """
    runs = re.findall(rb"[\x80-\xff]+", data[: 16 * _SAMPLE])
    if sum(len(run) > 1 for run in runs) > len(runs) / 2:
        from charset_normalizer import from_bytes

        lines = b"\n".join(line for line in data[: 16 * _SAMPLE].split(b"\n") if re.search(rb"[\x80-\xff]", line))
        matches = list(from_bytes(lines[:_SAMPLE], cp_isolation=list(_DOUBLE)))
        if matches:
            return min(matches, key=lambda match: (match.chaos, _DOUBLE.index(match.encoding))).encoding
    shown = {encoding: data[: 16 * _SAMPLE].decode(encoding, errors="replace") for encoding in _SINGLE}
    return max(_SINGLE, key=lambda encoding: len(_EXPECTED.findall(shown[encoding])))
