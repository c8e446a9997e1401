"""After warm_up nothing is left to compile, so that no frame waits for the compiler."""

import json
import subprocess
import sys

# A process of its own: in this one, other tests may have compiled what warm_up forgot.
COUNT = """
import importlib, json, pkgutil
from numba.core.registry import CPUDispatcher
import trifix.kernels

modules = [importlib.import_module(f"trifix.kernels.{m.name}") for m in pkgutil.iter_modules(trifix.kernels.__path__)]
for module in modules:
    module.warm_up()
kernels = {
    f"{module.__name__}.{name}": kernel
    for module in modules
    for name, kernel in vars(module).items()
    if isinstance(kernel, CPUDispatcher)
}
before = {name: kernel.signatures[:] for name, kernel in kernels.items()}

from trifix.positioner import Positioner
from trifix.records import Fix
from trifix.sources.simulation import simulate_frames

positioned = {}
for level, frames in (("points", 12), ("dots", 12), ("images", 2)):
    simulation = simulate_frames("demo", 1, level, frames)
    positioned[level] = sum(isinstance(step.fix, Fix) for step in Positioner().run(simulation.frames))
more = {name: str(kernel.signatures) for name, kernel in kernels.items() if kernel.signatures != before[name]}
print(json.dumps({"kernels": len(kernels), "positioned": positioned, "more": more}))
"""


def test_positioning_compiles_nothing_more():
    done = subprocess.run([sys.executable, "-c", COUNT], capture_output=True, text=True, check=False, timeout=280)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["kernels"] > 10
    assert found["positioned"] == {"points": 12, "dots": 12, "images": 2}
    assert found["more"] == {}
