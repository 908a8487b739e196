#!/usr/bin/python3
"""Display of a LinuxCNC in tests: runs the bridge beside it, and again whenever that has been killed.

Arguments: folder, then options of the bridge. LinuxCNC ends with its display, and not with a bridge that is killed.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

folder, options = Path(sys.argv[3]), sys.argv[4:]  # after -ini and its file
files = {"--socket": "bridge.sock", "--token": "token", "--announce": "announced.json"}
arguments = [*options, *(word for option, name in files.items() for word in (option, str(folder / name)))]
ended = []
signal.signal(signal.SIGTERM, lambda *_: ended.append(True))
announced, first = folder / "announced.json", True
while not ended:
    announced.unlink(missing_ok=True)
    bridge = subprocess.Popen(["/usr/bin/python3", str(folder / "machine_bridge.py"), *arguments])
    while first and not announced.exists() and bridge.poll() is None:
        time.sleep(0.02)
    if first:
        part = folder / "bridge.part"
        part.write_text(json.dumps({"socket": str(folder / "bridge.sock"), "pid": os.getpid()}))
        part.rename(folder / "bridge.json")
        first = False
    while not ended and bridge.poll() is None:
        time.sleep(0.05)
bridge.terminate()
bridge.wait()
