"""Every golden vector names its source, and every device of a file has a page with its assumptions."""

import pytest
from wire_vectors import FOLDER, KINDS, vectors

DEVICES = sorted(path.stem for path in FOLDER.glob("*.toml"))
PAGES = FOLDER.parents[2] / "docs" / "reference" / "devices"


@pytest.mark.parametrize("device", DEVICES)
def test_vectors_have_sources(device):
    found = vectors(device)
    assert len({vector.name for vector in found}) == len(found)
    for vector in found:
        assert vector.kind in KINDS, vector
        assert len(vector.source) > 10, vector
        assert vector.data, vector


@pytest.mark.parametrize("device", DEVICES)
def test_devices_with_vectors_have_a_page(device):
    text = (PAGES / f"{device}.md").read_text(encoding="utf-8")
    for heading in ("## Documents", "## Assumptions", "## Independent implementations", "## Hardware"):
        assert heading in text, heading
