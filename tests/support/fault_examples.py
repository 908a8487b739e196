"""Small campaigns for trials of faults: the examples of the repository, shortened to seconds, every method in one."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
MOVES = 'moves = [["1 m", "0 m", "0.5 m"], ["3 m", "0 m", "0.5 m"]]'

SHORT: dict[str, tuple[str, str, list[tuple[str, str]]]] = {
    "beam_direction": ("virtual_beam", "campaign.toml", []),
    "spindle_drift": (
        "virtual_cframe",
        "campaign.toml",
        [
            (r'procedure = "beam_detection"', 'procedure = "beam_detection"\nsteps = 21\ndwell = "0.7 s"'),
            (r'duration = "104 min"', 'duration = "16 min"\naverage = "4 s"'),
            (r'running_end = "101 min".*', ""),
            (r'    \{ at = "101 min".*\n', ""),
            (r'"102 min"', '"14 min"'),
        ],
    ),
    "crossbeam_scan": (
        "virtual_gantry",
        "campaign.toml",
        [
            # A second test would not be repeated after a kill: the machine of the first is gone with its process.
            (r'(?s)\[\[test\]\]\nname = "pose".*?(?=\[\[test\]\])', ""),
            (r'inputs = \{ pose = "pose" \}\n', ""),
            (r"scan_z = .*", 'profiler_pose = { dz = "-170 mm" }'),
            (r"positions = .*", 'positions = ["-200 mm", "200 mm"]\nline_pitch = "140 um"'),
            (r"warm_up = .*", 'warm_up = ["7 min", "15 min", "30 min"]'),
        ],
    ),
    "crossbeam_scan, pose": (
        "virtual_gantry",
        "campaign.toml",
        [(r'(?s)\[\[test\]\]\nname = "scan".*', "")],
    ),
    "multilateration": ("virtual_tracker", "campaign.toml", [(r"count = .*", "count = [4, 3, 3]")]),
    "linear_positioning": (
        "virtual_positioning",
        "campaign.toml",
        [(r"feed = ", "runs = 4\ncount = 4\nfeed = ")],
    ),
    "linear_positioning, diagonals": (
        "virtual_diagonals",
        "campaign.toml",
        [(r'feed = "2000', 'runs = 2\ncount = 3\nfeed = "2000')],
    ),
    "normal_vector": (
        "virtual_probing",
        "monday.toml",
        [
            (r'duration = "180 min"', 'duration = "50 min"\ntouches = 4\n' + MOVES),
            (r'"60 min"', '"10 min"'),
            (r'"120 min"', '"30 min"'),
        ],
    ),
}
"""By method and procedure: the example, its campaign, and what is replaced in it (regular expression, text)."""
SECOND: dict[str, tuple[str, str, list[tuple[str, str]]]] = {
    "crossbeam_scan, after its pose": (
        "virtual_gantry",
        "campaign.toml",
        [
            (r"positions = .*", 'positions = ["-200 mm", "200 mm"]\nline_pitch = "140 um"\ncold_repeats = 0'),
            (r"warm_up = .*", 'warm_up = ["7 min"]'),
        ],
    ),
}
"""The same of tests that find the machine as an earlier test has left it."""
BENCH = [(r"points=800&pitch=25e-6&artefacts=-0.6,-0.2,0.2,0.6", "points=400&pitch=50e-6&artefacts=-0.2,0.2")]
"""The same of all benches: half of the profile points, and of the artefacts."""


def write(folder: Path, chosen: dict[str, tuple[str, str, list[tuple[str, str]]]] = SHORT) -> dict[str, Path]:
    """Write the campaigns, and return the file of each by its method."""
    found = {}
    for method, (example, campaign, changes) in chosen.items():
        place = folder / method.replace(", ", "_")
        shutil.copytree(EXAMPLES / example, place)
        _change(place / campaign, changes, all_found=True)
        _change(place / "bench.toml", BENCH, all_found=False)
        found[method] = place / campaign
    return found


def _change(file: Path, changes: list[tuple[str, str]], *, all_found: bool) -> None:
    text = file.read_text(encoding="utf-8")
    for old, new in changes:
        text, count = re.subn(old, lambda _, new=new: new, text)
        if all_found and not count:
            raise ValueError(f"{file}: has no {old}; change the short campaign as well")
    file.write_text(text, encoding="utf-8")
