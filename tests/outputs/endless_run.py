"""A run that is there to be killed: writes frames into the folder given, says when each was written, and never ends."""

import itertools
import sys
import time
from pathlib import Path

from made_steps import steps

from trifix.outputs.results import ResultsWriter

made = list(steps(60))
with ResultsWriter(Path(sys.argv[1]), "endless", "dots", "", is_online=True) as results:
    for k, step in enumerate(itertools.cycle(made)):
        results.write(step)
        print(k, time.monotonic_ns(), flush=True)
        time.sleep(0.002)
