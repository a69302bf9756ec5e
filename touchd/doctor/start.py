"""Checks of `touchd doctor` on the daemon's start: opens what the daemon opens, by its own code, and closes it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from touchd.client import Subscriber
from touchd.config.schema import Settings
from touchd.doctor.checks import Finding
from touchd.errors import AddressInUse, BusTimeout, TouchdError
from touchd.event import HealthEvent
from touchd.localization.model_fit import WORN
from touchd.service.daemon import Parts, open_parts
from touchd.sinks.endpoint import SERVICE


def failure(check: str, error: TouchdError) -> Finding:
    """Return the finding of a check that raised an error."""
    return Finding(check, "failure", f"{error.where}: {error.what}" if error.where else error.what, error.fix)


def check_start(settings: Settings, listen_s: float = 2.5, *, running: bool = False) -> tuple[Parts, list[Finding]]:
    """Open every part of the daemon but its source, and close it again.

    It waits `listen_s` for a `health` message at an address in use; a daemon sends one each second. One that is
    `running` hands out its frames, and need not be stopped. The parts are closed, except for model and keys; each that
    the settings ask for has a finding, in the order in which the daemon opens them.
    """
    service = Path(SERVICE.removeprefix("ipc://"))
    if not settings.bus.bind and service.exists():  # the service runs, with a default of its own
        settings = settings.model_copy(update={"bus": settings.bus.model_copy(update={"bind": (SERVICE,)})})
    refused: dict[str, TouchdError] = {}

    @contextmanager
    def step(name: str) -> Iterator[None]:
        try:
            yield
        except TouchdError as error:
            refused[name] = error

    with ExitStack() as stack:
        parts = open_parts(settings, stack, step)
        bus, control, model, layout = parts.bus, parts.control, parts.model, parts.layout
        opened = {
            "bus": bus and f"{', '.join(bus.addresses)} free",
            "control": control and f"{control.path} is free",
            "model": model and f"{model.description.name}, {model.description.head} head, {model.path}",
            "keypad": layout and f"{len(layout.key)} keys on the plate",
        }
    health = _health_at(refused.get("bus"), settings, listen_s)
    findings = []
    for name, text in opened.items():
        error = refused.get(name)
        if error is not None and health and isinstance(error, AddressInUse):
            daemon = f"{error.where}: a daemon publishes there, in state {health.state}"
            fix = "stop it before the checks: systemctl stop touchd, or Ctrl-C where it was started"
            findings.append(Finding(name, "ok", daemon) if running else Finding(name, "warning", daemon, fix))
        elif error is not None:
            findings.append(failure(name, error))
        elif text:
            findings.append(Finding(name, "ok", text))
        elif name == "model":
            fix = f"touchd calibrate -o {settings.model.path} --plate PLATE.toml makes one, without a touch"
            findings.append(Finding(name, "warning", f"uncalibrated: there is no {settings.model.path}", fix))
    if health is not None and isinstance(health.model_fit, float):
        findings.append(check_model_fit(health.model_fit))
    return parts, findings


def check_model_fit(explained: float) -> Finding:
    """Judge the share of a touch's energy that a daemon's model explains."""
    text = f"the daemon's model explains {explained:.1%} of a touch, {1 - WORN:.0%} or more expected"
    if explained >= 1 - WORN:
        return Finding("model fit", "ok", text)
    fix = "calibrate again: touchd calibrate; touchd check MODEL RECORDING tells more"
    return Finding("model fit", "warning", text, fix)


def _health_at(error: TouchdError | None, settings: Settings, listen_s: float) -> HealthEvent | None:
    """Return what the daemon that has bound the address says of itself; None if no daemon is heard there."""
    if not isinstance(error, AddressInUse) or settings.bus.curve_secret_key is not None:
        return None
    try:
        with Subscriber(error.where, ("health",), timeout_s=listen_s) as events:
            event = next(events)
    except (BusTimeout, StopIteration):
        return None
    assert isinstance(event, HealthEvent)
    return event
