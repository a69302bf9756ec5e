"""Checks of `touchd doctor`: frames (`checks`), computer (`host`), the daemon's start (`start`), USB device (`usb`)."""
