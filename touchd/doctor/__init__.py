"""Checks of `touchd doctor`: frames (`checks`), computer and DAQ (`host`), touch screen (`screen`), start (`start`)."""
