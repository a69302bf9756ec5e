"""`touchd web` on the wire: who is refused, what it keeps for slow readers, and how it ends."""

from __future__ import annotations

import http.client
import io
import json
import os
import resource
import select
import signal
import socket
import time
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from tests.command_line import touchd
from tests.processes import PATIENCE_S, started
from tests.system.web.bus import RATE_HZ
from tests.system.web.rig import Web, bus, web
from touchd.recording.format import read
from touchd.web.live import PERIOD_S

OWN = "own"
HURRIED = "tests.system.web.hurried"
POSTS = ("/session", "/check/start", "/check/bundle", "/calibrate/do")


@pytest.fixture(scope="module")
def server(address: str) -> Iterator[Web]:
    with web(address) as found:
        yield found


def ask(server: Web, method: str, path: str, **headers: str) -> tuple[int, bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
    try:
        connection.putrequest(method, path, skip_host=True)
        for name, value in ({"Host": f"127.0.0.1:{server.port}"} | headers).items():
            connection.putheader(name, value)
        connection.endheaders()
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def live(server: Web, origin: str | None = OWN, max_queue: int = 16) -> ClientConnection:
    """Open the WebSocket, from the page's own origin unless another is named."""
    said = f"http://127.0.0.1:{server.port}" if origin == OWN else origin
    return connect(
        f"ws://127.0.0.1:{server.port}/live", origin=None if said is None else Origin(said), max_queue=max_queue,
        open_timeout=PATIENCE_S, compression=None, legacy=True,
    )  # fmt: skip


def end_of(socket: ClientConnection, most: int) -> int | None:
    """Read at most so many messages; return the code with which the server closes, None if it does not."""
    try:
        for _ in range(most):
            socket.recv(timeout=PATIENCE_S)
    except ConnectionClosed as closed:
        return closed.rcvd.code if closed.rcvd else 0
    return None


def read_on(socket: ClientConnection, updates: int, frames: int) -> None:
    """Read until so many updates have come, and so many frames have passed."""
    first = last = None
    while updates > 0 or last is None or first is None or last - first < frames:
        updates -= 1
        for message in json.loads(socket.recv(timeout=PATIENCE_S))["messages"]:
            if message["type"] == "touch":
                last = message["frame"]
                first = first or last


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(path=st.text(st.characters(min_codepoint=33, max_codepoint=126, exclude_characters="#?"), max_size=40))
def test_paths(server: Web, path: str) -> None:
    """No path but the page's own gives anything."""
    known = ("", "index.html", "page.css", "icon.svg", "favicon.ico")
    if path not in known and not path.endswith(".js"):
        assert ask(server, "GET", f"/{path}")[0] in (400, 404, 405)  # 405: what is posted to, as `session`


@pytest.mark.parametrize("path", [
    "/../server.py", "/../guards.py", "/%2e%2e/guards.py", "//etc/passwd", "/..%2f..%2fetc/passwd", "/vendor/",
    "/vendor/../../site.py", "/.%00/", "/texts.js%00.html", "/page.css/..",
])  # fmt: skip
def test_no_way_out(server: Web, path: str) -> None:
    """Nothing beside the page's files can be read."""
    assert ask(server, "GET", path)[0] in (400, 404)


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "localhost:1", "127.0.0.1:8770.evil.example", ""])
def test_rebinding(server: Web, host: str) -> None:
    """A foreign name that points here is answered neither on HTTP nor as a WebSocket."""
    assert ask(server, "GET", "/", Host=host)[0] in (400, 421)
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade |= {"Sec-WebSocket-Key": "x3JJHMbDL1EzLkh9GBhXDw==", "Origin": f"http://127.0.0.1:{server.port}"}
    assert ask(server, "GET", "/live", Host=host, **upgrade)[0] in (400, 403)
    assert ask(server, "POST", "/session", Host=host, **{"Content-Length": "0"})[0] in (400, 421)


