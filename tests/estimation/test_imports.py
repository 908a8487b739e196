import subprocess
import sys
from pkgutil import walk_packages

from errormotion import estimation

SLOW = ("scipy.stats", "numba", "xarray")


def test_no_module_imports_a_slow_package() -> None:
    names = [module.name for module in walk_packages(estimation.__path__, "errormotion.estimation.")]
    assert names
    program = f"import sys, {', '.join(names)}\nprint([name for name in {SLOW} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
