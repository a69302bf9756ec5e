"""READ FIRST: takes a page's commands at a socket, runs one job at a time, and says its state to whoever watches.

What was running when this process ended goes on when it starts again.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import structlog

from touchd.calibration.wizard import MOST_BYTES
from touchd.calibration.wizard.frames import Stopped, keep, open_feed, shown, take_crosses, take_untouched
from touchd.calibration.wizard.models import Trial, compare, fit, train
from touchd.calibration.wizard.state import State, collect, tell, undo
from touchd.calibration.wizard.watchers import stay, watch
from touchd.config.load import load
from touchd.errors import BusError, CalibrationError, OutputError, RecordingMissing, TouchdError
from touchd.files import socket_file, stamps_of
from touchd.service.signals import stops
from touchd.service.systemd import Notifier

PICTURES = ("response.png", "residual.png", "expected-error.png")
LONG = ("fit", "train")
"""Jobs that no other one ends: a person stops them first."""
ENDING = ("untouched", "fit", "taps", "crosses", "train", "undo", "begin")
"""Commands that end the running job."""
_AGAIN_S = 1.0
"""After a loss of the daemon's frames."""

log = structlog.get_logger()
Job = Callable[[threading.Event], None]


class _Asked(dict[str, Any]):
    """What a page asks; it may be anything."""

    def __missing__(self, part: str) -> Any:
        raise CalibrationError(f"{part} is missing", "the command", "load the page again")


class Worker:
    """The wizard.

    `control` is the daemon's control socket and `bus` where it publishes; `target` is the model in use, which `install`
    replaces. The plate stays untouched for `seconds`. `config` takes the mapping; touches for a mapping that this
    process may not write are left at `handed`.
    """

    def __init__(
        self, state: State, control: Path, target: Path, seconds: float, config: Path, handed: Path,
        bus: str | None = None,
    ) -> None:  # fmt: skip
        self._state, self._control, self._seconds = state, control, seconds
        self._trial = Trial(state, target, control)
        self._config, self._handed, self._bus = config, handed, bus
        self._others = target, config
        self._seen = stamps_of(*self._others)
        self._one = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._jobs: dict[str, Job] = {
            "untouched": self._take,
            "fit": self._fit,
            "taps": lambda stop: self._with_frames(stop, lambda feed: collect(self._state, feed, stop)),
            "crosses": self._map,
            "train": self._train,
        }

    def resume(self) -> None:
        """Go on with the job that was running."""
        self._trial.look()
        if self._state["running"]:
            self._run(self._state["running"])

    def look(self) -> None:
        """Look which model runs and where the screen lies, once `touchd model` or `touchd map` has changed that."""
        found = stamps_of(*self._others)
        if found == self._seen or not self._one.acquire(blocking=False):  # a command may be trying a model
            return
        self._seen = found
        try:
            self._trial.look()
            self._state.set(mapping=shown(load(self._config if self._config.exists() else None).input))
        except TouchdError as error:
            log.error("another program's model or configuration is not read", error=str(error))
        finally:
            self._one.release()

    def end(self) -> None:
        """End the job that runs, to be resumed by another process."""
        running = self._state["running"]
        self._halt()
        self._state.set_anyway(running=running)

    def answer(self, asked: Any) -> dict[str, Any]:
        """Obey a command, and return what is to be said of it: at least `ok`."""
        asked = _Asked(asked if isinstance(asked, dict) else {})
        name = str(asked.get("do"))
        command = self._commands().get(name)
        if command is None:
            return {"ok": False, "problem": f"no such command: {name[:20]}"}
        try:
            with self._one:
                if name in (*ENDING, "try") and self._state["running"] in LONG:
                    raise CalibrationError("a fit or a training runs", "", "wait for its end, or stop it first")
                found = command(asked)
        except Exception as error:  # whoever asks gets an answer: without one the page says that no wizard runs
            return {"ok": False} | _told(error, "the command failed")
        return {"ok": True} | (found or {})

    def _commands(self) -> dict[str, Callable[[dict[str, Any]], dict[str, Any] | None]]:
        return {name: lambda _, job=name: self._run(job) for name in self._jobs} | {
            "measures": self._measure, "train": self._ask_to_train,
            "pause": lambda _: self._halt(), "undo": lambda _: self._undo(),
            "try": self._try, "take": lambda _: self._trial.take(), "rollback": lambda _: self._trial.go_back(),
            "compare": lambda _: self._compare(), "begin": lambda _: self._begin(), "picture": self._picture,
        }  # fmt: skip

    # -- commands ------------------------------------------------------------------------------------

    def _measure(self, asked: dict[str, Any]) -> None:
        if self._state.differs(asked["plate"]):
            if self._state["running"] == "fit":  # its verdict would be on the measures before
                raise CalibrationError("a fit runs", "", "wait for its end, or stop it first")
            if self._state["running"] == "taps":  # its model and its crosses are those of the measures before
                self._halt()
        self._state.set_plate(asked["plate"])
        self._trial.look()

    def _undo(self) -> None:
        """Take back the last good tap."""
        running = self._state["running"]
        self._halt()
        if undo(self._state):
            tell(self._state)
        if running:
            self._run(running)

    def _ask_to_train(self, asked: dict[str, Any]) -> None:
        wish = {name: str(asked[name]) for name in ("recording", "recipe")}
        for name, text in wish.items():
            if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
                raise CalibrationError("contains a character that no path has", name, "type it again")
        if not os.access(wish["recording"], os.R_OK):
            raise RecordingMissing(
                "is not there, or not for this process to read", wish["recording"],
                "check the path; the service sees no home folder: sudo install -m 644 FILE /var/lib/touchd/",
            )  # fmt: skip
        self._state.set(training=wish)
        self._run("train")

    def _try(self, asked: dict[str, Any]) -> None:
        self._trial.begin(self._state.trained if asked.get("model") == "trained" else self._state.model)

    def _compare(self) -> None:
        models = {"new": self._state.model} | self._trial.others()
        self._state.set(compared=compare(self._state, {name: path for name, path in models.items() if path.exists()}))

    def _begin(self) -> None:
        self._halt()
        self._state.begin_again()

    def _picture(self, asked: dict[str, Any]) -> dict[str, Any]:
        name, result = asked["name"], self._state["result"]
        if name in PICTURES and result and result["report"]:
            with contextlib.suppress(OSError):
                return {"png": base64.b64encode((Path(result["report"]) / name).read_bytes()).decode()}
        return {"ok": False, "problem": "no such picture"}

    # -- jobs ----------------------------------------------------------------------------------------

    def _run(self, name: str) -> None:
        self._halt()
        self._stop = threading.Event()
        self._state.set(running=name, share=0.0, note="", problem="", fix="", log=[])
        self._thread = threading.Thread(target=self._guard, args=(self._jobs[name], self._stop), name=name, daemon=True)
        self._thread.start()

    def _halt(self) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        self._state.set_anyway(running=None, note="")

    def _guard(self, job: Job, stop: threading.Event) -> None:
        """Run a job; its error is for the page."""
        try:
            job(stop)
        except Stopped:
            return
        except Exception as error:
            self._state.set_anyway(running=None, **_told(error, "the job failed"))

    def _take(self, stop: threading.Event) -> None:
        said = self._state.said()
        self._with_frames(
            stop, lambda feed: take_untouched(feed, said, self._state.untouched, self._seconds, stop, self._progress)
        )
        self._state.set(untouched=True)
        self._fit(stop)

    def _fit(self, stop: threading.Event) -> None:
        self._state.set(running="fit", share=0.0, note="")
        result = fit(self._state, stop, self._progress)
        self._trial.look()
        self._state.set(result=result, compared=None, expected=None)
        if result["model"] and self._state["taps"]:
            tell(self._state)
        self._state.set(running=None, note="")

    def _train(self, stop: threading.Event) -> None:
        trained = train(self._state, stop, self._progress)
        self._trial.look()
        self._state.set(running=None, trained=trained, note="")

    def _map(self, stop: threading.Event) -> None:
        try:
            touched = take_crosses(self._bus, stop, lambda due: self._state.set(cross=due))
        finally:
            self._state.set_anyway(cross=None)
        self._state.set(mapping=keep(touched, self._config, self._handed))
        self._state.set(running=None)

    def _with_frames(self, stop: threading.Event, use: Callable[[Any], None]) -> None:
        """Run `use` on the daemon's frames; while no daemon hands out any say why, and wait for one."""
        while not stop.is_set():
            try:
                with contextlib.closing(open_feed(self._control, self._bus, stop)) as feed:
                    self._progress(0.0, "")
                    return use(feed)
            except BusError as error:
                self._progress(0.0, ": ".join(filter(None, (error.where, error.what, error.fix))))
                stop.wait(_AGAIN_S)
        raise Stopped

    def _progress(self, share: float, note: str) -> None:
        self._state.set(share=share, note=note)