@pytest.mark.parametrize("origin", [None, "null", "http://evil.example", "http://127.0.0.1:1", "https://127.0.0.1"])
def test_foreign_page(server: Web, origin: str | None) -> None:
    """A page of another site, and a program without an origin, gets no WebSocket and no POST."""
    with pytest.raises(InvalidStatus) as refused:
        live(server, origin=origin)
    assert refused.value.response.status_code == 403
    said = {} if origin is None else {"Origin": origin}
    for path in POSTS:
        assert ask(server, "POST", path, **{"Content-Length": "0"}, **said)[0] == 403


def test_no_session(server: Web) -> None:
    """From the right page without the token, nothing acts."""
    said = {"Origin": f"http://127.0.0.1:{server.port}", "Content-Length": "0"}
    for path in POSTS[1:]:
        assert ask(server, "POST", path, **said)[0] == 401
    assert ask(server, "POST", "/session", **said)[0] == 403


NAMES = st.sampled_from(["127.0.0.1", "localhost", "[::1]", "0.0.0.0", "127.0.0.1.evil.example", "2130706433", "evil"])
PORTS = st.sampled_from(["", ":80", ":1", ":OWN", ":0OWN", ":OWN.", ":OWN@evil"])
SCHEMES = st.sampled_from(["http://", "https://", "HTTP://", "ws://", "null", "", "file://"])
COOKIES = st.sampled_from(["", "touchd-OWN=", "touchd-OWN=x", 'touchd-OWN="', "touchd-OWN=x; touchd-OWN=y", "=;=,"])


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(
    host=st.builds("".join, st.tuples(NAMES, PORTS)), origin=st.builds("".join, st.tuples(SCHEMES, NAMES, PORTS)),
    cookie=COOKIES, method=st.sampled_from(["POST", "GET", "PUT", "OPTIONS", "DELETE"]),
    path=st.sampled_from([*POSTS, "/live", "/calibrate//do", "/calibrate/do/", "/calibrate/picture/../do", "//live"]),
)  # fmt: skip
def test_strangers(server: Web, host: str, origin: str, cookie: str, method: str, path: str) -> None:
    """No mixture of hosts, origins, cookies, methods and paths acts or listens, but the page's own may listen."""
    host, origin, cookie = (text.replace("OWN", str(server.port)) for text in (host, origin, cookie))
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade |= {"Sec-WebSocket-Key": "x3JJHMbDL1EzLkh9GBhXDw=="}
    said = {"Host": host, "Origin": origin, "Cookie": cookie, "Content-Length": "0"}
    status = ask(server, method, path, **said, **(upgrade if "live" in path else {}))[0]
    own = {f"{name}:{server.port}" for name in ("127.0.0.1", "localhost", "[::1]")}
    if host in own and origin.removeprefix("http://") in own and (method, path) == ("GET", "/live"):
        assert status == 101
    else:
        assert status in (400, 401, 403, 404, 405, 421)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(said=st.text(max_size=200) | st.binary(max_size=200))
def test_noise_on_the_socket(server: Web, said: str | bytes) -> None:
    """Whatever is sent to the WebSocket, the server goes on, and obeys none of it."""
    with live(server) as socket:
        socket.send(said)
        assert end_of(socket, 3) in (None, 1003)
    assert server.process.poll() is None


def test_long_message(server: Web) -> None:
    """A message of more than 4 KiB ends its connection."""
    with live(server) as socket:
        socket.send("x" * 100_000)
        assert end_of(socket, 10_000) is not None


@contextmanager
def sleeper(server: Web) -> Iterator[None]:
    """A browser that reads nothing, and leaves without a word."""
    asleep = live(server, max_queue=1)
    try:
        yield
    finally:
        asleep.socket.close()


