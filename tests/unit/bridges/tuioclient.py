"""A TUIO 1.1 client with the rules of the reference one, TUIO11_CPP, and stricter about what it takes."""

from __future__ import annotations

from pythonosc.osc_bundle import OscBundle

from touchd.bridges.tuio import BLOB, CURSOR

LATE_FRAMES = 100
ARGUMENTS = {CURSOR: 5, BLOB: 11}
Row = tuple[float, ...]


class Client:
    """Keeps the cursors or blobs of one source."""

    def __init__(self, profile: str = CURSOR) -> None:
        self.profile = profile
        self.rows: dict[int, Row] = {}
        self.frame = 0
        self.late = 0
        self.boundaries = 0
        self.added: list[int] = []
        self.removed: list[int] = []

    def take(self, packet: bytes) -> None:
        """Take one datagram."""
        assert len(packet) <= 1472
        bundle = OscBundle(packet)
        messages = [(message.address, list(message.params)) for message in bundle]
        if messages[0][0] != self.profile:
            return
        assert {address for address, _ in messages} == {self.profile}
        commands = [params[0] for _, params in messages]
        assert commands == ["source", "alive", *["set"] * (len(commands) - 3), "fseq"], "in this order"
        source, alive = messages[0][1][1], messages[1][1][1:]
        assert "@" in source
        rows = {}
        for _, (_, session, *row) in messages[2:-1]:
            assert len(row) == ARGUMENTS[self.profile]
            assert all(type(value) is float for value in row)
            assert session in alive
            assert all(0.0 <= share <= 1.0 for share in row[:2])
            rows[session] = tuple(row)
        (fseq,) = messages[-1][1][1:]
        if fseq > 0:
            if 0 < self.frame - fseq <= LATE_FRAMES:
                self.late += 1
                return
            self.frame = fseq
        else:
            assert fseq == -1
            assert not alive
            self.boundaries += 1
        self.removed += [session for session in self.rows if session not in alive]
        self.added += [session for session in rows if session not in self.rows]
        self.rows = {s: rows.get(s, self.rows.get(s, ())) for s in alive}