def _told(error: Exception, what: str) -> dict[str, str]:
    """Return what the page shows of an error; log one that touchd does not raise on purpose."""
    if isinstance(error, TouchdError):
        return {"problem": f"{error.where}: {error.what}" if error.where else error.what, "fix": error.fix}
    log.exception(what, exc_info=error)
    return {"problem": f"internal error: {error!r}", "fix": "see the log: journalctl"}


async def serve(worker: Worker, state: State, path: Path, manager: Notifier, ready: Callable[[], object]) -> None:
    """Listen at `path` until SIGTERM, SIGINT or SIGHUP.

    Raises AddressInUse if another wizard listens there; OutputError if no socket can be made there; BusError if
    somebody removes its folder.
    """
    ended = asyncio.Event()

    async def converse(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # The wizard's end cancels a conversation: one that ended so would put a traceback into the log.
        broken = (OSError, ValueError, RecursionError, asyncio.IncompleteReadError, asyncio.CancelledError)
        with contextlib.suppress(*broken), contextlib.closing(writer):
            while line := await reader.readline():
                asked = json.loads(line)
                if asked == {"do": "watch"}:
                    await watch(state, reader, writer, ended)
                    return
                answer = await asyncio.to_thread(worker.answer, asked)
                writer.write(json.dumps(answer).encode() + b"\n")
                await writer.drain()

    fix = "name another place with --socket"
    with socket_file(path, socket.SOCK_STREAM, "", str(path), fix, OutputError):
        server = await asyncio.start_unix_server(converse, path, limit=MOST_BYTES)
    loop = asyncio.get_running_loop()
    for number in stops():
        loop.add_signal_handler(number, ended.set)
    try:
        worker.resume()
        ready()
        manager.ready()
        await stay(path, ended, worker.look)
        manager.stopping()
        server.close()
        await asyncio.to_thread(worker.end)
    finally:
        path.unlink(missing_ok=True)
