"""touchd: real-time touch localization on a plate, from ultrasonic Lamb waves."""

__version__ = "0.1.0"
