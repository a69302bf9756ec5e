"""A model on trial in the daemon: tried, then taken or given back.

The model from before stays the previous one, which `touchd model rollback` knows, however many fits are tried.
"""

from __future__ import annotations

import contextlib
from pathlib import Path

from touchd.calibration.wizard.state import State
from touchd.errors import BusError, ModelMissing
from touchd.localization.model_file import digest, install, previous_path
from touchd.service.control import send


class Trial:
    """Changes the daemon's model, which is in use at `target`, through its control socket.

    The state's `before` is the digest of the model from before the trial, empty if none ran, None without a trial;
    `runs` is what runs: `fitted`, `trained`, `earlier` (a try before the last fit), `before`, or empty for none.
    """

    def __init__(self, state: State, target: Path, control: Path) -> None:
        self._state, self._target, self._control = state, target, control

    def begin(self, model: Path) -> None:
        """Put a model in use; the one from before the first try is kept."""
        if self._state["before"] is None:  # first: whoever is killed in between goes back to what runs
            self._state.set(before=digest(self._target))
        try:
            install(model, self._target, keep=digest(self._target) == self._state["before"])
        finally:
            self.look()
        self._reload()

    def take(self) -> None:
        """End the trial: its model stays in use."""
        self._state.set(before=None)
        self.look()

    def go_back(self) -> None:
        """End the trial with the model from before it; ModelMissing if none ran, or it is kept no longer."""
        before, kept = self._state["before"], previous_path(self._target)
        if not before:
            raise ModelMissing("no model ran before", str(self._target), "keep this one, or calibrate again")
        if digest(self._target) != before:  # else `touchd model rollback` has been there
            if digest(kept) != before:
                raise ModelMissing(
                    "the model from before is kept no longer: another one was installed meanwhile", str(kept),
                    "touchd model install FILE",
                )  # fmt: skip
            install(kept, self._target, keep=False)  # not exchanged: a copy of it is on disk at any time
        self._state.set(before=None)
        self.look()
        self._reload()

    def others(self) -> dict[str, Path]:
        """Return where the models are to compare a fit with: the old one, and one that was tried before it."""
        runs = self._state["runs"]
        found = {"tried": self._target} if runs == "earlier" else {}
        if self._state["before"] != "":
            found["old"] = self._target if runs == "before" else previous_path(self._target)
        return found

    def look(self) -> None:
        """Look which model runs."""
        now, before = digest(self._target), self._state["before"]
        if now == before:
            before = None
        of = {digest(self._state.trained): "trained", digest(self._state.model): "fitted"}
        runs = of.get(now, "before" if before is None else "earlier") if now else ""
        self._state.set(before=before, runs=runs)

    def _reload(self) -> None:
        with contextlib.suppress(BusError):  # the next daemon takes it
            send(self._control, "reload")
