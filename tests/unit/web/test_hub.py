"""What browsers are handed, and what they are not."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any, NoReturn

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st
from starlette.routing import WebSocketRoute
from starlette.types import Message
from starlette.websockets import WebSocket
from structlog.testing import capture_logs

from tests.unit.bridges.events import contact, health, touch
from touchd.client import Subscriber
from touchd.config.schema import BusSettings
from touchd.errors import BusError
from touchd.event import Event, PlateEvent, PlateKey, SpectrumEvent, TruthEvent, encode
from touchd.sinks import stream
from touchd.sinks.zeromq import ZeromqSink
from touchd.web.guards import Access
from touchd.web.hub import MOST_CLIENTS, TOPICS, Client, Hub
from touchd.web.live import _asked, batch, routes
from touchd.web.site import Site

KEY = PlateKey("7", 0.0, 0.0, 10.0, 10.0)


def plate(*keys: PlateKey) -> PlateEvent:
    return PlateEvent("p", 1, 1, "", 200.0, 100.0, 125.0, 4, 500, 5e5, (5e4, 1e5), "usb", keys=list(keys))


def take(hub: Hub, event: Event) -> None:
    hub._take([event])


def handed(hub: Hub, client: Client) -> list[dict[str, Any]]:
    said: dict[str, Any] = json.loads(batch(hub, client))
    found: list[dict[str, Any]] = said["messages"]
    return found


@pytest.fixture
def hub() -> Hub:
    return Hub("ipc:///nowhere")


def joined(hub: Hub) -> Client:
    client = hub.join()
    assert client is not None
    return client


def test_newest_wins(hub: Hub) -> None:
    """A page that was slow gets the newest message of each topic, once."""
    client = joined(hub)
    take(hub, plate())
    for n in range(1000):
        take(hub, touch(contact(n, "move", n, 0.0), seq=n))
    said = json.loads(batch(hub, client))
    assert [message["type"] for message in said["messages"]] == ["plate", "touch"]
    assert said["messages"][1]["seq"] == 999
    assert json.loads(batch(hub, client))["messages"] == []


def test_updates(hub: Hub) -> None:
    """A page gets at most 60 updates a second, however much is said."""
    sent_ns: list[int] = []
    first = iter([{"type": "websocket.connect"}])

    async def receive() -> Message:
        for said in first:
            return said
        while len(sent_ns) < 2 or sent_ns[-1] - sent_ns[0] < 500_000_000:
            hub.publish("calibrate", {})
            await asyncio.sleep(0)
        return {"type": "websocket.disconnect"}

    async def send(message: Message) -> None:
        sent_ns.extend(ns for ns in [json.loads(message.get("text", "{}")).get("now_ns")] if ns)

    [route] = routes(Site(Access(8770, (), watched=False), hub))
    assert isinstance(route, WebSocketRoute)
    asyncio.run(route.endpoint(WebSocket({"type": "websocket", "headers": []}, receive, send)))
    assert len(sent_ns) - 1 <= 61e-9 * (sent_ns[-1] - sent_ns[0])


def test_keypad_is_private(hub: Hub) -> None:
    """In keypad mode no touch, key or spectrum leaves, to browsers there and to come; its keys' places may."""
    client = joined(hub)
    hub.ask(client, frozenset())
    client.asked = frozenset({"spectrum"})
    take(hub, touch(contact(1, "down", 5.0, 5.0)))  # before the daemon has said what it is
    take(hub, plate(KEY))
    take(hub, touch(contact(1, "move", 5.0, 5.0)))
    take(hub, SpectrumEvent("p", 1, 1, "", 1, [1.0]))
    later = joined(hub)
    for one in (client, later):
        assert [message["type"] for message in handed(hub, one)] == ["plate"]


def test_keypad_by_name() -> None:
    """Asked for by name, they are shown."""
    hub = Hub("ipc:///nowhere", shows_keys=True)
    client = joined(hub)
    take(hub, plate(KEY))
    take(hub, touch(contact(1, "move", 5.0, 5.0)))
    assert [message["type"] for message in handed(hub, client)] == ["plate", "touch"]