def test_slow_reader(tmp_path: Path) -> None:
    """A browser that reads nothing of a minute's frames and updates costs at most 5 MB, and holds up nobody."""
    where = f"ipc://{tmp_path}/bus"
    with bus(where, "hurried"), web(where, module=HURRIED) as server, live(server) as reader:
        with sleeper(server):  # what any such browser costs a busy server once, as queues and arenas, counts as before
            read_on(reader, round(20 / PERIOD_S), 20 * RATE_HZ)
        before = server.memory_bytes()
        with sleeper(server):
            read_on(reader, round(60 / PERIOD_S), 60 * RATE_HZ)
            assert server.memory_bytes() - before < 5_000_000


def test_half_requests(tmp_path: Path) -> None:
    """Whoever opens connections and says nothing on them, or no body, locks nobody out."""
    with web(f"ipc://{tmp_path}/bus", module=HURRIED) as server, ExitStack() as held:
        own = f"127.0.0.1:{server.port}"
        head = f"POST /session HTTP/1.1\r\nHost: {own}\r\nOrigin: http://{own}\r\nContent-Length: 60000\r\n\r\n"
        for number in range(130):
            one = held.enter_context(socket.create_connection(("127.0.0.1", server.port), PATIENCE_S))
            one.sendall(b"G" if number % 2 else head.encode())
        until_s = time.monotonic() + PATIENCE_S
        while ask(server, "GET", "/")[0] != 200:
            assert time.monotonic() < until_s
            time.sleep(0.1)


def test_no_traceback(address: str) -> None:
    """Text that is no UTF-8 ends the WebSocket with one line in the log."""
    with web(address) as server:
        with live(server) as reader:
            reader.socket.sendall(b"\x81\x82\0\0\0\0\xff\xfe")
            assert end_of(reader, 10_000) is not None
        server.process.send_signal(signal.SIGTERM)
        _, err = server.process.communicate(timeout=PATIENCE_S)
    assert [json.loads(line)["reason"] for line in err.splitlines()] == ["Invalid UTF-8 sequence received from client"]


def test_malformed_requests_do_not_fill_the_log(address: str) -> None:
    """They are answered, and told at most once a second."""
    with web(address) as server:
        began_s = time.monotonic()
        for _ in range(100):
            with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as one:
                one.sendall(b"GET\0\r\n\r\n")
                assert b" 400 " in one.recv(4096)
        took_s = time.monotonic() - began_s
        server.process.send_signal(signal.SIGTERM)
        _, err = server.process.communicate(timeout=PATIENCE_S)
    lines = [json.loads(line) for line in err.splitlines()]
    assert {(line["event"], line["reason"]) for line in lines} == {("request refused", "Invalid HTTP request received")}
    assert len(lines) <= took_s + 1


def test_no_descriptor_is_left(address: str) -> None:
    """Whoever opens more connections than there are descriptors does not fill the log, and locks nobody out."""
    with web(address) as server, ExitStack() as held:
        number = server.process.pid
        few, many = resource.prlimit(number, resource.RLIMIT_NOFILE)
        resource.prlimit(number, resource.RLIMIT_NOFILE, (len(os.listdir(f"/proc/{number}/fd")), many))
        for _ in range(10):
            held.enter_context(socket.create_connection(("127.0.0.1", server.port), PATIENCE_S))
        assert server.process.stderr is not None
        lines = [server.process.stderr.readline()]
        resource.prlimit(number, resource.RLIMIT_NOFILE, (few, many))
        assert ask(server, "GET", "/")[0] == 200
        server.process.send_signal(signal.SIGTERM)
        lines += server.process.communicate(timeout=PATIENCE_S)[1].splitlines()
    assert [json.loads(line)["reason"] for line in lines] == ["no connection can be taken (Too many open files)"]


