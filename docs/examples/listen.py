"""Print touches."""

import signal
import sys

from touchd.client import Subscriber

signal.signal(signal.SIGINT, signal.SIG_DFL)
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
with Subscriber(*sys.argv[1:2]) as events:
    for event in events:
        for c in event.contacts:
            print(c.id, c.phase, f"{c.x_mm:.1f} {c.y_mm:.1f}", flush=True)