def test_turned_into_a_keypad(hub: Hub) -> None:
    """A daemon that becomes a keypad shows nothing more, not even what came before."""
    waiting = joined(hub)
    take(hub, plate())
    take(hub, touch(contact(1, "move", 5.0, 5.0)))
    take(hub, plate(KEY))
    for client in (waiting, joined(hub)):
        assert [message["type"] for message in handed(hub, client)] == ["plate"]
    take(hub, plate())
    take(hub, health("starting"))
    take(hub, touch(contact(2, "move", 5.0, 5.0)))  # of a daemon that has not said yet what it is
    assert "touch" not in [message["type"] for message in handed(hub, waiting)]


@asynccontextmanager
async def started(address: str) -> AsyncIterator[tuple[Hub, zmq.Socket[bytes]]]:
    """A hub that listens to a daemon's socket, and stops at the end."""
    hub = Hub(address)
    with zmq.Context() as context, context.socket(zmq.XPUB) as daemon:
        daemon.bind(address)
        hub.start()
        for _ in TOPICS:
            await asyncio.to_thread(daemon.recv)
        yield hub, daemon
        await asyncio.to_thread(hub.stop)


def test_a_daemon_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a daemon that was killed with a finger down, a page that opens later shows neither finger nor truth."""
    monkeypatch.setattr(stream, "SILENCE_NS", 0)

    async def told() -> list[dict[str, Any]]:
        async with started(f"ipc://{tmp_path}/bus") as (hub, daemon):
            for event in (plate(), touch(contact(1, "down", 5.0, 5.0)), TruthEvent("p", 1, 1, "", 1, [(5.0, 5.0)])):
                daemon.send_multipart([event.type.encode(), encode(event)])
            page = joined(hub)
            await page.wake.wait()
            while b'"contacts":[]' not in (hub.last("touch") or b""):
                await asyncio.sleep(0.01)
        return handed(hub, joined(hub))

    messages = asyncio.run(asyncio.wait_for(told(), 60))
    assert {message["type"]: message.get("contacts") for message in messages} == {"plate": None, "touch": []}


def test_a_lift_is_no_sign_of_life(hub: Hub) -> None:
    """A finger that the subscription lifts does not shorten the silence that pages tell."""
    take(hub, touch(contact(1, "down", 5.0, 5.0)))
    heard_s = hub.heard_s
    take(hub, touch())
    assert hub.heard_s == heard_s


def test_a_daemon_that_is_newer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Messages that are not understood are said to be so, and do not fill the log for as long as they come."""
    monkeypatch.setattr("touchd.web.hub._AGAIN_S", 0.0)
    monkeypatch.setattr("touchd.sinks.throttle.PERIOD_S", 60.0)

    async def hear() -> None:
        async with started(f"ipc://{tmp_path}/bus") as (hub, daemon):
            for _ in range(10):
                daemon.send_multipart([b"health", b'{"v":2}'])
            daemon.send_multipart([b"health", encode(health("streaming"))])
            while hub.silent_s is None:
                await asyncio.sleep(0.01)

    with capture_logs() as log:
        asyncio.run(asyncio.wait_for(hear(), 60))
    (line,) = log
    assert "of version 2" in line["error"]


def test_a_bus_that_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an address that can be used no more the log says why, without a traceback."""

    def refuse(*_arguments: object, **_options: object) -> NoReturn:
        raise BusError("this user may not use the socket", "ipc:///nowhere", "join its group")

    async def ask() -> None:
        hub = Hub("ipc:///nowhere")
        hub.start()
        monkeypatch.setattr("touchd.web.hub.Subscriber", refuse)
        hub.ask(joined(hub), frozenset({"spectrum"}))
        hub.stop()

    with capture_logs() as log:
        asyncio.run(ask())
    assert [line["event"] for line in log] == ["not listened to, and tried again"]


def test_a_page_that_cannot_decide(tmp_path: Path) -> None:
    """However often a page asks for the spectrum, one thread listens to it, and in the end as the page wants."""

    async def ask() -> list[int]:
        hub = Hub(f"ipc://{tmp_path}/bus")
        hub.start()
        page, listening = joined(hub), []
        for number in range(101):
            hub.ask(page, frozenset({"spectrum"} if number % 2 == 0 else ()))
            listening.append(sum(thread.name == "bus" for thread in threading.enumerate()))
            await asyncio.sleep(0)
        with closing(ZeromqSink(BusSettings(bind=(f"ipc://{tmp_path}/bus",)))) as sink:
            while not sink.wants("spectrum"):
                sink.poll()
                await asyncio.sleep(0.01)
            hub.ask(page, frozenset())
            while sink.wants("spectrum"):
                sink.poll()
                await asyncio.sleep(0.01)
        await asyncio.to_thread(hub.stop)
        return listening

    before = sum(thread.name == "bus" for thread in threading.enumerate())
    assert max(asyncio.run(asyncio.wait_for(ask(), 60))) <= before + 2


def test_a_bus_that_is_closed_for_a_moment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A page's server that comes while the daemon makes its socket hears the daemon all the same."""
    address, really, refused = f"ipc://{tmp_path}/bus", Subscriber, threading.Event()

    def refuse_once(*arguments: Any, **options: Any) -> Subscriber[Event]:
        if not refused.is_set():
            refused.set()
            raise BusError("this user may not use the socket", address, "join its group")
        return really(*arguments, **options)

    async def hear() -> None:
        hub = Hub(address)
        monkeypatch.setattr("touchd.web.hub.Subscriber", refuse_once)
        hub.start()
        with closing(ZeromqSink(BusSettings(bind=(address,)))) as sink:
            sink.publish(health("streaming"), 0)
            while hub.silent_s is None:
                sink.poll()
                await asyncio.sleep(0.01)
        await asyncio.to_thread(hub.stop)

    asyncio.run(asyncio.wait_for(hear(), 60))
    assert refused.is_set()


