"""Checks of `touchd doctor`: frames (`checks`), computer (`host`), USB device (`usb`)."""
