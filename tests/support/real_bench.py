"""A bench at real addresses: the devices are simulated in this process and listen on ports of this computer."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from errormotion import plugins
from errormotion.instruments.transports import load_simulator, parse_address

BENCH = """\
schema = "errormotion.bench/1"
name = "Real bench"
machine = "{machine}"
[instruments.laser]
driver = "attocube_ids"
address = "{laser}"
[instruments.control]
driver = "virtual_controller"
address = "{control}"
arm = true
[limits]
X = ["-50 mm", "50 mm"]
feed = "2000 mm/min"
"""
CAMPAIGN = """\
schema = "errormotion.campaign/1"
name = "Positioning"
bench = "bench.toml"
[[test]]
name = "axis-x"
method = "linear_positioning"
[test.settings]
axis = "X"
travel = ["0 mm", "40 mm"]
start = ["0 mm", "0 mm", "200 mm"]
count = 3
runs = 5
feed = "1500 mm/min"
dwell = "3 s"
functional_point = ["0 mm", "0 mm", "0 mm"]
"""
DEVICES = {"laser": ("attocube_ids", "ids?seed=3&beam1=1,0,0"), "control": ("virtual_controller", "controller?seed=3")}


@contextmanager
def devices() -> Iterator[dict[str, str]]:
    """Simulate the devices; yield their addresses by instrument."""
    made = {}
    try:
        for name, (plugin, address) in DEVICES.items():
            simulator = plugins.get("instruments", plugin).info.simulator
            url = f"sim://cframe/{address}"
            made[name] = load_simulator(str(simulator), url)(parse_address(url))
        yield {name: device.url for name, device in made.items()}
    finally:
        for device in made.values():
            device.close()


def write(folder: Path, addresses: dict[str, str], machine: str = "Mill 7") -> Path:
    """Write the bench and a campaign that moves X; return the campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.toml").write_text(BENCH.format(machine=machine, **addresses))
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder / "campaign.toml"
