"""Everything that a command may import: a process forked from one that has done so starts in milliseconds."""

import pkgutil
from importlib import import_module

import errormotion

for module in pkgutil.walk_packages(errormotion.__path__, "errormotion."):
    if not module.name.endswith("__main__"):
        import_module(module.name)
