"""The demonstration in small: beams, two minutes of drift, and four balls, through the wire; no figures."""

from pathlib import Path

import pytest
from markupsafe import Markup

from errormotion.campaign.files import load_campaign
from errormotion.campaign.folder import RunFolder
from errormotion.cli.demo import spindle as demonstration
from errormotion.report import canvas

SHORTER = {
    "steps = 41": "steps = 21",
    'procedure = "beam_detection"': 'procedure = "beam_detection"\nscan_length = "1.6 mm"',
    '"61.4 min"': '"132 s"',
    '{ at = "121 min"': '{ at = "61 min"',
    '{ at = "121.2 min"': '{ at = "61.6 min"',
    '{ at = "61 min", compensation = { Z = false } },\n    { at = "61.2 min"': (
        '{ at = "1 min", compensation = { Z = false } },\n    { at = "1.6 min"'
    ),
    'running_end = "61 min"': 'running_end = "1 min"',
    'at = "54 min"': 'at = "57.8 min"',
    'duration = "65 min"': 'duration = "3.7 min"',
    'interval = "5 min"': 'interval = "72 s"',
}


def measure(folder: Path) -> tuple[Path, list[RunFolder]]:
    """Run the short campaign in a folder; return the campaign and its run folders."""
    text = demonstration.CAMPAIGN.read_text()
    for long, short in SHORTER.items():
        assert long in text
        text = text.replace(long, short)
    (folder / "campaign.toml").write_text(text)
    (folder / "bench.toml").write_text((demonstration.CAMPAIGN.parent / "bench.toml").read_text())
    campaign = folder / "campaign.toml"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(canvas, "draw", lambda *_, **__: Markup("<svg></svg>"))
        return campaign, demonstration.work(load_campaign(campaign), runs=folder / "runs", quiet=True)