def test_flood(address: str) -> None:
    """A flood of connections is closed before it has taken the descriptors, some of which the bus needs."""
    with web(address) as server, ExitStack() as held:
        poll = select.poll()
        for _ in range(500):
            one = held.enter_context(socket.create_connection(("127.0.0.1", server.port), PATIENCE_S))
            one.sendall(b"G")
            poll.register(one, select.POLLIN)
        until_s = time.monotonic() + PATIENCE_S
        while len(poll.poll(0)) < 150:
            assert time.monotonic() < until_s
            assert len(os.listdir(f"/proc/{server.process.pid}/fd")) < 450
            time.sleep(0.01)  # the server takes them one after the other
        assert server.process.poll() is None


def test_end(address: str) -> None:
    """SIGTERM ends it at once, with a page that is connected, and with status 0; its output tells no touch."""
    with web(address) as server, live(server) as reader:
        reader.recv(timeout=PATIENCE_S)
        server.process.send_signal(signal.SIGTERM)
        out, err = server.process.communicate(timeout=PATIENCE_S)
    assert server.process.returncode == 0
    assert (out, err) == ("", "")


@pytest.mark.parametrize(("where", "code"), [("0.0.0.0:8770", 42), ("nonsense", 10), ("127.0.0.1:99999", 10)])
def test_bind(where: str, code: int) -> None:
    """It serves on loopback alone."""
    ended = touchd("web", "--bind", where)
    assert ended.code == code
    assert "--bind" in ended.err


def test_taken(server: Web) -> None:
    """An address in use is said so."""
    ended = touchd("web", "--bind", f"127.0.0.1:{server.port}")
    assert ended.code == 41


def test_no_recording() -> None:
    """A recording that is not there is said so at the start."""
    assert touchd("web", "--replay", "nowhere.npz").code == 21


def test_bundle(tmp_path: Path) -> None:
    """The support bundle says how the plate is and keeps secrets: no key, no token, and frames only if asked for."""
    secret = tmp_path / "hidden" / "server.key_secret"
    key = {"TOUCHD_BUS__CURVE_SECRET_KEY": str(secret)}
    where = f"ipc://{tmp_path}/bus"
    frames = ("--replay", "touchd/demo/session.npz", "--loop", "--bind", where)
    control = {"TOUCHD_CONTROL__SOCKET": f"{tmp_path}/control"}
    journal = tmp_path / "journalctl"
    path = {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    with started(*frames, **control), web(where, port=0, **control, **key, **path) as server:
        journal.write_text(f"#!/bin/sh\necho first line\necho touchd: open {server.url}\necho last line\n")
        journal.chmod(0o755)
        with live(server) as socket:
            while '"state":"streaming"' not in str(socket.recv(timeout=PATIENCE_S)):
                pass
        token = server.url.partition("#token=")[2]
        post = {"Origin": server.base.rstrip("/")}
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=PATIENCE_S)
        connection.request("POST", "/session", token, post)
        given = connection.getresponse()
        given.read()
        post["Cookie"] = str(given.headers["Set-Cookie"]).partition(";")[0]
        found = {}
        for wish in ("", "recording"):
            connection.request("POST", "/check/bundle", wish, post)
            answer = connection.getresponse()
            found[wish] = zipfile.ZipFile(io.BytesIO(answer.read()))
            assert answer.status == 200
        connection.close()
    names = {name.rpartition("/")[2] for name in found[""].namelist()}
    assert names == {"about.txt", "config.toml", "health.jsonl", "plate.json", "check.json", "log.txt"}
    text = "".join(found[""].read(name).decode() for name in found[""].namelist())
    assert "[device]" in text
    assert '"state":"streaming"' in text
    assert str(secret) not in text
    assert token not in text
    assert found[""].read("touchd-support/log.txt").decode().splitlines() == [
        "first line", f"touchd: open {server.base}#token=...", "last line",
    ]  # fmt: skip
    assert '"phase":' not in text, "no finger"
    recording = tmp_path / "recording.npz"
    recording.write_bytes(found["recording"].read("touchd-support/recording.npz"))
    assert len(read(recording).frames) > 100
