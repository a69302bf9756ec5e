"""touchd: real-time touch localization on a plate, from ultrasonic Lamb waves."""

import os

__version__ = "0.1.0"

# onnxruntime would make an identifier of this computer and send events to its vendor. It reads this when it is
# imported, which is always after this package.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
