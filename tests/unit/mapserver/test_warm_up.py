"""What a process has compiled before it says that it is ready."""

import json
import subprocess
import sys

import pytest

LIST = """
import json, sys
from numba.core.dispatcher import Dispatcher
from mapserver.config import ServerConfig
from mapserver.server import warm_up
def kernels():
    for name, module in list(sys.modules.items()):
        if name.startswith(("mapserver.roads.", "mapserver.routes.", "mapserver.ingest.")):
            for kernel, value in vars(module).items():
                if isinstance(value, Dispatcher) and value.py_func.__module__ == name and not kernel.startswith("_"):
                    yield f"{name}.{kernel}", bool(value.signatures)
cold = dict(kernels())
warm_up(ServerConfig())
print(json.dumps([cold, dict(kernels())]))
"""


@pytest.mark.slow
def test_nobody_who_asks_waits_for_a_kernel_of_roads_routes_or_ingest():
    done = subprocess.run([sys.executable, "-c", LIST], capture_output=True, text=True, check=True, timeout=170)
    cold, warm = json.loads(done.stdout)
    assert len(warm) > 5
    assert not any(cold.values())
    assert [name for name, is_warm in warm.items() if not is_warm] == []