def test_one_connection(tmp_path: Path) -> None:
    """A page's server that starts is one subscriber to the daemon, which has nothing to warn of."""
    address = f"ipc://{tmp_path}/bus"

    async def hear(sink: ZeromqSink) -> None:
        hub = Hub(address)
        hub.open()
        hub.start()
        while hub.silent_s is None:
            sink.poll()
            await asyncio.sleep(0.01)
        await asyncio.to_thread(hub.stop)

    with capture_logs() as log, closing(ZeromqSink(BusSettings(bind=(address,)))) as sink:
        sink.publish(health("streaming"), 0)
        asyncio.run(asyncio.wait_for(hear(sink), 60))
        sink.poll()
    assert log == []


def test_address_that_cannot_be_used() -> None:
    """It is refused before the server starts; a hub that never started is closed all the same."""
    hub = Hub("tcp://nowhere")
    with pytest.raises(BusError, match="not an address"):
        hub.open()
    hub.stop()
    hub = Hub("ipc:///nowhere")
    hub.open()
    hub.stop()
    hub.stop()


def test_most_clients(hub: Hub) -> None:
    """Browsers are few: one more is refused, until one leaves."""
    clients = [joined(hub) for _ in range(MOST_CLIENTS)]
    assert hub.join() is None
    hub.leave(clients[0])
    assert hub.join() is not None


def test_history(hub: Hub) -> None:
    """A page that opens gets the last minutes of health, and no more than that."""
    for n in range(500):
        take(hub, health("streaming", seq=n))
    found = {message["type"]: message for message in handed(hub, joined(hub))}
    assert len(found["history"]["health"]) == 300
    assert found["history"]["health"][-1]["seq"] == 499


def test_own_messages(hub: Hub) -> None:
    """A view's own state reaches pages there and to come."""
    client = joined(hub)
    hub.publish("check", {"running": True})
    assert handed(hub, client) == handed(hub, joined(hub)) == [{"type": "check", "running": True}]


json_values = st.recursive(
    st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8) | st.just("topics"), inner, max_size=3)
    ),
)


@given(text=st.text(max_size=60) | json_values.map(json.dumps))
def test_what_a_page_says(text: str) -> None:
    """A page can ask for topics and for nothing else, whatever it sends."""
    topics = _asked(text)
    if topics is not None:
        said = json.loads(text)
        assert topics == frozenset(said["topics"])
        client, hub = Client(), Hub("ipc:///nowhere")
        vars(hub)["_listen"] = lambda _topics, _stopped: None
        hub.ask(client, topics)
        assert client.asked <= {"spectrum"}


def test_deep_message() -> None:
    """A message nested too deep for the parser is one that is not understood."""
    assert _asked("[" * 100_000) is None


def test_wakes() -> None:
    """A page's sender sleeps until there is something to send."""

    async def run() -> tuple[bool, bool]:
        client = Client()
        before = client.wake.is_set()
        client.offer("touch", b"{}")
        return before, client.wake.is_set()

    assert asyncio.run(run()) == (False, True)
